"""Method `ins`: the autopilot's own position and attitude, interpolated; what a cheap INS gives and no more.

Source: FOI-R--4045--SE (2014), steps 1 to 3 of its geometry. There poses are interpolated linearly to a 10 ms grid and one pose is
used per 10 ms; that is `grid_ns`. The default interpolates with velocities and rates, for every firing.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.constants import NS_PER_MS, NS_PER_S, STANDARD_GRAVITY_M_S2
from flightlog.errors import LogError
from flightlog.mount import Mount
from groundproc.estimation import glitches
from groundproc.estimation.alignment import align
from groundproc.estimation.felt import Felt, autopilot_force, felt
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

UERE_M: Final = 2.5
"""Error of a single-frequency GPS receiver at a dilution of precision of 1 (1 sigma) [m]; used where it states none of its own."""
VERTICAL_FACTOR: Final = 1.5
SIGMA_TILT_RAD: Final = np.deg2rad(1.0)
SIGMA_HEADING_RAD: Final = np.deg2rad(5.0)
"""What is assumed of an AHRS of the APM class with a compass; the autopilot states nothing (1 sigma)."""

ALIGNMENT: Final = "alignment of IMU and positions"
"""Where attitudes come from that nobody states."""
HEIGHTS: Final = {
    "msl": "above mean sea level as the autopilot states it (the geoid of its GPS module, EGM 96 or coarser)",
    "ellipsoid": "above the WGS 84 ellipsoid",
    "relative": "above the autopilot's home position",
}
SIGMA_SOURCE: Final = (
    "position: accuracy that the GPS receiver states, else its dilution of precision times 2.5 m; attitude: assumed for an AHRS of this "
    "class (1 deg tilt, 5 deg heading), not estimated"
)


@dataclass(frozen=True, slots=True)
class PositionFixes:
    """Positions of the INS, or of its antenna.

    Attributes
    ----------
    source : str
        Message they come from.
    time_ns : ndarray of int64, shape (n,)
        Since boot.
    latitude_deg, longitude_deg, height_m : ndarray, shape (n,)
    velocity_m_s : ndarray, shape (n, 3), or None
        East, north, up.
    sigma_m : ndarray, shape (n, 3)
    left_out : int
        Glitches: positions that jumped away and came back.
    note : str
        What became of jumps; empty where there are none.
    """

    source: str
    time_ns: Times
    latitude_deg: Array
    longitude_deg: Array
    height_m: Array
    velocity_m_s: Array | None
    sigma_m: Array
    left_out: int = 0
    note: str = ""


def position_fixes(boot: Boot, height: str, undulation_m: float | None = None) -> PositionFixes:
    """Positions of one boot with the heights asked for.

    Parameters
    ----------
    boot : Boot
    height : str
        "msl": as the autopilot gives it; "ellipsoid": that plus the undulation; "relative": above home.
    undulation_m : float, optional
        Height of the geoid above the ellipsoid [m]. Without it "ellipsoid" needs the autopilot to send both heights.

    Raises
    ------
    LogError
        No positions, or heights of a kind that the log does not hold: nothing is taken to be zero.
    """
    if boot.has("GLOBAL_POSITION_INT"):
        fixes = _global_positions(boot, height)
    elif boot.has("GPS_RAW_INT"):
        fixes = _gps_positions(boot, height)
    else:
        raise LogError("MAVLink: neither GLOBAL_POSITION_INT nor GPS_RAW_INT in the log; a position is needed")
    fixes = _without_glitches(fixes, _felt(boot, fixes.time_ns))
    if height != "ellipsoid":
        return fixes
    if undulation_m is None:
        undulation_m = _undulation(boot)
    return replace(fixes, height_m=fixes.height_m + undulation_m)


def _felt(boot: Boot, time_ns: Times) -> Felt | None:
    """What the autopilot's accelerometers felt between positions; None where it states no attitude of its own, or no forces."""
    force = autopilot_force(boot)
    if force is None or not len(time_ns) or attitude_source(boot) not in ("ATTITUDE", "ATTITUDE_QUATERNION"):
        return None
    _, attitude_ns, quat, _ = attitudes(boot)
    return felt(time_ns, force[1:], (attitude_ns, quat))


def _without_glitches(fixes: PositionFixes, forces: Felt | None) -> PositionFixes:
    """The positions that hold, and what is to be said of the others."""
    place = [float(np.median(v)) for v in (fixes.latitude_deg, fixes.longitude_deg, fixes.height_m)]
    enu = LocalFrame(*place).from_geodetic(fixes.latitude_deg, fixes.longitude_deg, fixes.height_m)
    time_s: Array = np.asarray((fixes.time_ns - fixes.time_ns[0]) * 1e-9, np.float64)
    found = glitches.judge(time_s, np.asarray(enu, np.float64), fixes.velocity_m_s, fixes.sigma_m, forces)
    kept, left_out = found.kept, int((~found.kept).sum())
    notes = []
    if left_out:
        at_s = float(time_s[~kept][0])
        notes.append(
            f"{left_out} positions of {fixes.source} left out: from {at_s:.1f} s after the first one they jump or walk away by up "
            f"to {found.farthest_m:.0f} m"
        )
    notes += [
        f"positions of {fixes.source} shift by {size_m:.0f} m at {at_s:.1f} s and stay there; nothing contradicts them"
        for at_s, size_m in found.shifts
    ]
    velocity = None if fixes.velocity_m_s is None else fixes.velocity_m_s[kept]
    return PositionFixes(
        fixes.source,
        fixes.time_ns[kept],
        fixes.latitude_deg[kept],
        fixes.longitude_deg[kept],
        fixes.height_m[kept],
        velocity,
        fixes.sigma_m[kept],
        left_out,
        "; ".join(notes),
    )


def position_source(boot: Boot) -> str | None:
    """The message that positions of a boot come from; None where there is none or it never had a fix."""
    for name in ("GLOBAL_POSITION_INT", "GPS_RAW_INT"):
        if boot.has(name):
            return name if _known_positions(boot, name).any() else None
    return None


def has_position(boot: Boot) -> bool:
    """Whether a boot ever knew where it is."""
    return position_source(boot) is not None


def _known_positions(boot: Boot, name: str) -> npt.NDArray[np.bool_]:
    """Which rows of a message hold a position: it is zero until the first fix."""
    table = boot.tables[name]
    if name == "GPS_RAW_INT":
        return np.asarray(table["fix_type"] >= 3)
    return np.asarray((table["lat"] != 0) | (table["lon"] != 0))


def attitude_source(boot: Boot) -> str | None:
    """The message that attitudes of a boot come from."""
    named = next((name for name in ("ATTITUDE", "ATTITUDE_QUATERNION", "AHRS2") if boot.has(name)), None)
    return named or (ALIGNMENT if boot.has("HIGHRES_IMU", 100) else None)


def _global_positions(boot: Boot, height: str) -> PositionFixes:
    table, time_ns = boot.tables["GLOBAL_POSITION_INT"], boot.stamps_ns["GLOBAL_POSITION_INT"]
    known = _known_positions(boot, "GLOBAL_POSITION_INT")
    if not known.any():
        raise LogError("MAVLink: GLOBAL_POSITION_INT holds no position; the autopilot never had a fix")
    table, time_ns = table[known], time_ns[known]
    field = "relative_alt" if height == "relative" else "alt"
    if field not in (table.dtype.names or ()):
        raise LogError("dataflash: POS has no height above home; --height msl takes that above the sea")
    velocity = np.stack([table["vy"], table["vx"], -table["vz"].astype(np.float64)], axis=1) * 0.01
    return PositionFixes(
        "GLOBAL_POSITION_INT",
        time_ns,
        table["lat"] * 1e-7,
        table["lon"] * 1e-7,
        table[field] * 1e-3,
        velocity,
        _sigma_position(boot, time_ns),
    )


def _gps_positions(boot: Boot, height: str) -> PositionFixes:
    if height == "relative":
        raise LogError(
            "MAVLink: GPS_RAW_INT has no height above home; GLOBAL_POSITION_INT is needed for relative heights"
        )
    table, time_ns = boot.tables["GPS_RAW_INT"], boot.stamps_ns["GPS_RAW_INT"]
    known = _known_positions(boot, "GPS_RAW_INT")
    if not known.any():
        raise LogError("MAVLink: GPS_RAW_INT never has a 3D fix")
    table, time_ns = table[known], time_ns[known]
    return PositionFixes(
        "GPS_RAW_INT",
        time_ns,
        table["lat"] * 1e-7,
        table["lon"] * 1e-7,
        table["alt"] * 1e-3,
        None,
        _sigma_position(boot, time_ns),
    )


def _undulation(boot: Boot) -> float:
    """Height of the geoid that the GPS module itself works with: the difference of the two heights it states."""
    if boot.has("GPS_RAW_INT", 1):
        table = boot.tables["GPS_RAW_INT"]
        both = table["alt_ellipsoid"] != 0
        if both.any():
            return float(np.median(table["alt_ellipsoid"][both].astype(np.int64) - table["alt"][both]) * 1e-3)
    raise LogError(
        "heights above the ellipsoid: the autopilot states none (GPS_RAW_INT.alt_ellipsoid) and no undulation of the geoid is given; "
        "give it with --geoid"
    )


def _sigma_position(boot: Boot, time_ns: Times) -> Array:
    """Standard deviation of positions [m], shape (n, 3): the receiver's own figure, else from its dilution of precision."""
    sigma = np.full((len(time_ns), 3), UERE_M * 2.0)
    sigma[:, 2] *= VERTICAL_FACTOR
    if not boot.has("GPS_RAW_INT", 1):
        return sigma
    table, gps_ns = boot.tables["GPS_RAW_INT"], boot.stamps_ns["GPS_RAW_INT"]
    row = np.clip(np.searchsorted(gps_ns, time_ns, side="right") - 1, 0, len(gps_ns) - 1)
    table = table[row]
    hdop = np.where(table["eph"] < 65535, table["eph"] * 0.01, 2.0)
    vdop = np.where(table["epv"] < 65535, table["epv"] * 0.01, hdop * VERTICAL_FACTOR)
    # an "epv" of 0 or below the horizontal one is a receiver that does not know it
    vdop = np.maximum(vdop, hdop)
    horizontal = np.where(table["h_acc"] > 0, table["h_acc"] * 1e-3, hdop * UERE_M)
    vertical = np.where(table["v_acc"] > 0, table["v_acc"] * 1e-3, vdop * UERE_M)
    return np.stack([horizontal, horizontal, vertical], axis=1)


def attitudes(boot: Boot) -> tuple[str, Times, Array, Array | None]:
    """Message, boot time [ns], quaternion "local from ins" and body rate [rad/s] of all attitudes of one boot.

    Raises
    ------
    LogError
        There are none.
    """
    if boot.has("ATTITUDE"):
        table, source = boot.tables["ATTITUDE"], "ATTITUDE"
        quat = frames.quat_from_mat(
            frames.mat_local_ins(*(table[f].astype(np.float64) for f in ("yaw", "pitch", "roll")))
        )
    elif boot.has("ATTITUDE_QUATERNION"):
        table, source = boot.tables["ATTITUDE_QUATERNION"], "ATTITUDE_QUATERNION"
        ned_frd = np.stack([table[f].astype(np.float64) for f in ("q1", "q2", "q3", "q4")], axis=1)
        # the turn from NED to ENU and from FRD to RFU is the same half turn on both sides
        half_turn = np.array([0.0, 1.0, 1.0, 0.0]) / np.sqrt(2.0)
        quat = frames.quat_multiply(frames.quat_multiply(half_turn, ned_frd), frames.quat_inverse(half_turn))
        quat = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    elif boot.has("AHRS2"):
        table, source = boot.tables["AHRS2"], "AHRS2"
        quat = frames.quat_from_mat(
            frames.mat_local_ins(*(table[f].astype(np.float64) for f in ("yaw", "pitch", "roll")))
        )
        return source, boot.stamps_ns[source], quat, None
    elif boot.has("HIGHRES_IMU", 100) and boot.has("GPS_RAW_INT", 10):
        return _aligned(boot)
    else:
        raise LogError("MAVLink: neither ATTITUDE nor ATTITUDE_QUATERNION nor AHRS2 in the log; an attitude is needed")
    frd = np.stack([table[f].astype(np.float64) for f in ("rollspeed", "pitchspeed", "yawspeed")], axis=1)
    return source, boot.stamps_ns[source], quat, frames.ins_from_frd(frd)


def _aligned(boot: Boot) -> tuple[str, Times, Array, Array]:
    """Attitudes of a kit that states none, from its IMU and its positions."""
    table, stamp_ns = boot.tables["HIGHRES_IMU"], boot.stamps_ns["HIGHRES_IMU"]
    rate, force = (
        frames.ins_from_frd(np.stack([table[axis + kind].astype(np.float64) for axis in "xyz"], axis=1))
        for kind in ("gyro", "acc")
    )
    fixes = _gps_positions(boot, "msl")
    frame = LocalFrame(float(fixes.latitude_deg[0]), float(fixes.longitude_deg[0]), float(fixes.height_m[0]))
    enu = frame.from_geodetic(fixes.latitude_deg, fixes.longitude_deg, fixes.height_m)
    inside = (stamp_ns >= fixes.time_ns[0]) & (stamp_ns <= fixes.time_ns[-1])
    start_ns = int(stamp_ns[inside][0])
    imu_s: Array = np.asarray((stamp_ns[inside] - start_ns) * 1e-9, np.float64)
    fix_s: Array = np.asarray((fixes.time_ns - start_ns) * 1e-9, np.float64)
    sigma_m, gravity = float(np.median(fixes.sigma_m[:, 0])), STANDARD_GRAVITY_M_S2
    quat = align(imu_s, rate[inside], force[inside], fix_s, np.asarray(enu, np.float64), sigma_m, gravity)
    return ALIGNMENT, stamp_ns[inside], quat, rate[inside]


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
        From `position_fixes`.
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
