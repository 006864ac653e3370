"""Windows of a long flight: each a batch of its own, tied to the one before and joined into one path.

The errors that are then left between windows are for `joining`.
"""

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.estimation.adjustment.batch import DRAWS, Batch
from groundproc.estimation.adjustment.bridging import along_untold
from groundproc.estimation.adjustment.joining import Stiffness, stiffness_of
from groundproc.estimation.adjustment.loops import closed_loops
from groundproc.estimation.adjustment.patches import Patches, all_of, coarse, patches_of
from groundproc.estimation.adjustment.poses import PoseErrors, pose_errors
from groundproc.estimation.adjustment.posterior import Posterior, Spread, joined
from groundproc.estimation.adjustment.skew import misalignment_rad
from groundproc.estimation.observations import lasers
from groundproc.estimation.observations.inertial import carried_density, gyro_readings, retiming_of
from groundproc.estimation.observations.lidar import Lidar
from groundproc.estimation.observations.observation import Observation, Stretch
from groundproc.estimation.observations.rows import H, Unknowns
from groundproc.estimation.observations.spin import spin_of
from groundproc.estimation.observations.tie import Tie
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.grid import SLICE_NS, STEPS
from groundproc.estimation.odometry.matching import TELLS_M
from groundproc.estimation.odometry.motion import LIDAR, Motion
from groundproc.estimation.odometry.spline import Path
from groundproc.estimation.odometry.track import Track
from groundproc.machine.aside import aside
from groundproc.machine.readahead import both
from groundproc.machine.system import give_back_memory, large_blocks_given_back
from groundproc.trajectory.covariance import SIZE

Array = npt.NDArray[np.float64]

WINDOW: Final = 2100
"""Slices of a window, three and a half minutes: most flights of a multirotor are one to three windows, and one takes about 1 GB."""
OVERLAP: Final = 200
LEVER_FLOOR_M: Final = 0.003
"""What the residuals do not show of the lever arm: it is found through accelerometers, whose axes are no better than a gyro's (`skew`)."""
SMOOTH: Final = 11
SMOOTH_DRAWS: Final = 101
"""Slices over which variances of poses are averaged, and correlations of what is drawn: ten seconds hold several times the errors that
one knot has, and a leg of the flight is longer."""
CALIBRATION: Final = ("ins.turn", "ins.lever", "ins.scale", "ins.delay", "ins.drift", "lidar.delay")
"""Globals that other flights use: their covariance is not drawn, but solved for column by column."""


@dataclass(slots=True)
class Sources:
    """What the batch needs besides the lidar.

    Attributes
    ----------
    observations : sequence of Observation
        Not begun.
    mat_ins_lidar, lever_m : ndarray
        Nominal mount.
    exact : tuple of str
        Globals whose covariance is wanted exactly.
    lasers_apart : bool
        Whether clusters are of one laser each, and the corrections of lasers unknowns.
    known : mapping of str to float
        What of a global has been taken off the readings already: reports state the whole.
    """

    observations: Sequence[Observation]
    mat_ins_lidar: Array
    lever_m: Array
    exact: tuple[str, ...] = ()
    lasers_apart: bool = False
    known: Mapping[str, float] = field(default_factory=dict)

    def leads(self) -> bool:
        """Whether something is better, where the lidar sees nothing, than what the adjustment began from."""
        return any(each.leads for each in self.observations)


TIED: Final = 1e-6
"""Share of the prior of the whole's turn and shift that is left to a window that is tied to another."""


@dataclass(slots=True)
class Window:
    """One adjusted window.

    Attributes
    ----------
    first, last : int
        Slices, counted from the track's first.
    own : int
        Slices until the next window's begin; all of them for the last.
    path : Path
    values : dict of str to (ndarray, ndarray)
        Globals and their sigmas.
    unknowns : Unknowns
        What was known of the globals before, and their units.
    sigma_position_m, sigma_attitude_rad : ndarray, shape (slices + 1, 3)
        At slice boundaries: east, north, up; roll, pitch, heading; of the ins frame.
    log : list of dict
        What each Gauss-Newton step said.
    covariance : ndarray or None
        Of the globals asked for exactly, without what a gyro's axes may differ from its board's.
    corrections : tuple of (ndarray, ndarray), optional
        Of the lasers, shape (64,), and their covariance.
    told : dict of str to Any
        What the observations say, by their names.
    seen : Seen or None
        What the joining needs of it; a window that is the whole flight is not joined, and its sigmas are those of the whole. Those of
        the others are what they do not know of themselves.
    correlation : ndarray, shape (slices + 1, 6, 6)
        Of the errors of position and attitude.
    density : float
        Noise of the turns of the gyro that carries the motion, as learnt [rad/sqrt(s)].
    datum : ndarray, shape (6, 6)
        Of the shift and the turn about the origin that the whole window shares.
    loops : list of dict
        Places that it came back to metres beside itself, and was laid on, for the report.
    beside : int
        Pieces that lie beside what was seen there before, and were not found on it.
    """

    first: int
    last: int
    own: int
    path: Path
    values: dict[str, tuple[Array, Array]]
    unknowns: Unknowns
    sigma_position_m: Array
    sigma_attitude_rad: Array
    log: list[dict[str, float]]
    covariance: Array | None = None
    corrections: tuple[Array, Array] | None = None
    told: dict[str, Any] = field(default_factory=dict)
    seen: "Seen | None" = None
    correlation: Array = field(default_factory=lambda: np.zeros((0, SIZE, SIZE)))
    density: float = 0.0
    datum: Array = field(default_factory=lambda: np.zeros((SIZE, SIZE)))
    loops: list[dict[str, float]] = field(default_factory=list)
    beside: int = 0

    def set_aside(self) -> None:
        """Have what grows with the flight in a file until the windows are joined."""
        quat, position_m, self.correlation = aside(self.path.quat, self.path.position_m, self.correlation)
        self.path = replace(self.path, quat=quat, position_m=position_m)
        if self.seen is not None:
            self.seen.patches.set_aside()


@dataclass(slots=True)
class Seen:
    """What is kept of a window for the joining: some megabytes.

    Attributes
    ----------
    patches : Patches
    stiffness : Stiffness
    kept : dict of str to Any
        What the observations need of it, by their names.
    """

    patches: Patches
    stiffness: Stiffness
    kept: dict[str, Any] = field(default_factory=dict)


@large_blocks_given_back()
def adjust_window(
    track: Track, motion: Motion, sources: Sources, first: int, last: int, before: Sequence[Window], *, more: bool,
    told: Callable[[], None] = lambda: None,
) -> Window:  # fmt: skip
    """Adjust slices `first` to `last` of a track, tied to the last of the windows `before`; whether there is `more` to come.

    `told` is called after each step.
    """
    path, tie = track.path(motion, first, last), None
    if before:
        previous = before[-1]
        previous.own = first - previous.first
        common = slice((first - previous.first) * STEPS, (first - previous.first + OVERLAP) * STEPS, STEPS)
        tie = Tie(previous.path.quat[common], previous.path.position_m[common], _walked(previous, first))
        path = _laid_on(path, tie)
    give_back_memory()  # what the odometry freed is in pieces that are too small for a window
    loops = closed_loops(path, track, first, last)
    path = loops.path
    mat, lever = sources.mat_ins_lidar, sources.lever_m
    bias = track.gyro_bias[first:last].mean(axis=0)
    unheld_m = np.array(track.unheld_m[first:last])
    stretch = Stretch(
        path, motion.source, bias, not before and not more,
        None if track.restarts else unheld_m, unheld_m <= TELLS_M,
    )  # fmt: skip
    observations = [each.begin(stretch) for each in sources.observations] + ([] if tie is None else [tie])
    lidar = Lidar(track.gathered(first, last, sources.lasers_apart), retiming=retiming_of(observations, motion.source))
    track.forget(last - OVERLAP if more else last)
    lidar.clusters.set_aside()
    give_back_memory()
    lidar.doubted = along_untold(track)[first:last]
    if motion.source == LIDAR:
        lidar.spin = spin_of(lidar.clusters, path)
        if lidar.spin is not None:
            lidar.spin.read(gyro_readings(observations))
    give_back_memory()
    batch = Batch(path, lidar, observations, mat.T, free=1.0 if tie is None else TIED, told=told)
    posterior = batch.run()
    unknowns, said, seen = batch.unknowns(), batch.said(), None
    if before or more:
        frame = coarse(batch.path)
        kept = {each.name: each.keep(batch.state(), frame) for each in observations}
        patches = patches_of(lidar.clusters, batch.path, len(before))
    batch.log[-1] |= posterior.figures()
    lidar.clusters = Clusters.none()  # what is left to do takes the rows alone, and much more
    give_back_memory()
    wanted = [name for name in dict.fromkeys((*sources.exact, *CALIBRATION)) if name in posterior.unknowns.names]
    spread, covariance, datum = _solved(posterior, wanted)
    values, exact = _values(unknowns, posterior.unknowns.names, spread, (wanted, covariance), sources.exact)
    corrections, solved = None, posterior.unknowns
    if sources.lasers_apart:
        corrections = lidar.corrections, lasers.stretched(posterior.weighed(lasers.NAMES), lasers.STRETCH)
    del posterior  # and all rows with it
    give_back_memory()
    if before or more:
        seen = Seen(patches, stiffness_of(batch.path, solved, spread.whole), kept)
        # how the whole lies is asked for when all windows are joined
        spread = spread.without([solved.names[name] for name in ("world.turn", "world.shift")])
    skew_rad = misalignment_rad(values, mat) if "ins.turn" in values else 0.0
    errors = _errors(batch.path, solved, spread, mat, lever, (motion.rate_density, skew_rad))
    return Window(
        first, last, last - first, batch.path, values, unknowns, errors.sigma_position_m, errors.sigma_attitude_rad,
        batch.log, exact, corrections, said, seen, errors.correlation,
        carried_density(observations, motion.rate_density), datum, loops.closed, loops.apart,
    )  # fmt: skip


def unseen(values: Mapping[str, tuple[Array, Array]], mat_ins_lidar: Array) -> dict[str, float]:
    """Uncertainty that the residuals do not show, by the global that contains it, of what is known of all of them."""
    return {"ins.turn": misalignment_rad(values, mat_ins_lidar), "ins.lever": LEVER_FLOOR_M}


def corrections_over(windows: Sequence[Window]) -> tuple[Array, Array] | None:
    """Corrections of the lasers that all windows together give, and their covariance; None where they were no unknowns."""
    told = [window.corrections for window in windows if window.corrections is not None]
    return joined([o for o, _ in told], [square for _, square in told], lasers.PRIOR) if told else None


def _walked(previous: Window, first: int) -> Array:
    """Variance of a window's positions over its overlap with the next against the first of them [m^2], shape (OVERLAP, 3)."""
    if previous.seen is None:
        return np.zeros((OVERLAP, 3))
    gained = previous.seen.stiffness.shift[first - previous.first :][: OVERLAP - 1] * H
    return np.concatenate([np.zeros((1, 3)), np.cumsum(gained, axis=0)])


def _laid_on(path: Path, tie: Tie) -> Path:
    """The path turned and moved as a whole so that its begin lies on a tie."""
    count = len(tie.quat)
    quat, place = path.quat[: count * STEPS : STEPS], path.position_m[: count * STEPS : STEPS]
    off = frames.quat_log(frames.quat_multiply(tie.quat, frames.quat_inverse(quat)))
    mat = frames.mat_from_quat(frames.quat_exp(off.mean(axis=0)[None]))[0]
    return path.turned(mat, (tie.position_m - place @ mat.T).mean(axis=0))


def _solved(posterior: Posterior, wanted: Sequence[str]) -> tuple[Spread, Array, Array]:
    """Draws of the errors; meanwhile, by a second thread, the covariance of some globals and that of the datum: all take the same rows."""
    spread, (covariance, datum) = both(
        lambda: posterior.spread(DRAWS), lambda: (posterior.covariance(wanted), posterior.datum())
    )
    return spread, covariance, datum


def _values(
    unknowns: Unknowns, names: Mapping[str, slice], spread: Spread, solved: tuple[Sequence[str], Array], exact: Sequence[str]
) -> tuple[dict[str, tuple[Array, Array]], Array | None]:  # fmt: skip
    """Globals with their sigmas, and the covariance of those that are asked for exactly.

    `unknowns` are those after the last step; `names` say where they stand in what is spread; `solved` are some of them, those that
    are asked for first, and their covariance.
    """
    found = {}
    for name, where in names.items():
        if name.partition(".")[0] not in ("world", "lasers"):
            found[name] = (unknowns.value[name], np.sqrt(spread.variance(operator.itemgetter(where))))
    wanted, covariance = solved
    at = 0
    for name in wanted:
        size = names[name].stop - names[name].start
        found[name] = (found[name][0], np.sqrt(np.diag(covariance)[at : at + size]))
        at += size
    asked = sum(names[name].stop - names[name].start for name in exact if name in names)
    return found, covariance[:asked, :asked] if exact and set(exact) <= set(found) else None


def _errors(
    path: Path, unknowns: Unknowns, spread: Spread, mat_ins_lidar: Array, lever: Array, beyond: tuple[float, float]
) -> PoseErrors:
    """Errors of position and of roll, pitch, heading of the ins frame at the slice boundaries.

    `beyond` is what comes on top: noise of the gyro between two knots [rad/sqrt(s)], turn of the other's axes on their board [rad].
    """
    rate_density, skew_rad = beyond
    quat, place = path.quat[::STEPS], path.position_m[::STEPS]
    mats = frames.mat_from_quat(quat)
    to_ins = -mat_ins_lidar.T @ lever
    heading, pitch, _ = frames.attitude_of(mats @ mat_ins_lidar.T)
    right = np.stack([np.cos(heading), -np.sin(heading)], axis=1)
    ahead = np.stack([np.sin(heading), np.cos(heading)], axis=1)

    def poses(x: Array) -> Array:
        """Errors of position, and turns about the levelled axes forward, right, up, shape (n, 6)."""
        part = {name: x[where] for name, where in unknowns.names.items()}
        spline = x[: unknowns.path_size].reshape(-1, 6)
        at = (spline[:-2] + 4.0 * spline[1:-1] + spline[2:]) / 6.0
        in_body = at[:, :3] + part.get("ins.turn", np.zeros(3))
        turn = np.einsum("nij,nj->ni", mats, in_body) + part["world.turn"]
        arm = np.cross(at[:, :3], to_ins) + part.get("ins.lever", np.zeros(3))
        moved = at[:, 3:] + np.cross(part["world.turn"], place) + part["world.shift"]
        position = moved + np.einsum("nij,nj->ni", mats, arm)
        forward, sideways = (turn[:, :2] * ahead).sum(axis=1), (turn[:, :2] * right).sum(axis=1)
        return np.column_stack([position, forward, sideways, turn[:, 2]])

    # what the gyro adds between two knots, the mean of a Brownian bridge
    bridge = rate_density**2 * H / 6.0
    return pose_errors(spread, poses, pitch, smooth=SMOOTH, smooth_draws=SMOOTH_DRAWS, extra=bridge + skew_rad**2)


def joined_path(windows: Sequence[Window]) -> Path:
    """The windows' paths as one, each faded into the next over their overlap."""
    path = windows[0].path
    for window in windows[1:]:
        begin = (window.first - windows[0].first) * STEPS
        shared = len(path.quat) - begin
        share = np.linspace(0.0, 1.0, shared)[:, None]
        turn = frames.quat_log(frames.quat_multiply(frames.quat_inverse(path.quat[begin:]), window.path.quat[:shared]))
        quat = frames.quat_multiply(path.quat[begin:], frames.quat_exp(share * turn))
        place = path.position_m[begin:] + share * (window.path.position_m[:shared] - path.position_m[begin:])
        path = Path(
            path.start_ns,
            np.concatenate([path.quat[:begin], quat, window.path.quat[shared:]]),
            np.concatenate([path.position_m[:begin], place, window.path.position_m[shared:]]),
        )
    return path


def all_patches(windows: Sequence[Window]) -> Patches:
    """What all windows saw; of an overlap each says what is nearer to its own middle."""
    parts = []
    for number, window in enumerate(windows):
        if window.seen is None:
            continue
        begin = window.first + (OVERLAP // 2 if number else 0)
        end = windows[number + 1].first + OVERLAP // 2 if number + 1 < len(windows) else window.last
        slot = window.first + (window.seen.patches.clusters.time_ns - window.path.start_ns) // SLICE_NS
        parts.append(window.seen.patches.of((slot >= begin) & (slot < end)))
    return all_of(parts)


def observations_joined(
    windows: Sequence[Window], observations: Sequence[Observation], values: Mapping[str, Array]
) -> list[Observation]:
    """What the joining goes by, with globals as the windows found them and what these kept for it."""
    found = []
    for each in observations:
        kept = [window.seen.kept.get(each.name) for window in windows if window.seen is not None]
        joint = each.joined(values, kept)
        if joint is not None:
            found.append(joint)
    return found


def whole_stiffness(windows: Sequence[Window]) -> Stiffness:
    """Stiffness of all slices; the tilt is as well known as the first window's, which is tied to nothing."""
    parts = [(window, window.seen.stiffness) for window in windows if window.seen is not None]
    turn, shift = (np.concatenate([(s.turn, s.shift)[i][: w.own] for w, s in parts]) for i in range(2))
    return Stiffness(turn, shift, parts[0][1].tilt)
