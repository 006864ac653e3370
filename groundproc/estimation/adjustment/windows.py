"""Windows of a long flight: each a batch of its own, tied to the one before where they overlap, and joined into one path.

What is left between them after that is for `joining`.
"""

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter1d

from flightlog import frames
from groundproc.estimation.adjustment import lasers
from groundproc.estimation.adjustment.anchors import Tie
from groundproc.estimation.adjustment.batch import DRAWS, Batch, make_unit
from groundproc.estimation.adjustment.control import kept_for, together
from groundproc.estimation.adjustment.factors import H, Unknowns
from groundproc.estimation.adjustment.joining import Stiffness, stiffness_of
from groundproc.estimation.adjustment.outside import DELAY, Outside
from groundproc.estimation.adjustment.patches import Patches, all_of, coarse, patches_of
from groundproc.estimation.adjustment.posterior import Posterior, Spread, joined
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.grid import SLICE_NS, STEPS
from groundproc.estimation.odometry.motion import ImuTrack, Motion
from groundproc.estimation.odometry.spline import Path
from groundproc.estimation.odometry.stated import Attitudes, Positions
from groundproc.estimation.odometry.track import Track
from groundproc.flight.control import ControlPoint

Array = npt.NDArray[np.float64]

WINDOW: Final = 2400
"""Slices of a window, four minutes: most flights of a multirotor are one to three windows, and one takes about 1 GB."""
OVERLAP: Final = 200
MISALIGNMENT_RAD: Final = np.deg2rad(0.2)
"""How far the axes of a cheap gyro are from those of its board (cross-axis sensitivity of its class, one sigma): the boresight is found
through the gyro, and no flight tells the two apart."""
LEVER_FLOOR_M: Final = 0.003
"""The same for the lever arm, which is found through accelerometers whose axes are no better."""
UNSEEN: Final = {"ins.turn": MISALIGNMENT_RAD, "ins.lever": LEVER_FLOOR_M}
"""What the residuals do not show, by the global that it is in."""
CALIBRATION: Final = ("ins.turn", "ins.lever", "ins.scale", "ins.delay", "ins.drift")
"""What other flights go by: their covariance is not drawn, but solved for column by column."""


@dataclass(slots=True)
class Sources:
    """What the batch needs besides the lidar.

    Attributes
    ----------
    units : mapping of str to ImuTrack
        "lidar", "ins" or both.
    positions, attitudes
    mat_ins_lidar, lever_m : ndarray
        Nominal mount.
    exact : tuple of str
        Globals whose covariance is wanted exactly.
    outside : sequence of Outside
        Positions and poses of another program.
    lasers_apart : bool
        Whether clusters are of one laser each, and the corrections of lasers unknowns.
    control : tuple of ControlPoint
        In the local frame.
    """

    units: Mapping[str, ImuTrack]
    positions: Sequence[Positions]
    attitudes: Sequence[Attitudes]
    mat_ins_lidar: Array
    lever_m: Array
    exact: tuple[str, ...] = ()
    outside: Sequence[Outside] = ()
    lasers_apart: bool = False
    control: tuple[ControlPoint, ...] = ()


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
    sigma_position_m, sigma_attitude_rad : ndarray, shape (slices + 1, 3)
        At slice boundaries: east, north, up; roll, pitch, heading; of the ins frame.
    log : list of dict
        What each Gauss-Newton step said.
    covariance : ndarray or None
        Of the globals asked for exactly, without what a gyro's axes may differ from its board's.
    corrections : tuple of (ndarray, ndarray), optional
        Of the lasers, shape (64,), and their covariance.
    control : list of dict
        What is to be said of each control point; empty where none was met.
    seen : Seen or None
        What the joining needs of it; a window that is the whole flight is not joined, and its sigmas are those of the whole. Those of
        the others are what they do not know of themselves.
    """

    first: int
    last: int
    own: int
    path: Path
    values: dict[str, tuple[Array, Array]]
    sigma_position_m: Array
    sigma_attitude_rad: Array
    log: list[dict[str, float]]
    covariance: Array | None = None
    corrections: tuple[Array, Array] | None = None
    control: list[dict[str, Any]] = field(default_factory=list)
    seen: "Seen | None" = None


@dataclass(slots=True)
class Seen:
    """What is kept of a window for the joining: some megabytes.

    Attributes
    ----------
    patches : Patches
    stiffness : Stiffness
    control : Clusters, optional
        What may be of a surface at some control, in the frame of the coarse path.
    """

    patches: Patches
    stiffness: Stiffness
    control: Clusters | None = None


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
        tie = Tie(previous.path.quat[common], previous.path.position_m[common])
        path = _laid_on(path, tie)
    mat, lever = sources.mat_ins_lidar, sources.lever_m
    to_ins = -mat.T @ lever
    bias = np.array(track.gyro_bias[first:last]).mean(axis=0)
    units = [
        make_unit(
            name,
            unit,
            path,
            bias if unit.name == motion.source else np.zeros(3),
            np.zeros(3) if name == "lidar" else to_ins,
        )
        for name, unit in sources.units.items()
    ]
    gathered = track.gathered(first, last, sources.lasers_apart)
    track.forget(last - OVERLAP if more else last)
    batch = Batch(
        path,
        gathered,
        units,
        dict(sources.units),
        sources.positions,
        sources.attitudes,
        mat.T,
        to_ins,
        tie=tie,
        outside=sources.outside,
        told=told,
        control=() if before or more else sources.control,
    )
    posterior = batch.run()
    spread = posterior.spread(DRAWS)
    (values, exact), seen = _values(batch, posterior, spread, sources.exact), None
    if before or more:
        stiffness = stiffness_of(batch.path, posterior.unknowns, spread.whole)
        control = kept_for(sources.control, gathered, batch.path, coarse(batch.path)) if sources.control else None
        seen = Seen(patches_of(gathered, batch.path, len(before)), stiffness, control)
        # how the whole lies is asked for when all windows are joined
        spread = spread.without([posterior.unknowns.names[name] for name in ("world.turn", "world.shift")])
    position, attitude = _sigmas(batch.path, posterior.unknowns, spread, mat, lever, motion.rate_density)
    corrections = None
    if sources.lasers_apart:
        corrections = batch.corrections, lasers.stretched(posterior.weighed(lasers.NAMES), lasers.STRETCH)
    held = [] if batch.held is None else batch.held.report(batch.clusters, batch.path)
    return Window(
        first, last, last - first, batch.path, values, position, attitude, batch.log, exact, corrections, held, seen
    )


def corrections_over(windows: Sequence[Window]) -> tuple[Array, Array] | None:
    """Corrections of the lasers that all windows together give, and their covariance; None where they were no unknowns."""
    told = [window.corrections for window in windows if window.corrections is not None]
    return joined([o for o, _ in told], [square for _, square in told], lasers.PRIOR) if told else None


def _laid_on(path: Path, tie: Tie) -> Path:
    """The path turned and moved as a whole so that its begin lies on a tie."""
    count = len(tie.quat)
    quat, place = path.quat[: count * STEPS : STEPS], path.position_m[: count * STEPS : STEPS]
    off = frames.quat_log(frames.quat_multiply(tie.quat, frames.quat_inverse(quat)))
    mat = frames.mat_from_quat(frames.quat_exp(off.mean(axis=0)[None]))[0]
    return path.turned(mat, (tie.position_m - place @ mat.T).mean(axis=0))


def _values(
    batch: Batch, posterior: Posterior, spread: Spread, exact: tuple[str, ...]
) -> tuple[dict[str, tuple[Array, Array]], Array | None]:
    """Globals with their sigmas, and the covariance of those asked for."""
    found, common = {}, {"compass": batch.compass, DELAY: batch.outside_delay_s}
    names = posterior.unknowns.names
    for name, where in names.items():
        unit, _, key = name.partition(".")
        if unit in ("world", "lasers"):
            continue
        value = common[name] if name in common else next(u for u in batch.units if u.name == unit).values[key]
        found[name] = (value, np.sqrt(spread.variance(operator.itemgetter(where))))
    wanted = [name for name in dict.fromkeys((*exact, *CALIBRATION)) if name in names]
    covariance = posterior.covariance(wanted)
    at = 0
    for name in wanted:
        size = names[name].stop - names[name].start
        found[name] = (found[name][0], np.sqrt(np.diag(covariance)[at : at + size]))
        at += size
    asked = sum(names[name].stop - names[name].start for name in exact if name in names)
    return found, covariance[:asked, :asked] if exact and set(exact) <= set(found) else None


def _sigmas(
    path: Path, unknowns: Unknowns, spread: Spread, mat_ins_lidar: Array, lever: Array, rate_density: float
) -> tuple[Array, Array]:
    """Sigmas of position and of roll, pitch, heading of the ins frame at the slice boundaries."""
    quat, place = path.quat[::STEPS], path.position_m[::STEPS]
    mats = frames.mat_from_quat(quat)
    to_ins = -mat_ins_lidar.T @ lever
    heading = frames.attitude_of(mats @ mat_ins_lidar.T)[0]
    right = np.stack([np.cos(heading), -np.sin(heading)], axis=1)
    ahead = np.stack([np.sin(heading), np.cos(heading)], axis=1)

    def poses(x: Array) -> Array:
        """Errors of position and of roll, pitch, heading, shape (2, n, 3)."""
        part = {name: x[where] for name, where in unknowns.names.items()}
        spline = x[: unknowns.path_size].reshape(-1, 6)
        at = (spline[:-2] + 4.0 * spline[1:-1] + spline[2:]) / 6.0
        in_body = at[:, :3] + part.get("ins.turn", np.zeros(3))
        turn = np.einsum("nij,nj->ni", mats, in_body) + part["world.turn"]
        arm = np.cross(at[:, :3], to_ins) + part.get("ins.lever", np.zeros(3))
        moved = at[:, 3:] + np.cross(part["world.turn"], place) + part["world.shift"]
        position = moved + np.einsum("nij,nj->ni", mats, arm)
        return np.stack(
            [
                position,
                np.stack([(turn[:, :2] * ahead).sum(axis=1), (turn[:, :2] * right).sum(axis=1), turn[:, 2]], axis=1),
            ]
        )

    position, attitude = uniform_filter1d(spread.variance(poses), 11, axis=1, mode="nearest")
    if "ins.turn" in unknowns.names:
        attitude = attitude + MISALIGNMENT_RAD**2
    # what the gyro adds between two knots, the mean of a Brownian bridge
    bridge = rate_density**2 * H / 6.0
    return np.sqrt(position), np.sqrt(attitude + bridge)


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


def control_clusters(windows: Sequence[Window]) -> Clusters | None:
    """What all windows kept for control; None where nothing was."""
    parts = [window.seen.control for window in windows if window.seen is not None and window.seen.control is not None]
    return together(parts) if parts else None


def whole_stiffness(windows: Sequence[Window]) -> Stiffness:
    """Stiffness of all slices; the tilt is as well known as the first window's, which is tied to nothing."""
    parts = [(window, window.seen.stiffness) for window in windows if window.seen is not None]
    turn, shift = (np.concatenate([(s.turn, s.shift)[i][: w.own] for w, s in parts]) for i in range(2))
    return Stiffness(turn, shift, parts[0][1].tilt)
