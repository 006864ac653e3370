"""From one coordinate reference system to another with national heights and epochs, and nothing in silence.

PROJ does without a grid that it does not have, and takes a ballpark where it knows no way: metres off, unsaid. Here both are refused.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import pyproj
from pyproj.crs import ProjectedCRS
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import TransformerGroup

from flightlog.errors import GeodesyError

Array = npt.NDArray[np.float64]
Move = Callable[[Array], Array]

DEBIAN: Final = Path("/usr/share/proj")
"""Where Debian's package proj-data keeps grids."""
_ELLIPSOID: Final = "+ELLIPSOID"
_OF_TIME: Final = ("t_epoch", "deformation")
_EARTH_RADIUS_M: Final = 6_371_000.0


@dataclass(frozen=True, slots=True)
class Operation:
    """A way from one CRS to another.

    Attributes
    ----------
    name : str
        PROJ's own words.
    accuracy_m : float or None
        As EPSG has it.
    grids : tuple of str
        Files that it uses.
    move : callable
        Places, shape (n, 3), to places.
    """

    name: str
    accuracy_m: float | None
    grids: tuple[str, ...]
    move: Move


def crs_of(text: str) -> pyproj.CRS:
    """A CRS by EPSG codes: 25833, EPSG:25833, or with heights 25833+7837 or 25833+ellipsoid.

    32619@9990 is the projection of 32619 in the frame 9990 (ITRF2020), for which EPSG has no code.

    Raises
    ------
    GeodesyError
        There is none.
    """
    codes = text.upper().replace("EPSG:", "").strip()
    if codes.endswith(_ELLIPSOID):
        return crs_of(codes.removesuffix(_ELLIPSOID)).to_3d()
    if "@" in codes:
        return _in_frame(*codes.split("@", 1))
    if not all(part.isdigit() for part in codes.split("+")):
        raise GeodesyError(f"CRS {text!r}: expected EPSG codes such as 25833, or with heights 25833+7837")
    try:
        return pyproj.CRS.from_user_input(f"EPSG:{codes}")
    except CRSError:
        raise GeodesyError(f"CRS {text!r}: no such coordinate reference system") from None


def _in_frame(projected: str, frame: str) -> pyproj.CRS:
    """A projection in another frame."""
    crs, base = crs_of(projected), crs_of(frame)
    conversion = crs.coordinate_operation
    if not crs.is_projected or conversion is None or not base.is_geographic or len(base.axis_info) != 2:
        raise GeodesyError(
            f"CRS {projected}@{frame}: expected a projected CRS and a geographic one in two axes, such as 32619@9990"
        )
    return ProjectedCRS(conversion=conversion, geodetic_crs=base, name=f"{crs.name} in {base.name}")


def heights_of(crs: pyproj.CRS) -> pyproj.CRS | None:
    """The vertical part of a CRS, where it has one."""
    return crs.sub_crs_list[1] if crs.is_compound else None


def operation(source: pyproj.CRS, target: pyproj.CRS, epoch: float | None, grids: Path | None = None) -> Operation:
    """The best way from one CRS to another.

    Parameters
    ----------
    source, target : pyproj.CRS
        Both with heights, or neither.
    epoch : float or None
        At which the coordinates hold, as a year with its fraction.
    grids : Path, optional
        Folder with more grid files.

    Raises
    ------
    GeodesyError
        There is none, a grid is missing, or an epoch is needed and not given, or given and not needed.
    """
    for folder in (DEBIAN, grids):
        if folder is not None and folder.is_dir():
            pyproj.datadir.append_data_dir(str(folder))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        group = TransformerGroup(source, target, always_xy=True, allow_ballpark=False)
    what = f"{source.name} to {target.name}"
    if not group.transformers or not group.best_available:
        missing = sorted(
            {
                g.short_name
                for way in group.unavailable_operations
                for op in way.operations
                for g in op.grids
                if not g.available
            }
        )
        if not missing:
            raise GeodesyError(f"{what}: PROJ knows no way from one to the other")
        raise GeodesyError(
            f"{what}: the grid is not here (one of {', '.join(missing[:4])}); install Debian's package proj-data, or say with --grids DIR "
            "where it is"
        )
    best = group.transformers[0]
    moving = any(word in best.definition for word in _OF_TIME)
    if moving and epoch is None:
        raise GeodesyError(
            f"{what}: the plates have moved in between; say with --epoch at which year the coordinates hold, such as 2025.4"
        )
    if epoch is not None and not moving:
        raise GeodesyError(
            f"{what}: knows no epoch, so --epoch {epoch:g} would change nothing; say the frame of the coordinates with --from, such as "
            "32633@9990 in ITRF2020"
        )
    used = tuple(sorted({grid.short_name for op in best.operations or () for grid in op.grids}))
    return Operation(best.description, best.accuracy if best.accuracy >= 0 else None, used, _mover(best, epoch, what))


def _mover(transformer: pyproj.Transformer, epoch: float | None, what: str) -> Move:
    def move(places: Array) -> Array:
        x, y, z = places.T
        try:
            if epoch is None:
                found = transformer.transform(x, y, z, errcheck=True)
            else:
                found = transformer.transform(x, y, z, np.full(len(x), epoch), errcheck=True)[:3]
        except ProjError:
            found = (np.full(len(x), np.inf),) * 3
        moved = np.column_stack(found)
        if not np.isfinite(moved).all():
            raise GeodesyError(f"{what}: a point lies outside of what the transformation or its grids cover")
        return moved

    return move


def combined_factor(crs: pyproj.CRS, place_m: Array) -> tuple[float, float]:
    """Scale of the grid, and the combined factor: a distance on the map over that on the ground.

    Parameters
    ----------
    crs : pyproj.CRS
        Projected.
    place_m : ndarray, shape (3,)
        Its height is taken as one above the ellipsoid: 30 m of a geoid are 5 mm in a kilometre.
    """
    base = crs.geodetic_crs
    assert base is not None
    longitude, latitude = pyproj.Transformer.from_crs(crs, base, always_xy=True).transform(place_m[0], place_m[1])
    factors = pyproj.Proj(crs).get_factors(longitude, latitude)
    scale = float(np.sqrt(factors.meridional_scale * factors.parallel_scale))
    return scale, scale * _EARTH_RADIUS_M / (_EARTH_RADIUS_M + float(place_m[2]))
