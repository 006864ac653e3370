"""What a page is told of a cloud before it sees a point."""

from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyproj

from flightlog.errors import GeodesyError
from groundproc.viewer.shades import Shade

Array = npt.NDArray[np.float64]

_SIGNS: Final = {"metre": "m", "foot": "ft", "US survey foot": "US ft"}
_HEIGHTS: Final = (1.0, 99.0)
"""Percentiles between which the colours of heights span at first."""
_CORE: Final = (0.5, 99.5)
"""Percentiles of each axis between which the camera looks first: single points far away would make all others small."""


def origin_of(low_m: Array, high_m: Array) -> Array:
    """A round place in the middle, shape (3,), so that coordinates from there keep their millimetres in single precision."""
    return np.asarray(np.floor((low_m + high_m) / 20.0) * 10.0)


def units_of(crs: pyproj.CRS | None) -> tuple[str, str]:
    """Units of coordinates in plan and of heights, as signs; "units" where the file does not say.

    Raises
    ------
    GeodesyError
        The coordinates are angles, in which nothing can be measured.
    """
    if crs is None:
        return "units", "units"
    names = [axis.unit_name for axis in crs.axis_info]
    if crs.is_geographic or any("degree" in name for name in names[:2]):
        raise GeodesyError(f"coordinates in {crs.name} are angles, expected a projected CRS")
    signs = [_SIGNS.get(name, name) for name in names]
    return signs[0], signs[2] if len(signs) > 2 else signs[0]


def scene(
    origin_m: Array,
    limits_m: tuple[Array, Array],
    sample_m: Array,
    shades: Sequence[Shade],
    paths: Iterable[Array],
    spacing_m: float,
    crs: pyproj.CRS | None,
) -> dict[str, Any]:
    """Plain values for `Viewer`.

    Parameters
    ----------
    origin_m : ndarray, shape (3,)
    limits_m : ndarray, ndarray, shape (3,)
        Least and largest coordinates.
    sample_m : ndarray, shape (n, 3)
        Some points: between which heights colours span, and what the camera looks at first.
    shades : sequence of Shade
    paths : iterable of ndarray, shape (k, 3)
        Pieces of the flight's path.
    spacing_m : float
        Between points: their size.
    crs : pyproj.CRS, optional

    Raises
    ------
    GeodesyError
        The coordinates are angles.
    """
    low, high = np.percentile(sample_m[:, 2], _HEIGHTS)
    core = np.percentile(sample_m, _CORE, axis=0) - origin_m
    return {
        "origin": _rounded(origin_m),
        "low": _rounded(limits_m[0] - origin_m),
        "high": _rounded(limits_m[1] - origin_m),
        "core": [_rounded(core[0]), _rounded(core[1])],
        "heights": _rounded(np.array([low, high]) - origin_m[2]),
        "shades": [shade.plain() for shade in shades],
        "paths": [[_rounded(place) for place in path - origin_m] for path in paths],
        "spacing": round(spacing_m, 4),
        "crs": "" if crs is None else crs.name,
        "units": list(units_of(crs)),
    }


def _rounded(values: Array) -> list[float]:
    """Millimetres."""
    return [round(float(value), 3) for value in values]
