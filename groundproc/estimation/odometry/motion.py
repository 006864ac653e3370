"""Rates and specific force of the inertial sensors, on one time scale and in the sensor frame of the lidar.

There may be two units. The lidar's own comes at 200 Hz and is noisy, with offsets of tens of deg/s, but is on the very
clock that stamps the returns. The autopilot's comes at 10 to 400 Hz through MAVLink, and is better, but is stamped by
another clock.
"""

from dataclasses import dataclass, replace
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline

from flightlog import frames
from flightlog.constants import NS_PER_S, STANDARD_GRAVITY_M_S2
from flightlog.errors import LogError
from groundproc.estimation.method import Given
from groundproc.estimation.odometry.grid import STEP_NS
from groundproc.flight.autopilot import Boot
from groundproc.flight.timeline import Leg, LidarRun
from groundproc.machine.aside import aside
from groundproc.numerics import robust

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

LEAST_BASE_HZ: Final = 20.0
"""A gyro slower than this does not carry the motion between two revolutions."""


LIDAR: Final = "lidar"
"""Name of the lidar's own unit."""


@dataclass(frozen=True, slots=True)
class ImuTrack:
    """Samples of one inertial unit over one leg.

    Attributes
    ----------
    name : str
    time_ns : ndarray of int64, shape (n,)
        UTC, increasing.
    rate_rad_s, force_m_s2 : ndarray, shape (n, 3)
        In the unit's own axes, turned by the nominal mount into the sensor frame; a force of not-a-number is not measured.
    sigma_rate_rad_s, sigma_force_m_s2 : float
        White noise of a sample.
    """

    name: str
    time_ns: Times
    rate_rad_s: Array
    force_m_s2: Array
    sigma_rate_rad_s: float
    sigma_force_m_s2: float

    def set_aside(self) -> "ImuTrack":
        """The same in a file, of which is in memory what is read."""
        time_ns, rate, force = aside(self.time_ns, self.rate_rad_s, self.force_m_s2)
        return replace(self, time_ns=time_ns, rate_rad_s=rate, force_m_s2=force)

    @property
    def rate_hz(self) -> float:
        """Mean sample rate [Hz]."""
        return float((len(self.time_ns) - 1) * NS_PER_S / max(int(np.ptp(self.time_ns)), 1))

    def rate_density(self) -> float:
        """Square root of the two-sided power density of the rate's noise [rad/s/sqrt(Hz)]: angle random walk [rad/sqrt(s)]."""
        return float(self.sigma_rate_rad_s / np.sqrt(self.rate_hz))

    def force_density(self) -> float:
        """The same of the specific force [m/s^2/sqrt(Hz)]."""
        return float(self.sigma_force_m_s2 / np.sqrt(self.rate_hz))


def lidar_imu(run: LidarRun, leg: Leg, mat_ins_lidar: Array) -> ImuTrack | None:
    """The lidar's own unit; None where the log does not have its position packets.

    Its axes are the sensor's by the manual; where the gyros' correlation says otherwise (a sign, a permutation), that holds.
    """
    if run.gyro is None or run.force_m_s2 is None:
        return None
    rate = run.gyro.rate_rad_s
    solved = leg.sync.mat_ins_lidar
    if solved is not None:
        turn = mat_ins_lidar.T @ solved
        # nearest signed permutation: what is left of a turn is boresight, which belongs to the other unit
        axes = np.rint(turn)
        if np.array_equal(np.abs(axes) @ np.ones(3), np.ones(3)) and np.array_equal(
            np.ones(3) @ np.abs(axes), np.ones(3)
        ):
            rate = rate @ axes.T
    time_ns = leg.utc_from_lidar(run.gyro.time_ns)
    force = run.force_m_s2 if np.ptp(run.force_m_s2) > 0.0 else np.full_like(rate, np.nan)
    return ImuTrack(LIDAR, time_ns, rate, force, _noise(rate), _noise(force))


INS_FORCES: Final = (
    ("RAW_IMU", 1e-3 * STANDARD_GRAVITY_M_S2),
    ("SCALED_IMU", 1e-3 * STANDARD_GRAVITY_M_S2),
    ("HIGHRES_IMU", 1.0),
)


def ins_imu(boot: Boot, leg: Leg, mat_ins_lidar: Array) -> ImuTrack | None:
    """The autopilot's unit in the sensor frame: its fastest series of rates, with forces where these come along."""
    tracks = [t for t in boot.gyros() if len(t.time_ns) > 10]
    if not tracks:
        return None
    forces = {name: unit for name, unit in INS_FORCES if _felt(boot, name)}
    # one that also tells forces is worth more than one a little faster
    with_forces = [track for track in tracks if track.name in forces and track.rate_hz >= LEAST_BASE_HZ]
    best = max(with_forces or tracks, key=lambda track: track.rate_hz if track.rate_hz < 1e3 else 0.0)
    force = np.full_like(best.rate_rad_s, np.nan)
    if best.name in forces:
        force = frames.ins_from_frd(_force_frd(boot, best.name) * forces[best.name])
    rate, force = best.rate_rad_s @ mat_ins_lidar, force @ mat_ins_lidar
    return ImuTrack(best.name, leg.utc_from_boot(best.time_ns), rate, force, _noise(rate), _noise(force))


def _force_frd(boot: Boot, name: str) -> Array:
    """Readings of the accelerometer in a message, shape (n, 3)."""
    return np.stack([boot.tables[name][field].astype(np.float64) for field in ("xacc", "yacc", "zacc")], axis=1)


def _felt(boot: Boot, name: str) -> bool:
    """Whether a message is there and its accelerometer says anything."""
    return boot.has(name, 10) and bool(np.ptp(_force_frd(boot, name)) > 0.0)


def _noise(samples: Array) -> float:
    """White noise of a sample from second differences, which smooth motion hardly enters: robust, all axes together."""
    if len(samples) < 3 or not np.isfinite(samples).all():
        return float("nan")
    return robust.white_noise(samples)


class MotionGrid(Protocol):
    """What the odometry needs of the motion: of a whole recording, or of a flight that goes on.

    Attributes
    ----------
    start_ns : int
        Start of the grid; step i is from start_ns + i STEP_NS to the next.
    rate_rad_s, force_m_s2 : ndarray, shape (n, 3)
        Mean rate and specific force of each step, sensor frame.
    known : ndarray of bool, shape (n,)
        Whether samples say it.
    rate_density, force_density : float
        Noise as in `ImuTrack`.
    source : str
        Whose rates these are.
    """

    @property
    def start_ns(self) -> int:
        """Start of the grid [ns]."""

    @property
    def rate_rad_s(self) -> Array:
        """Mean rates."""

    @property
    def force_m_s2(self) -> Array:
        """Mean specific forces."""

    @property
    def known(self) -> npt.NDArray[np.bool_]:
        """Whether samples say it."""

    @property
    def rate_density(self) -> float:
        """Noise of the rates."""

    @property
    def force_density(self) -> float:
        """Noise of the forces."""

    @property
    def source(self) -> str:
        """Whose rates these are."""

    def __len__(self) -> int: ...


@dataclass(frozen=True, slots=True)
class Motion:
    """Mean rate and force of each grid step, in the sensor frame.

    Attributes
    ----------
    start_ns : int
        Start of the grid [UTC]; step i is from start_ns + i STEP_NS to the next.
    rate_rad_s, force_m_s2 : ndarray, shape (n, 3)
    known : ndarray of bool, shape (n,)
        Whether samples lie close enough about the step.
    rate_density, force_density : float
        Noise as in `ImuTrack`.
    source : str
    """

    start_ns: int
    rate_rad_s: Array
    force_m_s2: Array
    known: npt.NDArray[np.bool_]
    rate_density: float
    force_density: float
    source: str

    def __len__(self) -> int:
        return len(self.rate_rad_s)

    def set_aside(self) -> "Motion":
        """The same in a file, of which is in memory what is read."""
        rate, force, known = aside(self.rate_rad_s, self.force_m_s2, self.known)
        return replace(self, rate_rad_s=rate, force_m_s2=force, known=known)


LONGEST_SAMPLE_GAP_NS: Final = 150_000_000
CUBIC_BELOW_HZ: Final = 120.0
BESIDE_NS: Final = 3 * NS_PER_S
BESIDE: Final = 8
"""So long, and so many samples, before and after some steps are enough for `on_grid`: a cubic forgets by a factor of four with each."""


def near(time_ns: Times, start_ns: int, steps: int) -> slice:
    """The samples of a whole flight that some of its grid steps need."""
    ends = np.array([start_ns - BESIDE_NS, start_ns + steps * STEP_NS + BESIDE_NS])
    first, last = np.searchsorted(time_ns, ends).tolist()
    return slice(max(first - BESIDE, 0), last + BESIDE)


def on_grid(time_ns: Times, values: Array, start_ns: int, steps: int) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Mean of samples over each grid step, shape (steps, 3), and where samples are near enough to say it.

    Between samples of a fast, noisy unit it goes straight; of a slow one in a cubic, for a straight line would take 5 % off a swing of
    3 Hz at 25 Hz.
    """
    seconds = (time_ns - start_ns) * 1e-9
    edges = np.arange(steps + 1) * (STEP_NS * 1e-9)
    place = np.clip(np.searchsorted(seconds, edges, side="right") - 1, 0, len(seconds) - 2)
    gap = seconds[place + 1] - seconds[place]
    spacing = np.diff(seconds)
    usual = spacing[
        spacing * 1e9 <= LONGEST_SAMPLE_GAP_NS
    ]  # a hole in a part of a flight makes no slow unit of a fast one
    if len(seconds) > 3 and len(usual) < CUBIC_BELOW_HZ * usual.sum():
        total = CubicSpline(seconds, values, axis=0).antiderivative()(np.clip(edges, seconds[0], seconds[-1]))
    else:
        rise = 0.5 * (values[1:] + values[:-1]) * spacing[:, None]
        area = np.concatenate([np.zeros((1, 3)), np.cumsum(rise, axis=0)])
        since = np.clip(edges - seconds[place], 0.0, gap)[:, None]
        slope = (values[place + 1] - values[place]) / gap[:, None]
        total = area[place] + since * values[place] + 0.5 * since**2 * slope
    inside = (edges >= seconds[0]) & (edges <= seconds[-1]) & (gap * 1e9 <= LONGEST_SAMPLE_GAP_NS)
    return np.diff(total, axis=0) / (STEP_NS * 1e-9), inside[:-1] & inside[1:]


def base_motion(
    given: Given, leg: Leg, run: LidarRun, quieter: bool = False
) -> tuple[Motion, ImuTrack | None, ImuTrack | None]:
    """The motion between revolutions, from the lidar's own unit where it is there, else from the autopilot's; and both units.

    Parameters
    ----------
    given : Given
    leg : Leg
    run : LidarRun
    quieter : bool
        Whether forces come from the accelerometer of less noise, moved to the lidar; else from the lidar's own, where it is there.

    Raises
    ------
    LogError
        Neither has a gyro of 20 Hz.
    """
    mat = given.mount.mat_ins_lidar()
    own, other = lidar_imu(run, leg, mat), ins_imu(leg.boot, leg, mat)
    base = next((u for u in (own, other) if u is not None and u.rate_hz >= LEAST_BASE_HZ), None)
    if base is None:
        raise LogError(
            "adjusted: no gyro of 20 Hz or more in the log, neither the lidar's (UDP port 8308) nor the autopilot's (RAW_IMU); "
            "use --method ins or filtered"
        )
    ends = leg.utc_from_lidar(
        np.array([run.line.device_ns(run.first_receive_ns), run.line.device_ns(run.last_receive_ns)])
    )
    start_ns = int(ends[0]) // NS_PER_S * NS_PER_S
    steps = int((int(ends[1]) - start_ns) // STEP_NS) + 1
    rate, known = on_grid(base.time_ns, base.rate_rad_s, start_ns, steps)
    forces = [unit for unit in (own, other) if unit is not None and np.isfinite(unit.force_m_s2).all()]
    if not forces:
        raise LogError("adjusted: no accelerometer in the log, neither the lidar's nor the autopilot's (RAW_IMU)")
    if base is own and other is not None and other.rate_hz >= LEAST_BASE_HZ:
        known = _filled(rate, known, *on_grid(other.time_ns, other.rate_rad_s, start_ns, steps))
    if quieter:
        # the lidar's accelerometer feels each bearing; the autopilot's is eight times quieter. One below 20 Hz misses gusts
        forces.sort(key=lambda unit: (unit.rate_hz < LEAST_BASE_HZ, unit.force_density()))
    felt_by = [on_grid(unit.time_ns, unit.force_m_s2, start_ns, steps) for unit in forces]
    if quieter and other in forces:
        at_ins, _ = felt_by[forces.index(other)]
        bias = _offset(own, other, start_ns, steps) if base is own else np.zeros(3)
        at_ins += lever_force(rate - bias, mat.T @ given.mount.lidar_position_m())
    (force, felt), *others = felt_by
    for second in others:
        felt = _filled(force, felt, *second)
    known &= felt
    if known.any():  # a last step that is half known would leave the path's end without hold
        end = int(np.flatnonzero(known)[-1]) + 1
        rate, force, known = rate[:end], force[:end], known[:end]
    motion = Motion(start_ns, rate, force, known, base.rate_density(), forces[0].force_density(), base.name)
    return motion, own, other


def lever_force(rate_rad_s: Array, lever_m: Array) -> Array:
    """What a turning body accelerates at the end of a lever by beside its beginning, each grid step [m/s^2], shape (n, 3).

    Parameters
    ----------
    rate_rad_s : ndarray, shape (n, 3)
        Mean rates of the steps, less their bias.
    lever_m : ndarray, shape (3,)
        In the same axes.
    """
    turning = np.gradient(rate_rad_s, STEP_NS * 1e-9, axis=0)
    return np.asarray(np.cross(turning, lever_m) + np.cross(rate_rad_s, np.cross(rate_rad_s, lever_m)))


def _filled(
    values: Array, known: npt.NDArray[np.bool_], second: Array, second_known: npt.NDArray[np.bool_]
) -> npt.NDArray[np.bool_]:
    """Fill what one unit does not know from another, less their mean difference, in place; what is known then."""
    both, missing = known & second_known, ~known & second_known
    if both.any() and missing.any():
        values[missing] = second[missing] + (values[both] - second[both]).mean(axis=0)
    return np.asarray(known | (second_known if both.any() else known))


def gyro_offset(motion: Motion, own: ImuTrack | None, other: ImuTrack | None) -> Array:
    """Where to begin with the bias of the gyro that carries the motion: its mean difference from the autopilot's, which has a small one."""
    if own is None or motion.source != own.name:
        return np.zeros(3)
    return _offset(own, other, motion.start_ns, len(motion))


def _offset(own: ImuTrack | None, other: ImuTrack | None, start_ns: int, steps: int) -> Array:
    """Mean rate of the lidar's gyro less that of the autopilot's [rad/s], shape (3,); 0 where one is missing."""
    if own is None or other is None:
        return np.zeros(3)
    rate, known = on_grid(other.time_ns, other.rate_rad_s, start_ns, steps)
    own_rate, own_known = on_grid(own.time_ns, own.rate_rad_s, start_ns, steps)
    both = known & own_known
    return np.asarray((own_rate - rate)[both].mean(axis=0)) if both.any() else np.zeros(3)
