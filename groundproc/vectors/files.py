"""Contours as files: in each format what its users expect."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pyproj
import shapely

from groundproc.cloud.metres import Metres
from groundproc.vectors.contours import Contour
from groundproc.vectors.dxf import Label, Line, write_dxf
from groundproc.vectors.features import DRIVERS, Features, write_features

ENDINGS: Final = (*DRIVERS, ".dxf")
_LABEL_M: Final = 0.5
"""Size of the text; a label every so many of its lengths along the line would clutter, so each index contour has one."""
_LEAST_LABELLED_M: Final = 10.0


def write_contours(path: Path, ending: str, lines: Sequence[Contour], crs: pyproj.CRS | None, unit: Metres) -> None:
    """Write contours: with height and rank as attributes, or on layers CONTOUR and CONTOUR_INDEX with labels on the latter.

    Lines are in the units of the CRS; `unit` says which these are.

    Raises
    ------
    SourceError
        It cannot be written.
    """
    if ending == ".dxf":
        drawn = [Line(each.places, "CONTOUR_INDEX" if each.index else "CONTOUR", each.height) for each in lines]
        labels = []
        for each in lines:
            if each.index and each.length * unit.across >= _LEAST_LABELLED_M:
                place, turn = each.label()
                labels.append(
                    Label(
                        f"{each.height:g}", np.append(place, each.height), turn, _LABEL_M / unit.across, "CONTOUR_LABEL"
                    )
                )
        write_dxf(path, drawn, labels, unit.across)
        return
    geometry = np.array(
        [shapely.LineString(np.column_stack([each.places, np.full(len(each.places), each.height)])) for each in lines],
        object,
    )
    columns = {
        f"height_{unit.height_word}": np.array([each.height for each in lines]),
        "index": np.array([each.index for each in lines]),
        "length_m": np.array([each.length * unit.across for each in lines]),
    }
    write_features(path, Features(geometry, columns, crs), "LineString Z", "contours", ending)
