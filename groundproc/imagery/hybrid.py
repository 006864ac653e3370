"""Image poses for the smoother: what the images know that the trajectory did not, so that nothing is counted twice.

The adjustment of a block holds the trajectory's own poses. A pose handed back has the information gained, the inverse
of its covariance after the adjustment less that before, and is placed such that both together give the adjusted pose.
In directions in which images say nothing, its variance is `MOST_SHARE` times that of the trajectory. This form is for
engines that know each pose alone.

The errors of adjusted poses are correlated: a block is stiff to millimetres, but lies where all positions of a flight
put it, to centimetres. Taken one by one with their full uncertainty, poses lose their shape; taken as certain as their
shape is, they would pretend to know where they are. So the smoother gets the adjusted poses themselves, each with a
small error of its own (`OWN_SHARE`). The rest of its covariance is shared with its neighbours; it enters what the
smoother states, but not its solution. Given the poses at the images, the path between them follows from inertial
sensors alone, whatever the images saw. The mean of the whole trajectory is then that of trajectory and images
together, and its covariance the sum of both parts. Where images say little about a pose, its own error is large and
the shared one is zero.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.files import make_folder, written_aside
from groundproc.flight.positions.fixes import Tied
from groundproc.geodesy import LocalFrame
from groundproc.imagery.bundle.block import Block
from groundproc.imagery.bundle.covariance import Cofactors, of_columns
from groundproc.imagery.bundle.unknowns import Unknowns
from groundproc.imagery.flown import of_datum
from groundproc.imagery.rotations import mat_of_vector
from groundproc.trajectory.covariance import STATES, mat_attitude_turn
from groundproc.trajectory.estimate import COVARIANCE, TIED, TRAJECTORY
from groundproc.trajectory.table import from_poses, write_trajectory

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

GAINED: Final = "gained"
TRUE: Final = "true"
MOST_SHARE: Final = 1e4
TRUE_PLACE_M: Final = 0.001
TRUE_TURN_RAD: Final = float(np.deg2rad(0.001))
"""Sigmas of a pose that is taken to be true, as [N] re-initialises its filter."""
OWN_SHARE: Final = 0.01
"""Part of the variance gained that is a pose's own in the smoother: so little that the shape of the block counts, not where it began."""
_LEAST_GAIN: Final = 1.0 / MOST_SHARE
_ROUNDING: Final = np.array([1e-4] * 3 + [1e-6] * 3)
"""Sigmas [m, rad] that no pose is known better than by the tables that it is written to."""


@dataclass(frozen=True, slots=True)
class Gained:
    """Poses of the ins for the smoother.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (k,)
    place_m : ndarray, shape (k, 3)
    mat_local_ins : ndarray, shape (k, 3, 3)
    covariance : ndarray, shape (k, 6, 6)
        Place [m] and turn in the local frame [rad].
    tied : Tied, optional
        The poses as they were adjusted together.
    """

    time_ns: Ints
    place_m: Array
    mat_local_ins: Array
    covariance: Array
    tied: Tied | None = None

    def rows(self, chosen: Any) -> "Gained":
        """The rows of a mask or an index."""
        tied = None if self.tied is None else self.tied.rows(chosen)
        return Gained(
            self.time_ns[chosen], self.place_m[chosen], self.mat_local_ins[chosen], self.covariance[chosen], tied
        )


def gained(block: Block, unknowns: Unknowns, found: Cofactors, sigma0: float) -> Gained:
    """What the images of a block add to the poses that it was given.

    Attitudes are as late as the trajectory's: its gyros, which carry them on, are.
    """
    priors, stations = block.priors, block.stations
    shift_s = np.array([one.timeshift_s for one in block.rig.cameras])
    time_ns = stations.time_ns[priors.station] + np.rint(shift_s[stations.lead[priors.station]] * 1e9).astype(np.int64)
    known = priors.covariance
    if priors.common.covariance is not None:
        known = known + of_datum(priors.common.covariance, priors.place_m)
    begun = mat_of_vector(-priors.common.late_s * priors.turning_rad_s) @ priors.mat_local_ins
    place, mats, covariances, tied = [], [], [], []
    for row, station in enumerate(priors.station.tolist()):
        before = known[row]
        after = sigma0**2 * of_columns(found.matrix, unknowns.station[station])
        turn = frames.quat_log(frames.quat_from_mat(stations.mat_local_ins[station] @ priors.mat_local_ins[row].T))
        moved = np.concatenate([stations.place_m[station] - priors.place_m[row], turn])
        told = information_gained(before, after, moved)
        place.append(priors.place_m[row] + told.step[:3])
        mats.append(mat_of_vector(told.step[None, 3:])[0] @ begun[row])
        covariances.append(told.covariance)
        tied.append((told.adjusted - told.step, told.own, told.shared))
    together = Tied(*(np.array(each) for each in zip(*tied, strict=True)))
    poses = Gained(time_ns, np.array(place), np.array(mats), np.array(covariances), together)
    return poses.rows(np.argsort(time_ns, kind="stable"))


@dataclass(frozen=True, slots=True)
class OfPose:
    """What images tell of one pose; steps are from where it was before, shape (6,), covariances of shape (6, 6).

    Attributes
    ----------
    step, covariance : ndarray
        With what was known before they give what is known after.
    adjusted : ndarray
        What gives the same with a covariance of `own`.
    own, shared : ndarray
        What of the covariance after is the pose's own, and what its neighbours share.
    """

    step: Array
    covariance: Array
    adjusted: Array
    own: Array
    shared: Array


def information_gained(before: Array, after: Array, moved: Array) -> OfPose:
    """What images tell of a pose beyond what was known before.

    Parameters
    ----------
    before, after : ndarray, shape (6, 6)
    moved : ndarray, shape (6,)
        By how much the estimate moved.
    """
    lower = np.linalg.cholesky(before)
    white = np.linalg.solve(lower, np.linalg.solve(lower, after).T)
    values, axes = np.linalg.eigh((white + white.T) / 2.0)
    # an eigenvalue is what is left of a unit variance; 1 where nothing was gained
    left = np.clip(values, 1e-9, 1.0 / (1.0 + _LEAST_GAIN))
    variance = left / (1.0 - left)
    own = OWN_SHARE * variance
    gains = values < 1.0 / (1.0 + _LEAST_GAIN)
    basis, way = lower @ axes, axes.T @ np.linalg.solve(lower, moved)
    shared = np.maximum(left - own, 0.0)
    return OfPose(
        basis @ (np.where(gains, 1.0 / (1.0 - left), 0.0) * way),
        (basis * variance) @ basis.T,
        basis @ (np.where(gains, 1.0 + own, 0.0) * way),
        (basis * own) @ basis.T + np.diag(np.square(_ROUNDING)),
        (basis * shared) @ basis.T,
    )


def thinned(poses: Gained, every_s: float) -> Gained:
    """One pose in so many seconds, the first of each."""
    if every_s <= 0.0 or not len(poses.time_ns):
        return poses
    kept = [0]
    for number, stamp in enumerate(poses.time_ns.tolist()):
        if stamp - poses.time_ns[kept[-1]] >= every_s * 1e9:
            kept.append(number)
    return poses.rows(kept)


def taken_as_true(block: Block) -> Gained:
    """The adjusted poses, believed: the filter begins anew at each of them."""
    stations, at = block.stations, np.unique(block.priors.station)
    shift_s = np.array([one.timeshift_s for one in block.rig.cameras])
    time_ns = stations.time_ns[at] + np.rint(shift_s[stations.lead[at]] * 1e9).astype(np.int64)
    late_s = block.priors.common.late_s
    turning = np.einsum("kij,kj->ki", stations.mat_local_ins[at], stations.rate_rad_s[at])
    mats = mat_of_vector(-late_s * turning) @ stations.mat_local_ins[at]
    variance = np.diag([TRUE_PLACE_M**2] * 3 + [TRUE_TURN_RAD**2] * 3)
    order = np.argsort(time_ns, kind="stable")
    return Gained(
        time_ns[order],
        stations.place_m[at][order],
        mats[order],
        np.tile(variance, (len(at), 1, 1)),
    )


def write_gained(folder: Path, poses: Gained, frame: LocalFrame) -> None:
    """Write trajectory.csv and covariance.npz as `swath process --poses` reads them.

    Raises
    ------
    SourceError
        They cannot be written.
    """
    poses = poses.rows(np.append(True, np.diff(poses.time_ns) > 0))
    time_ns, mats, tied = poses.time_ns, poses.mat_local_ins, poses.tied
    heading, pitch, _ = frames.attitude_of(mats)
    full = np.zeros((len(time_ns), 6, 6))
    full[:, :3, :3], full[:, 3:, 3:] = np.eye(3), mat_attitude_turn(heading, pitch)
    covariance = full @ poses.covariance @ np.swapaxes(full, 1, 2)
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    quat = frames.quat_from_mat(mats)
    make_folder(folder)
    write_trajectory(folder / TRAJECTORY, from_poses(frame, time_ns, poses.place_m, quat, sigma[:, :3], sigma[:, 3:]))
    with written_aside(folder / COVARIANCE) as aside, aside.open("wb") as file:
        arrays = {"time_ns": time_ns, "covariance": covariance, "states": np.array(STATES)}
        if tied is not None:
            arrays |= {name: getattr(tied, name) for name in TIED}
        np.savez(file, allow_pickle=False, **arrays)


CHOICES: Final[Sequence[str]] = (GAINED, TRUE)
