"""Whether the starting trajectory refutes an adjustment: a lidar may be wrong with confidence.

Two paths of one flight are compared, by what both state and by what the same fixes say of either. Three conditions
must hold before the adjusted path is called wrong. It slides away from the fixes that it believes. The smoother's path
does not. And the two move apart by more than both know of their motion. Beside walls, where a receiver errs within
seconds, the smoother follows it by hardly more than it states.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.constants import NS_PER_S
from groundproc.estimation.consensus import GATE_SIGMAS, LOOKED_BACK_S, POSITION_TAU_S
from groundproc.estimation.observations.fixes import DRIFT_S
from groundproc.estimation.observations.moments import means, seconds
from groundproc.estimation.odometry.stated import Positions
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]


def parted(made: Trajectory, begun: Trajectory) -> bool:
    """Whether two trajectories move apart, within some seconds, by more than `GATE_SIGMAS` of what both state."""
    return parted_sigmas(made, begun) > GATE_SIGMAS


def parted_sigmas(made: Trajectory, begun: Trajectory) -> float:
    """Largest step of the distance between two trajectories, in its sigmas, over the spans of `LOOKED_BACK_S`; 0 where they do not overlap.

    Parameters
    ----------
    made : Trajectory
        Adjusted: of what it shares as a whole, its `datum`, only the turn moves it within a span.
    begun : Trajectory
        The smoother's: its errors of position are those of the fixes, and last as long.
    """
    first, last = (pick(int(made.time_ns[end]), int(begun.time_ns[end])) for end, pick in ((0, max), (-1, min)))
    time_ns = np.arange(first, last + 1, NS_PER_S, dtype=np.int64)
    if not len(time_ns):
        return 0.0
    (mine, here), (theirs, there) = made.where_covered(time_ns), begun.where_covered(time_ns)
    both = here & there
    apart = mine.position_m - theirs.position_m
    own, turned = _own(made, time_ns, mine.position_m)
    smoothers = np.diagonal(begun.covariance_at(time_ns), axis1=1, axis2=2)[:, :3]
    largest = 0.0
    for span in (round(span_s) for span_s in LOOKED_BACK_S):
        good = both[span:] & both[:-span]
        if not good.any():
            continue
        fresh = -np.expm1(-span / POSITION_TAU_S)
        way = np.linalg.norm((mine.position_m[span:] - mine.position_m[:-span])[:, :2], axis=1)[:, None]
        variance = (smoothers[span:] + smoothers[:-span]) * fresh + own[span:] + own[:-span] + np.square(way * turned)
        step = (apart[span:] - apart[:-span]) / np.sqrt(variance)
        largest = max(largest, float(np.abs(step[good]).max()))
    return largest


def _own(made: Trajectory, time_ns: npt.NDArray[np.int64], place_m: Array) -> tuple[Array, Array]:
    """Variance of positions beyond what all share, shape (n, 3) [m^2]; how far a way is turned, east, north, up, shape (3,) [rad]."""
    whole = np.diagonal(made.covariance_at(time_ns), axis1=1, axis2=2)
    tilt, heading = np.nanmedian(whole[:, 3:5]), np.nanmedian(whole[:, 5])
    turned = np.sqrt([heading, heading, tilt])
    if made.datum is None:
        return whole[:, :3], turned
    arm = np.zeros((len(place_m), 3, 6))
    arm[:, range(3), range(3)] = 1.0
    x, y, z = place_m.T
    for row, column, value in ((0, 4, z), (0, 5, -y), (1, 3, -z), (1, 5, x), (2, 3, y), (2, 4, -x)):
        arm[:, row, column] = value
    shared = np.einsum("nij,jk,nik->ni", arm, made.datum, arm)
    return np.maximum(whole[:, :3] - shared, 0.0), turned


def slid_sigmas(path: Trajectory, antenna_m: Array, fixes: Sequence[Positions]) -> float:
    """How far a trajectory slides away from fixes within `DRIFT_S`, in sigmas of such a mean; as `drift` has it of the adjustment.

    Parameters
    ----------
    path : Trajectory
        Of the ins frame.
    antenna_m : ndarray, shape (3,)
        In the ins frame.
    fixes : sequence of Positions
        Of each leg.
    """
    largest = 0.0
    for given in fixes:
        poses, known = path.where_covered(given.time_ns)
        if known.sum() < 2:
            continue
        place = poses.position_m + frames.mat_from_quat(poses.quat_local_ins_wxyz) @ antenna_m
        group, middle = seconds(given.time_ns[known])
        off, sigma = (means(values[known], group) for values in (place - given.position_m, given.sigma_m))
        time_s = (given.time_ns[known][middle] - given.time_ns[0]) * 1e-9
        keep = np.exp(-np.diff(time_s)[:, None] / given.tau_s)
        size = np.sqrt(sigma[1:] ** 2 * (1.0 - keep**2) + given.white_m**2 * (1.0 + keep**2))
        sums = np.cumsum((off[1:] - keep * off[:-1]) / size, axis=0)
        if len(sums) > DRIFT_S:
            largest = max(largest, float(np.abs(sums[DRIFT_S:] - sums[:-DRIFT_S]).max()) / np.sqrt(DRIFT_S))
    return largest
