"""A solution as a filter takes it: positions in a local frame with covariance and lever arm."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.errors import LogError, UsageError
from flightlog.mount import Mount
from groundproc.flight.positions.ellipsoid import mat_ecef_enu, turned
from groundproc.flight.positions.scales import first_of_each
from groundproc.flight.positions.solution import ELLIPSOID, INS, MSL, Quality, Solution, diagonal_covariance
from groundproc.geodesy import LocalFrame

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

USED: Final = tuple(kind for kind in Quality if kind is not Quality.NONE)


@dataclass(frozen=True, slots=True)
class Tied:
    """Poses that were adjusted together, as an engine takes them that knows what lies between one and the next.

    Attributes
    ----------
    step : ndarray, shape (n, 6)
        From the stated pose to the adjusted one: place [m] and turn in the local frame [rad].
    own, shared : ndarray, shape (n, 6, 6)
        Covariance of the adjusted pose: what is its own, and what it shares with those before and after it.
    """

    step: Array
    own: Array
    shared: Array

    def rows(self, chosen: Any) -> "Tied":
        """The rows of a slice, a mask or an index."""
        return Tied(self.step[chosen], self.own[chosen], self.shared[chosen])


@dataclass(frozen=True, slots=True)
class OutsideFixes:
    """Positions of a point of the airframe in a local frame.

    Attributes
    ----------
    source : str
        File and format.
    time_ns : ndarray of int64, shape (n,)
        UTC, strictly increasing.
    position_m : ndarray, shape (n, 3)
        Of the point, in the local frame: that of the INS origin plus mat_local_ins @ lever_arm_m.
    covariance_m2 : ndarray, shape (n, 3, 3)
        In the local frame.
    lever_arm_m : ndarray, shape (3,)
        The point in the ins frame: right, forward, up.
    quality : ndarray of uint8, shape (n,)
        Values of `Quality`.
    velocity_m_s : ndarray, shape (n, 3), or None
        Of the point, in the local frame; not a number where it is not stated.
    velocity_covariance_m2_s2 : ndarray, shape (n, 3, 3), or None
    quat_local_ins_wxyz : ndarray, shape (n, 4), or None
    attitude_covariance_rad2 : ndarray, shape (n, 3, 3), or None
        Of a small rotation vector in the local frame, mat_true = exp(v) mat_stated; not a number where it is not stated.
    left_out : dict
        Positions not taken, by reason; those of the reader included.
    cross_covariance_m_rad : ndarray, shape (n, 3, 3), or None
        Of position (rows) with that rotation vector (columns), in the local frame: the covariance of a pose is then a full 6 x 6.
    tied : Tied, optional
        Where poses were adjusted together; `position_m` and the covariances are then what each gained by that alone.
    """

    source: str
    time_ns: Times
    position_m: Array
    covariance_m2: Array
    lever_arm_m: Array
    quality: npt.NDArray[np.uint8]
    velocity_m_s: Array | None
    velocity_covariance_m2_s2: Array | None
    quat_local_ins_wxyz: Array | None
    attitude_covariance_rad2: Array | None
    left_out: dict[str, int]
    cross_covariance_m_rad: Array | None = None
    tied: Tied | None = None

    def __len__(self) -> int:
        return len(self.time_ns)

    @property
    def sigma_m(self) -> Array:
        """Standard deviations along the local axes [m], shape (n, 3)."""
        return np.asarray(np.sqrt(np.einsum("nii->ni", self.covariance_m2)))

    def between(self, start_ns: int, end_ns: int) -> "OutsideFixes":
        """Those of a stretch of time [ns], both ends included."""
        chosen = slice(
            int(np.searchsorted(self.time_ns, start_ns)), int(np.searchsorted(self.time_ns, end_ns, side="right"))
        )
        named: dict[str, Any] = {name: getattr(self, name) for name in _PER_ROW}
        part = {name: value[chosen] for name, value in named.items() if value is not None}
        return dataclasses.replace(self, **part, tied=None if self.tied is None else self.tied.rows(chosen))


_PER_ROW: Final = (
    "time_ns", "position_m", "covariance_m2", "quality", "velocity_m_s", "velocity_covariance_m2_s2", "quat_local_ins_wxyz",
    "attitude_covariance_rad2", "cross_covariance_m_rad",
)  # fmt: skip


def lever_arm(solution: Solution, mount: Mount, given_m: Sequence[float] | None = None) -> Array:
    """Where the point that a solution places sits in the ins frame [m], shape (3,): as given, else as the mount has it.

    Raises
    ------
    UsageError
        It is an antenna, and nobody says where it sits: that is not taken to be zero.
    """
    if given_m is not None:
        return np.asarray(given_m, np.float64)
    if solution.point == INS:
        return np.zeros(3)
    if mount.gps_position_m is None:
        raise UsageError(
            f"{solution.source}: its positions are those of an antenna, and neither a lever arm is given nor gps_position_m in the mount "
            "(right, forward, up of the IMU, in metres)"
        )
    return np.array(mount.gps_position_m)


def outside_fixes(
    solution: Solution,
    frame: LocalFrame,
    lever_arm_m: Array,
    *,
    height: str = ELLIPSOID,
    undulation_m: float | None = None,
    sigma_m: Sequence[float] | None = None,
    sigma_scale: float = 1.0,
    qualities: Sequence[Quality] = USED,
    interval_s: float = 0.0,
) -> OutsideFixes:
    """Positions of a solution in a local frame.

    Parameters
    ----------
    solution : Solution
    frame : LocalFrame
        Its heights are of the reference `height`.
    lever_arm_m : ndarray, shape (3,)
        From `lever_arm`.
    height : str
        "ellipsoid" or "msl".
    undulation_m : float, optional
        Geoid above ellipsoid [m], where the solution's heights are of the other reference and it does not state the undulation itself.
    sigma_m : three floats, optional
        East, north, up: for positions whose sigma nobody states.
    sigma_scale : float
        Times all stated sigmas: formal sigmas know nothing of multipath.
    qualities : sequence of Quality
        Which positions are taken.
    interval_s : float
        One position of each such interval [s]. The errors of a smoothed trajectory hang together for seconds: a filter that takes 200 of
        them a second as independent believes 14 times too much.

    Raises
    ------
    LogError
        Heights of that reference cannot be had, or none of the positions is of these qualities.
    UsageError
        A sigma is stated neither by the file nor by the user.
    """
    wanted = np.isin(solution.quality, [int(kind) for kind in qualities])
    left_out = dict(solution.left_out)
    if not wanted.all():
        left_out["other_quality"] = int((~wanted).sum())
    if not wanted.any():
        names = ", ".join(kind.name.lower() for kind in qualities)
        raise LogError(f"{solution.source}: none of its {len(solution)} positions is of quality {names}")
    chosen = solution.rows(wanted)
    if interval_s > 0:
        rows = first_of_each(chosen.time_ns * 1e-9, interval_s)
        left_out["thinned"] = len(chosen) - len(rows)
        chosen = chosen.rows(rows)
    height_m = _heights(chosen, height, undulation_m)
    mat_place = mat_frame_place(frame, chosen.latitude_deg, chosen.longitude_deg)
    velocity, attitude = chosen.velocity_m_s, chosen.quat_place_ins_wxyz
    turns, crossed = _rotation_covariance(chosen)
    return OutsideFixes(
        source=f"{chosen.source} ({chosen.format})",
        time_ns=chosen.time_ns,
        position_m=frame.from_geodetic(chosen.latitude_deg, chosen.longitude_deg, height_m),
        covariance_m2=turned(mat_place, _stated(chosen, sigma_m) * sigma_scale**2),
        lever_arm_m=np.asarray(lever_arm_m, np.float64),
        quality=chosen.quality,
        velocity_m_s=None if velocity is None else np.einsum("nij,nj->ni", mat_place, velocity),
        velocity_covariance_m2_s2=_turned_if(mat_place, chosen.velocity_covariance_m2_s2, sigma_scale),
        quat_local_ins_wxyz=None
        if attitude is None
        else frames.quat_multiply(frames.quat_from_mat(mat_place), attitude),
        attitude_covariance_rad2=_turned_if(mat_place, turns, sigma_scale),
        left_out=left_out,
        cross_covariance_m_rad=_turned_if(mat_place, crossed, sigma_scale),
    )


def _heights(solution: Solution, height: str, undulation_m: float | None) -> Array:
    """Heights above the reference asked for [m], shape (n,)."""
    if height == solution.height_reference:
        return solution.height_m
    if height not in (ELLIPSOID, MSL) or solution.height_reference not in (ELLIPSOID, MSL):
        raise LogError(
            f"{solution.source}: heights {height!r} are asked for, but its own are above the {solution.height_reference}, expected "
            f"{ELLIPSOID} or {MSL}"
        )
    sign = 1.0 if height == ELLIPSOID else -1.0
    own = solution.undulation_m
    if own is not None and np.isfinite(own).any():
        # the geoid is smooth: where single sentences leave it out, its median over the flight serves
        return np.asarray(solution.height_m + sign * np.where(np.isfinite(own), own, np.nanmedian(own)))
    if undulation_m is None:
        raise LogError(
            f"{solution.source}: heights above the {solution.height_reference} found, above the {height} asked for, and no undulation of "
            "the geoid is given; give it with --geoid"
        )
    return np.asarray(solution.height_m + sign * undulation_m)


def mat_frame_place(frame: LocalFrame, latitude_deg: Array, longitude_deg: Array) -> Array:
    """Column matrices "axes of the frame from east, north, up at the place", shape (n, 3, 3): 0.01 deg for each kilometre."""
    mat_ecef_frame = mat_ecef_enu(np.array(frame.latitude_deg), np.array(frame.longitude_deg))
    return np.asarray(mat_ecef_frame.T @ mat_ecef_enu(latitude_deg, longitude_deg))


def _stated(solution: Solution, sigma_m: Sequence[float] | None) -> Array:
    """Covariances of positions [m^2], shape (n, 3, 3), all of them stated."""
    covariance = solution.covariance_m2
    unknown = np.asarray(~np.isfinite(covariance).all(axis=(1, 2)))
    if not unknown.any():
        return covariance
    if sigma_m is None:
        raise UsageError(
            f"{solution.source}: states no sigma for {int(unknown.sum())} of its {len(solution)} positions; give one (east, north, up, in "
            "metres), or the accuracy file of an SBET"
        )
    given = diagonal_covariance(np.asarray(sigma_m, np.float64)[None])[0]
    return np.where(unknown[:, None, None], given, covariance)


def _turned_if(mat: Array, covariance: Array | None, scale: float) -> Array | None:
    return None if covariance is None else turned(mat, covariance) * scale**2


def _rotation_covariance(solution: Solution) -> tuple[Array | None, Array | None]:
    """Covariances of a small rotation vector in the place's axes, shape (n, 3, 3): its own [rad^2], and of the position with it [m rad].

    Of those of roll, pitch and heading; None where they are not stated.

    A change of heading turns about down, one of pitch about the right axis before the roll, one of roll about the forward axis.
    """
    if solution.attitude_covariance_rad2 is None or solution.quat_place_ins_wxyz is None:
        return None, None
    heading, pitch, _ = frames.attitude_of(frames.mat_from_quat(solution.quat_place_ins_wxyz))
    zero = np.zeros_like(heading)
    forward = np.stack([np.sin(heading) * np.cos(pitch), np.cos(heading) * np.cos(pitch), np.sin(pitch)], axis=-1)
    right = np.stack([np.cos(heading), -np.sin(heading), zero], axis=-1)
    down = np.stack([zero, zero, zero - 1.0], axis=-1)
    axes, crossed = np.stack([forward, right, down], axis=-1), solution.cross_covariance_m_rad
    turns = turned(axes, solution.attitude_covariance_rad2)
    return turns, None if crossed is None else crossed @ np.swapaxes(axes, 1, 2)
