"""What the autopilot states of itself: positions with their sigma, and attitudes, of one boot.

Where it states no attitude, one is found by alignment of its IMU with its positions.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.constants import STANDARD_GRAVITY_M_S2
from flightlog.errors import LogError
from groundproc.estimation import glitches
from groundproc.estimation.alignment import align
from groundproc.estimation.felt import Felt, autopilot_force, felt
from groundproc.flight.autopilot import Boot
from groundproc.geodesy import LocalFrame

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

UERE_M: Final = 2.5
"""Error of a single-frequency GPS receiver at a dilution of precision of 1 (1 sigma) [m]; used where it states none of its own."""
VERTICAL_FACTOR: Final = 1.5

ALIGNMENT: Final = "alignment of IMU and positions"
"""Where attitudes come from that nobody states."""
HEIGHTS: Final = {
    "msl": "above mean sea level as the autopilot states it (the geoid of its GPS module, EGM 96 or coarser)",
    "ellipsoid": "above the WGS 84 ellipsoid",
    "relative": "above the autopilot's home position",
}


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
