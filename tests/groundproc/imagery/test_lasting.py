"""How long a trajectory's errors last, and the rows of poses whose errors do."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from imageblock import true_camera

from groundproc.imagery.assembly import unknown_poses
from groundproc.imagery.bundle.block import POSE, Block, ImagePoints, PosePriors
from groundproc.imagery.bundle.observed import bare_rows, pose_rows, whitening
from groundproc.imagery.bundle.unknowns import lay_out
from groundproc.imagery.lasting import Lasting, Told, applied, departures, likeliest
from groundproc.imagery.rig import Rig
from groundproc.imagery.rotations import cross_matrix, mat_of_vector
from groundproc.imagery.thinning import thinned

Array = npt.NDArray[np.float64]
SIGMA = np.array([0.02, 0.02, 0.03, 1e-3, 1e-3, 2e-3])
STEP_S = 2.0


def block_with(errors: Array) -> Block:
    """Stations there and back whose observed poses have errors, shape (n, 6); no points."""
    count = len(errors)
    known = unknown_poses(count, np.zeros(count, np.int64))
    along = np.arange(count) % 16
    place = np.stack([4.0 * along, 30.0 * (np.arange(count) // 16), 40.0 + np.zeros(count)], axis=1)
    mat = mat_of_vector(np.stack([np.zeros(count), np.zeros(count), np.pi * (np.arange(count) // 16)], axis=1))
    stations = replace(
        known.stations, time_ns=(np.arange(count) * STEP_S * 1e9).astype(np.int64), place_m=place, mat_local_ins=mat
    )
    velocity = np.tile([2.0, 0.0, 0.0], (count, 1)) * np.where(np.arange(count) // 16 % 2, -1.0, 1.0)[:, None]
    priors = PosePriors(
        np.arange(count), place - errors[:, :3], mat_of_vector(-errors[:, 3:]) @ mat, np.tile(np.diag(SIGMA**2), (count, 1, 1)),
        np.zeros((count, 3)), velocity, np.zeros((count, 3)), np.ones(count),
    )  # fmt: skip
    none = np.empty(0, np.int64)
    points = ImagePoints(none, none, np.empty((0, 2)), np.empty(0), np.empty(0))
    names = tuple(f"{n}.jpg" for n in range(count))
    camera = np.zeros(count, np.int64)
    return Block(
        Rig((true_camera(),)), names, camera, np.arange(count), stations, np.empty((0, 3)), points, priors=priors
    )


def errors_lasting(seed: int, tau_s: float, count: int = 48) -> Array:
    rng = np.random.default_rng(seed)
    keep = np.exp(-STEP_S / tau_s) if tau_s else 0.0
    out = rng.normal(0, 1, (count, POSE))
    for n in range(1, count):
        out[n] = keep * out[n - 1] + np.sqrt(1.0 - keep**2) * out[n]
    return np.asarray(out * SIGMA)


def told_of(block: Block) -> Lasting:
    """Images that know the shape of the block to millimetres, and nothing of where it lies."""
    count = len(block.stations)
    place = block.stations.place_m - block.stations.place_m.mean(axis=0)
    turned = np.concatenate([-cross_matrix(place), np.tile(np.eye(3), (count, 1, 1))], axis=1).reshape(-1, 3)
    moved = np.tile(np.eye(6)[:, :3], (count, 1))
    scaled = np.concatenate([place, np.zeros_like(place)], axis=1).reshape(-1, 1)
    free, _ = np.linalg.qr(np.concatenate([turned, moved, scaled], axis=1))
    shape = (np.eye(6 * count) - free @ free.T) * 1e8
    residual, by, columns = bare_rows(block, lay_out(block))
    white = whitening(block.priors.covariance)
    return likeliest(
        Told(np.linspace(0.0, STEP_S * (count - 1), count), residual, by, columns, white, shape, np.zeros(6 * count))
    )


def test_errors_that_last_are_told_from_independent_ones() -> None:
    white, lasting = (
        [told_of(block) for block in (block_with(errors_lasting(n, tau_s)) for n in range(4))] for tau_s in (0.0, 10.0)
    )
    assert sum(one.place_s == 0.0 for one in white) >= 3
    assert sum(one.turn_s == 0.0 for one in white) >= 3
    # 96 s are some five independent stretches of three coordinates: a time constant to a factor of two
    assert 5.0 < np.median([one.place_s for one in lasting]) < 20.0
    assert 5.0 < np.median([one.turn_s for one in lasting]) < 20.0
    assert 1.0 <= np.median([one.place for one in lasting]) < 2.0


def test_errors_of_the_stated_size_are_not_taken_for_large_ones_that_last_for_as_long_as_the_flight() -> None:
    """Both change alike from image to image; of the images alone three in eight were 3 to 5 times as large and lasted 30 to 60 s."""
    found = [told_of(block_with(errors_lasting(n, 10.0, 40))) for n in range(8)]
    assert max(one.place_s for one in found) < 25.0
    assert max(one.place for one in found) < 2.0


def test_errors_larger_than_stated_are_found_to_be() -> None:
    block = block_with(3.0 * errors_lasting(1, 0.0))
    told = told_of(block)
    assert told.place == pytest.approx(9.0, rel=0.3)
    assert told.turn == pytest.approx(9.0, rel=0.3)


def test_a_departure_is_counted_in_stated_sigmas() -> None:
    block = block_with(3.0 * errors_lasting(1, 0.0))
    found = departures(block, block.priors)
    # of 144 values each
    assert found["place"] == pytest.approx(3.0, rel=0.2)
    assert found["turn"] == pytest.approx(3.0, rel=0.2)


def test_rows_of_errors_that_last_are_those_of_their_full_covariance() -> None:
    errors = errors_lasting(2, 10.0, 12)
    lasting = Lasting(10.0, 4.0, 2.0, 3.0)
    block = applied(block_with(errors), lasting)
    residual, by, columns = pose_rows(block, lay_out(block))
    full = np.zeros((72, 72))
    time_s = STEP_S * np.arange(12)
    for first, tau_s, factor in ((0, 10.0, 2.0), (3, 4.0, 3.0)):
        correlation = factor * np.exp(-np.abs(time_s[:, None] - time_s) / tau_s)
        for axis in range(first, first + 3):
            full[axis::6, axis::6] = correlation * SIGMA[axis] ** 2
    off = errors.ravel()
    assert np.square(residual).sum() == pytest.approx(off @ np.linalg.solve(full, off), rel=1e-6)
    matrix = np.zeros((72, 72))
    for rows, places in zip(by, columns, strict=True):
        held = places >= 0
        matrix[np.ix_(places[held], places[held])] += rows[:, held].T @ rows[:, held]
    np.testing.assert_allclose(matrix, np.linalg.inv(full), rtol=1e-6, atol=1e-6 * matrix.max())


def test_a_thinned_block_keeps_what_most_images_see_and_all_that_people_measured() -> None:
    rng = np.random.default_rng(3)
    rays = np.sort(rng.integers(2, 6, 4000))
    point = np.repeat(np.arange(4000), rays)
    image = np.concatenate([rng.choice(8, n, replace=False) for n in rays])
    count = len(point)
    points = ImagePoints(image, point, np.zeros((count, 2)), np.ones(count), np.ones(count))
    block = replace(block_with(errors_lasting(0, 0.0, 8)), measured=points, points_m=np.zeros((4000, 3)))
    matched = point != 0
    kept = thinned(block, matched)
    assert kept[~matched].all()
    assert np.bincount(image[kept], minlength=8).min() >= 300
    assert kept.mean() < 0.3
    assert rays[point[kept & matched]].min() == 5
