"""The windows of a long flight adjusted together: one more batch, of the whole flight, whose path bends slowly.

Each window has been adjusted by itself, and its path is right within the window. What is left are slow errors: how the
windows lie relative to each other, how each is bent over minutes, and how the whole lies on the Earth. The joined path
is therefore corrected by a spline with a knot every two seconds. Four things hold it: the windows' own shape (a random
walk whose steps are those of the windows' posteriors); gravity; all positions and attitudes of the flight; and patches
of planes that more than one window saw, each plane solved for within, as in a window. Streets flown again after ten
minutes thus close like those of the same minute (the idea of hierarchical bundle adjustment, Liu et al. 2023). An hour
has some 11 000 unknowns and a million patches: less than a window.
"""

import operator
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.ndimage import uniform_filter1d

from flightlog import frames
from groundproc.estimation.adjustment.batch import DRAWS, add_world, corrected, held, linearised, told_by
from groundproc.estimation.adjustment.noise import noise_of
from groundproc.estimation.adjustment.patches import Patches, coarse
from groundproc.estimation.adjustment.poses import pose_errors
from groundproc.estimation.adjustment.posterior import Posterior, Spread
from groundproc.estimation.adjustment.solve import problem
from groundproc.estimation.adjustment.straining import strains
from groundproc.estimation.observations.lidar import DEFLATION
from groundproc.estimation.observations.observation import Observation, State
from groundproc.estimation.observations.planes import Rows, places, rows_of
from groundproc.estimation.observations.rows import Factor, H, RowBuilder, Unknowns, cross, eye, whitened
from groundproc.estimation.odometry.grid import STEPS
from groundproc.estimation.odometry.spline import Path
from groundproc.machine.system import give_back_memory
from groundproc.numerics.splines import basis
from groundproc.numerics.voxelhash import assign
from groundproc.trajectory.covariance import SIZE, Correlation

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

ROUNDS: Final = ((2.0, False), (1.0, False), (1.0, True), (1.0, True))
"""Edge of the voxels [m], and whether outliers are cut, of each step."""
ENOUGH: Final = 1e-5
"""What a step may leave of the cost: of 0.003 of any sigma, and so a centimetre of where the whole lies."""
ROWS: Final = 1000
"""Patches of an interval of two seconds that count, at most."""
NODE: Final = STEPS // 2
"""Slices between two poses whose difference the windows' shape holds."""
INTERVAL_S: Final = H * STEPS
"""Between two knots of the correction [s]."""
WALK_S: Final = 20.0
"""Over so long the windows' posteriors are asked how far a path walks: below, it is the noise of single slices."""
LEAST_TURN: Final = np.deg2rad(0.0005)
LEAST_SHIFT_M: Final = 0.0003
"""Of a window's shape no more is claimed, per root second."""
LEAST_TILT: Final = np.deg2rad(0.003)
SMOOTH_DRAWS: Final = 5
"""Knots over which correlations of what is drawn are averaged: ten seconds."""
TILT_TAU_S: Final = 240.0
"""The tilt of a path against gravity is that of the accelerometers' biases as a window knows them."""


@dataclass(slots=True)
class Stiffness:
    """How well a window knows its own shape and tilt.

    Attributes
    ----------
    turn, shift : ndarray, shape (slices, 3)
        Variance that orientation [rad^2/s] and position [m^2/s] gain against each other, about and along local axes.
    tilt : float
        Sigma of the tilt against gravity [rad].
    """

    turn: Array
    shift: Array
    tilt: float


def stiffness_of(path: Path, unknowns: Unknowns, draws: Array) -> Stiffness:
    """Stiffness by draws from a window's posterior."""
    names = unknowns.names
    mats = frames.mat_from_quat(path.quat[::STEPS])
    place = path.position_m[::STEPS]
    lag = max(min(round(WALK_S / H), len(mats) // 2), 1)
    turn, shift, tilt = np.zeros((len(mats) - lag, 3)), np.zeros((len(mats) - lag, 3)), 0.0
    for draw in draws:
        rotation, moved = _at_knots(draw[: unknowns.path_size], mats)
        step = rotation[lag:] - rotation[:-lag]
        swept = np.cross(0.5 * (rotation[lag:] + rotation[:-lag]), place[lag:] - place[:-lag])
        turn += np.square(step)
        shift += np.square(moved[lag:] - moved[:-lag] - swept)
        leaning = (rotation + draw[names["world.turn"]])[:, :2]
        tilt += float(np.square(leaning).mean())
    spread = [_centred(s / (len(draws) * lag * H), lag, len(mats) - 1) for s in (turn, shift)]
    return Stiffness(
        np.maximum(spread[0], LEAST_TURN**2), np.maximum(spread[1], LEAST_SHIFT_M**2), max(float(np.sqrt(tilt / len(draws))), LEAST_TILT)
    )  # fmt: skip


def _at_knots(coefficients: Array, mats: Array) -> tuple[Array, Array]:
    """Rotation about local axes and shift that a spline makes at the knots, shape (n, 3) each."""
    spline = coefficients.reshape(-1, 6)
    at = (spline[:-2] + 4.0 * spline[1:-1] + spline[2:]) / 6.0
    return np.einsum("nij,nj->ni", mats, at[:, :3]), at[:, 3:]


def _centred(values: Array, lag: int, count: int) -> Array:
    """Values of stretches of `lag` slices, smoothed, as those of the slices in their middle."""
    smooth = uniform_filter1d(values, max(lag // 4, 1), axis=0, mode="nearest")
    return np.asarray(smooth[np.clip(np.arange(count) - lag // 2, 0, len(smooth) - 1)])


@dataclass(slots=True)
class Joining:
    """The flight under its last adjustment.

    Attributes
    ----------
    path : Path
        Coarse: a pose for each slice boundary, the last one repeated until the last interval is full.
    begin : Path
        The same before.
    patches : Patches
    stiffness : Stiffness
        Of all slices.
    observations : list of Observation
    mat_sensor_ins : ndarray, shape (3, 3)
        Boresight as the windows found it.
    log : list of dict
        What each step said.
    """

    path: Path
    begin: Path
    patches: Patches
    stiffness: Stiffness
    observations: Sequence[Observation]
    mat_sensor_ins: Array
    log: list[dict[str, float]] = field(default_factory=list)

    def run(self) -> "Joined":
        """All steps, and the posterior of the last."""
        for voxel_m, cut in ROUNDS:
            last = None  # rows are large: those of the step before go before new ones are made
            last = self.step(voxel_m, cut)
        assert last is not None
        last = self._hold(last)
        self.log[-1] |= last.figures()
        return self._joined(last.unknowns, last.spread(DRAWS), last.datum())

    def _hold(self, last: Posterior) -> Posterior:
        """Where some observation lays the flight, which is right in itself, as a whole elsewhere: adjust it with that."""
        path = held(self.observations, self.state(), last)
        if path is not None:
            self.path = path
            for voxel_m, cut in ROUNDS[-2:]:
                last = self.step(voxel_m, cut)
        return last

    def state(self) -> State:
        """What the observations share."""
        return State(self.path, self.patches.clusters, self.mat_sensor_ins)

    def unknowns(self) -> Unknowns:
        """A slow path, the whole's turn and shift, and what the observations have left to find: the mean error of fixes, the compass."""
        unknowns = Unknowns(self.path.intervals)
        add_world(unknowns)
        for each in self.observations:
            each.unknowns(unknowns)
        return unknowns

    def step(self, voxel_m: float, cut: bool) -> Posterior:
        """One Gauss-Newton step."""
        give_back_memory()
        unknowns = self.unknowns()
        seen = self.patches.of(shared(self.patches, self.path, voxel_m))
        rows = rows_of(seen.clusters, self.path, voxel_m, ROWS, cut)
        stated, figures = linearised(self.observations, self.state(), unknowns)
        own = [
            *shape_factors(self.begin, self.path, self.stiffness, unknowns),
            tilt_factor(self.begin, self.path, self.stiffness.tilt, unknowns),
        ]
        factors = [*own, *stated]
        linear = problem(rows, factors, unknowns, DEFLATION, self.path)
        x, steps = linear.solve(-linear.gradient, ENOUGH)
        self.log.append(
            {"voxel_m": voxel_m, "patches": len(seen), "rows": len(rows), "steps": steps} | _apart(rows, seen)
        )
        self.log[-1] |= {f"{factor.name}_rms": factor.rms() for factor in own} | figures
        before = self.path
        self.path = corrected(before, unknowns, x)
        part = {name: x[place] for name, place in unknowns.names.items()}
        for each in self.observations:
            each.take(part, self.path)
        self.log[-1]["moved_m"] = float(np.sqrt(np.square(self.path.position_m - before.position_m).sum(axis=1).mean()))
        return Posterior(
            linear,
            unknowns,
            lambda: noise_of(
                rows, seen.clusters, before, DEFLATION, factors, x, strains(factors, x, linear.coarse, figures)
            ),
        )

    def _joined(self, unknowns: Unknowns, spread: Spread, datum: Array) -> "Joined":
        """The correction, and its sigmas."""
        knots = slice(None, None, STEPS)
        mats, place = frames.mat_from_quat(self.path.quat[knots]), self.path.position_m[knots]
        names = unknowns.names
        heading, pitch, _ = frames.attitude_of(mats @ self.mat_sensor_ins)

        def poses(x: Array) -> Array:
            """Errors of position, and turns about the levelled axes forward, right, up, shape (n, 6)."""
            rotation, moved = _at_knots(x[: unknowns.path_size], mats)
            whole = x[names["world.turn"]]
            turn = rotation + whole
            forward = turn[:, 0] * np.sin(heading) + turn[:, 1] * np.cos(heading)
            right = turn[:, 0] * np.cos(heading) - turn[:, 1] * np.sin(heading)
            position = moved + np.cross(whole, place) + x[names["world.shift"]]
            return np.column_stack([position, forward, right, turn[:, 2]])

        errors = pose_errors(spread, poses, pitch, smooth=1, smooth_draws=SMOOTH_DRAWS)
        at = np.arange(len(self.begin.quat)) / STEPS
        sigmas = [
            np.stack([np.interp(at, np.arange(len(mats)), axis) for axis in part.T], axis=1)
            for part in (errors.sigma_position_m, errors.sigma_attitude_rad)
        ]
        correlation = Correlation(np.arange(len(mats)) * STEPS, errors.correlation).at(np.arange(len(self.begin.quat)))
        values = self.unknowns().value
        found = {
            name: (values[name], np.sqrt(spread.variance(operator.itemgetter(where))))
            for name, where in names.items()
            if not name.startswith("world.")
        }
        told = told_by(self.observations, self.state())
        return Joined(self.begin, self.path, sigmas[0], sigmas[1], found, self.log, told, correlation, datum)


@dataclass(slots=True)
class Joined:
    """What the joining found.

    Attributes
    ----------
    begin, path : Path
        Coarse, before and after.
    sigma_position_m, sigma_attitude_rad : ndarray, shape (slices + 1 or more, 3)
        At slice boundaries: east, north, up; roll, pitch, heading. What a window does not know of itself comes on top.
    values : dict of str to (ndarray, ndarray)
        Globals that the joining found, and their sigmas: the compass's curve.
    log : list of dict
    told : dict of str to Any
        What the observations say, by their names.
    correlation : ndarray, shape (slices + 1 or more, 6, 6)
        Of the errors of position and attitude at slice boundaries.
    datum : ndarray, shape (6, 6)
        Of the shift and the turn about the origin that all of the path shares.
    """

    begin: Path
    path: Path
    sigma_position_m: Array
    sigma_attitude_rad: Array
    values: dict[str, tuple[Array, Array]]
    log: list[dict[str, float]]
    told: dict[str, Any] = field(default_factory=dict)
    correlation: Array = field(default_factory=lambda: np.zeros((0, SIZE, SIZE)))
    datum: Array = field(default_factory=lambda: np.zeros((SIZE, SIZE)))

    def applied(self, path: Path) -> Path:
        """The path that was begun with, on its fine grid, as corrected."""
        turn = frames.quat_log(frames.quat_multiply(self.path.quat, frames.quat_inverse(self.begin.quat)))
        change = np.concatenate([turn, self.path.position_m - self.begin.position_m], axis=1)
        count = len(path.quat)
        fine = CubicSpline(np.arange(len(change)) * STEPS, change, axis=0)(np.arange(count))
        quat = frames.quat_multiply(frames.quat_exp(fine[:, :3]), path.quat)
        return Path(path.start_ns, quat, path.position_m + fine[:, 3:])

    def report(self) -> dict[str, Any]:
        """What stands in quality.json."""
        off = self.path.position_m - self.begin.position_m
        bent = off - off.mean(axis=0)
        return {"rounds": self.log, "bent_m": float(np.sqrt(np.square(bent).sum(axis=1).mean()))}


def joining(
    path: Path,
    patches: Patches,
    stiffness: Stiffness,
    observations: Sequence[Observation],
    mat_sensor_ins: Array,
) -> Joining:
    """Set the last adjustment up on the windows' joined path; the observations are those that `joined` gave."""
    begin = padded(coarse(path))
    return Joining(begin, begin, patches, stiffness, observations, mat_sensor_ins)


def padded(path: Path) -> Path:
    """A path with its last pose repeated until its last interval is full."""
    more = -(len(path.quat) - 1) % STEPS
    return Path(
        path.start_ns,
        np.concatenate([path.quat, np.repeat(path.quat[-1:], more, axis=0)]),
        np.concatenate([path.position_m, np.repeat(path.position_m[-1:], more, axis=0)]),
        path.step_ns,
    )


def shared(patches: Patches, path: Path, voxel_m: float) -> npt.NDArray[np.bool_]:
    """Which patches lie in a voxel that more than one window saw: of the others the windows have said all there is."""
    world = places(patches.clusters, path)
    voxel, voxels = assign(world, voxel_m)
    low, high = np.full(voxels, np.iinfo(np.int32).max, np.int32), np.full(voxels, -1, np.int32)
    np.minimum.at(low, voxel, patches.window)
    np.maximum.at(high, voxel, patches.window)
    return np.asarray((low < high)[voxel])


def shape_factors(begin: Path, path: Path, stiffness: Stiffness, unknowns: Unknowns) -> list[Factor]:
    """Poses every second against those that the windows left, in local axes: orientation and position as random walks.

    Twice as often as there are knots: by its values at the knots alone a spline is not known at its ends.
    """
    node = np.arange(0, len(path.quat), NODE)
    quat, place, old_quat, old_place = path.quat[node], path.position_m[node], begin.quat[node], begin.position_m[node]
    count = len(node) - 1
    mats, old_mats = frames.mat_from_quat(quat), frames.mat_from_quat(old_quat)
    made = frames.quat_multiply(frames.quat_inverse(quat[:-1]), quat[1:])
    was = frames.quat_multiply(frames.quat_inverse(old_quat[:-1]), old_quat[1:])
    back = np.swapaxes(frames.mat_from_quat(made), 1, 2)
    turned_by = frames.quat_log(frames.quat_multiply(frames.quat_inverse(was), made))
    knot, weights, row = *_spline_at(node, path.intervals), 3 * np.arange(count)
    now, then = (knot[:-1], weights[:-1]), (knot[1:], weights[1:])
    sigmas = [
        np.sqrt(NODE * H * part[np.minimum(node[:-1] + NODE // 2, len(part) - 1)])
        for part in (stiffness.turn, stiffness.shift)
    ]
    turn = RowBuilder(3 * count, unknowns)
    turn.at_times(row, *then, 0, old_mats[1:])
    turn.at_times(row, *now, 0, -old_mats[1:] @ back)
    to_old = old_mats[:-1] @ np.swapaxes(mats[:-1], 1, 2)
    ahead = np.einsum("nji,nj->ni", mats[:-1], place[1:] - place[:-1])
    shift = RowBuilder(3 * count, unknowns)
    shift.at_times(row, *then, 3, to_old)
    shift.at_times(row, *now, 3, -to_old)
    shift.at_times(row, *now, 0, old_mats[:-1] @ cross(ahead))
    residual = np.einsum("nij,nj->ni", old_mats[:-1], ahead) - (old_place[1:] - old_place[:-1])
    off = np.einsum("nij,nj->ni", old_mats[1:], turned_by)
    return [
        Factor("shape turn", off.ravel(), turn.matrix(), sigmas[0].ravel()),
        Factor("shape shift", residual.ravel(), shift.matrix(), sigmas[1].ravel()),
    ]


def _spline_at(node: Ints, intervals: int) -> tuple[Ints, Array]:
    """Interval and spline weights, shape (n, 4), at poses of the coarse path."""
    knot = np.minimum(node // STEPS, intervals - 1)
    return knot, np.array([basis(float(u)) for u in node / STEPS - knot])


def tilt_factor(begin: Path, path: Path, sigma_rad: float, unknowns: Unknowns) -> Factor:
    """The path's tilt against the one that the accelerometers of each window gave it."""
    quat = path.quat[::STEPS]
    residual = frames.quat_log(frames.quat_multiply(quat, frames.quat_inverse(begin.quat[::STEPS])))[:, :2]
    count = len(quat)
    builder, knot = RowBuilder(2 * count, unknowns), np.arange(count)
    builder.at_knots(2 * knot, knot, 0, frames.mat_from_quat(quat)[:, :2])
    builder.by(2 * knot, "world.turn", eye(count)[:, :2])
    return whitened(
        "gravity", residual, builder.matrix(), np.asarray(knot * INTERVAL_S), np.full((count, 2), sigma_rad), np.full(2, TILT_TAU_S), 0.0
    )  # fmt: skip


def _apart(rows: Rows, seen: Patches) -> dict[str, float]:
    """How far what different windows saw of one voxel lies apart: RMS of the windows' mean distances from its mean plane [m]."""
    cost, used = rows.cost()
    voxel = np.repeat(np.arange(len(rows.first) - 1), np.diff(rows.first))
    number = voxel * (int(seen.window.max(initial=0)) + 1) + seen.window[rows.cluster]
    _, group = np.unique(number, return_inverse=True)
    weight = np.bincount(group, rows.weight)
    good = weight > 0
    mean = np.bincount(group, rows.weight * rows.residual_m)[good] / weight[good]
    apart = float(np.sqrt(np.mean(np.square(mean)))) if len(mean) else 0.0
    return {"used": used, "chi_square": cost / max(used, 1), "apart_m": apart}
