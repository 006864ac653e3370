"""Positions and poses from outside, of a GNSS solution, images or another program: centimetres, as long as it is right.

Their errors last, as the autopilot's do. Each row gets the variance that independent errors would need for the mean of
many rows to be as uncertain (the spectrum of an autoregressive process at frequency zero). No differences are taken,
so one wrong fix is one wrong row. The shape from one second to the next is left to the lidar, which knows it better.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Final

import numpy as np
import numpy.typing as npt
from scipy import sparse

from flightlog import frames
from groundproc.estimation.observations.measured import Heard, Learnt, Measured, Place, Rows, turned_by
from groundproc.estimation.observations.moments import means, poses, rates, seconds, spots, velocities, within
from groundproc.estimation.observations.observation import Flown, Observation, Outcome, State
from groundproc.estimation.observations.pieces import laid_by_pieces, seen_slices
from groundproc.estimation.observations.rows import Errors, Factor, RowBuilder, Unknowns, cross, eye
from groundproc.estimation.observations.source import Arm, Clock
from groundproc.estimation.observations.states import ATTITUDE, OUTSIDE, POSITION, VELOCITY
from groundproc.estimation.odometry.spline import Path
from groundproc.estimation.surveyed import surveyed
from groundproc.flight.positions.fixes import OutsideFixes
from groundproc.flight.positions.solution import Quality
from groundproc.flight.timebase import UtcTie
from groundproc.numerics import robust

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

TAU_S: Final = {Quality.FIX: 20.0}
LONGER_S: Final = 60.0
"""How long errors last: what multipath does to fixed ambiguities, and everything else (floats, code, blends with an IMU)."""
LEAST_SIGMA_M: Final = 0.005
LEAST_SIGMA_RAD: Final = np.deg2rad(0.02)
"""No sigma is believed below these: antennas have phase centres, and frames of other instruments their mounting."""
LEAST_DELAY_SIGMA_S: Final = 0.001
BY_BOOT_SIGMA_S: Final = 0.01
"""UTC that comes by way of the autopilot has the age of its gyros in it, which synchronisation cannot tell from an offset of clocks."""
LASTS: Final = 0.75
"""Part of the variance of a receiver's positions whose errors last; the rest is white."""
MEDIAN_DISTANCE: Final = {3: 1.54, 6: 2.31}
"""Median of the distance of so many unit normals (chi distribution)."""
OUTLIER: Final = 3.0
"""Times the usual distance from the path beyond which a position loses weight."""


@dataclass(frozen=True, slots=True)
class Outside:
    """Positions of a point of the airframe, and attitudes where there are any.

    Attributes
    ----------
    source : str
        File and format.
    time_ns : ndarray of int64, shape (n,)
        UTC.
    position_m : ndarray, shape (n, 3)
        Of the point, local.
    covariance_m2 : ndarray, shape (n, 3, 3)
    lever_m : ndarray, shape (3,)
        From the sensor to the point, sensor frame.
    tau_s : ndarray, shape (n,)
        How long the errors last.
    quat : ndarray, shape (n, 4), or None
        Local from ins.
    attitude_covariance_rad2 : ndarray, shape (n, 3, 3), or None
        Of a small rotation vector in the local frame; not a number where nobody states it.
    delay_sigma_s : float
        How well the UTC of the lidar's stamps is known.
    cross_covariance : ndarray, shape (n, 3, 3), optional
        Of position (rows) and rotation vector (columns) [m rad]: with it the covariance of a pose is a full 6 x 6; without, the two are
        independent.
    """

    source: str
    time_ns: Ints
    position_m: Array
    covariance_m2: Array
    lever_m: Array
    tau_s: Array
    quat: Array | None
    attitude_covariance_rad2: Array | None
    delay_sigma_s: float
    cross_covariance: Array | None = None


def outside_track(fixes: OutsideFixes, mat_ins_lidar: Array, lidar_m: Array, utc: UtcTie) -> Outside:
    """Outside positions as the adjustment takes them.

    Parameters
    ----------
    fixes : OutsideFixes
    mat_ins_lidar, lidar_m : ndarray
        Nominal mount.
    utc : UtcTie
        What ties the lidar's clock to UTC.
    """
    tau_s = np.array([TAU_S.get(Quality(kind), LONGER_S) for kind in fixes.quality.tolist()])
    known = fixes.quat_local_ins_wxyz is not None and fixes.attitude_covariance_rad2 is not None
    return Outside(
        fixes.source,
        fixes.time_ns,
        fixes.position_m,
        fixes.covariance_m2,
        mat_ins_lidar.T @ (fixes.lever_arm_m - lidar_m),
        tau_s,
        fixes.quat_local_ins_wxyz if known else None,
        fixes.attitude_covariance_rad2 if known else None,
        delay_sigma_s(utc),
        fixes.cross_covariance_m_rad if known else None,
    )


def delay_sigma_s(utc: UtcTie) -> float:
    """How well the lidar's clock is known to show the UTC of positions from outside [s]."""
    return float(np.hypot(utc.sigma_ns * 1e-9, LEAST_DELAY_SIGMA_S if utc.source == "gprmc" else BY_BOOT_SIGMA_S))


@dataclass(slots=True)
class OutsidePoses(Observation):
    """One source of positions or poses.

    Attributes
    ----------
    name : str
        Prefix of its globals.
    given : Outside
    clock : Clock
    arm : Arm
    """

    name: str
    given: Outside
    clock: Clock
    arm: Arm
    leads: ClassVar[bool] = True

    def joined(self, values: Mapping[str, Array], kept: Sequence[Any]) -> "OutsidePoses":
        """With delay and lever arm as the windows found them."""
        del kept
        return replace(self, clock=self.clock.held(values), arm=self.arm.held(values))

    def unknowns(self, unknowns: Unknowns) -> None:
        """Delay and lever arm where they are free."""
        self.clock.unknowns(unknowns)
        self.arm.unknowns(unknowns)

    def lay(self, state: State) -> Path:
        """Pieces of the path between blind stretches, where the positions have them."""
        given, sigma_m = self.given, float(np.sqrt(np.median(self.given.covariance_m2[:, 0, 0])))
        view = seen_slices(state.clusters, state.path)
        return laid_by_pieces(state.path, given.time_ns, given.position_m, self.arm.lever_m, sigma_m, view)

    def factors(self, state: State, unknowns: Unknowns) -> list[Factor]:
        """Means of a second."""
        mat, turn_name = state.boresight(unknowns)
        return outside_factors(self.given, state.path, unknowns, self.clock, self.arm, mat, turn_name, self.name)

    def take(self, part: Mapping[str, Array], path: Path) -> None:
        """Delay and lever arm."""
        del path
        self.clock, self.arm = self.clock.taken(part), self.arm.taken(part)

    def report(self, outcome: Outcome) -> dict[str, Any]:
        """Where it came from, how much of it lies within the flight, and how well it agrees."""
        inside = within(self.given.time_ns, outcome.path)
        off = self._off(outcome)
        return {"outside": [{"source": self.given.source, "positions": int(inside.sum()), "residual_rms": off}]}

    def warnings(self, outcome: Outcome) -> list[str]:
        """Residuals beyond what is stated."""
        off = self._off(outcome)
        if off <= 1.0:
            return []
        sentence = (
            f"the path differs from {self.given.source} by {off:.1f} times what its sigmas explain though its errors "
            "last, expected under 1; sigmas, lever arm, heights or time scale of that file may be wrong"
        )
        return [sentence]

    def _off(self, outcome: Outcome) -> float:
        """Residuals over what is stated, of positions alone or of whole poses; the largest of all windows."""
        return max(outcome.largest(f"{self.name} {what}_rms") for what in ("position", "pose"))


def of_run(flown: Flown) -> list[Observation]:
    """One for each file that the survey names."""
    found: list[Observation] = []
    for number, fixes in enumerate(surveyed(flown.given)):
        name = f"outside{number + 1}" if number else "outside"
        given = outside_track(fixes, flown.mat_ins_lidar, flown.given.mount.lidar_position_m(), flown.legs[0].utc)
        found.append(observed(given, name))
    return found


def observed(given: Outside, name: str = "outside", arm_sigma_m: float = 0.0) -> OutsidePoses:
    """A source with a clock of its own, and a lever arm that is held unless a sigma is given."""
    return OutsidePoses(
        name, given, Clock(f"{name}.delay", given.delay_sigma_s), Arm(f"{name}.lever", given.lever_m, arm_sigma_m)
    )


def outside_factors(
    given: Outside,
    path: Path,
    unknowns: Unknowns,
    clock: Clock,
    arm: Arm,
    mat_sensor_ins: Array,
    turn_name: str | None,
    name: str = "outside",
) -> list[Factor]:
    """Rows of positions and of attitudes in means of a second; none where the path covers fewer than two.

    Parameters
    ----------
    given : Outside
    path : Path
    unknowns : Unknowns
    clock, arm : Clock, Arm
        Of the source, as estimated so far.
    mat_sensor_ins : ndarray, shape (3, 3)
        Boresight as estimated so far included.
    turn_name : str, optional
        The global that corrects the boresight.
    name : str
        Of the source: with it the names of the factors begin.
    """
    time_ns = clock.ours_ns(given.time_ns)
    inside = within(time_ns, path)
    if inside.sum() < 2:
        return []
    stated = inside & _attitude_known(given)
    own = _Source(given, time_ns, path, unknowns, clock, arm)
    if stated.sum() < 2:
        return [_weighed(f"{name} position", *own.positions(inside))]
    turns = own.attitudes(stated, mat_sensor_ins, turn_name)
    if given.cross_covariance is None:
        return [_weighed(f"{name} position", *own.positions(inside)), _weighed(f"{name} attitude", *turns)]
    found = [_weighed(f"{name} pose", *_together(own.positions(stated), turns, own.crossed(stated)))]
    alone = inside & ~stated
    return [*found, _weighed(f"{name} position", *own.positions(alone))] if alone.sum() >= 2 else found


def _attitude_known(given: Outside) -> Mask:
    """Which poses have an attitude with a covariance."""
    if given.quat is None or given.attitude_covariance_rad2 is None:
        return np.zeros(len(given.time_ns), np.bool_)
    known = np.isfinite(given.attitude_covariance_rad2).all(axis=(1, 2))
    if given.cross_covariance is not None:
        known &= np.isfinite(given.cross_covariance).all(axis=(1, 2))
    return np.asarray(known)


@dataclass(frozen=True, slots=True)
class _Source:
    """A source on a path: makes the rows of chosen stamps."""

    given: Outside
    time_ns: Ints
    path: Path
    unknowns: Unknowns
    clock: Clock
    arm: Arm

    def positions(self, chosen: Mask) -> "_Rows":
        """Positions in means of a second."""
        path, lever = self.path, self.arm.lever_m
        time_ns = self.time_ns[chosen]
        _, _, step, share = spots(time_ns, path)
        quat, position = poses(path, step, share)
        mat = frames.mat_from_quat(quat)
        point = position + mat @ lever
        group, middle = seconds(time_ns)
        residual = means(point - self.given.position_m[chosen], group)
        covariance = _means_of(self.given.covariance_m2[chosen], group) + LEAST_SIGMA_M**2 * np.eye(3)
        knot, weights, _, _ = spots(time_ns[middle], path)
        count = len(middle)
        builder, row = RowBuilder(3 * count, self.unknowns), 3 * np.arange(count)
        builder.at_times(row, knot, weights, 3, eye(count))
        builder.at_times(row, knot, weights, 0, -mat[middle] @ np.tile(cross(lever[None]), (count, 1, 1)))
        builder.by(row, "world.turn", -cross(means(point, group)))
        builder.by(row, "world.shift", eye(count))
        self.clock.add(builder, row, means(velocities(path, step, lever), group))
        self.arm.add(builder, row, means(mat.reshape(-1, 9), group).reshape(-1, 3, 3))
        return residual, builder.matrix(), covariance, self._lasting(chosen, group, middle)

    def attitudes(self, chosen: Mask, mat_sensor_ins: Array, turn_name: str | None) -> "_Rows":
        """Attitudes in means of a second."""
        given, path, time_ns = self.given, self.path, self.time_ns[chosen]
        assert given.quat is not None
        assert given.attitude_covariance_rad2 is not None
        _, _, step, share = spots(time_ns, path)
        mat = frames.mat_from_quat(poses(path, step, share)[0])
        stated = np.swapaxes(frames.mat_from_quat(given.quat[chosen]), 1, 2)
        off = frames.quat_log(frames.quat_from_mat(mat @ mat_sensor_ins @ stated))
        group, middle = seconds(time_ns)
        knot, weights, _, _ = spots(time_ns[middle], path)
        count = len(middle)
        builder, row = RowBuilder(3 * count, self.unknowns), 3 * np.arange(count)
        builder.at_times(row, knot, weights, 0, mat[middle])
        builder.by(row, "world.turn", eye(count))
        if turn_name is not None:
            builder.by(row, turn_name, means(mat.reshape(-1, 9), group).reshape(-1, 3, 3))
        self.clock.add(builder, row, means(rates(path, step), group))
        spread = _means_of(given.attitude_covariance_rad2[chosen], group) + LEAST_SIGMA_RAD**2 * np.eye(3)
        return means(off, group), builder.matrix(), spread, self._lasting(chosen, group, middle)

    def crossed(self, chosen: Mask) -> Array:
        """Covariance of position and rotation in means of a second."""
        assert self.given.cross_covariance is not None
        return _means_of(self.given.cross_covariance[chosen], seconds(self.time_ns[chosen])[0])

    def _lasting(self, chosen: Mask, group: Ints, middle: Ints) -> Array:
        tau_s = means(self.given.tau_s[chosen, None], group)[:, 0]
        return _lasting(self.time_ns[chosen][middle], tau_s)


_Rows = tuple[Array, sparse.csr_matrix, Array, Array]
"""Residuals, shape (n, m), matrix, covariances, shape (n, m, m), and what the variances are multiplied by, shape (n,)."""


def _together(places: _Rows, turns: _Rows, crossed: Array) -> _Rows:
    """Positions and attitudes of the same poses as six rows each."""
    residual = np.concatenate([places[0], turns[0]], axis=1)
    count = len(residual)
    order = np.concatenate([np.arange(3 * count).reshape(-1, 3), 3 * count + np.arange(3 * count).reshape(-1, 3)], 1)
    matrix = sparse.vstack([places[1], turns[1]], format="csr")[order.ravel()]
    covariance = np.block([[places[2], crossed], [np.swapaxes(crossed, 1, 2), turns[2]]])
    return residual, matrix, covariance, places[3]


def _means_of(covariance: Array, group: Ints) -> Array:
    """Mean covariance of each group: errors that last are the same ones throughout a second."""
    return means(covariance.reshape(-1, 9), group).reshape(-1, 3, 3)


def _lasting(time_ns: Ints, tau_s: Array) -> Array:
    """What variances are multiplied by, shape (n,): (1 + k) / (1 - k) with k = exp(-dt / tau)."""
    spacing_s = float(np.median(np.diff(time_ns))) * 1e-9 if len(time_ns) > 1 else np.inf
    keep = np.exp(-spacing_s / tau_s)
    return np.asarray((1.0 + keep) / (1.0 - keep))


def _weighed(name: str, residual: Array, matrix: sparse.csr_matrix, covariance: Array, inflation: Array) -> Factor:
    """Rows made independent and of unit noise; those far from where the others lie get less weight.

    The usual size of residuals comes from the rows themselves, about their median. Before the path is where it
    belongs, all rows are off alike, and a file whose sigmas are all too small does not make all of them wrong. The
    loss grows linearly (Huber), because where the lidar was blind it is the path that is far off, and must be pulled
    back.
    """
    spread = np.linalg.cholesky(covariance)
    centred = residual - np.median(residual, axis=0)
    distance = np.linalg.norm(np.linalg.solve(spread, centred[:, :, None])[:, :, 0], axis=1)
    usual = OUTLIER * max(1.0, float(np.median(distance)) / MEDIAN_DISTANCE[residual.shape[1]])
    share = robust.huber(distance, usual)
    white = np.linalg.inv(spread) * np.sqrt(share / inflation)[:, None, None]
    blocks = sparse.block_diag(white, format="csr")
    return Factor(
        name, blocks @ residual.ravel(), (blocks @ matrix).tocsr(), np.ones(residual.size), errors=Errors.ANCHOR
    )


@dataclass(frozen=True, slots=True)
class OutsideRows(Measured):
    """The same in the smoother, with velocities where they are stated.

    What lasts of the errors of a receiver is a state. Poses are taken as they come; those that were adjusted together as they are after
    that, each with its own error alone: what they share moves all that lies between them, and is added to what the smoother states.
    """

    fixes: OutsideFixes
    start_ns: int
    lasting_m2: Array
    learnt: Mapping[str, Learnt] = field(default_factory=dict)

    def rows(self, rows: Rows) -> None:
        """Positions, velocities and attitudes, each with its covariance."""
        fixes = self.fixes
        time_s: Array = (fixes.time_ns - self.start_ns).astype(np.float64) * 1e-9
        place, inside = rows.at(time_s)
        mat = frames.mat_from_quat(place.quat)
        arm = mat @ fixes.lever_arm_m
        covariance, blocks = fixes.covariance_m2[inside], [(POSITION, None), (ATTITUDE, turned_by(arm))]
        if lasts(fixes):
            covariance, blocks = white_part(covariance, self.lasting_m2), [*blocks, (OUTSIDE, None)]
        left = fixes.position_m[inside] - place.position_m - arm
        turn, spread = self._turn(place, inside), fixes.attitude_covariance_rad2
        whole = self._pose_covariance(inside)
        if turn is not None and fixes.tied is not None:
            poses = np.concatenate([left, turn], axis=1) + fixes.tied.step[inside]
            _add_poses(rows, place, fixes.tied.own[inside], poses, arm)
        elif turn is not None and whole is not None:
            _add_poses(rows, place, whole, np.concatenate([left, turn], axis=1), arm)
        else:
            rows.add_whitened("outside position", place.node, covariance, left, blocks)
            if turn is not None and spread is not None:
                rows.add_whitened("outside attitude", place.node, spread[inside], turn, [(ATTITUDE, None)])
        if fixes.velocity_m_s is not None and fixes.velocity_covariance_m2_s2 is not None:
            swing = np.einsum("nij,nj->ni", mat, np.cross(place.rate_rad_s, fixes.lever_arm_m))
            left = fixes.velocity_m_s[inside] - place.velocity_m_s - swing
            covariance = fixes.velocity_covariance_m2_s2[inside]
            rows.add_whitened("outside velocity", place.node, covariance, left, [(VELOCITY, None)])

    def _turn(self, place: Place, inside: Mask) -> Array | None:
        """Stated attitude against the reference, shape (m, 3); None where none is stated."""
        if self.fixes.quat_local_ins_wxyz is None:
            return None
        stated = self.fixes.quat_local_ins_wxyz[inside]
        return frames.quat_log(frames.quat_multiply(stated, frames.quat_inverse(place.quat)))

    def _pose_covariance(self, inside: Mask) -> Array | None:
        """Covariances of whole poses, shape (m, 6, 6); None where places and turns are stated apart."""
        fixes = self.fixes
        if fixes.cross_covariance_m_rad is None or fixes.attitude_covariance_rad2 is None:
            return None
        crossed, turns = fixes.cross_covariance_m_rad[inside], fixes.attitude_covariance_rad2[inside]
        whole = np.block([[fixes.covariance_m2[inside], crossed], [np.swapaxes(crossed, 1, 2), turns]])
        return whole if np.isfinite(whole).all() else None


def _add_poses(rows: Rows, place: Place, covariance: Array, left: Array, arm: Array) -> None:
    """Six rows a pose, whitened together: what an image does not tell is a shift and a turn at once."""
    count = len(left)
    places = np.tile(np.eye(6)[:, :3], (count, 1, 1))
    turns = np.concatenate([turned_by(arm), np.tile(np.eye(3), (count, 1, 1))], axis=1)
    rows.add_whitened("outside pose", place.node, covariance, left, [(POSITION, places), (ATTITUDE, turns)])


def of_leg(heard: Heard) -> list[Measured]:
    """One for each source."""
    lasting_m2 = np.square(lasting(heard.stated.outside)[0])
    return [OutsideRows(fixes, heard.stated.start_ns, lasting_m2) for fixes in heard.stated.outside]


def lasts(fixes: OutsideFixes) -> bool:
    """Whether errors of a source are those of a receiver, which last; those of poses are what who made them says."""
    return fixes.quat_local_ins_wxyz is None


def lasting(sources: Sequence[OutsideFixes]) -> tuple[Array, float]:
    """Sigma east, north, up [m] of what lasts of the errors of receivers, and for how long [s]; 0 m where there is none."""
    receivers = [fixes for fixes in sources if lasts(fixes) and len(fixes)]
    if not receivers:
        return np.zeros(3), LONGER_S
    variance = np.concatenate([np.diagonal(each.covariance_m2, axis1=1, axis2=2) for each in receivers])
    quality = Quality(int(np.median(np.concatenate([each.quality for each in receivers]))))
    return np.sqrt(LASTS * np.median(variance, axis=0)), TAU_S.get(quality, LONGER_S)


SHARED_FADES_S: Final = 20.0
"""How long what tied poses share is left before the first and after the last of them, where receivers take over."""


def shared(sources: Sequence[OutsideFixes], time_ns: Ints) -> Array:
    """Covariance of place and turn that tied poses share, at times, shape (n, 6, 6)."""
    total = np.zeros((len(time_ns), 6, 6))
    for fixes in sources:
        if fixes.tied is None or not len(fixes):
            continue
        zero = int(fixes.time_ns[0])
        now_s, own_s = (time_ns - zero) * 1e-9, (fixes.time_ns - zero) * 1e-9
        columns = fixes.tied.shared.reshape(-1, 36).T
        between = np.stack([np.interp(now_s, own_s, column) for column in columns], axis=1)
        away_s = np.maximum(np.maximum(own_s[0] - now_s, now_s - own_s[-1]), 0.0)
        total += between.reshape(-1, 6, 6) * np.exp(-away_s / SHARED_FADES_S)[:, None, None]
    return total


def white_part(covariance: Array, lasting_m2: Array) -> Array:
    """What covariances of positions, shape (n, 3, 3), leave beside what lasts of all alike, shape (3,); positive definite."""
    white = (1.0 - LASTS) * covariance
    axes = np.arange(3)
    white[:, axes, axes] += np.maximum(LASTS * np.diagonal(covariance, axis1=1, axis2=2) - lasting_m2, 0.0)
    return white
