"""RTKLIB's solution files (.pos), written in the one form that `rtklib` reads with all sigmas."""

from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Final, TextIO

import numpy as np
import numpy.typing as npt

from flightlog.constants import NS_PER_S
from groundproc.flight.positions.scales import gps_calendar_from_utc
from groundproc.flight.positions.solution import ELLIPSOID, Solution

Array = npt.NDArray[np.float64]
_HEAD: Final = (
    "% (lat/lon/height=WGS84/{},Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)\n"
    "%  GPST                     latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)"
    "  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio    vn(m/s)    ve(m/s)    vu(m/s)      sdvn     sdve     sdvu    sdvne    sdveu    sdvun\n"
)


def write_pos(file: TextIO, solution: Solution, comments: Iterable[str]) -> None:
    """Write positions, GPS calendar and heights of its reference, as RTKLIB does; `comments` are header lines such as "program : x"."""
    assert solution.satellites is not None
    assert solution.age_s is not None
    assert solution.ratio is not None
    file.writelines(f"% {comment}\n" for comment in comments)
    file.write("%\n" + _HEAD.format("ellipsoidal" if solution.height_reference == ELLIPSOID else "geodetic"))
    velocity, velocity_covariance = np.zeros((len(solution), 3)), np.zeros((len(solution), 3, 3))
    if solution.velocity_m_s is not None and solution.velocity_covariance_m2_s2 is not None:
        stated = np.isfinite(solution.velocity_m_s).all(axis=1)
        velocity[stated], velocity_covariance[stated] = (
            solution.velocity_m_s[stated],
            solution.velocity_covariance_m2_s2[stated],
        )
    roots, velocity_roots = _roots(solution.covariance_m2), _roots(velocity_covariance)
    for k, time_ns in enumerate(gps_calendar_from_utc(solution.time_ns).tolist()):
        east, north, up = velocity[k]
        file.write(
            f"{_calendar(time_ns)} {solution.latitude_deg[k]:14.9f} {solution.longitude_deg[k]:14.9f} {solution.height_m[k]:10.4f} "
            f"{solution.quality[k]:3d} {int(solution.satellites[k]):3d}{''.join(f' {value:8.4f}' for value in roots[k])} "
            f"{solution.age_s[k]:6.2f} {solution.ratio[k]:6.1f} {north:10.5f} {east:10.5f} {up:10.5f} "
            f"{''.join(f' {value:8.5f}' for value in velocity_roots[k])}\n"
        )


def _roots(covariance: Array) -> Array:
    """Roots of covariances with their signs in RTKLIB's order n, e, u, ne, eu, un, shape (n, 6)."""
    values = np.stack([covariance[:, i, j] for i, j in ((1, 1), (0, 0), (2, 2), (1, 0), (0, 2), (2, 1))], axis=-1)
    return np.asarray(np.copysign(np.sqrt(np.abs(values)), values))


def _calendar(time_ns: int) -> str:
    """Year/month/day and time of day of nanoseconds since 1970, to the microsecond."""
    whole, rest_ns = divmod(time_ns + 500, NS_PER_S)
    return f"{datetime.fromtimestamp(whole, UTC):%Y/%m/%d %H:%M:%S}.{rest_ns // 1000:06d}"
