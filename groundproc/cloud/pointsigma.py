"""How well the place of each point is known: what the pose, the mount, the ranging and the beam do to it.

    var = J C J^T  +  turn of the mount  +  range  +  angles of the beam, or place within the footprint

J takes the six errors of the pose to the point: the shift, and the turn about east, north and up times the way from the INS to the point.
C is the covariance of the trajectory, so errors of the GNSS are in it. The range is known to its noise, stretched where the pulse is (a
slanted surface answers for as long as the beam takes to cross it; Gardner 1992). A beam has a width. A surface fills it, and its middle
is what is measured: there only the angles err, which are stated in steps. On an HDL-32E ranges to a road at 83 to 88 deg of incidence
scatter by 5 to 15 mm from shot to shot, where the footprint is 8 to 23 cm long. Where there is no surface, on leaves and wires, what
answered lies somewhere in the beam, a uniform disc, with a quarter of its diameter as the sigma of each axis (Lichti and Gordon 2004).
"""

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog.mount import Mount
from groundproc.cloud.georeference import sensor_poses
from groundproc.sensors.model import Ranging
from groundproc.trajectory.covariance import mat_attitude_turn
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]
Single = npt.NDArray[np.float32]

STEP_NS: Final = 20_000_000
"""Covariances and attitudes are those of the nearest of these times [ns]: they change slowly."""
LARGEST_M: Final = 65.0
"""What a file can hold; who knows a point no better does not know it."""
UNKNOWN_INCIDENCE_DEG: Final = 45.0
"""Where there is no surface to tell: the middle."""
_STEEPEST: Final = np.cos(np.deg2rad(89.0))
_FWHM: Final = 2.0 * np.sqrt(2.0 * np.log(2.0))


@dataclass(frozen=True, slots=True)
class MountErrors:
    """How well the mount is known, beyond what the covariance of the poses holds.

    Attributes
    ----------
    turn_rad : ndarray, shape (3,)
        One sigma about the sensor's axes.
    position_m : ndarray, shape (3,)
        Of the lever arm, in the ins frame.
    """

    turn_rad: Array
    position_m: Array


class _Steps(NamedTuple):
    """Errors at steps of time, as the kernel takes them.

    Attributes
    ----------
    place_m2 : ndarray, shape (m, 3, 3)
        Covariance of the pose's place, on the axes of the local frame.
    turn_rad2 : ndarray, shape (m, 3, 3)
        Of the turn about these axes, the mount's included.
    both : ndarray, shape (m, 3, 3)
        Rows: place; columns: turn [m rad].
    ins_m : ndarray, shape (m, 3)
        Place of the INS.
    """

    place_m2: Array
    turn_rad2: Array
    both: Array
    ins_m: Array


@dataclass(frozen=True, slots=True)
class Errors:
    """Errors of poses and mount over a piece of the flight.

    Attributes
    ----------
    first_ns : int
    steps : _Steps
    """

    first_ns: int
    steps: _Steps

    @classmethod
    def of(cls, time_ns: Times, trajectory: Trajectory, mount: Mount, mount_errors: MountErrors) -> "Errors":
        """For times, shape (n,), at least one of them, that the trajectory covers."""
        first_ns = int(time_ns.min()) // STEP_NS * STEP_NS
        count = (int(time_ns.max()) - first_ns) // STEP_NS + 2
        asked = first_ns + STEP_NS * np.arange(count, dtype=np.int64)
        asked = np.clip(asked, time_ns.min(), time_ns.max())
        covariance = trajectory.covariance_at(asked)
        poses, covered = trajectory.where_covered(asked)
        sensor, _ = sensor_poses(asked, trajectory, mount)
        mats = sensor[:, :9].reshape(-1, 3, 3)
        # the covariance is of roll, pitch and heading; a small turn t changes them by T t
        forward = (mats @ mount.mat_ins_lidar().T)[:, :, 1]
        heading, pitch = np.arctan2(forward[:, 0], forward[:, 1]), np.arcsin(np.clip(forward[:, 2], -1.0, 1.0))
        heading, pitch = np.where(covered, heading, 0.0), np.where(covered, pitch, 0.0)
        turn_of = np.linalg.inv(mat_attitude_turn(heading, pitch))
        own = mats * np.square(mount_errors.turn_rad) @ mats.transpose(0, 2, 1)
        arm = mats @ mount.mat_ins_lidar().T
        place = covariance[:, :3, :3] + arm * np.square(mount_errors.position_m) @ arm.transpose(0, 2, 1)
        turn = turn_of @ covariance[:, 3:, 3:] @ turn_of.transpose(0, 2, 1) + own
        both = covariance[:, :3, 3:] @ turn_of.transpose(0, 2, 1)
        # a gap within the piece has no points; not a number is what they would be told
        for part in (place, turn, both):
            part[~covered] = np.nan
        return cls(first_ns, _Steps(*map(np.ascontiguousarray, (place, turn, both, poses.position_m))))

    def sigmas_m(
        self, xyz_m: Array, time_ns: Times, origins_m: Array, ranging: Ranging, incidence_deg: Single | None = None
    ) -> tuple[Single, Single]:
        """One sigma of points [m]: of each horizontal axis (root of the mean of both variances), and of the height; shape (n,) each.

        Parameters
        ----------
        xyz_m, origins_m : ndarray, shape (n, 3)
            Points and the places of the sensor, in the local frame.
        time_ns : ndarray of int64, shape (n,)
        ranging : Ranging
        incidence_deg : ndarray of float32, shape (n,), optional
            Not-a-number, or None: unknown.
        """
        out = np.empty((len(xyz_m), 2), np.float32)
        step = (time_ns - self.first_ns + STEP_NS // 2) // STEP_NS
        slant = np.zeros(0, np.float32) if incidence_deg is None else incidence_deg
        _sigmas(
            xyz_m, origins_m, step, self.steps, slant,
            np.array([ranging.sigma_m, 0.25 * ranging.divergence_rad, ranging.pulse_m / _FWHM, ranging.pointing_rad]), out,
        )  # fmt: skip
        return np.ascontiguousarray(out[:, 0]), np.ascontiguousarray(out[:, 1])


@njit(cache=True, nogil=True)
def _sigmas(xyz: Any, origin: Any, step: Any, errors: _Steps, incidence_deg: Any, ranging: Any, out: Any) -> None:
    """Fill sigmas, shape (n, 2); `ranging`: range, angle within the beam, length of the pulse, angle of the beam, each a sigma."""
    place, turn, both, ins = errors.place_m2, errors.turn_rad2, errors.both, errors.ins_m
    told = len(incidence_deg) > 0
    noise, beam2, pulse2, angle2 = ranging[0] ** 2, ranging[1] ** 2, ranging[2] ** 2, ranging[3] ** 2
    for i in range(len(xyz)):
        s = step[i]
        x, y, z = xyz[i, 0] - ins[s, 0], xyz[i, 1] - ins[s, 1], xyz[i, 2] - ins[s, 2]
        t, b, p = turn[s], both[s], place[s]
        # a turn w moves the point by w x r: east by w1 z - w2 y, north by w2 x - w0 z, up by w0 y - w1 x
        east = p[0, 0] + 2.0 * (b[0, 1] * z - b[0, 2] * y) + t[1, 1] * z * z + t[2, 2] * y * y - 2.0 * t[1, 2] * y * z
        north = p[1, 1] + 2.0 * (b[1, 2] * x - b[1, 0] * z) + t[2, 2] * x * x + t[0, 0] * z * z - 2.0 * t[0, 2] * x * z
        up = p[2, 2] + 2.0 * (b[2, 0] * y - b[2, 1] * x) + t[0, 0] * y * y + t[1, 1] * x * x - 2.0 * t[0, 1] * x * y
        x, y, z = xyz[i, 0] - origin[i, 0], xyz[i, 1] - origin[i, 1], xyz[i, 2] - origin[i, 2]
        square = x * x + y * y + z * z
        slant = np.float64(incidence_deg[i]) if told else np.nan
        wide = angle2 * square
        if np.isnan(slant):
            slant = UNKNOWN_INCIDENCE_DEG
            wide += beam2 * square
        cosine = max(np.cos(np.deg2rad(slant)), _STEEPEST)
        along = noise * (1.0 + beam2 * square * (1.0 / (cosine * cosine) - 1.0) / pulse2)
        level = (x * x + y * y) / max(square, 1e-12)
        horizontal = 0.5 * (east + north + along * level + wide * (2.0 - level))
        vertical = up + along * (1.0 - level) + wide * level
        out[i, 0], out[i, 1] = _held(horizontal), _held(vertical)


@njit(cache=True, nogil=True, inline="always")
def _held(variance: float) -> Any:
    """Root of a variance to two digits, no more than a file can hold; not-a-number stays that.

    A sigma is known no better than that, and a file with more digits of it is a seventh larger.
    """
    if not variance > 0.0:
        return variance
    sigma = np.sqrt(variance)
    per_m = 1000.0 if sigma < 0.1 else 100.0 if sigma < 1.0 else 10.0 if sigma < 10.0 else 1.0
    return min(np.rint(sigma * per_m) / per_m, LARGEST_M)
