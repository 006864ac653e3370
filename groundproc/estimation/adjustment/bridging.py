"""Bridging: where the lidar does not hold the path, the smoother's motion joins the good poses at both ends."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.estimation.consensus import POSITION_TAU_S
from groundproc.estimation.odometry.grid import SLICE_NS
from groundproc.estimation.odometry.matching import TELLS_M
from groundproc.estimation.odometry.track import Track
from groundproc.estimation.odometry.tracker import SURE_HELD_M
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

FEWEST_MATCHED: Final = 50
"""Clusters that find something in the map, below which a slice is blind."""
START: Final = 10
"""First slices that are not counted: there is no map yet."""
KEPT: Final = 30
"""Consecutive slices that hold the path and are worth keeping: three seconds."""
SHORTEST: Final = 100
"""Slices of a stretch that is bridged: over less than 10 s inertial data between two good ends are better than any GNSS."""
TAIL_NS: Final = 500_000_000
"""So much at the end of a flight may lie beyond what the smoother covers."""
CLOSED: Final = 5
"""Fewer slices than this that seem to hold the path between two loose stretches belong to these."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """A stretch to be bridged.

    Attributes
    ----------
    begin_ns, end_ns : int
        UTC of its first and last moment.
    held_before, held_after : bool
        Whether the path is good there: it is not where the flight begins or ends with the stretch.
    """

    begin_ns: int
    end_ns: int
    held_before: bool
    held_after: bool


def unheld(track: Track) -> Mask:
    """Slices in which the lidar does not hold the path, shape (n,): it sees next to nothing, or some direction is not told."""
    found = np.array(track.unheld_m) > TELLS_M
    found[:START] = False
    return np.asarray(found | _silent(track))


def misleading(track: Track) -> Mask:
    """Slices whose lidar sees enough but does not observe the motion, shape (n,): what it seems to tell is noise.

    If a single direction is missing, as along a street or a bank, the others are good, and the adjustment takes the
    missing one from inertial sensors and fixes. A lidar that has led astray once is believed only where it holds the
    path firmly.
    """
    limit_m = SURE_HELD_M if track.astray else TELLS_M
    found = (np.array(track.next_unheld_m) > limit_m) & ~_silent(track)
    found[:START] = False
    return np.asarray(found)


def loose(track: Track) -> Mask:
    """Slices whose motion a smoother knows better, shape (n,): where the lidar sees next to nothing, or nothing that tells the way."""
    return np.asarray(misleading(track) | _silent(track))


def along_untold(track: Track) -> Mask:
    """Slices of the spans of ten seconds in which a single direction of the way is missing most of the time, as along plain walls.

    Here and there a slice seems to tell it: planes that lean by chance do.
    """
    single = unheld(track) & ~loose(track)
    width = min(SHORTEST, len(single))
    found = np.zeros(len(single), np.bool_)
    if width:
        most = np.convolve(single, np.ones(width), mode="valid") > 0.5 * width
        for first in np.flatnonzero(most).tolist():
            found[first : first + width] = True
    return found


def along_untold_s(track: Track) -> float:
    """Seconds of the longest stretch of them."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], along_untold(track), [False]])))
    return int(np.diff(edges.reshape(-1, 2), axis=1).max(initial=0)) * SLICE_NS * 1e-9


def holds_somewhere(track: Track) -> bool:
    """Whether there is a stretch long enough to be worth keeping in which the lidar tells the way, but perhaps for one direction.

    Of a flight of few seconds, half of what counts is long enough.
    """
    least = min(KEPT, max(len(track.matched) - START, 0) // 2)
    ends = np.concatenate([[True], loose(track), [True]])
    ends[1 : START + 1] = True
    return bool(np.diff(np.flatnonzero(ends)).max(initial=0) > least)


def _silent(track: Track) -> Mask:
    found = np.array(track.matched) < FEWEST_MATCHED
    found[:START] = False
    return np.asarray(found)


def stretches(given: Mask, start_ns: int) -> list[Stretch]:
    """Stretches of loose slices that are long enough, of slices that begin at `start_ns`."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], given, [False]])))
    found: list[list[int]] = []
    for first, last in edges.reshape(-1, 2).tolist():
        if found and first - found[-1][1] < CLOSED:
            found[-1][1] = last
        else:
            found.append([first, last])
    return [
        Stretch(start_ns + first * SLICE_NS, start_ns + last * SLICE_NS, first > START, last < len(given))
        for first, last in found
        if last - first >= SHORTEST
    ]


def bridged(made: Trajectory, begun: Trajectory, parts: Sequence[Stretch]) -> Trajectory:
    """A trajectory whose loose stretches have the motion of another one, laid between the good poses at their ends.

    The disagreement of the two ends is spread evenly over the time between them.

    Parameters
    ----------
    made, begun : Trajectory
        As adjusted, and what it began from; stretches that the latter does not cover are left as they are.
    parts : sequence of Stretch
    """
    position, quat = made.position_m.copy(), made.quat_local_ins_wxyz.copy()
    sigma_position, sigma_attitude = made.sigma_position_m.copy(), made.sigma_attitude_rad.copy()
    changed = np.zeros(len(made), np.bool_)
    for each in parts:
        here = np.flatnonzero((made.time_ns >= each.begin_ns) & (made.time_ns <= each.end_ns))
        if len(here) < 2 or not (each.held_before or each.held_after):
            continue
        time_ns = made.time_ns[here]
        until = each.end_ns if each.held_after else each.end_ns - TAIL_NS
        poses, covered = begun.where_covered(time_ns)
        if not covered[time_ns <= until].all():
            continue
        # the smoother ends with its last node: what is left of a stretch that ends the flight stays as it was adjusted
        here, time_ns = here[covered], time_ns[covered]
        poses, _ = begun.where_covered(time_ns)
        rest = np.flatnonzero(made.time_ns > time_ns[-1]) if not each.held_after else here[:0]
        last = here[-1]
        was = position[last].copy(), quat[last].copy()
        seconds = (time_ns - time_ns[0]) * 1e-9
        position[here], quat[here] = _laid(
            (made.position_m[here], made.quat_local_ins_wxyz[here]),
            (poses.position_m, poses.quat_local_ins_wxyz),
            _shares(seconds, each),
            turned=each.held_before and each.held_after,
        )
        if len(rest):
            turn = frames.quat_multiply(quat[[last]], frames.quat_inverse(was[1][None]))
            position[rest] = position[last] + (position[rest] - was[0]) @ frames.mat_from_quat(turn)[0].T
            quat[rest] = frames.quat_multiply(np.repeat(turn, len(rest), axis=0), quat[rest])
        own = np.nan_to_num(np.sqrt(np.diagonal(begun.covariance_at(time_ns), axis1=1, axis2=2)))
        drift = np.sqrt(-2.0 * np.expm1(-_away(seconds, each)[:, None] / POSITION_TAU_S))
        sigma_position[here] = np.hypot(sigma_position[here], np.minimum(drift, 1.0) * own[:, :3])
        sigma_attitude[here] = np.hypot(sigma_attitude[here], own[:, 3:])
        sigma_position[rest], sigma_attitude[rest] = sigma_position[last], sigma_attitude[last]
        changed[here] = changed[rest] = True
    if not changed.any():
        return made
    velocity, rate = made.velocity_m_s.copy(), made.rate_rad_s.copy()
    seconds = (made.time_ns - made.time_ns[0]) * 1e-9
    velocity[changed] = np.gradient(position, seconds, axis=0)[changed]
    turn = frames.quat_log(frames.quat_multiply(frames.quat_inverse(quat[:-1]), quat[1:])) / np.diff(seconds)[:, None]
    rate[changed] = np.concatenate([turn[:1], 0.5 * (turn[1:] + turn[:-1]), turn[-1:]])[changed]
    return replace(
        made, position_m=position, quat_local_ins_wxyz=quat, velocity_m_s=velocity, rate_rad_s=rate,
        sigma_position_m=sigma_position, sigma_attitude_rad=sigma_attitude,
    )  # fmt: skip


def _shares(seconds: Array, each: Stretch) -> Array:
    """How much of each pose goes by the stretch's end, the rest by its begin; shape (n,)."""
    if not each.held_before:
        return np.ones(len(seconds))
    return np.asarray(seconds / seconds[-1] if each.held_after else np.zeros(len(seconds)))


def _away(seconds: Array, each: Stretch) -> Array:
    """Time from the nearest good pose [s]; shape (n,)."""
    since = seconds if each.held_before else np.full(len(seconds), np.inf)
    until = seconds[-1] - seconds if each.held_after else np.full(len(seconds), np.inf)
    return np.asarray(np.minimum(since, until))


def _laid(good: tuple[Array, Array], motion: tuple[Array, Array], share: Array, *, turned: bool) -> tuple[Array, Array]:
    """Positions and attitudes of a motion, shapes (n, 3) and (n, 4), moved and turned so that its ends lie on good poses.

    With one good end the way is moved and not `turned`: a smoother has it from fixes, and what its heading is off has not turned it.
    """
    (place, quat), (way, turn) = good, motion
    off = frames.quat_multiply(quat, frames.quat_inverse(turn))
    between = frames.quat_log(frames.quat_multiply(frames.quat_inverse(off[:1]), off[-1:]))
    offs = frames.quat_multiply(np.repeat(off[:1], len(off), axis=0), frames.quat_exp(share[:, None] * between))
    laid = []
    for end in (0, -1):
        mat = frames.mat_from_quat(off[[end]])[0] if turned else np.eye(3)
        laid.append(place[end] + (way - way[end]) @ mat.T)
    position = laid[0] + share[:, None] * (laid[1] - laid[0])
    return position, frames.quat_multiply(offs, turn)
