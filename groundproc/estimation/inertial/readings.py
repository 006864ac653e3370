"""What one boot of the autopilot and the lidar beside it measured, in seconds of UTC since a start, in one local frame."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.constants import NS_PER_MS, NS_PER_S
from flightlog.errors import LogError
from flightlog.mount import Mount
from groundproc.estimation import ownsolution
from groundproc.estimation.felt import IMU_MESSAGES, autopilot_force
from groundproc.estimation.inertial.imu import Samples, Signal, combine
from groundproc.estimation.observations.measured import Stated
from groundproc.estimation.ownsolution import PositionFixes
from groundproc.flight.autopilot import Boot
from groundproc.flight.positions.fixes import OutsideFixes
from groundproc.flight.sync import GyroTrack
from groundproc.flight.sync.tracks import low_pass
from groundproc.geodesy import LocalFrame

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

FAST_STEP_NS: Final = 5 * NS_PER_MS
STEP_NS: Final = 10 * NS_PER_MS
"""Of the nodes with the lidar's 200 Hz, and without."""
THINNED_HZ: Final = {"fixes": 10.0, "attitude": 25.0, "baro": 5.0}
"""Stated values that come faster are thinned out: their errors are the same ones."""
LONGEST_FIX_GAP_NS: Final = 1_500_000_000
"""Silence of the receiver from which the autopilot's position is dead reckoning."""
LONGEST_WITHOUT_FIX_NS: Final = 60 * NS_PER_S
"""So long before the first fix, and behind the last, inertial sensors carry the position: as long as they bridge an outage."""
RECOVERY_S: Final = 10.0
"""How long after an outage an autopilot's position is still on its way back to the fixes."""
UNKNOWN_RATE_DENSITY: Final = np.deg2rad(5.0) ** 2 * 0.2
UNKNOWN_FORCE_DENSITY: Final = 1.0**2 * 0.5
"""Where no gyro and no accelerometer was: a vehicle that turns at 5 deg/s for 0.2 s, and pushes with 1 m/s^2 for 0.5 s."""


@dataclass(frozen=True, slots=True)
class Readings(Stated):
    """All that goes into the estimate of one leg: what is stated, and the inertial sensors.

    Attributes
    ----------
    gyro, force : Signal or None
        Body rate [rad/s] and specific force [m/s^2] in the ins frame over each step.
    """

    gyro: Signal | None
    force: Signal | None


def normal_gravity(latitude_deg: float, height_m: float) -> float:
    """Gravity of the WGS 84 ellipsoid [m/s^2] (Somigliana; NIMA TR8350.2, with its free-air gradient)."""
    square = np.sin(np.deg2rad(latitude_deg)) ** 2
    surface = 9.7803253359 * (1 + 0.00193185265241 * square) / np.sqrt(1 - 0.00669437999013 * square)
    return float(surface - 3.086e-6 * height_m)


def pressure_height(pressure_hpa: Array) -> Array:
    """Height by the standard atmosphere [m] (ICAO, below 11 km)."""
    return np.asarray((1.0 - (pressure_hpa / 1013.25) ** 0.190263) * 44330.8)


def read(
    boot: Boot,
    fixes: PositionFixes,
    frame: LocalFrame,
    utc_from_boot: Callable[[Times], Times],
    mount: Mount,
    *,
    lidar: tuple[GyroTrack, Array] | None = None,
    utc_from_lidar: Callable[[Times], Times] | None = None,
    mat_ins_lidar: Array | None = None,
    outside: Sequence[OutsideFixes] = (),
) -> Readings:
    """Bring everything together.

    Parameters
    ----------
    boot, fixes, frame, utc_from_boot, mount
        As of `ins.ins_trajectory`.
    lidar : tuple of GyroTrack and ndarray of shape (n, 3), optional
        Rates and specific force of the lidar's sensors, sensor frame, lidar time.
    utc_from_lidar : callable
        Needed with `lidar`.
    mat_ins_lidar : ndarray, shape (3, 3), optional
        Rotation or reflection between the gyros as synchronisation found it; else the mount's.
    outside : sequence of OutsideFixes

    Raises
    ------
    LogError
        Position and attitude do not overlap.
    """
    source, attitude_ns, quat, _ = ownsolution.attitudes(boot)
    del source
    attitude_utc, fix_utc = utc_from_boot(attitude_ns), utc_from_boot(fixes.time_ns)
    step_ns = FAST_STEP_NS if lidar is not None else STEP_NS
    first_ns, last_ns = int(fix_utc[0]), int(fix_utc[-1])
    if lidar is not None or autopilot_force(boot) is not None:
        # the first fix came late, or the last one early: what flew before and after is told by inertial sensors
        first_ns, last_ns = _widened(first_ns, int(attitude_utc[0]), -1), _widened(last_ns, int(attitude_utc[-1]), 1)
    start_ns = -(-max(int(attitude_utc[0]), first_ns) // STEP_NS) * STEP_NS
    end_ns = min(int(attitude_utc[-1]), last_ns)
    if end_ns - start_ns < 2 * STEP_NS:
        raise LogError("MAVLink: positions and attitudes of the autopilot do not overlap in time")
    nodes_s: Array = np.arange(0, end_ns - start_ns + 1, step_ns).astype(np.float64) * 1e-9

    def seconds(time_ns: Times) -> Array:
        return np.asarray((time_ns - start_ns) * 1e-9)

    slow_gyro, slow_force = _autopilot_imu(boot, lambda t: seconds(utc_from_boot(t)))
    fast_gyro, fast_force = None, None
    if lidar is not None and utc_from_lidar is not None:
        lidar_s = seconds(utc_from_lidar(lidar[0].time_ns))
        fast_gyro, fast_force = Samples("lidar", lidar_s, lidar[0].rate_rad_s), Samples("lidar", lidar_s, lidar[1])
    nominal = mount.mat_ins_lidar()
    gyro = combine(nodes_s, slow_gyro, fast_gyro, nominal if mat_ins_lidar is None else mat_ins_lidar, 0.015)
    force = combine(
        nodes_s,
        slow_force,
        fast_force,
        nominal,
        0.02,
        None if gyro is None else gyro.mean,
        mount.lidar_position_m(),
    )
    kept = _with_fix(boot, fixes)
    thin = _thinned(seconds(fix_utc)[kept], THINNED_HZ["fixes"])
    velocity, linked = _fix_velocities(boot, fixes)
    chosen = np.flatnonzero(kept)[thin]
    few = _thinned(seconds(attitude_utc), THINNED_HZ["attitude"])
    baro_s, baro_m = _baro(boot, lambda t: seconds(utc_from_boot(t)))
    lever_m = np.zeros(3) if mount.gps_position_m is None else np.array(mount.gps_position_m)
    return Readings(
        start_ns,
        step_ns,
        nodes_s,
        seconds(fix_utc)[chosen],
        frame.from_geodetic(fixes.latitude_deg, fixes.longitude_deg, fixes.height_m)[chosen],
        fixes.sigma_m[chosen],
        None if velocity is None else velocity[chosen],
        linked,
        seconds(attitude_utc)[few],
        quat[few],
        baro_s,
        baro_m,
        lever_m,
        [each.between(start_ns, start_ns + round(nodes_s[-1] * NS_PER_S)) for each in outside],
        normal_gravity(frame.latitude_deg, frame.height_m),
        int((~kept).sum()),
        None if gyro is None else gyro.set_aside(),
        None if force is None else force.set_aside(),
    )


def _widened(fix_ns: int, attitude_ns: int, side: int) -> int:
    """The end of the fixes, or that of the attitudes where these go on for longer than a silence between fixes, within reason."""
    beyond = side * (attitude_ns - fix_ns)
    return fix_ns if beyond <= LONGEST_FIX_GAP_NS else fix_ns + side * min(beyond, LONGEST_WITHOUT_FIX_NS)


def _thinned(time_s: Array, rate_hz: float) -> Times:
    """Rows of which none follows another faster than a rate, by a tenth or so."""
    slot = np.floor(time_s * rate_hz).astype(np.int64)
    if not len(slot) or np.median(np.diff(time_s)) * rate_hz > 0.9:
        return np.arange(len(slot))
    return np.flatnonzero(np.diff(slot, prepend=slot[0] - 1) > 0)


def _autopilot_imu(boot: Boot, seconds: Callable[[Times], Array]) -> tuple[Samples | None, Samples | None]:
    """The autopilot's gyros [rad/s] and accelerometers [m/s^2] in the ins frame: the message that has most of both."""
    gyros = {track.name: track for track in boot.gyros()}
    # an IMU's own message unless another brings the same gyros much oftener
    best = max(
        gyros.values(),
        key=lambda track: len(track.time_ns) * (1.5 if track.name in IMU_MESSAGES else 1.0),
        default=None,
    )
    gyro = None if best is None else Samples(best.name, seconds(best.time_ns), best.rate_rad_s)
    found = autopilot_force(boot)
    if found is None:
        return gyro, None
    name, time_ns, force_m_s2 = found
    return gyro, Samples(name, seconds(time_ns), force_m_s2)


def _with_fix(boot: Boot, fixes: PositionFixes) -> Mask:
    """Which positions rest on a GPS fix: an autopilot goes on stating positions without, and comes back to the fixes slowly."""
    kept = np.ones(len(fixes.time_ns), np.bool_)
    if not boot.has("GPS_RAW_INT", 1) or fixes.source == "GPS_RAW_INT":
        return kept
    # while a receiver has no fix it repeats the last one with its old stamp, or none
    good_ns = boot.stamps_ns["GPS_RAW_INT"][boot.tables["GPS_RAW_INT"]["fix_type"] >= 3]
    if len(good_ns) < 2:
        return kept
    steps = np.diff(good_ns)
    longest = max(LONGEST_FIX_GAP_NS, round(3.0 * float(np.median(steps))))
    row = np.searchsorted(good_ns, fixes.time_ns, side="right") - 1
    kept = (row >= 0) & (fixes.time_ns - good_ns[np.maximum(row, 0)] <= longest)
    for end_ns in good_ns[1:][steps > longest]:
        kept &= ~((fixes.time_ns >= end_ns) & (fixes.time_ns < end_ns + RECOVERY_S * NS_PER_S))
    return kept if kept.sum() >= 2 else np.ones(len(kept), np.bool_)


def _fix_velocities(boot: Boot, fixes: PositionFixes) -> tuple[Array | None, bool]:
    """Velocities at the fixes, NaN where unknown, and whether they are the stated positions' own."""
    if fixes.velocity_m_s is not None:
        seconds = (fixes.time_ns - fixes.time_ns[0]) * 1e-9
        enu = np.stack(
            [fixes.latitude_deg * 1.11e5, fixes.height_m], axis=1
        )  # north and up will do to see whether they mean anything
        moved = np.gradient(enu, seconds, axis=0) if len(seconds) > 2 else np.zeros_like(enu)
        if np.ptp(fixes.velocity_m_s) == 0.0 and np.square(moved).mean() > 0.25:
            return None, True
        return fixes.velocity_m_s, True
    if fixes.source != "GPS_RAW_INT":
        return None, True
    table, stamp_ns = boot.tables["GPS_RAW_INT"], boot.stamps_ns["GPS_RAW_INT"]
    row = np.searchsorted(stamp_ns, fixes.time_ns)
    speed, course = table["vel"][row].astype(np.float64) * 0.01, np.deg2rad(table["cog"][row] * 0.01)
    known = (table["vel"][row] < 65535) & (table["cog"][row] < 65535)
    velocity = np.stack([speed * np.sin(course), speed * np.cos(course), np.full(len(speed), np.nan)], axis=1)
    velocity[~known] = np.nan
    return (velocity if known.any() and np.nanmax(speed) > 0 else None), False


def _baro(boot: Boot, seconds: Callable[[Times], Array]) -> tuple[Array, Array]:
    if not boot.has("SCALED_PRESSURE"):
        return np.empty(0), np.empty(0)
    pressure = boot.tables["SCALED_PRESSURE"]["press_abs"].astype(np.float64)
    time_s = seconds(boot.stamps_ns["SCALED_PRESSURE"])
    good = (pressure > 200.0) & (pressure < 1200.0)
    few = np.flatnonzero(good)[_thinned(time_s[good], THINNED_HZ["baro"])]
    return time_s[few], pressure_height(pressure[few])


def standing(readings: Readings) -> Mask:
    """At which nodes the vehicle stands: no turning, no pushing and no speed in the second around, shape (n,)."""
    nodes = len(readings.nodes_s)
    if readings.gyro is None or readings.force is None or readings.fix_velocity_m_s is None:
        return np.zeros(nodes, np.bool_)
    rate_hz = NS_PER_S / readings.step_ns
    quiet = readings.gyro.known & readings.force.known
    for signal, limit in ((readings.gyro, np.deg2rad(0.5)), (readings.force, 0.15)):
        slow = low_pass(signal.mean, 5.0, rate_hz)
        # scatter within about a second
        square = low_pass(slow**2, 1.0, rate_hz) - low_pass(slow, 1.0, rate_hz) ** 2
        quiet &= np.sqrt(np.maximum(square, 0.0)).max(axis=1) < limit
        quiet &= np.abs(slow - np.median(slow[quiet], axis=0)).max(axis=1) < 5.0 * limit if quiet.any() else quiet
    known = np.isfinite(readings.fix_velocity_m_s[:, :2]).all(axis=1)
    if known.sum() < 2:
        return np.zeros(nodes, np.bool_)
    speed = np.hypot(*readings.fix_velocity_m_s[known, :2].T)
    slow_enough = np.interp(readings.nodes_s, readings.fix_s[known], speed) < 0.5
    found = np.append(quiet, quiet[-1]) & slow_enough
    # for at least a second
    run = max(round(rate_hz), 1)
    count = np.cumsum(np.concatenate([[0], found.astype(np.int64)]))
    full = np.zeros(nodes, np.bool_)
    if nodes > run:
        whole = count[run:] - count[:-run] == run
        for shift in (0, run // 2, run - 1):
            full[shift : shift + len(whole)] |= whole
    return full & found


def drives(readings: Readings) -> bool:
    """Whether the vehicle is one that goes where it points, such as a car: it feels the acceleration of its turns.

    A multirotor leans into them and feels next to nothing sideways, however it flies.
    """
    if readings.force is None or readings.fix_velocity_m_s is None or not readings.force.known.any():
        return False
    known = np.isfinite(readings.fix_velocity_m_s[:, :2]).all(axis=1)
    if known.sum() < 10:
        return False
    rate_hz = NS_PER_S / readings.step_ns
    time_s = readings.nodes_s[:-1]
    velocity = np.stack(
        [np.interp(time_s, readings.fix_s[known], v) for v in readings.fix_velocity_m_s[known, :2].T], axis=1
    )
    gained = np.gradient(low_pass(velocity, 0.5, rate_hz), 1.0 / rate_hz, axis=0)
    heading, _, _ = frames.attitude_of(frames.mat_from_quat(readings.quat))
    heading = np.interp(time_s, readings.attitude_s, np.unwrap(heading))
    sideways = gained[:, 0] * np.cos(heading) - gained[:, 1] * np.sin(heading)
    felt = low_pass(readings.force.mean[:, :1], 0.5, rate_hz)[:, 0]
    moving = np.hypot(*velocity.T) > 1.0
    astray = np.abs(frames.quat_log(_about_up(np.arctan2(velocity[:, 0], velocity[:, 1]) - heading))[:, 2])
    if not moving.any() or np.quantile(astray[moving], 0.9) > np.deg2rad(25.0):
        return False
    sideways, felt = sideways[moving], felt[moving]
    if len(felt) < 5 * rate_hz or np.sqrt(np.mean(sideways**2)) < 0.25:
        return False
    slope = np.mean((sideways - sideways.mean()) * (felt - felt.mean())) / np.var(sideways)
    return bool(slope > 0.5)


def _about_up(angle_rad: Array) -> Array:
    """Quaternions of turns about the upward axis, shape (n, 4)."""
    zero = np.zeros_like(angle_rad)
    return frames.quat_exp(np.stack([zero, zero, angle_rad], axis=1))
