"""DXF: lines at heights and labels, on layers."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from flightlog.errors import SourceError

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Line:
    """A line.

    Attributes
    ----------
    places_m : ndarray, shape (n, 2) at one height, or (n, 3)
    layer : str
    height_m : float
        Of a line of two coordinates.
    """

    places_m: Array
    layer: str
    height_m: float = 0.0


@dataclass(frozen=True, slots=True)
class Label:
    """A text at a place, turned so many degrees counter-clockwise."""

    text: str
    place_m: Array
    turn_deg: float
    size_m: float
    layer: str


def write_dxf(path: Path, lines: Sequence[Line], labels: Sequence[Label] = ()) -> None:
    """Write a drawing in metres, in place (the caller writes aside).

    Raises
    ------
    SourceError
        It cannot be written.
    """
    from ezdxf import units
    from ezdxf.document import Drawing
    from ezdxf.enums import TextEntityAlignment

    drawing = Drawing.new("R2010")
    drawing.units = units.M
    space: Any = drawing.modelspace()
    for layer in sorted({each.layer for each in lines} | {each.layer for each in labels}):
        drawing.layers.add(layer)
    for line in lines:
        attributes = {"layer": line.layer}
        if line.places_m.shape[1] == 2:
            space.add_lwpolyline(line.places_m.tolist(), dxfattribs=attributes | {"elevation": line.height_m})
        else:
            space.add_polyline3d(line.places_m.tolist(), dxfattribs=attributes)
    for label in labels:
        text = space.add_text(
            label.text, height=label.size_m, rotation=label.turn_deg, dxfattribs={"layer": label.layer}
        )
        text.set_placement(tuple(label.place_m.tolist()), align=TextEntityAlignment.MIDDLE_CENTER)
    try:
        with path.open("w", encoding="utf-8") as file:
            drawing.write(file)
    except OSError as error:
        raise SourceError(f"{path}: cannot be written ({error.strerror or error})") from None
