"""Where a block lies: between the coordinates that people use and the local frame that it is adjusted in.

With a coordinate system the local frame is the plane tangent to the ellipsoid; without one the coordinates are taken to be Cartesian, and
only their origin is moved, so that digits are not lost.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flightlog.errors import GeodesyError
from groundproc.geodesy import LocalFrame, Projection, projected_crs

Array = npt.NDArray[np.float64]

_STEP_M = 10.0


@dataclass(frozen=True, slots=True)
class Site:
    """A place on the earth with its coordinates.

    Attributes
    ----------
    origin_m : ndarray, shape (3,)
        Of the local frame: easting, northing, height.
    projection : Projection or None
        None: Cartesian coordinates.
    """

    origin_m: Array
    projection: Projection | None = None

    @property
    def epsg(self) -> int | None:
        """Code of the coordinate system; None where the coordinates are Cartesian."""
        if self.projection is None:
            return None
        code = self.projection.crs.to_epsg()
        return None if code is None else int(code)

    def local(self, map_m: Array) -> Array:
        """Local coordinates [m] of easting, northing, height, shape (n, 3).

        Raises
        ------
        GeodesyError
            A place has none in this coordinate system.
        """
        places = np.asarray(map_m, np.float64).reshape(-1, 3)
        if self.projection is None:
            return np.asarray(places - self.origin_m)
        found = self.projection.local(places)
        if not np.isfinite(found).all():
            bad = places[int(np.argmin(np.isfinite(found).all(axis=1)))]
            raise GeodesyError(f"{bad.tolist()}: is no place in EPSG:{self.epsg}")
        return found

    def map(self, local_m: Array) -> Array:
        """Easting, northing, height of local coordinates [m], shape (n, 3)."""
        places = np.asarray(local_m, np.float64).reshape(-1, 3)
        return np.asarray(places + self.origin_m) if self.projection is None else self.projection.exact(places)

    def mat_local_grid(self, local_m: Array) -> Array:
        """Grid axes (east, north, up) at local places, shape (n, 3), in the local frame: rotations, shape (n, 3, 3).

        The nearest rotation to the derivatives of the coordinates: what is left when the projection's scale is taken out. It holds
        the convergence of meridians and how the plumb line leans away from the frame's axis.
        """
        places = np.asarray(local_m, np.float64).reshape(-1, 3)
        if self.projection is None:
            return np.tile(np.eye(3), (len(places), 1, 1))
        steps = _STEP_M * np.eye(3)
        columns = [(self.map(places + step) - self.map(places - step)) / (2.0 * _STEP_M) for step in steps]
        u, _, v = np.linalg.svd(np.stack(columns, axis=2))
        return np.asarray(np.swapaxes(u @ v, 1, 2))


def cartesian(places_m: Array) -> Site:
    """A site without a coordinate system, about the middle of some places, shape (n, 3)."""
    return Site(np.round(np.median(np.asarray(places_m).reshape(-1, 3), axis=0)))


def georeferenced(epsg: int | str, places_m: Array) -> Site:
    """A site in a projected coordinate system, about the middle of some places in it, shape (n, 3).

    Raises
    ------
    GeodesyError
        See `projected_crs` and `Projection`; or the middle is no place in it.
    """
    crs = projected_crs(epsg)
    middle = np.median(np.asarray(places_m).reshape(-1, 3), axis=0)
    probe = Projection(LocalFrame(0.0, 0.0, 0.0), crs)
    latitude, longitude, height = probe.frame.to_geodetic(probe.local(middle[None]))
    if not np.isfinite([latitude, longitude, height]).all():
        raise GeodesyError(f"{middle.tolist()}: is no place in EPSG:{crs.to_epsg()}")
    return Site(middle, Projection(LocalFrame(float(latitude[0]), float(longitude[0]), float(height[0])), crs))


def in_frame(frame: LocalFrame, epsg: int | str) -> Site:
    """A site whose local frame is a given one."""
    projection = Projection(frame, projected_crs(epsg))
    return Site(projection.exact(np.zeros((1, 3)))[0], projection)
