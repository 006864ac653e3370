"""Contours as files: in each format what its users expect."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pyproj
import shapely

from groundproc.vectors.contours import Contour
from groundproc.vectors.dxf import Label, Line, write_dxf
from groundproc.vectors.features import DRIVERS, Features, write_features

ENDINGS: Final = (*DRIVERS, ".dxf")
_LABEL_M: Final = 0.5
"""Size of the text; a label every so many of its lengths along the line would clutter, so each index contour has one."""
_LEAST_LABELLED_M: Final = 10.0


def write_contours(path: Path, ending: str, lines: Sequence[Contour], crs: pyproj.CRS | None) -> None:
    """Write contours: with height and rank as attributes, or on layers CONTOUR and CONTOUR_INDEX with labels on the latter.

    Raises
    ------
    SourceError
        It cannot be written.
    """
    if ending == ".dxf":
        drawn = [Line(each.places_m, "CONTOUR_INDEX" if each.index else "CONTOUR", each.height_m) for each in lines]
        labels = []
        for each in lines:
            if each.index and each.length_m >= _LEAST_LABELLED_M:
                place, turn = each.label()
                labels.append(
                    Label(f"{each.height_m:g}", np.append(place, each.height_m), turn, _LABEL_M, "CONTOUR_LABEL")
                )
        write_dxf(path, drawn, labels)
        return
    geometry = np.array(
        [
            shapely.LineString(np.column_stack([each.places_m, np.full(len(each.places_m), each.height_m)]))
            for each in lines
        ],
        object,
    )
    columns = {
        "height_m": np.array([each.height_m for each in lines]),
        "index": np.array([each.index for each in lines]),
        "length_m": np.array([each.length_m for each in lines]),
    }
    write_features(path, Features(geometry, columns, crs), "LineString Z", "contours", ending)
