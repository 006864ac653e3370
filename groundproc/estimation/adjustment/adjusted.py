"""Method `adjusted`: the whole flight in one adjustment of lidar, inertial sensors, GNSS and compass.

packets --slices--> clusters --odometry--> path --batch--> path, mount, clocks, biases, compass; and the sigma of each.
"""

import functools
import pathlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.constants import NS_PER_S
from flightlog.errors import LogError
from flightlog.mount import Mount
from groundproc.estimation import ins
from groundproc.estimation.adjustment.anchors import within
from groundproc.estimation.adjustment.batch import COMPASS_PRIOR, DRIFT_S, PRIORS, turned
from groundproc.estimation.adjustment.control import control_report, control_warnings
from groundproc.estimation.adjustment.factors import H
from groundproc.estimation.adjustment.joining import Joined, joining
from groundproc.estimation.adjustment.lasers import Corrections
from groundproc.estimation.adjustment.outside import DELAY, outside_track
from groundproc.estimation.adjustment.windows import (
    OVERLAP,
    UNSEEN,
    WINDOW,
    Sources,
    Window,
    adjust_window,
    all_patches,
    control_clusters,
    corrections_over,
    joined_path,
    whole_stiffness,
)
from groundproc.estimation.method import Estimate, Given, Progress
from groundproc.estimation.odometry.beginning import BEGINNING, redo_beginning
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.motion import ImuTrack, Motion, base_motion, on_grid
from groundproc.estimation.odometry.slices import Slice, slices
from groundproc.estimation.odometry.spline import Path
from groundproc.estimation.odometry.stated import Attitudes, Positions
from groundproc.estimation.odometry.track import Track, Tracker, grid_ns, tracked
from groundproc.estimation.surveyed import surveyed, surveyed_control
from groundproc.flight.autopilot import Boot
from groundproc.flight.timeline import Leg
from groundproc.geodesy import LocalFrame
from groundproc.sensors.lasers import ESTIMATE
from groundproc.sensors.shots import LaserTable
from groundproc.trajectory.trajectory import Trajectory, joined

Array = npt.NDArray[np.float64]

POSITION_TAU_S: Final = np.array([60.0, 60.0, 300.0])
POSITION_WHITE_M: Final = 0.1
"""Errors of a GNSS receiver that smooths last for a minute, those of a height that the barometer carries for longer (east, north, up);
a tenth of a metre is new each second."""
LEAST_POSITION_SIGMA_M: Final = 0.02
ATTITUDE_SIGMA_RAD: Final = np.deg2rad([1.0, 1.0, 2.0])
ATTITUDE_TAU_S: Final = 10.0
"""Of an AHRS of the APM class: tilt, and heading beyond the compass's curve; its errors last for the time of its own filter."""


def estimate(given: Given, progress: Progress, start: Trajectory) -> Estimate:
    """Adjust every run of the lidar's clock.

    Parameters
    ----------
    given : Given
    progress : Progress
    start : Trajectory
        Rough poses of the ins frame over the flight.

    Raises
    ------
    LogError
        No run has lidar, inertial data and positions together.
    """
    made: list[Run | CausalRun] = []
    reasons: list[LogError] = []
    adjust = causal_run if given.survey.causal else adjust_run
    for number in sorted({leg.run for leg in given.placed}):
        legs = [leg for leg in given.placed if leg.run == number]
        try:
            made.append(adjust(given, legs, number, start, progress))
        except LogError as error:
            reasons.append(error)
    if not made:
        raise reasons[0]
    main = max(made, key=lambda run: len(run.path.quat))
    mount = main.mount(given.mount)
    warnings = [w for run in made for w in run.warnings()] + [str(reason) for reason in reasons]
    corrections = main.corrections()
    trajectory = joined([own_part(start, run) if run.is_worse() else run.trajectory(given, mount) for run in made])
    return Estimate(
        trajectory,
        mount,
        main.SIGMA_SOURCE,
        main.lasers(given.lasers),
        report=main.report(given.mount),
        warning="; ".join(warnings),
        products=(
            functools.partial(_draw, main, given, trajectory),
            *(() if corrections is None else (functools.partial(_draw_lasers, corrections, given.lidar.lasers),)),
        ),
    )


def _draw(run: "Run | CausalRun", given: Given, trajectory: Trajectory, folder: pathlib.Path) -> None:
    from groundproc.products.adjustment_plot import draw_adjustment, sheet_of

    draw_adjustment(folder / "adjustment.png", sheet_of(run, given, trajectory))


def _draw_lasers(corrections: Corrections, nominal: LaserTable, folder: pathlib.Path) -> None:
    from groundproc.products.laser_plot import draw_lasers

    draw_lasers(folder / "lasers.png", corrections, nominal)


@dataclass(slots=True)
class Run:
    """The adjustment of one run of the lidar's clock: its windows, and the path joined of them.

    Attributes
    ----------
    windows : list of Window
    path : Path
    track : Track
    motion : Motion
    sources : Sources
    joined : Joined or None
        What the windows' joining found, where there is more than one.
    """

    SIGMA_SOURCE: ClassVar = (
        "posterior of the adjustment: what surfaces, the gyro between knots, lasting errors of the inertial units, GNSS and compass do "
        "to the solution; absolute position and heading are those of control, outside positions, GNSS and compass"
    )

    windows: list[Window]
    path: Path
    track: Track
    motion: Motion
    sources: Sources
    joined: Joined | None = None

    def estimates(self) -> dict[str, tuple[Array, Array]]:
        """Globals over all windows: mean by their variances, and its sigma; the compass curve is that of the windows' joining."""
        found = {}
        for name in self.windows[0].values:
            values = np.array([window.values[name][0] for window in self.windows])
            weights = np.array([window.values[name][1] for window in self.windows]) ** -2.0
            sigma = np.hypot(weights.sum(axis=0) ** -0.5, UNSEEN.get(name, 0.0))
            found[name] = ((weights * values).sum(axis=0) / weights.sum(axis=0), sigma)
        return found if self.joined is None else found | {"compass": self.joined.compass}

    def mount(self, nominal: Mount) -> Mount:
        """The mount as estimated."""
        values = self.estimates()
        if "ins.turn" not in values:
            return nominal
        mat = nominal.mat_ins_lidar() @ turned(-values["ins.turn"][0])
        heading, pitch, roll = (float(np.rad2deg(a[0])) for a in frames.attitude_of(mat[None]))
        lever = nominal.lidar_position_m()
        if "ins.lever" in values:
            lever = -mat @ values["ins.lever"][0]
        x, y, z = (float(v) for v in lever)
        return nominal.with_lidar(
            yaw_deg=(180.0 - heading) % 360.0 - 180.0, pitch_deg=pitch, roll_deg=roll, position_m=(x, y, z)
        )

    def corrections(self) -> Corrections | None:
        """Those of the lasers; None where they were not asked for."""
        told = corrections_over(self.windows)
        return None if told is None else Corrections(*told)

    def lasers(self, nominal: LaserTable) -> LaserTable:
        """The lasers as estimated, or as they were given."""
        found = self.corrections()
        return nominal if found is None else found.file(len(nominal)).table(nominal)

    def trajectory(self, given: Given, mount: Mount) -> Trajectory:
        """The path as that of the ins frame, with the posterior's sigmas."""
        position = np.concatenate([w.sigma_position_m[: w.own + (w is self.windows[-1])] for w in self.windows])
        attitude = np.concatenate([w.sigma_attitude_rad[: w.own + (w is self.windows[-1])] for w in self.windows])
        if self.joined is not None:
            position = np.hypot(position, self.joined.sigma_position_m[: len(position)])
            attitude = np.hypot(attitude, self.joined.sigma_attitude_rad[: len(attitude)])
        grid, knots = np.arange(len(self.path.quat)), np.arange(len(position)) * STEPS
        sigmas = (np.stack([np.interp(grid, knots, axis) for axis in part.T], axis=1) for part in (position, attitude))
        return of_ins(self.path, self.motion, given.frame, mount, *sigmas)

    def warnings(self) -> list[str]:
        """What the self-check found, a sentence each."""
        found = lost(self.track)
        chi_square = max(window.log[-1]["chi_square"] for window in self.windows)
        if chi_square > 2.0:
            found.append(
                f"the lidar's residuals are {chi_square:.1f} times what their noise explains, expected 1 or less; the cloud may be "
                "doubled"
            )
        moved = max(
            log[-1]["moved_m"] for log in [w.log for w in self.windows] + ([self.joined.log] if self.joined else [])
        )
        if moved > UNSETTLED_M:
            found.append(
                f"the last step still moved the path by {moved * 1e3:.0f} mm, expected under {UNSETTLED_M * 1e3:.0f}; it has not settled"
            )
        slid = self.slid_sigmas()
        if slid > SLID_SIGMAS:
            found.append(
                f"for {DRIFT_S} s the path slides away from the GNSS positions by {slid:.1f} sigma, expected under {SLID_SIGMAS:.0f}; "
                + (
                    "the trajectory is what the adjustment began from"
                    if self.is_misled()
                    else "the lidar may have been misled there"
                )
            )
        off = max(window.log[-1].get("position_rms", 0.0) for window in self.windows)
        if off > 4.0:
            found.append(
                f"the path differs from the GNSS positions by {off:.1f} sigma, expected 1; one of them is wrong"
            )
        off = max(window.log[-1].get("outside position_rms", 0.0) for window in self.windows)
        if off > 1.0:
            found.append(
                f"the path differs from {self.sources.outside[0].source} by {off:.1f} times what its sigmas explain though its errors "
                "last, expected under 1; sigmas, lever arm, heights or time scale of that file may be wrong"
            )
        return found + control_warnings(self.sources.control, self.control())

    def control(self) -> list[list[dict[str, Any]]]:
        """What is to be said of each control point: by the joining, or by the one window."""
        return [window.control for window in self.windows] if self.joined is None else [self.joined.control]

    def blind_s(self) -> float:
        """Seconds in which the lidar saw next to no planes, the first one left out: there is no map yet."""
        return float(sum(m < 50 for m in self.track.matched[10:]) * H)

    def is_blind(self) -> bool:
        """Whether the lidar saw nothing for most of the flight: without better positions it then knows no more than what it began from."""
        return self.blind_s() > 0.5 * len(self.track) * H and not self.sources.outside

    def slid_sigmas(self) -> float:
        """How far the path slid away from the fixes within `DRIFT_S`, in sigmas of such a mean."""
        return max(window.log[-1]["position_drift"] for window in self.windows)

    def is_misled(self) -> bool:
        """Whether the odometry lost its way and the batch did not find it again: the path goes where the fixes do not."""
        return self.track.restarts > 0 and self.slid_sigmas() > SLID_SIGMAS and not self.sources.outside

    def is_worse(self) -> bool:
        """Whether what the adjustment began from is better than what it made of it."""
        return self.is_blind() or self.is_misled()

    def note(self) -> str:
        """What a reader must know though nothing is wrong."""
        if self.is_misled():
            return "the lidar misled the adjustment: the trajectory is what it began from"
        if self.is_blind():
            return "the lidar saw next to no planes for most of the flight: the trajectory is what the adjustment began from"
        blind, whole = self.blind_s(), len(self.track) * H
        if blind <= 0.02 * whole:
            return ""
        return (
            f"{blind:.1f} s of {whole:.1f} s without planes to hold on to: there the path is the inertial sensors' and the GNSS's, "
            "and its sigma says so"
        )

    def priors(self) -> dict[str, Array]:
        """What was known of the globals before, one sigma."""
        known = {name: np.array(sigma) for name, sigma in PRIORS.items()} | {"compass": COMPASS_PRIOR}
        outside = self.sources.outside
        return known | ({DELAY: np.array(outside[0].delay_sigma_s)} if outside else {})

    def report(self, nominal: Mount) -> dict[str, Any]:
        """What stands in quality.json."""
        values: dict[str, Any] = {}
        priors = self.priors()
        corrections = self.corrections()
        for key, (value, sigma) in self.estimates().items():
            name = key.rsplit(".", 1)[-1]
            scale = np.rad2deg(1.0) if name in ("bias", "turn", "accel_turn", "compass") else 1.0
            prior = np.broadcast_to(priors[key], value.shape)
            values[key + _UNITS[name]] = {
                "value": (value * scale).tolist(),
                "sigma": (sigma * scale).tolist(),
                "prior_sigma": (prior * scale).tolist(),
                "held": (sigma > 0.7 * prior).tolist(),
            }
        mount = self.mount(nominal)
        return {
            "note": self.note(),
            "seconds": len(self.track) * H,
            "blind_s": self.blind_s(),
            "restarts": self.track.restarts,
            "windows": [
                {"start_s": w.first * H, "seconds": (w.last - w.first) * H, "rounds": w.log} for w in self.windows
            ],
            "joining": None if self.joined is None else self.joined.report(),
            "estimated": values,
            "control": control_report(self.sources.control, self.control()),
            "outside": [
                {
                    "source": outside.source,
                    "positions": int(within(outside.time_ns, self.path).sum()),
                    "residual_rms": max(w.log[-1].get("outside position_rms", 0.0) for w in self.windows),
                }
                for outside in self.sources.outside
            ],
            **({} if corrections is None else {"lasers": corrections.report()}),
            "mount_change": {
                "yaw_pitch_roll_deg": [
                    mount.lidar.yaw_deg - nominal.lidar.yaw_deg,
                    mount.lidar.pitch_deg - nominal.lidar.pitch_deg,
                    mount.lidar.roll_deg - nominal.lidar.roll_deg,
                ],
                "position_m": (mount.lidar_position_m() - nominal.lidar_position_m()).tolist(),
            },
        }


SLID_SIGMAS: Final = 6.0
"""A path that slides away from the fixes by more is worth a warning."""
UNSETTLED_M: Final = 0.03
"""A last step larger than this is worth a warning."""


def of_ins(
    path: Path, motion: Motion, frame: LocalFrame, mount: Mount, sigma_position_m: Array, sigma_attitude_rad: Array
) -> Trajectory:
    """The path of the sensor as the trajectory of the ins frame; sigmas on its grid."""
    mat_ins_lidar, lever = mount.mat_ins_lidar(), mount.lidar_position_m()
    back = frames.quat_from_mat(mat_ins_lidar.T[None])
    quat = frames.quat_multiply(path.quat, np.repeat(back, len(path.quat), axis=0))
    position = path.position_m - frames.mat_from_quat(quat) @ lever
    step_s = STEP_NS * 1e-9
    turn = frames.quat_log(frames.quat_multiply(frames.quat_inverse(quat[:-1]), quat[1:])) / step_s
    first = (path.start_ns - motion.start_ns) // STEP_NS
    return Trajectory(
        frame,
        grid_ns(path),
        position,
        np.gradient(position, step_s, axis=0),
        quat,
        np.concatenate([turn[:1], 0.5 * (turn[1:] + turn[:-1]), turn[-1:]]),
        sigma_position_m,
        sigma_attitude_rad,
        np.append(motion.known[first : first + len(quat) - 1], False),
    )


_UNITS: Final = {
    "bias": "_deg_s", "scale": "", "shear": "", "turn": "_deg", "delay": "_s", "drift": "", "accel_bias": "_m_s2",
    "accel_turn": "_deg", "lever": "_m",
    "compass": "_deg",
}  # fmt: skip


@dataclass(slots=True)
class CausalRun:
    """The odometry alone: what was known at each moment, a tenth of a second late."""

    SIGMA_SOURCE: ClassVar = (
        "the filter's covariance; position and heading as uncertain as the fix and the compass that it began from"
    )

    path: Path
    track: Track
    motion: Motion
    start_sigma_m: Array

    def mount(self, nominal: Mount) -> Mount:
        """The nominal mount: nothing else is known in time."""
        return nominal

    def trajectory(self, given: Given, mount: Mount) -> Trajectory:
        """The path as that of the ins frame."""
        sigma = np.array([self.track.sigma[0], *self.track.sigma])
        grid, knots = np.arange(len(self.path.quat)), np.arange(len(sigma)) * STEPS
        attitude, position = (
            np.stack([np.interp(grid, knots, axis) for axis in part.T], axis=1) for part in (sigma[:, :3], sigma[:, 3:])
        )
        attitude = np.hypot(attitude, ATTITUDE_SIGMA_RAD * np.array([1.0, 1.0, 2.5]))
        return of_ins(self.path, self.motion, given.frame, mount, np.hypot(position, self.start_sigma_m), attitude)

    def corrections(self) -> None:
        """The lasers are taken as they are given."""

    def lasers(self, nominal: LaserTable) -> LaserTable:
        """As they were given."""
        return nominal

    def is_worse(self) -> bool:
        """It is what it is."""
        return False

    def warnings(self) -> list[str]:
        """What the self-check found."""
        return lost(self.track)

    def report(self, nominal: Mount) -> dict[str, Any]:
        """What stands in quality.json."""
        del nominal
        return {
            "causal": True,
            "seconds": len(self.track) * H,
            "restarts": self.track.restarts,
            "median_matched": float(np.median(self.track.matched)),
            "median_residual_m": float(np.nanmedian(self.track.residual_m)),
        }


def own_part(start: Trajectory, run: Run | CausalRun) -> Trajectory:
    """The part of what was begun from that lies within a run."""
    first = run.path.start_ns
    return start.after(first - 1).before(int(grid_ns(run.path)[-1]))


def lost(track: Track) -> list[str]:
    """One sentence where the odometry lost its way."""
    if not track.restarts:
        return []
    return [
        f"the odometry lost its way {track.restarts} times and began anew from the autopilot's pose; the cloud is doubled there"
    ]


def causal_run(given: Given, legs: Sequence[Leg], number: int, start: Trajectory, progress: Progress) -> CausalRun:
    """Odometry over one run of the lidar's clock, nothing of the future used but the gyro's offset."""
    motion, own, other = base_motion(given, legs[0], given.flight.runs[number])
    positions = position_track(given, legs[0])
    mat, lever = given.mount.mat_ins_lidar(), given.mount.lidar_position_m()
    tracker = Tracker(
        motion,
        start,
        mat,
        lever,
        gyro_offset(motion, own, other),
        positions,
        keep=False,
        attitudes=attitude_track(legs[0]),
    )
    for piece in slices(given, motion.start_ns, progress):
        tracker.feed(piece)
    track = tracked(tracker)
    return CausalRun(track.causal_path(motion), track, motion, positions.sigma_m[0])


def adjust_run(
    given: Given,
    legs: Sequence[Leg],
    number: int,
    start: Trajectory,
    progress: Progress,
    exact: tuple[str, ...] = (),
) -> Run:
    """Adjust one run of the lidar's clock, window by window as the odometry goes on: the memory is that of a window.

    `exact` names globals whose covariance is wanted exactly.
    """
    motion, own, other = base_motion(given, max(legs, key=lambda leg: leg.sync.samples), given.flight.runs[number])
    mat, lever = given.mount.mat_ins_lidar(), given.mount.lidar_position_m()
    sources = Sources(
        {name: unit for name, unit in (("lidar", own), ("ins", other)) if unit is not None},
        [position_track(given, leg) for leg in legs],
        [attitude for leg in legs if (attitude := attitude_track(leg)) is not None],
        mat,
        lever,
        exact,
        [outside_track(fixes, mat, lever, legs[0].utc) for fixes in surveyed(given)],
        given.survey.lasers == ESTIMATE,
        surveyed_control(given),
    )
    tracker = Tracker(
        motion, start, mat, lever, gyro_offset(motion, own, other), sources.positions[0],
        attitudes=sources.attitudes[0] if sources.attitudes else None,
    )  # fmt: skip
    pace = Pace(progress)
    windows: list[Window] = []
    begin = 0
    early: list[Slice] = []
    for piece in slices(given, motion.start_ns, pace.read, sources.lasers_apart):
        tracker.feed(piece)
        if tracker.track is None:
            continue
        if len(tracker.track) <= BEGINNING:
            early.append(piece)
        if len(tracker.track) - begin >= WINDOW:
            _redo(tracker, motion, early)
            last = len(tracker.track)
            windows.append(
                adjust_window(tracker.track, motion, sources, begin, last, windows, more=True, told=pace.stepped)
            )
            pace.caught_up()
            begin = last - OVERLAP
            windows[-1].own = begin - windows[-1].first
    track = tracked(tracker)
    _redo(tracker, motion, early)
    if not windows or len(track) - begin > OVERLAP:
        windows.append(adjust_window(track, motion, sources, begin, len(track), windows, more=False, told=pace.stepped))
    else:
        windows[-1].own = windows[-1].last - windows[-1].first
    pace.caught_up()
    return joined_run(windows, track, motion, sources)


def _redo(tracker: Tracker, motion: Motion, early: list[Slice]) -> None:
    """The beginning again, before the first window; its slices are not kept after that."""
    if early and tracker.track is not None and tracker.odometry is not None:
        redo_beginning(tracker.track, motion, early, tracker.odometry.state)
    early.clear()


def joined_run(windows: list[Window], track: Track, motion: Motion, sources: Sources) -> Run:
    """The windows as one run: more than one are adjusted together."""
    run = Run(windows, joined_path(windows), track, motion, sources)
    if windows[0].seen is None:
        return run
    values = run.estimates()
    boresight = turned(values["ins.turn"][0]) if "ins.turn" in values else np.eye(3)
    run.joined = joining(
        run.path, all_patches(windows), whole_stiffness(windows), sources.positions, sources.attitudes,
        boresight @ sources.mat_ins_lidar.T, values["compass"][0], sources.outside,
        float(values[DELAY][0][0]) if DELAY in values else 0.0, sources.control, control_clusters(windows),
    ).run()  # fmt: skip
    run.path = run.joined.applied(run.path)
    for window in windows:
        window.seen = None
    return run


class Pace:
    """Tells the progress of reading and adjusting as one: a window's bytes count in part as they are read, in part as it is adjusted.

    Parameters
    ----------
    progress : callable
    """

    READING: Final = 0.4
    """Part of the work that is done while the log is read: the odometry."""
    STEPS: Final = 8
    """Steps that a window takes, or so."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._owed, self._step = 0, 0

    def read(self, stage: str, done: int) -> None:
        """So many bytes more are read."""
        now = round(self.READING * done)
        self._owed += done - now
        self._step = self._owed // self.STEPS
        self._progress(stage, now)

    def stepped(self) -> None:
        """A step of a window is done."""
        self._pay(min(self._step, self._owed))

    def caught_up(self) -> None:
        """A window is done."""
        self._pay(self._owed)

    def _pay(self, done: int) -> None:
        self._owed -= done
        self._progress("adjust", done)


def gyro_offset(motion: Motion, own: ImuTrack | None, other: ImuTrack | None) -> Array:
    """Where to begin with the bias of the gyro that carries the motion: its mean difference from the autopilot's, which has a small one."""
    if own is None or other is None or motion.source != own.name:
        return np.zeros(3)
    rate, known = on_grid(other.time_ns, other.rate_rad_s, motion.start_ns, len(motion))
    own_rate, own_known = on_grid(own.time_ns, own.rate_rad_s, motion.start_ns, len(motion))
    both = known & own_known
    return np.asarray((own_rate - rate)[both].mean(axis=0)) if both.any() else np.zeros(3)


def position_track(given: Given, leg: Leg) -> Positions:
    """The autopilot's positions in the local frame."""
    fixes = given.fixes[list(given.placed).index(leg)]
    place = given.frame.from_geodetic(fixes.latitude_deg, fixes.longitude_deg, fixes.height_m)
    mat, lever = given.mount.mat_ins_lidar(), given.mount.lidar_position_m()
    antenna = np.zeros(3) if given.mount.gps_position_m is None else np.array(given.mount.gps_position_m)
    good = measured(leg.boot, fixes.time_ns)
    return Positions(
        leg.utc_from_boot(fixes.time_ns[good]),
        place[good],
        np.maximum(fixes.sigma_m[good], LEAST_POSITION_SIGMA_M),
        mat.T @ (antenna - lever),
        POSITION_TAU_S,
        POSITION_WHITE_M,
    )


RECOVERY_NS: Final = 30 * NS_PER_S
"""So long after a fix is back, the autopilot's position still comes back from where it had drifted to."""


def measured(boot: Boot, time_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Which positions rest on satellites: without a fix an autopilot goes on with a position that drifts away, and says so elsewhere."""
    if not boot.has("GPS_RAW_INT", 2):
        return np.ones(len(time_ns), np.bool_)
    gps_ns, fixed = boot.stamps_ns["GPS_RAW_INT"], boot.tables["GPS_RAW_INT"]["fix_type"] >= 3
    row = np.clip(np.searchsorted(gps_ns, time_ns, side="right") - 1, 0, len(gps_ns) - 1)
    # a message late: between the last with a fix and the first without, it may be lost already
    good = fixed[row] & fixed[np.minimum(row + 1, len(fixed) - 1)]
    for regained_ns in gps_ns[1:][fixed[1:] & ~fixed[:-1]].tolist():
        good &= (time_ns < regained_ns) | (time_ns > regained_ns + RECOVERY_NS)
    return np.asarray(good if good.sum() >= 2 else np.ones(len(time_ns), np.bool_))


def attitude_track(leg: Leg) -> Attitudes | None:
    """The autopilot's attitudes."""
    if ins.attitude_source(leg.boot) is None:
        return None
    _, time_ns, quat, _ = ins.attitudes(leg.boot)
    return Attitudes(leg.utc_from_boot(time_ns), quat, ATTITUDE_SIGMA_RAD, ATTITUDE_TAU_S)
