"""DXF: lines at heights, labels, points and triangles, on layers."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

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


_UNITS: Final = {1.0: 6, 0.3048: 2, 0.304801: 21}
"""$INSUNITS of the format, by metres in a unit to a millionth: metres, feet, feet of the US survey; 0 is none that is said."""


def write_dxf(path: Path, lines: Sequence[Line], labels: Sequence[Label] = (), unit_m: float = 1.0) -> None:
    """Write a drawing, in place (the caller writes aside).

    Parameters
    ----------
    path : Path
    lines : sequence of Line
    labels : sequence of Label
    unit_m : float
        What their numbers count [m].

    Raises
    ------
    SourceError
        It cannot be written.
    """
    from ezdxf.enums import TextEntityAlignment

    drawing, space = _new({each.layer for each in lines} | {each.layer for each in labels}, unit_m)
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
    _write(path, drawing)


def write_faces(path: Path, places: Array, triangles: npt.NDArray[np.int64], layer: str, unit_m: float = 1.0) -> None:
    """Write triangles as 3D faces, in place (the caller writes aside).

    Parameters
    ----------
    path : Path
    places : ndarray, shape (n, 3)
    triangles : ndarray of int64, shape (m, 3)
        Rows of `places`.
    layer : str
    unit_m : float
        What the places count [m].

    Raises
    ------
    SourceError
        It cannot be written.
    """
    drawing, space = _new({layer}, unit_m)
    for corners in places[triangles].tolist():
        space.add_3dface(corners, dxfattribs={"layer": layer})
    _write(path, drawing)


def write_places(path: Path, places_m: Array, layers: Sequence[str]) -> None:
    """Write points, shape (n, 3), each on a layer, in place (the caller writes aside).

    Raises
    ------
    SourceError
        It cannot be written.
    """
    drawing, space = _new(set(layers))
    for place, layer in zip(places_m.tolist(), layers, strict=True):
        space.add_point(place, dxfattribs={"layer": layer})
    _write(path, drawing)


def _new(layers: Iterable[str], unit_m: float = 1.0) -> tuple[Any, Any]:
    """An empty drawing, and where its entities go."""
    from ezdxf.document import Drawing

    drawing = Drawing.new("R2010")
    drawing.units = _UNITS.get(round(unit_m, 6), 0)
    for layer in sorted(layers):
        drawing.layers.add(layer)
    return drawing, drawing.modelspace()


def _write(path: Path, drawing: Any) -> None:
    try:
        with path.open("w", encoding="utf-8") as file:
            drawing.write(file)
    except OSError as error:
        raise SourceError(f"{path}: cannot be written ({error.strerror or error})") from None
