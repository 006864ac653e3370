"""Windows joined: a town of planes seen by windows that lie and bend a little wrong, and fixes with errors that last."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from flightlog import frames
from flightlog.constants import NS_PER_S
from groundproc.estimation.adjustment.joining import (
    Joined,
    Stiffness,
    joining,
    padded,
    shape_factors,
    shared,
    stiffness_of,
    tilt_factor,
)
from groundproc.estimation.adjustment.pace import Pace
from groundproc.estimation.adjustment.patches import CHUNK, KEPT, PATCH_M, Patches, all_of, coarse, patches_of
from groundproc.estimation.observations.attitudes import COMPASS_PRIOR, StatedAttitudes
from groundproc.estimation.observations.fixes import Fixes
from groundproc.estimation.observations.observation import Observation
from groundproc.estimation.observations.planes import placed
from groundproc.estimation.observations.rows import Factor, Unknowns, normal_equations, prior_factor, turned
from groundproc.estimation.observations.source import Clock
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.grid import SLICE_NS, STEP_NS, STEPS
from groundproc.estimation.odometry.spline import Path
from groundproc.estimation.odometry.stated import Attitudes, Positions

Array = npt.NDArray[np.float64]
START_NS = 1_779_000_000_000_000_000
SLICES = 900
"""Three windows of 30 s, round a square of 30 m three times: each window flies where the others flew."""
WINDOW = 300
LAP_S = 30.0


def flown(first: int, last: int) -> Path:
    """Slices of the true path: a circle of 15 m, nose ahead, with a multirotor's swaying."""
    seconds = np.arange(first * STEPS, last * STEPS + 1) * STEP_NS * 1e-9
    angle = 2.0 * np.pi * seconds / LAP_S
    place = np.stack([15.0 * np.cos(angle), 15.0 * np.sin(angle), 6.0 + 0.5 * np.sin(2.1 * angle)], axis=1)
    heading = frames.quat_exp(np.stack([0.0 * angle, 0.0 * angle, angle], axis=1))
    sway = frames.quat_exp(np.stack([0.1 * np.sin(3 * seconds), 0.08 * np.cos(4 * seconds), 0.0 * seconds], axis=1))
    return Path(START_NS + first * SLICE_NS, frames.quat_multiply(heading, sway), place)


def seen_from(path: Path, noise_m: float, seed: int) -> Clusters:
    """Clusters on the ground, four walls and a roof, 200 in each slice, as seen from a path."""
    rng, count = np.random.default_rng(seed), 200 * path.intervals
    time_ns = path.start_ns + np.sort(rng.integers(0, path.intervals * SLICE_NS, count))
    u, v, kind = rng.uniform(-25, 25, count), rng.uniform(0, 8, count), rng.integers(0, 6, count)
    world = np.stack([u, rng.uniform(-25, 25, count), 0.02 * u], axis=1)
    for k, (axis, at) in enumerate(((0, -25.3), (0, 25.4), (1, -25.6), (1, 25.2)), start=1):
        wall = np.stack([u, u, v], axis=1)
        wall[:, axis] = at
        world[kind == k] = wall[kind == k]
    world[kind == 5] = np.stack([u, 3.0 * v / 8.0, 3.0 + 0.5 * v], axis=1)[kind == 5]
    world += noise_m * rng.normal(size=world.shape)
    none = Clusters(
        time_ns, np.zeros((count, 3), np.float32), np.zeros((count, 6), np.float32), np.full(count, 8, np.int32)
    )
    place, mats = placed(none, path)
    inside = np.linalg.solve(mats.reshape(-1, 3, 3).astype(float), (world - place)[:, :, None])[:, :, 0]
    return replace(none, xyz_m=inside.astype(np.float32))


def bent(path: Path, turn: Sequence[float], shift_m: Sequence[float]) -> Path:
    """A path that goes wrong evenly, by so much in the end."""
    share = np.linspace(0.0, 1.0, len(path.quat))[:, None]
    turns = frames.quat_exp(share * np.array(turn))
    place = path.position_m - path.position_m[0]
    turned_place = np.einsum("nij,nj->ni", frames.mat_from_quat(turns), place)
    return Path(
        path.start_ns,
        frames.quat_multiply(turns, path.quat),
        path.position_m[0] + turned_place + share * np.array(shift_m),
    )


def fixes_of(path: Path, sigma_m: float, seed: int, tau_s: float = 20.0) -> Positions:
    """Three fixes a second with Gauss-Markov errors."""
    rng, every = np.random.default_rng(seed), 66
    at = np.arange(0, len(path.quat), every)
    keep = np.exp(-every * STEP_NS * 1e-9 / tau_s)
    error = np.empty((len(at), 3))
    error[0] = sigma_m * rng.normal(size=3)
    for i in range(1, len(at)):
        error[i] = keep * error[i - 1] + sigma_m * np.sqrt(1 - keep**2) * rng.normal(size=3)
    return Positions(
        path.start_ns + at * STEP_NS, path.position_m[at] + error, np.full((len(at), 3), sigma_m), np.zeros(3),
        np.full(3, tau_s), 0.1,
    )  # fmt: skip


@pytest.fixture(scope="module")
def true() -> Path:
    return flown(0, SLICES)


@pytest.fixture(scope="module")
def windows_wrong(true: Path) -> tuple[Path, Patches]:
    """The path as windows left it, each carried on from the end of the one before with a bend of its own, and what they saw."""
    quat, place, parts = [true.quat[:1]], [true.position_m[:1]], []
    mat, at = np.eye(3), true.position_m[0]
    bends = (([0, 0, 0.002], [0.02, 0, 0.01]), ([2e-4, 0, -0.003], [0, 0.03, 0.03]), ([0, 2e-4, 0.002], [0, 0, -0.03]))
    for number, (turn, shift) in enumerate(bends):
        real = flown(number * WINDOW, (number + 1) * WINDOW)
        wrong = bent(real, turn, shift)
        wrong = wrong.turned(mat, at - mat @ wrong.position_m[0])
        parts.append(patches_of(seen_from(real, 0.004, number), wrong, number))
        quat.append(wrong.quat[1:])
        place.append(wrong.position_m[1:])
        mat = frames.mat_from_quat(wrong.quat[-1:])[0] @ frames.mat_from_quat(real.quat[-1:])[0].T
        at = wrong.position_m[-1]
    return Path(START_NS, np.concatenate(quat), np.concatenate(place)), all_of(parts)


def loose() -> Stiffness:
    """About what the bends are."""
    return Stiffness(np.full((SLICES, 3), np.deg2rad(0.02) ** 2), np.full((SLICES, 3), 0.005**2), np.deg2rad(0.02))


def stated(fixes: Positions, *attitudes: Attitudes) -> list[Observation]:
    """What the autopilot says."""
    return [Fixes("fixes0", fixes, 0, Clock("fixes0.delay")), StatedAttitudes(attitudes)]


@pytest.fixture(scope="module")
def joined(true: Path, windows_wrong: tuple[Path, Patches]) -> tuple[Joined, Positions]:
    begun, patches = windows_wrong
    fixes = fixes_of(true, 2.0, 1)
    return joining(begun, patches, loose(), stated(fixes), np.eye(3)).run(), fixes


def shape_error(path: Path, true: Path) -> tuple[float, float]:
    """RMS of position [m] and attitude [rad] after one rigid alignment by positions."""
    a, b = path.position_m - path.position_m.mean(axis=0), true.position_m - true.position_m.mean(axis=0)
    u, _, vt = np.linalg.svd(b.T @ a)
    mat = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    turn = np.swapaxes(frames.mat_from_quat(true.quat), 1, 2) @ mat @ frames.mat_from_quat(path.quat)
    angle = frames.quat_log(frames.quat_from_mat(turn))
    off = b - a @ mat.T
    return float(np.sqrt(np.square(off).sum(axis=1).mean())), float(np.sqrt(np.square(angle).sum(axis=1).mean()))


def test_windows_over_the_same_ground_are_laid_on_each_other(
    true: Path, windows_wrong: tuple[Path, Patches], joined: tuple[Joined, Positions]
) -> None:
    """They came in 3 cm and 0.05 deg out of shape; 4 mm of noise in 200 clusters of a slice leaves a small part of that."""
    before_m, before_rad = shape_error(windows_wrong[0], true)
    after_m, after_rad = shape_error(joined[0].applied(windows_wrong[0]), true)
    assert before_m > 0.02
    assert after_m < 0.1 * before_m
    assert after_rad < 0.2 * before_rad
    log = joined[0].log
    assert log[0]["apart_m"] > 0.01
    assert log[-1]["apart_m"] < 0.003
    assert log[-1]["moved_m"] < 0.001


def test_the_whole_lies_where_the_plain_mean_of_all_fixes_has_it(
    true: Path, windows_wrong: tuple[Path, Patches], joined: tuple[Joined, Positions]
) -> None:
    """Not where the fixes of the first window have it; a centimetre for means of a second."""
    result, fixes = joined
    after = result.applied(windows_wrong[0])
    at = (fixes.time_ns - START_NS) // STEP_NS
    np.testing.assert_allclose(
        (after.position_m - true.position_m).mean(axis=0), (fixes.position_m - true.position_m[at]).mean(axis=0), rtol=0, atol=0.03
    )  # fmt: skip
    error, sigma = np.abs(after.position_m - true.position_m).mean(axis=0), result.sigma_position_m.mean(axis=0)
    # 2 m that last 20 s, over 90 s: the sigma of their mean
    expected = 2.0 * np.sqrt(2 * 20 / 90 * (1 - 20 / 90 * (1 - np.exp(-90 / 20))))
    np.testing.assert_allclose(sigma[:2], expected, rtol=0.05)
    # these fixes are 3.5 of their sigma off in height, as one set in two thousand is: the path shows that they are worse than stated
    assert error[2] > 3.0 * expected
    assert 1.2 * expected < sigma[2] < 2.0 * expected
    assert result.log[-1]["position_strain"] == pytest.approx(sigma[2] / expected, rel=0.05)
    assert (error < 2.5 * sigma).all()


def test_a_correction_is_as_smooth_as_its_spline(
    windows_wrong: tuple[Path, Patches], joined: tuple[Joined, Positions]
) -> None:
    before, after = windows_wrong[0], joined[0].applied(windows_wrong[0])
    assert len(after.quat) == len(before.quat)
    moved = after.position_m - before.position_m
    steps = np.linalg.norm(np.diff(moved, n=2, axis=0), axis=1) / (STEP_NS * 1e-9) ** 2
    assert (
        steps.max() < 0.2
    )  # m/s^2: some centimetres within seconds, and what a turn of the whole makes of the path's own


def test_without_common_ground_the_shape_is_the_windows_own(true: Path, windows_wrong: tuple[Path, Patches]) -> None:
    """Fixes and a compass turn and move it, and 2 m that last do not bend it: less than a centimetre."""
    begun, patches = windows_wrong
    none = patches.of(np.zeros(len(patches), np.bool_))
    at = np.arange(0, len(true.quat), 20)
    attitudes = Attitudes(START_NS + at * STEP_NS, true.quat[at], np.deg2rad([1.0, 1.0, 2.0]), 10.0)
    stiff = replace(loose(), turn=loose().turn / 100, shift=loose().shift / 100)
    result = joining(begun, none, stiff, stated(fixes_of(true, 2.0, 2), attitudes), np.eye(3)).run()
    off, _ = shape_error(result.applied(begun), begun)
    assert off < 0.01
    assert result.log[-1]["apart_m"] == 0.0
    assert (np.abs(result.values["compass"][0]) < COMPASS_PRIOR).all()


def numeric(factor: Factor, again: list[Array], step: float) -> Array:
    return np.stack([(up - down) / (2 * step) for up, down in zip(again[::2], again[1::2], strict=True)], axis=1)


def test_shape_and_tilt_are_linear_as_stated() -> None:
    """Against differences of their own residuals, on a path that is off by a degree and some centimetres."""
    begin = padded(coarse(flown(0, 70)))
    rng = np.random.default_rng(3)
    unknowns = Unknowns(begin.intervals)
    unknowns.add("world.turn", np.ones(3))
    path = begin.corrected(0.01 * rng.normal(size=(begin.intervals + 3, 6))).turned(
        turned(np.array([1e-3, -2e-3, 0.02])), np.zeros(3)
    )
    stiff = Stiffness(np.ones((70, 3)), np.ones((70, 3)), 0.01)

    def made(p: Path) -> list[Factor]:
        return [*shape_factors(begin, p, stiff, unknowns), tilt_factor(begin, p, 0.01, unknowns)]

    step, columns = 1e-5, rng.permutation(unknowns.path_size)[:20]
    for number, factor in enumerate(made(path)):
        again = []
        for column in columns:
            for sign in (step, -step):
                change = np.zeros(unknowns.path_size)
                change[column] = sign
                again.append(made(path.corrected(change.reshape(-1, 6)))[number].residual)
        stated = factor.matrix[:, columns].toarray()
        # residuals of 0.01 rad: their logarithm's own derivative is one to half of that
        assert np.abs(stated - numeric(factor, again, step)).max() < 0.02 * np.abs(stated).max()
        again = [
            made(path.turned(turned(sign * axis), np.zeros(3)))[number].residual for axis in step * np.eye(3) for sign in (1, -1)
        ]  # fmt: skip
        stated = factor.matrix[:, unknowns.names["world.turn"]].toarray()
        assert np.abs(stated - numeric(factor, again, step)).max() < 0.02 * max(np.abs(stated).max(), 1.0)


def test_the_stiffness_is_that_of_the_random_walk_that_the_draws_are() -> None:
    """Knots that walk by known steps: the variance by second is found, to what a few hundred independent steps tell."""
    path, rng = flown(0, 800), np.random.default_rng(8)
    unknowns = Unknowns(path.intervals)
    unknowns.add("world.turn", np.ones(3))
    still = Path(path.start_ns, np.tile([1.0, 0, 0, 0], (len(path.quat), 1)), np.zeros_like(path.position_m))
    draws = np.zeros((12, unknowns.size))
    for draw in draws:
        walk = np.cumsum(rng.normal(size=(path.intervals + 3, 6)), axis=0) * np.repeat([1e-4, 2e-3], 3) * np.sqrt(0.1)
        draw[: unknowns.path_size] = walk.ravel()
    found = stiffness_of(still, unknowns, draws)
    assert found.turn.shape == found.shift.shape == (path.intervals, 3)
    assert np.sqrt(found.turn.mean()) == pytest.approx(1e-4, rel=0.3)
    assert np.sqrt(found.shift.mean()) == pytest.approx(2e-3, rel=0.3)


# Patches -----------------------------------------------------------------------------------------------------------------


def test_patches_lie_where_the_window_saw_them(true: Path) -> None:
    path = flown(0, 100)
    clusters = seen_from(path, 0.004, 5)
    patches = patches_of(clusters, path, 3)
    assert (patches.window == 3).all()
    world, _ = placed(patches.clusters, coarse(path))
    wall = world[np.abs(world[:, 0] - 25.4) < 0.3]
    assert len(wall) > 20
    # 8 returns and more clusters: the noise of single ones is averaged
    np.testing.assert_allclose(wall[:, 0], 25.4, rtol=0, atol=0.02)
    slot = (patches.clusters.time_ns - path.start_ns) // (SLICE_NS * CHUNK)
    assert set(slot.tolist()) == {0, 1}
    # one of a voxel in a chunk, and no return in two of them
    keys = np.unique(np.column_stack([slot, np.floor(world / PATCH_M)]), axis=0)
    assert len(keys) >= 0.98 * len(patches)
    assert patches.clusters.count.sum() <= clusters.count.sum()


def test_what_is_kept_of_a_window_is_bounded(true: Path) -> None:
    """By chunk, however much was seen; and by flight, by places: what is kept of one place is kept of all windows."""
    path = flown(0, 50)
    rng, count = np.random.default_rng(6), 60_000
    world = np.stack([rng.uniform(-60, 60, count), rng.uniform(-60, 60, count), np.zeros(count)], axis=1)
    time_ns = np.sort(path.start_ns + rng.integers(0, 50 * SLICE_NS, count))
    clusters = Clusters(
        time_ns, np.zeros((count, 3), np.float32), np.zeros((count, 6), np.float32), np.full(count, 9, np.int32)
    )
    place, mats = placed(clusters, path)
    clusters.xyz_m = np.einsum("nji,nj->ni", mats.reshape(-1, 3, 3), world - place).astype(np.float32)
    one = patches_of(clusters, path, 0)
    assert 0.7 * KEPT < len(one) < 1.2 * KEPT
    parts = [replace(one, window=np.full(len(one), i, np.int32)) for i in range(40)]
    whole = all_of(parts, most=10_000)
    assert 0.7 * 10_000 < len(whole) < 1.3 * 10_000
    assert (np.bincount(whole.window) == np.bincount(whole.window)[0]).all()


def test_only_ground_of_more_than_one_window_is_taken(windows_wrong: tuple[Path, Patches]) -> None:
    begun, patches = windows_wrong
    path = padded(coarse(begun))
    assert shared(patches, path, 1.0).mean() > 0.8
    single = patches.of(patches.window == 1)
    assert not shared(single, path, 1.0).any()
    assert not shared(patches.of(np.zeros(len(patches), np.bool_)), path, 1.0).any()


# What is told ------------------------------------------------------------------------------------------------------------


def test_progress_comes_to_the_bytes_that_were_read() -> None:
    told: list[int] = []
    pace = Pace(lambda stage, done: told.append(done))
    for window in range(3):
        for _ in range(50):
            pace.read("adjust", 1001 + window)
        before = sum(told)
        for _ in range(11):  # more steps than are expected
            pace.stepped()
            assert min(told) >= 0
        assert sum(told) > before
        pace.caught_up()
    assert sum(told) == 50 * (1001 + 1002 + 1003)


def test_the_mean_of_fixes_is_right_when_a_problem_is_solved(true: Path) -> None:
    """One row for the mean, by shift and turn of the whole; the course of the fixes leaves it alone."""
    from groundproc.estimation.observations.fixes import fixes_name, mean_sigma, position_factors

    path, given = flown(0, 300), fixes_of(flown(0, 300), 2.0, 4)
    unknowns = Unknowns(path.intervals)
    unknowns.add("world.turn", np.full(3, 1e-9))
    unknowns.add("world.shift", np.full(3, 100.0))
    unknowns.add(fixes_name(0), np.full(3, 100.0))
    factors = [*position_factors(given, path, unknowns), prior_factor(unknowns)]
    factors[-1].sigma[: unknowns.path_size] = 1e-9
    normal, gradient = normal_equations(factors)
    found = np.linalg.solve(normal.toarray(), -gradient)[unknowns.names["world.shift"]]
    at = (given.time_ns - START_NS) // STEP_NS
    seconds = (given.time_ns - START_NS) // NS_PER_S
    error = given.position_m - path.position_m[at]
    plain = np.mean([error[seconds == s].mean(axis=0) for s in np.unique(seconds)], axis=0)
    np.testing.assert_allclose(found, plain, rtol=0, atol=0.01)
    spread = np.sqrt(np.diag(np.linalg.inv(normal.toarray()))[unknowns.names["world.shift"]])
    time_s, weights = np.arange(30.0), np.full((30, 1), 1 / 30)
    dense = 4.0 * np.exp(-np.abs(time_s[:, None] - time_s) / 20.0) + 0.01 * np.eye(30)
    expected = np.sqrt(weights[:, 0] @ dense @ weights[:, 0])
    assert mean_sigma(time_s, np.full((30, 1), 2.0), weights, np.array([20.0]), 0.1)[0] == pytest.approx(expected)
    np.testing.assert_allclose(spread, expected, rtol=0.02)
