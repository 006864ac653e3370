"""Method `adjusted`: the whole flight in one adjustment of lidar, inertial sensors, GNSS and compass.

packets --slices--> clusters --odometry--> path --batch--> path, mount, clocks, biases, compass; and the sigma of each.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.errors import LogError
from flightlog.mount import Mount
from groundproc.estimation.adjustment.figures import Figures, odometry_figures, outcome_figures, stated_figures
from groundproc.estimation.adjustment.joining import Joined, joining
from groundproc.estimation.adjustment.windows import (
    OVERLAP,
    UNSEEN,
    WINDOW,
    Sources,
    Window,
    adjust_window,
    all_patches,
    corrections_over,
    joined_path,
    observations_joined,
    whole_stiffness,
)
from groundproc.estimation.direct import ins_estimate
from groundproc.estimation.method import Given, Method, Progress
from groundproc.estimation.observations import observations_of
from groundproc.estimation.observations.attitudes import ATTITUDE_SIGMA_RAD, attitude_track
from groundproc.estimation.observations.fixes import SLID, SLID_SIGMAS, position_track
from groundproc.estimation.observations.lasers import Corrections
from groundproc.estimation.observations.lidar import plane_warnings
from groundproc.estimation.observations.observation import Flown, Outcome
from groundproc.estimation.observations.rows import H, turned
from groundproc.estimation.odometry.beginning import BEGINNING, redo_beginning
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.motion import ImuTrack, Motion, base_motion, on_grid
from groundproc.estimation.odometry.slices import Slice, slices
from groundproc.estimation.odometry.spline import Path
from groundproc.estimation.odometry.track import Track, Tracker, grid_ns, tracked
from groundproc.flight.timeline import Leg
from groundproc.geodesy import LocalFrame
from groundproc.sensors.lasers import ESTIMATE, LaserCorrections
from groundproc.trajectory.covariance import Correlation, correlation_of, scaled
from groundproc.trajectory.estimate import Estimate, MountSigma
from groundproc.trajectory.trajectory import Trajectory, joined

Array = npt.NDArray[np.float64]


def adjusted_estimate(given: Given, progress: Progress) -> Estimate:
    """Adjust every run of the lidar's clock, begun from the autopilot's solution.

    Raises
    ------
    LogError
        No run has lidar, inertial data and positions together.
    """
    begun = ins_estimate(given, progress)
    start = begun.trajectory
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
    # a run that is no better than its start tells nothing of the mount
    main = max(made, key=lambda run: (not run.is_worse(), len(run.path.quat)))
    mount = main.mount(given.mount)
    warnings = [w for run in made for w in run.warnings()] + [str(reason) for reason in reasons]
    corrections = main.corrections()
    trajectory = joined([own_part(start, run) if run.is_worse() else run.trajectory(given, mount) for run in made])
    return Estimate(
        trajectory,
        mount,
        begun.sigma_source if main.is_worse() else main.SIGMA_SOURCE,
        main.lasers(given.corrections, len(given.lidar.lasers)),
        mount_source=main.mount_source(given.mount_source),
        mount_sigma=main.mount_sigma(given.mount),
        report=main.report(given.mount),
        warning="; ".join(warnings),
        figures=_figures(main, given, trajectory) | ({} if corrections is None else corrections.figures(given.lasers)),
    )


def _figures(run: "Run | CausalRun", given: Given, trajectory: Trajectory) -> Figures:
    """What pictures show of a run."""
    windows = run.windows if isinstance(run, Run) else []
    seen = odometry_figures(run.track, run.motion, run.path if windows else None, trajectory)
    stated = stated_figures(
        int(seen["adjustment.begin_ns"]),
        run.path,
        [position_track(given, leg) for leg in given.placed],
        [attitude for leg in given.placed if (attitude := attitude_track(leg)) is not None],
        run.mount(given.mount).mat_ins_lidar(),
    )
    last_round = windows[-1].log[-1] if windows else {}
    estimated = run.report(given.mount).get("estimated", {})
    return seen | stated | outcome_figures(len(windows), run.track.restarts, run.is_worse(), last_round, estimated)


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
        """Globals over all windows: mean by their variances, and its sigma; what the joining found is that."""
        found = {}
        for name in self.windows[0].values:
            values = np.array([window.values[name][0] for window in self.windows])
            weights = np.array([window.values[name][1] for window in self.windows]) ** -2.0
            sigma = np.hypot(weights.sum(axis=0) ** -0.5, UNSEEN.get(name, 0.0))
            found[name] = ((weights * values).sum(axis=0) / weights.sum(axis=0), sigma)
        return found if self.joined is None else found | self.joined.values

    def mount(self, nominal: Mount) -> Mount:
        """The mount as estimated; the nominal one where the trajectory is what the run began from, which was made with it."""
        if not self.estimates_mount():
            return nominal
        values = self.estimates()
        mat = nominal.mat_ins_lidar() @ turned(-values["ins.turn"][0])
        heading, pitch, roll = (float(np.rad2deg(a[0])) for a in frames.attitude_of(mat[None]))
        lever = nominal.lidar_position_m()
        if "ins.lever" in values:
            lever = -mat @ values["ins.lever"][0]
        return nominal.with_lidar(
            yaw_deg=(180.0 - heading) % 360.0 - 180.0, pitch_deg=pitch, roll_deg=roll, position_m=_three(lever)
        )

    def corrections(self) -> Corrections | None:
        """Those of the lasers; None where they were not asked for."""
        told = corrections_over(self.windows)
        return None if told is None else Corrections(*told)

    def mount_source(self, nominal: str) -> str:
        """Where the mount comes from; `nominal` is where that came from which it began with."""
        return f"estimated by adjusted, begun from {nominal}" if self.estimates_mount() else nominal

    def mount_sigma(self, nominal: Mount) -> MountSigma | None:
        """How well the mount is known: the turn about the sensor's axes, the lever arm in the ins frame."""
        if not self.estimates_mount():
            return None
        values = self.estimates()
        turn, lever = values["ins.turn"][1], None
        if "ins.lever" in values:
            square = np.square(self.mount(nominal).mat_ins_lidar()) @ np.square(values["ins.lever"][1])
            lever = _three(np.sqrt(square))
        return MountSigma(_three(turn), lever)

    def estimates_mount(self) -> bool:
        """Whether the mount is estimated: it is not without the autopilot's gyro, nor where what the run began from is used."""
        return "ins.turn" in self.windows[0].values and not self.is_worse()

    def lasers(self, nominal: LaserCorrections, count: int) -> LaserCorrections:
        """Corrections of the sensor's lasers, so many, as estimated, or as they were given."""
        found = self.corrections()
        return nominal if found is None or self.is_worse() else found.file(count)

    def trajectory(self, given: Given, mount: Mount) -> Trajectory:
        """The path as that of the ins frame, with the posterior's sigmas."""
        position, attitude, correlation = (
            np.concatenate([getattr(w, name)[: w.own + (w is self.windows[-1])] for w in self.windows])
            for name in ("sigma_position_m", "sigma_attitude_rad", "correlation")
        )
        if self.joined is not None:
            count = len(position)
            whole = self.joined.sigma_position_m[:count], self.joined.sigma_attitude_rad[:count]
            covariance = scaled(correlation, position, attitude) + scaled(self.joined.correlation[:count], *whole)
            position, attitude = np.hypot(position, whole[0]), np.hypot(attitude, whole[1])
            correlation = correlation_of(np.arange(count), covariance).matrix
        grid, knots = np.arange(len(self.path.quat)), np.arange(len(position)) * STEPS
        sigmas = (np.stack([np.interp(grid, knots, axis) for axis in part.T], axis=1) for part in (position, attitude))
        made = of_ins(self.path, self.motion, given.frame, mount, *sigmas)
        return replace(made, correlation=Correlation(made.time_ns[knots], correlation))

    def warnings(self) -> list[str]:
        """What the self-check found, a sentence each."""
        found = lost(self.track)
        found += plane_warnings(self.outcome())
        moved = max(
            log[-1]["moved_m"] for log in [w.log for w in self.windows] + ([self.joined.log] if self.joined else [])
        )
        if moved > UNSETTLED_M:
            found.append(
                f"the last step still moved the path by {moved * 1e3:.0f} mm, expected under {UNSETTLED_M * 1e3:.0f}; it has not settled"
            )
        outcome = self.outcome()
        # several legs have one and the same thing to say
        said = dict.fromkeys(sentence for each in self.sources.observations for sentence in each.warnings(outcome))
        return [*found, *said]

    def outcome(self) -> Outcome:
        """What came of it, for the observations to report on."""
        told = [window.told for window in self.windows] if self.joined is None else [self.joined.told]
        return Outcome(self.path, [window.log[-1] for window in self.windows], told, self.is_misled())

    def blind_s(self) -> float:
        """Seconds in which the lidar saw next to no planes, the first one left out: there is no map yet."""
        return float(sum(m < 50 for m in self.track.matched[10:]) * H)

    def is_blind(self) -> bool:
        """Whether the lidar saw nothing for most of the flight: without better positions it then knows no more than what it began from."""
        return self.blind_s() > 0.5 * len(self.track) * H and not self.sources.leads()

    def slid_sigmas(self) -> float:
        """How far the path slid away from the fixes within `DRIFT_S`, in sigmas of such a mean."""
        return max(window.log[-1].get(SLID, 0.0) for window in self.windows)

    def is_misled(self) -> bool:
        """Whether the odometry lost its way and the batch did not find it again: the path goes where the fixes do not."""
        return self.track.restarts > 0 and self.slid_sigmas() > SLID_SIGMAS and not self.sources.leads()

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

    def report(self, nominal: Mount) -> dict[str, Any]:
        """What stands in quality.json."""
        values: dict[str, Any] = {}
        corrections, known = self.corrections(), self.windows[0].unknowns
        for name, (value, sigma) in self.estimates().items():
            unit = known.unit[name]
            scale = float(np.rad2deg(1.0)) if unit.startswith("deg") else 1.0
            prior = known.sigma[name]
            values[f"{name}_{unit}" if unit else name] = {
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
            **self._observed(),
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

    def _observed(self) -> dict[str, Any]:
        """What the observations report: lists of several under one name are put together."""
        outcome = self.outcome()
        told: dict[str, Any] = {"control": None, "outside": []}
        for each in self.sources.observations:
            for name, said in each.report(outcome).items():
                told[name] = told.get(name, []) + said if isinstance(said, list) else said
        return told


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

    def lasers(self, nominal: LaserCorrections, count: int) -> LaserCorrections:
        """As they were given."""
        del count
        return nominal

    def mount_source(self, nominal: str) -> str:
        """The nominal mount's."""
        return nominal

    def mount_sigma(self, nominal: Mount) -> None:
        """Nothing is said of it."""

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


def _three(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


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
    units = {name: unit for name, unit in (("lidar", own), ("ins", other)) if unit is not None}
    mat, lever = given.mount.mat_ins_lidar(), given.mount.lidar_position_m()
    observations = observations_of(Flown(given, legs, units))
    sources = Sources(observations, mat, lever, exact, given.survey.lasers == ESTIMATE)
    tracker = Tracker(
        motion, start, mat, lever, gyro_offset(motion, own, other), position_track(given, legs[0]),
        attitudes=next((found for leg in legs if (found := attitude_track(leg)) is not None), None),
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
    found = {name: value for name, (value, _) in values.items()}
    observations = observations_joined(windows, sources.observations, found)
    mat_sensor_ins = boresight @ sources.mat_ins_lidar.T
    run.joined = joining(run.path, all_patches(windows), whole_stiffness(windows), observations, mat_sensor_ins).run()
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


METHOD: Final = Method(
    adjusted_estimate, options=("positions", "control", "causal"), finds_lasers=True, uses_points=True
)
