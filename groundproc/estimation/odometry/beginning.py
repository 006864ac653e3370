"""The first seconds again, backwards in time, against the map of all that came after.

At the start there is no map, and the odometry has only a wall or two and inertial sensors of unknown bias. It may
slide metres along the walls before it knows better. So it is run once more, from a moment when it did know, with time
reversed: rates and velocities change sign, forces and gravity do not.
"""

import copy
from collections.abc import Sequence
from typing import Final

import numpy as np

from flightlog import frames
from groundproc.estimation.odometry.grid import SLICE_NS, STEP_NS, STEPS
from groundproc.estimation.odometry.motion import Motion
from groundproc.estimation.odometry.odometry import Odometry, Step
from groundproc.estimation.odometry.slices import Slice
from groundproc.estimation.odometry.state import STATES, State
from groundproc.estimation.odometry.track import KEPT, Track, thinned
from groundproc.estimation.odometry.voxels import PlaneMap
from groundproc.machine.system import let_go

BEGINNING: Final = 150
"""Slices that are run again."""
AFTER: Final = 600
"""Slices after them that make the map."""
SIGMA: Final = np.repeat([np.deg2rad(0.02), 0.02, 0.2, np.deg2rad(0.05), 0.05, 0.05], STATES // 6)
"""What is known at that moment: attitude, position, velocity, biases, gravity."""
SURE_M: Final = 0.15
"""Sigma of position beyond which the second run is not taken."""


def redo_beginning(
    track: Track, motion: Motion, early: Sequence[Slice], before: Odometry, count: int | None = None,
    mapped: int | None = None, turns: bool = True,
) -> None:  # fmt: skip
    """Run the first slices again and put the result into the track.

    Parameters
    ----------
    track : Track
    motion : Motion
    early : sequence of Slice
        The first slices.
    before : Odometry
        As it is at the end of the track: biases, gravity and the line of the spin are known by then.
    count : int, optional
        Slices that are run again; where left out `BEGINNING`, and no more than a third of a track that is short.
    mapped : int, optional
        From which slice on the map is taken; where left out, from `count` on.
    turns : bool
        Whether the turns within these slices are found: a batch does not use them.
    """
    count = min(BEGINNING, len(track) // 3) if count is None else count
    if count < 20:
        return
    end_ns = motion.start_ns + (track.first + count) * SLICE_NS
    grid = slice(track.first * STEPS, (track.first + count) * STEPS)
    if not motion.known[grid].all():
        return
    reversed_motion = Motion(
        0, -motion.rate_rad_s[grid][::-1], motion.force_m_s2[grid][::-1].copy(), motion.known[grid][::-1],
        motion.rate_density, motion.force_density, motion.source,
    )  # fmt: skip
    state = before.state
    begin = State(
        track.quat[count], track.position_m[count], -track.velocity_m_s[count - 1],
        -track.gyro_bias[count - 1], state.accel_bias_m_s2.copy(), state.gravity_m_s2.copy(), np.diag(SIGMA**2),
    )  # fmt: skip
    line = None if before.line is None else before.line.reversed()
    odometry = Odometry(begin, reversed_motion, 0, track.voxel_m, line, turns, beside=True)
    odometry.planes = _map_of(track, motion, count if mapped is None else mapped, min(count + AFTER, len(track)))
    found: dict[int, tuple[State, Step | None]] = {}
    for piece in reversed(early):
        k = piece.number - track.first
        if not 0 <= k < count:
            continue
        while odometry.number < count - 1 - k:  # nothing was seen
            odometry.propagate(odometry.number)
            found[count - odometry.number] = copy.deepcopy(odometry.state), None
        laser = None if piece.laser is None else piece.laser[::-1].copy()
        step = odometry.step(Slice(count - 1 - k, end_ns - piece.time_ns[::-1], piece.xyz_m[::-1].copy(), laser))
        found[k] = copy.deepcopy(odometry.state), step
        let_go()  # slices that were set aside, and have been read
    while odometry.number < count:
        odometry.propagate(odometry.number)
        found[count - odometry.number] = copy.deepcopy(odometry.state), None
    odometry.settle()
    # where the planes do not hold it, it is no better than what was there
    if max(float(np.sqrt(np.diag(state.covariance)[3:6].max())) for state, _ in found.values()) > SURE_M:
        return
    for k, (at, seen) in found.items():
        track.quat[k], track.position_m[k] = at.quat, at.position_m
        track.velocity_m_s[k], track.gyro_bias[k] = -at.velocity_m_s, -at.gyro_bias_rad_s
        track.sigma[k] = np.sqrt(np.diag(at.covariance)[:6])
        track.quats[k] = None if seen is None else seen.quats[::-1].copy()
        if seen is None:
            continue
        # all of a slice's clusters again, for the old ones were made with a wrong motion
        clusters = seen.clusters.copy()
        clusters["time_ns"] = end_ns - clusters["time_ns"]
        track.clusters[k] = thinned(clusters, seen.world_m, odometry.planes, KEPT)
        track.matched[k], track.residual_m[k] = seen.matched, seen.residual_m
        track.unheld_m[k], track.next_unheld_m[k] = seen.unheld_m, seen.next_unheld_m


def _map_of(track: Track, motion: Motion, first: int, last: int) -> PlaneMap:
    """The planes of slices `first` to `last`."""
    planes = PlaneMap(track.voxel_m)
    path = track.causal_path(motion, first, last)
    mats = frames.mat_from_quat(path.quat)
    for clusters in track.clusters[first:last]:
        if not len(clusters):
            continue
        place = np.clip((clusters["time_ns"] - path.start_ns) // STEP_NS, 0, len(path.quat) - 1)
        world = np.einsum("nij,nj->ni", mats[place], clusters["xyz"].astype(np.float64)) + path.position_m[place]
        planes.insert(world, clusters, Odometry.MOST, judged=False)
    planes.judge()
    return planes
