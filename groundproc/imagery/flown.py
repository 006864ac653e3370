"""Images on a trajectory: stations at their times, poses observed with full covariance, and what moves while a shutter rolls."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.clock import utc_text
from flightlog.errors import CoverageError
from groundproc.imagery.assembly import Known
from groundproc.imagery.bundle.block import Block, Common, PosePriors, Stations
from groundproc.imagery.poses import NO_TIME
from groundproc.imagery.rig import Rig
from groundproc.imagery.rotations import cross_matrix
from groundproc.trajectory.covariance import mat_attitude_turn
from groundproc.trajectory.estimate import TRAJECTORY, is_estimate, read_estimate
from groundproc.trajectory.table import read_trajectory
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

_STEP_NS: Final = 5_000_000
_QUARTER_NS: Final = 900 * 10**9
_MOST_QUARTERS: Final = 56
"""Local times are at most 14 h from UTC, in quarters of an hour."""
LATE_SIGMA_S: Final = 0.01
"""By how much an autopilot's attitudes may be later than places: what filters of gyros delay them."""
OF_AUTOPILOT: Final = ("filtered", "ins")
"""Methods whose attitudes are the autopilot's; one clock is behind all that others find."""
_WITHIN_SECOND_NS: Final = tuple(range(-400_000_000, 400_000_001, 200_000_000))
"""Where a stamp of whole seconds may be, half a second before and after the mean."""
_CUT_ALIKE: Final = 6.0
"""Exposures at even intervals are cut off alike for the images of a strip, which then count as one."""
_LEAST_STAMPS: Final = 3
LEAST_SHARE: Final = 1e-3
"""Of a variance: less is not believed to be left beside the datum, which is as well known as draws tell it."""
PLAIN_PLACE_M: Final = (0.1, 0.1, 0.15)
PLAIN_TURN_RAD: Final = float(np.deg2rad(0.3))
"""Of a trajectory that states no sigmas."""
_LEAST_PLACE_M: Final = 0.002
_LEAST_TURN_RAD: Final = float(np.deg2rad(0.002))


def load_trajectory(path: Path) -> tuple[Trajectory, float]:
    """A trajectory.csv, with the covariance beside it, or the folder of an estimate; and by how much its attitudes may be late [s].

    Raises
    ------
    LogError
        It cannot be read.
    """
    folder = path if path.is_dir() else path.parent
    if path.is_dir() or (path.name == TRAJECTORY and is_estimate(folder)):
        estimate = read_estimate(folder)
        return estimate.trajectory, LATE_SIGMA_S if estimate.method in OF_AUTOPILOT else 0.0
    return read_trajectory(path), 0.0


@dataclass(frozen=True, slots=True)
class Sampled:
    """A trajectory at times.

    Attributes
    ----------
    place_m, mat_local_ins, velocity_m_s, rate_rad_s : ndarray, shapes (n, 3), (n, 3, 3), (n, 3), (n, 3)
        The rate is that of the ins in its own frame.
    covariance : ndarray, shape (n, 6, 6)
        Place [m] and turn in the local frame [rad], beside the datum that all poses share.
    covered : ndarray of bool, shape (n,)
    stated : bool
        Whether the trajectory states sigmas.
    """

    place_m: Array
    mat_local_ins: Array
    velocity_m_s: Array
    rate_rad_s: Array
    covariance: Array
    covered: Mask
    stated: bool


def sample(trajectory: Trajectory, time_ns: Ints) -> Sampled:
    """Poses, velocities, rates and covariances at times, shape (n,), any order."""
    before, has_before = trajectory.where_covered(time_ns - _STEP_NS)
    after, has_after = trajectory.where_covered(time_ns + _STEP_NS)
    poses, covered = trajectory.where_covered(time_ns)
    covered = covered & has_before & has_after
    seconds = 2e-9 * _STEP_NS
    plain = np.array([1.0, 0.0, 0.0, 0.0])
    quats = [np.where(covered[:, None], each.quat_local_ins_wxyz, plain) for each in (before, poses, after)]
    velocity = np.where(covered[:, None], (after.position_m - before.position_m) / seconds, 0.0)
    rate = frames.quat_log(frames.quat_multiply(frames.quat_inverse(quats[0]), quats[2])) / seconds
    mat = frames.mat_from_quat(quats[1])
    place = np.where(covered[:, None], poses.position_m, 0.0)
    covariance, stated = _covariance(trajectory, time_ns, mat, place, covered)
    return Sampled(place, mat, velocity, rate, covariance, covered, stated)


def of_datum(datum: Array, place_m: Array) -> Array:
    """Covariance that a shift and a turn about the origin give poses at places, shape (n, 6, 6)."""
    by = np.tile(np.eye(6), (len(place_m), 1, 1))
    by[:, :3, 3:] = -cross_matrix(place_m)
    return np.asarray(by @ datum @ np.swapaxes(by, 1, 2))


def _beside(covariance: Array, common: Array) -> Array:
    """What covariances hold beside their common part, shape (n, 6, 6); nothing is known better than `LEAST_SHARE` of its variance."""
    size = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    unit = size[:, :, None] * size[:, None, :]
    value, axis = np.linalg.eigh((covariance - common) / unit)
    return np.asarray(unit * ((axis * np.maximum(value, LEAST_SHARE)[:, None, :]) @ np.swapaxes(axis, 1, 2)))


def _covariance(trajectory: Trajectory, time_ns: Ints, mat: Array, place: Array, covered: Mask) -> tuple[Array, bool]:
    """Covariance of place and turn; that of roll, pitch and heading is turned into one about east, north and up."""
    inside = np.clip(time_ns, trajectory.time_ns[0], trajectory.time_ns[-1])
    found = trajectory.covariance_at(inside)
    stated = bool(np.isfinite(found[covered]).all())
    heading, pitch, _ = frames.attitude_of(mat)
    pitch = np.clip(pitch, -1.5, 1.5)
    by_angles = np.linalg.inv(mat_attitude_turn(heading, pitch))
    full = np.zeros((len(time_ns), 6, 6))
    full[:, :3, :3], full[:, 3:, 3:] = np.eye(3), by_angles
    plain = np.zeros((6, 6))
    plain[np.arange(6), np.arange(6)] = [*np.square(PLAIN_PLACE_M), *[PLAIN_TURN_RAD**2] * 3]
    good = np.asarray(np.isfinite(found).all(axis=(1, 2)))
    found = np.where(good[:, None, None], found, plain)
    turned = full @ found @ np.swapaxes(full, 1, 2)
    if trajectory.datum is not None:
        turned = _beside(turned, of_datum(trajectory.datum, place))
    turned[:, np.arange(3), np.arange(3)] += _LEAST_PLACE_M**2
    turned[:, np.arange(3, 6), np.arange(3, 6)] += _LEAST_TURN_RAD**2
    return turned, stated


def whole_seconds(time_ns: Ints) -> bool:
    """Whether stamps are those of a clock that shows whole seconds, as EXIF without sub-seconds."""
    known = time_ns[time_ns != NO_TIME]
    return len(known) >= _LEAST_STAMPS and not (known % 10**9).any()


def _stamped(trajectory: Trajectory, time_ns: Ints, sampled: Sampled, whole: bool) -> Array:
    """Covariance of poses, shape (n, 6, 6), with what they change within half a second before and after if stamps are whole seconds.

    Place and turn by themselves: a turn within a second is no straight line, and would seem to tell the time.
    """
    if not whole:
        return sampled.covariance
    covariance = sampled.covariance.copy()
    plain = np.array([1.0, 0.0, 0.0, 0.0])
    inverse = frames.quat_inverse(frames.quat_from_mat(sampled.mat_local_ins))
    for later_ns in _WITHIN_SECOND_NS:
        poses, covered = trajectory.where_covered(time_ns + later_ns)
        both = (covered & sampled.covered)[:, None]
        moved = np.where(both, poses.position_m - sampled.place_m, 0.0)
        quat = np.where(both, poses.quat_local_ins_wxyz, plain)
        turned = np.where(both, frames.quat_log(frames.quat_multiply(quat, inverse)), 0.0)
        for part, change, times in ((slice(0, 3), moved, _CUT_ALIKE), (slice(3, 6), turned, 1.0)):
            covariance[:, part, part] += times * change[:, :, None] * change[:, None, :] / len(_WITHIN_SECOND_NS)
    return covariance


def whole_offset_ns(trajectory: Trajectory, time_ns: Ints) -> int:
    """Quarters of an hour [ns] by which stamps are local time: those that put most of them into the flight, the fewest that do."""
    known = time_ns[time_ns != NO_TIME]
    if not len(known):
        return 0
    best, most = 0, -1
    for quarters in sorted(range(-_MOST_QUARTERS, _MOST_QUARTERS + 1), key=abs):
        inside = int(trajectory.where_covered(known + quarters * _QUARTER_NS)[1].sum())
        if inside > most:
            best, most = quarters, inside
    return best * _QUARTER_NS if most > 0 else 0


def stations_of(
    trajectory: Trajectory, rig: Rig, camera: Ints, time_ns: Ints, whole: bool = False
) -> tuple[Known, Mask]:
    """Stations and observed poses of images; images of several cameras with one stamp share a station.

    Parameters
    ----------
    trajectory : Trajectory
    rig : Rig
        Its shifts are applied.
    camera : ndarray of int64, shape (i,)
    time_ns : ndarray of int64, shape (i,)
        Stamps, all known.
    whole : bool
        They are cut off to whole seconds.

    Returns
    -------
    known : Known
    covered : ndarray of bool, shape (i,)
        Images within the trajectory; the others have no pose.
    """
    station_time, station = np.unique(time_ns, return_inverse=True)
    count = len(station_time)
    # two images of one camera have two stations, whatever their stamps
    pair = station * len(rig.cameras) + camera
    _, first, times = np.unique(pair, return_index=True, return_counts=True)
    if (times > 1).any():
        station, count = np.arange(len(camera)), len(camera)
        station_time = time_ns.copy()
        del first
    lead = np.full(count, len(rig.cameras))
    np.minimum.at(lead, station, camera)
    sampled = sample(trajectory, station_time + _shift_ns(rig, lead))
    stations = Stations(
        station_time, sampled.place_m, sampled.mat_local_ins, sampled.velocity_m_s, sampled.rate_rad_s, lead
    )
    rows = np.flatnonzero(sampled.covered)
    covariance = _stamped(trajectory, station_time + _shift_ns(rig, lead), sampled, whole)
    priors = PosePriors(
        rows, sampled.place_m[rows], sampled.mat_local_ins[rows], covariance[rows], np.zeros((len(rows), 3)),
        sampled.velocity_m_s[rows], np.einsum("kij,kj->ki", sampled.mat_local_ins[rows], sampled.rate_rad_s[rows]),
        np.ones(len(rows)), common=Common(covariance=trajectory.datum, whole=whole),
    )  # fmt: skip
    covered = sampled.covered[station]
    return Known(covered.copy(), stations, station, priors), covered


def with_lateness(block: Block, sigma_s: float, own_cloud: bool) -> Block:
    """The block with attitudes that may be later than places, and a cloud that was made with them or not.

    Not before its clocks are found, for one is taken for the other.
    """
    common = replace(block.priors.common, late_sigma_s=sigma_s, cloud=own_cloud)
    return replace(block, priors=replace(block.priors, common=common))


def _shift_ns(rig: Rig, lead: Ints) -> Ints:
    shift_s = np.array([one.timeshift_s for one in rig.cameras])
    return np.asarray(np.rint(shift_s[lead] * 1e9), np.int64)


def resampled(trajectory: Trajectory, block: Block) -> Block:
    """The block with poses observed where the clocks, as they are now known, put them; a block on a straight line needs it least."""
    stations, priors = block.stations, block.priors
    at = priors.station
    time_ns = stations.time_ns[at] + _shift_ns(block.rig, stations.lead[at])
    sampled = sample(trajectory, time_ns)
    later = sample(trajectory, time_ns + round(priors.common.late_s * 1e9))
    covered = sampled.covered & later.covered
    if not covered.all():
        late = int(stations.time_ns[at][~covered][0])
        raise CoverageError(
            f"images: the clock's shift puts that of {utc_text(late)} outside of the trajectory; state its sigma or fix it"
        )
    velocity, rate = stations.velocity_m_s.copy(), stations.rate_rad_s.copy()
    velocity[at], rate[at] = sampled.velocity_m_s, later.rate_rad_s
    return replace(
        block,
        stations=replace(stations, velocity_m_s=velocity, rate_rad_s=rate),
        priors=replace(
            priors,
            place_m=sampled.place_m,
            mat_local_ins=later.mat_local_ins,
            covariance=_stamped(trajectory, time_ns, sampled, priors.common.whole),
            velocity_m_s=sampled.velocity_m_s,
            turning_rad_s=np.einsum("kij,kj->ki", later.mat_local_ins, later.rate_rad_s),
        ),
    )
