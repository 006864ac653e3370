"""Image poses for the smoother: what the images know that the trajectory did not, so that nothing is counted twice.

The adjustment of a block holds the trajectory's own poses. A pose handed back has the information gained, the inverse of its covariance
after less that before, and stands where the two together give the adjusted pose. In directions in which images say nothing its variance is
`MOST_SHARE` times that of the trajectory. What a neighbour's own observed pose adds by way of common points is still in it: little
outside of gaps, where both know nearly the same.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.files import make_folder, written_aside
from groundproc.geodesy import LocalFrame
from groundproc.imagery.bundle.block import Block
from groundproc.imagery.bundle.covariance import Cofactors, of_columns
from groundproc.imagery.bundle.unknowns import Unknowns
from groundproc.imagery.flown import of_datum
from groundproc.imagery.rotations import mat_of_vector
from groundproc.trajectory.covariance import STATES, mat_attitude_turn
from groundproc.trajectory.estimate import COVARIANCE, TRAJECTORY
from groundproc.trajectory.table import from_poses, write_trajectory

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

GAINED: Final = "gained"
TRUE: Final = "true"
MOST_SHARE: Final = 1e4
TRUE_PLACE_M: Final = 0.001
TRUE_TURN_RAD: Final = float(np.deg2rad(0.001))
"""Sigmas of a pose that is taken to be true, as [N] re-initialises its filter."""
_LEAST_GAIN: Final = 1.0 / MOST_SHARE


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
    """

    time_ns: Ints
    place_m: Array
    mat_local_ins: Array
    covariance: Array


def gained(block: Block, unknowns: Unknowns, found: Cofactors, sigma0: float) -> Gained:
    """What the images of a block add to the poses that it was given."""
    priors, stations = block.priors, block.stations
    shift_s = np.array([one.timeshift_s for one in block.rig.cameras])
    time_ns = stations.time_ns[priors.station] + np.rint(shift_s[stations.lead[priors.station]] * 1e9).astype(np.int64)
    known = priors.covariance
    if priors.common.covariance is not None:
        known = known + of_datum(priors.common.covariance, priors.place_m)
    place, mats, covariances = [], [], []
    for row, station in enumerate(priors.station.tolist()):
        before = known[row]
        after = sigma0**2 * of_columns(found.matrix, unknowns.station[station])
        turn = frames.quat_log(frames.quat_from_mat(stations.mat_local_ins[station] @ priors.mat_local_ins[row].T))
        moved = np.concatenate([stations.place_m[station] - priors.place_m[row], turn])
        step, covariance = information_gained(before, after, moved)
        place.append(priors.place_m[row] + step[:3])
        mats.append(mat_of_vector(step[None, 3:])[0] @ priors.mat_local_ins[row])
        covariances.append(covariance)
    order = np.argsort(time_ns, kind="stable")
    arrays = (np.array(each)[order] for each in (place, mats, covariances))
    return Gained(time_ns[order], *arrays)


def information_gained(before: Array, after: Array, moved: Array) -> tuple[Array, Array]:
    """Step and covariance, which with what was known before give what is known after.

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
    share = np.where(values < 1.0 / (1.0 + _LEAST_GAIN), 1.0 / (1.0 - left), 0.0)
    basis = lower @ axes
    step = basis @ (share * (axes.T @ np.linalg.solve(lower, moved)))
    return step, (basis * variance) @ basis.T


def thinned(poses: Gained, every_s: float) -> Gained:
    """One pose in so many seconds, the first of each."""
    if every_s <= 0.0 or not len(poses.time_ns):
        return poses
    kept = [0]
    for number, stamp in enumerate(poses.time_ns.tolist()):
        if stamp - poses.time_ns[kept[-1]] >= every_s * 1e9:
            kept.append(number)
    return Gained(poses.time_ns[kept], poses.place_m[kept], poses.mat_local_ins[kept], poses.covariance[kept])


def taken_as_true(block: Block) -> Gained:
    """The adjusted poses, believed: the filter begins anew at each of them."""
    stations, at = block.stations, np.unique(block.priors.station)
    shift_s = np.array([one.timeshift_s for one in block.rig.cameras])
    time_ns = stations.time_ns[at] + np.rint(shift_s[stations.lead[at]] * 1e9).astype(np.int64)
    variance = np.diag([TRUE_PLACE_M**2] * 3 + [TRUE_TURN_RAD**2] * 3)
    order = np.argsort(time_ns, kind="stable")
    return Gained(
        time_ns[order],
        stations.place_m[at][order],
        stations.mat_local_ins[at][order],
        np.tile(variance, (len(at), 1, 1)),
    )


def write_gained(folder: Path, poses: Gained, frame: LocalFrame) -> None:
    """Write trajectory.csv and covariance.npz as `swath process --poses` reads them.

    Raises
    ------
    SourceError
        They cannot be written.
    """
    distinct = np.append(True, np.diff(poses.time_ns) > 0)
    time_ns, mats = poses.time_ns[distinct], poses.mat_local_ins[distinct]
    heading, pitch, _ = frames.attitude_of(mats)
    full = np.zeros((len(time_ns), 6, 6))
    full[:, :3, :3], full[:, 3:, 3:] = np.eye(3), mat_attitude_turn(heading, pitch)
    covariance = full @ poses.covariance[distinct] @ np.swapaxes(full, 1, 2)
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    quat = frames.quat_from_mat(mats)
    make_folder(folder)
    write_trajectory(
        folder / TRAJECTORY, from_poses(frame, time_ns, poses.place_m[distinct], quat, sigma[:, :3], sigma[:, 3:])
    )
    with written_aside(folder / COVARIANCE) as aside, aside.open("wb") as file:
        np.savez(file, allow_pickle=False, time_ns=time_ns, covariance=covariance, states=np.array(STATES))


CHOICES: Final[Sequence[str]] = (GAINED, TRUE)
