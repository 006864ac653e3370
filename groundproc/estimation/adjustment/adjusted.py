"""Method `adjusted`: the whole flight in one adjustment of lidar, inertial sensors, GNSS and compass.

packets --slices--> clusters --odometry--> path --batch--> path, mount, clocks, biases, compass, and the sigma of each
packets, once more --fine--> the motion between the knots
"""

import contextlib
import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import LogError
from groundproc.estimation.adjustment.causal import CausalRun, causal_run
from groundproc.estimation.adjustment.figures import Figures, odometry_figures, outcome_figures, stated_figures
from groundproc.estimation.adjustment.fine import refined
from groundproc.estimation.adjustment.joining import joining
from groundproc.estimation.adjustment.pace import Pace, Part
from groundproc.estimation.adjustment.refuting import parted, slid_sigmas
from groundproc.estimation.adjustment.run import Run
from groundproc.estimation.adjustment.windows import (
    OVERLAP,
    WINDOW,
    Sources,
    Window,
    adjust_window,
    all_patches,
    joined_path,
    observations_joined,
    whole_stiffness,
)
from groundproc.estimation.direct import ins_estimate
from groundproc.estimation.filtered import filtered_estimate
from groundproc.estimation.method import Given, Method, Progress
from groundproc.estimation.observations import observations_of
from groundproc.estimation.observations.attitudes import attitude_track
from groundproc.estimation.observations.fixes import SLID_SIGMAS, position_track
from groundproc.estimation.observations.observation import Flown, Observation
from groundproc.estimation.observations.rows import turned
from groundproc.estimation.odometry.beginning import AFTER, BEGINNING, redo_beginning
from groundproc.estimation.odometry.motion import Motion, base_motion, gyro_offset
from groundproc.estimation.odometry.slices import Slice, slices
from groundproc.estimation.odometry.stated import Recorded
from groundproc.estimation.odometry.track import Track
from groundproc.estimation.odometry.tracker import Tracker, tracked
from groundproc.flight.timeline import Leg
from groundproc.machine.aside import aside
from groundproc.machine.system import give_back_memory, large_blocks_given_back
from groundproc.sensors.lasers import ESTIMATE
from groundproc.trajectory.estimate import Estimate
from groundproc.trajectory.trajectory import Trajectory, joined

Array = npt.NDArray[np.float64]

REFINING: Final = 0.2
"""Part of the work that is done while the log is read for the second time."""
FIRM: Final = 1.5
"""Times the usual sigma of its places up to which a smoother's trajectory guides the odometry."""
LEAST_LASERS: Final = 8
"""Fewest lasers of a lidar whose motion the adjustment can find from its returns."""


def adjusted_estimate(given: Given, progress: Progress, more: Sequence[Observation] = ()) -> Estimate:
    """Adjust every run of the lidar's clock, begun from the smoother's solution.

    Parameters
    ----------
    given : Given
    progress : Progress
    more : sequence of Observation
        From elsewhere, beside those of the log and of the survey: poses of images, steps of another odometry. Not used where the
        survey asks for nothing of the future.

    Raises
    ------
    LogError
        No run has lidar, inertial data and positions together, or the lidar has so few lasers that it does not see a surface
        twice within a slice.
    """
    if len(given.lidar.lasers) < LEAST_LASERS:
        raise LogError(
            f"adjusted: a {given.lidar.name} has {len(given.lidar.lasers)} laser; at least {LEAST_LASERS} are needed to see "
            "a surface again at once"
        )
    give_back_memory()
    begun = begun_from(given, progress)
    start, begun_sigma_source = begun.trajectory.set_aside(), begun.sigma_source
    del begun
    give_back_memory()
    made: list[Run | CausalRun] = []
    numbers: list[int] = []
    reasons: list[LogError] = []
    adjust = causal_run if given.survey.causal else functools.partial(whole_run, more=more)
    for number in sorted({leg.run for leg in given.placed}):
        legs = [leg for leg in given.placed if leg.run == number]
        try:
            made.append(adjust(given, legs, number, start, progress))
        except LogError as error:
            reasons.append(error)
        else:
            numbers.append(number)
    if not made:
        raise reasons[0]
    # a run that is no better than its start tells nothing of the mount
    main = max(made, key=lambda run: (not run.is_worse(), len(run.path.quat)))
    mount = main.mount(given.mount)
    warnings = [w for run in made for w in run.warnings()] + [str(reason) for reason in reasons]
    corrections = main.corrections()
    trajectory = joined(
        [
            own_part(start, given.placed, number)
            if run.is_worse()
            else run.bridged(run.trajectory(given, mount), start)
            for number, run in zip(numbers, made, strict=True)
        ]
    )
    return Estimate(
        trajectory,
        mount,
        begun_sigma_source if main.is_worse() else main.SIGMA_SOURCE,
        main.lasers(given.corrections, len(given.lidar.lasers)),
        mount_source=main.mount_source(given.mount_source),
        mount_sigma=main.mount_sigma(given.mount),
        report=main.report(given.mount),
        warning="; ".join(warnings),
        figures=_figures(main, given, trajectory) | ({} if corrections is None else corrections.figures(given.lasers)),
    )


def begun_from(given: Given, progress: Progress) -> Estimate:
    """What the adjustment begins from, and hands back at worst: the smoother's solution, whose heading and tilt are the better ones.

    The autopilot's own where nothing of the future may be used, and where the smoother has not what it needs.
    """
    if given.survey.causal:
        return ins_estimate(given, progress)
    try:
        return filtered_estimate(given, progress)
    except LogError:
        return ins_estimate(given, progress)


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


def own_part(start: Trajectory, placed: Sequence[Leg], number: int) -> Trajectory:
    """The part of what was begun from that belongs to a run, whatever of it the lidar saw: from the end of the one before to its own."""
    ends = {leg.run: int(leg.utc_from_lidar(np.array([leg.last_lidar_ns]))[0]) for leg in placed}
    before, after = (max((each for each in ends if each < number), default=None), any(each > number for each in ends))
    part = start if before is None else start.after(ends[before])
    return part.before(ends[number]) if after else part


def whole_run(
    given: Given,
    legs: Sequence[Leg],
    number: int,
    start: Trajectory,
    progress: Progress,
    more: Sequence[Observation] = (),
) -> Run:
    """Adjust one run of the lidar's clock, and stream it once more for its motion between the knots (`fine`)."""
    part = Part(progress, 1.0 - REFINING)
    run = adjust_run(given, legs, number, start, part, more=more)
    run.refuted = run.slides() and _refutes(start, run, given)
    if run.is_worse():
        part.rest("adjust")
        return run
    give_back_memory()
    corrected = replace(given, corrections=run.lasers(given.corrections, len(given.lidar.lasers)))
    pieces = slices(corrected, run.motion.start_ns, Part(progress, REFINING))
    density = float(np.mean([window.density for window in run.windows]))
    run.path = refined(run.path, pieces, run.motion.start_ns, density, run.track.voxel_m)
    return run


def adjust_run(
    given: Given,
    legs: Sequence[Leg],
    number: int,
    start: Trajectory,
    progress: Progress,
    exact: tuple[str, ...] = (),
    more: Sequence[Observation] = (),
) -> Run:
    """Adjust one run of the lidar's clock, window by window as the odometry goes on: the memory is that of a window.

    `exact` names globals whose covariance is wanted exactly; `more` are observations of neither the log nor the survey.
    """
    motion, own, other = base_motion(given, max(legs, key=lambda leg: leg.sync.samples), given.flight.runs[number])
    # of all of the flight only what a window or a slice asks for is in memory
    motion = motion.set_aside()
    own, other = (None if unit is None else unit.set_aside() for unit in (own, other))
    units = {name: unit for name, unit in (("lidar", own), ("ins", other)) if unit is not None}
    mat, lever = given.mount.mat_ins_lidar(), given.mount.lidar_position_m()
    observations = [*observations_of(Flown(given, legs, units)), *more]
    known = {"lidar.delay": given.survey.gyro_delay_ms * 1e-3}
    sources = Sources(observations, mat, lever, exact, given.survey.lasers == ESTIMATE, known)
    attitudes = next((found for leg in legs if (found := attitude_track(leg)) is not None), None)
    stated = Recorded(position_track(given, legs[0]), attitudes)
    tracker = Tracker(
        motion, start, mat, lever, gyro_offset(motion, own, other), stated, guide=firm(start), in_time=False
    )
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
        if len(tracker.track) >= BEGINNING + AFTER and tracker.odometry is not None and tracker.odometry.turns:
            tracker.odometry.turns = False  # only the map that the beginning is run again on goes by them
            early = _aside(early)
        if len(tracker.track) - begin >= WINDOW:
            tracker.settle()
            _redo(tracker, motion, early)
            last = len(tracker.track)
            with contextlib.nullcontext() if tracker.odometry is None else tracker.odometry.planes.set_aside():
                windows.append(
                    adjust_window(tracker.track, motion, sources, begin, last, windows, more=True, told=pace.stepped)
                )
            pace.caught_up()
            begin = last - OVERLAP
            windows[-1].own = begin - windows[-1].first
            windows[-1].set_aside()
            give_back_memory()
    track = tracked(tracker)
    _redo(tracker, motion, early)
    tracker.odometry = None  # and its map
    if not windows or len(track) - begin > OVERLAP:
        windows.append(adjust_window(track, motion, sources, begin, len(track), windows, more=False, told=pace.stepped))
    else:
        windows[-1].own = windows[-1].last - windows[-1].first
    pace.caught_up()
    return joined_run(windows, track, motion, sources)


def _refutes(start: Trajectory, run: Run, given: Given) -> bool:
    """Whether what a run began from agrees with the fixes, and moves elsewhere."""
    antenna = np.zeros(3) if given.mount.gps_position_m is None else np.array(given.mount.gps_position_m)
    fixes = [position_track(given, leg) for leg in given.placed]
    made = run.trajectory(given, run.mount(given.mount))
    return slid_sigmas(start, antenna, fixes) <= SLID_SIGMAS and parted(made, start)


def firm(guide: Trajectory) -> Trajectory:
    """What of a smoother's trajectory can tell that an odometry is wrong: in an outage of the GNSS it has metres a second of its own."""
    sigma = guide.sigma_position_m.max(axis=1)
    return replace(guide, covered=guide.covered & (sigma <= FIRM * np.nanmedian(sigma)))


def _aside(pieces: Sequence[Slice]) -> list[Slice]:
    """The same slices in a file: the beginning's are a hundred megabytes and more."""
    kept = iter(aside(*(array for piece in pieces for array in (piece.time_ns, piece.xyz_m))))
    return [replace(piece, time_ns=next(kept), xyz_m=next(kept)) for piece in pieces]


def _redo(tracker: Tracker, motion: Motion, early: list[Slice]) -> None:
    """The beginning again, before the first window; its slices are not kept after that."""
    if early and tracker.track is not None and tracker.odometry is not None:
        redo_beginning(tracker.track, motion, early, tracker.odometry, turns=False)
    early.clear()


@large_blocks_given_back()
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


METHOD: Final = Method(
    adjusted_estimate, options=("positions", "poses", "control", "causal"), finds_lasers=True, uses_points=True
)
