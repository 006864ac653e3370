"""Method `ins`: the autopilot's own position and attitude, interpolated; what a cheap INS gives and no more.

Source: FOI-R--4045--SE (2014), steps 1 to 3 of its geometry. There poses are interpolated linearly to a 10 ms grid and one pose is
used per 10 ms; that is `grid_ns`. The default interpolates with velocities and rates, for every firing.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.constants import NS_PER_MS, NS_PER_S
from flightlog.errors import LogError
from flightlog.mount import Mount
from groundproc.estimation.ownsolution import PositionFixes, attitudes
from groundproc.flight.autopilot import Boot
from groundproc.geodesy import LocalFrame
from groundproc.trajectory.trajectory import HOLD, Trajectory

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

KNOT_NS: Final = 10 * NS_PER_MS
"""Spacing of the trajectory's knots: between them motion at up to 20 Hz is followed to 1e-4 of its size."""
LONGEST_ATTITUDE_GAP_NS: Final = NS_PER_S
LONGEST_POSITION_GAP_NS: Final = 3 * NS_PER_S
"""Silences over which nothing is interpolated."""

SIGMA_TILT_RAD: Final = np.deg2rad(1.0)
SIGMA_HEADING_RAD: Final = np.deg2rad(5.0)
"""What is assumed of an AHRS of the APM class with a compass; the autopilot states nothing (1 sigma)."""

SIGMA_SOURCE: Final = (
    "position: accuracy that the GPS receiver states, else its dilution of precision times 2.5 m; attitude: assumed for an AHRS of this "
    "class (1 deg tilt, 5 deg heading), not estimated"
)


def ins_trajectory(
    boot: Boot,
    fixes: PositionFixes,
    frame: LocalFrame,
    utc_from_boot: Callable[[Times], Times],
    mount: Mount,
    grid_ns: int | None = None,
) -> Trajectory:
    """The trajectory of one boot.

    Parameters
    ----------
    boot : Boot
    fixes : PositionFixes
        From `ownsolution.position_fixes`.
    frame : LocalFrame
    utc_from_boot : callable
        Turns boot times, shape (n,), into UTC [ns].
    mount : Mount
        Its lever arm of the antenna is taken off the positions, where it has one.
    grid_ns : int, optional
        Spacing of the source's pose grid: linear interpolation to it, and the nearest grid pose for every shot.

    Raises
    ------
    LogError
        Position and attitude do not overlap.
    """
    _, attitude_ns, quat, rate = attitudes(boot)
    enu = frame.from_geodetic(fixes.latitude_deg, fixes.longitude_deg, fixes.height_m)
    step = grid_ns or KNOT_NS
    start = -(-max(attitude_ns[0], fixes.time_ns[0]) // step) * step
    knots = np.arange(start, min(attitude_ns[-1], fixes.time_ns[-1]) + 1, step, dtype=np.int64)
    if len(knots) < 2:
        raise LogError("MAVLink: positions and attitudes of the autopilot do not overlap in time")
    if grid_ns is None:
        turn = _turns(frame, attitude_ns, quat, rate)
        path = _path(frame, fixes.time_ns, enu, fixes.velocity_m_s)
        position, velocity = _with_slope(path, knots)
        attitude, body_rate = _with_rate(turn, knots)
    else:
        position = np.stack([np.interp(knots, fixes.time_ns, axis) for axis in enu.T], axis=1)
        attitude = _linear_attitude(attitude_ns, quat, knots)
        velocity, body_rate = np.zeros_like(position), np.zeros_like(position)
    if mount.gps_position_m is not None:
        position = position - frames.mat_from_quat(attitude) @ np.array(mount.gps_position_m)
    sigma = np.stack([np.interp(knots, fixes.time_ns, axis) for axis in fixes.sigma_m.T], axis=1)
    return Trajectory(
        frame=frame,
        time_ns=utc_from_boot(knots),
        position_m=position,
        velocity_m_s=velocity,
        quat_local_ins_wxyz=attitude,
        rate_rad_s=body_rate,
        sigma_position_m=sigma,
        sigma_attitude_rad=np.tile([SIGMA_TILT_RAD, SIGMA_TILT_RAD, SIGMA_HEADING_RAD], (len(knots), 1)),
        covered=_covered(knots, attitude_ns, LONGEST_ATTITUDE_GAP_NS)
        & _covered(knots, fixes.time_ns, LONGEST_POSITION_GAP_NS),
        interpolation=HOLD if grid_ns is not None else "cubic",
    )


def _covered(knots: Times, samples: Times, longest_ns: int) -> npt.NDArray[np.bool_]:
    """For each interval from a knot to the next, whether it touches no silence of the samples; False for the last knot."""
    before = np.clip(np.searchsorted(samples, knots, side="right") - 1, 0, len(samples) - 2)
    quiet = samples[before + 1] - samples[before] > longest_ns
    return np.append(~(quiet[:-1] | quiet[1:]), False)


def _bare(frame: LocalFrame, time_ns: Times) -> Trajectory:
    """A trajectory at rest: the frame for interpolating position or attitude alone."""
    zero = np.zeros((len(time_ns), 3))
    level = np.tile([1.0, 0.0, 0.0, 0.0], (len(time_ns), 1))
    covered = np.append(np.ones(len(time_ns) - 1, np.bool_), False)
    return Trajectory(frame, time_ns, zero, zero, level, zero, zero, zero, covered)


def _path(frame: LocalFrame, time_ns: Times, enu: Array, velocity: Array | None) -> Trajectory:
    return replace(_bare(frame, time_ns), position_m=enu, velocity_m_s=_slopes(time_ns, enu, velocity))


def _slopes(time_ns: Times, values: Array, given: Array | None) -> Array:
    """Slopes at the samples [1/s]: those given where they agree with the differences, else the parabola's through three samples."""
    seconds = (time_ns - time_ns[0]) * 1e-9
    if len(seconds) < 3:
        return np.tile((values[-1] - values[0]) / (seconds[-1] - seconds[0]), (len(values), 1))
    parabola = np.gradient(values, seconds, axis=0, edge_order=2)
    if given is None:
        return np.asarray(parabola)
    # a receiver without velocity sends zeros: what does not explain the motion is not used
    moved, missed = np.square(parabola).sum(), np.square(given - parabola).sum()
    return given if missed <= 0.5 * moved or moved < 0.01 * len(values) else np.asarray(parabola)


def _turns(frame: LocalFrame, time_ns: Times, quat: Array, rate: Array | None) -> Trajectory:
    seconds = (time_ns - time_ns[0]) * 1e-9
    step = frames.quat_log(frames.quat_multiply(frames.quat_inverse(quat[:-1]), quat[1:]))
    step /= np.diff(seconds)[:, None]
    mean = np.concatenate([step[:1], 0.5 * (step[:-1] + step[1:]), step[-1:]])
    if rate is None or np.square(rate - mean).sum() > 0.5 * np.square(mean).sum():
        rate = mean
    return replace(_bare(frame, time_ns), quat_local_ins_wxyz=quat, rate_rad_s=rate)


_EPSILON_NS: Final = NS_PER_MS // 2


def _around(samples: Times, knots: Times) -> tuple[Times, Times]:
    """Two times about each knot, within the samples, for a difference quotient."""
    return np.maximum(knots - _EPSILON_NS, samples[0]), np.minimum(knots + _EPSILON_NS, samples[-1])


def _with_slope(path: Trajectory, knots: Times) -> tuple[Array, Array]:
    before, after = _around(path.time_ns, knots)
    rise = path.at(after).position_m - path.at(before).position_m
    return path.at(knots).position_m, rise / ((after - before) * 1e-9)[:, None]


def _with_rate(turn: Trajectory, knots: Times) -> tuple[Array, Array]:
    before, after = _around(turn.time_ns, knots)
    first, second = turn.at(before).quat_local_ins_wxyz, turn.at(after).quat_local_ins_wxyz
    turned = frames.quat_log(frames.quat_multiply(frames.quat_inverse(first), second))
    return turn.at(knots).quat_local_ins_wxyz, turned / ((after - before) * 1e-9)[:, None]


def _linear_attitude(time_ns: Times, quat: Array, knots: Times) -> Array:
    """Heading, pitch and roll each interpolated linearly, heading and roll the short way through +-180 deg, as the source does."""
    angles = [np.interp(knots, time_ns, np.unwrap(angle)) for angle in frames.attitude_of(frames.mat_from_quat(quat))]
    return frames.quat_from_mat(frames.mat_local_ins(*angles))
