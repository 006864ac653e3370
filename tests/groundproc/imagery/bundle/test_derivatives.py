from dataclasses import replace

import numpy as np
import numpy.typing as npt

from groundproc.imagery import lenses
from groundproc.imagery.bundle.block import Block, Stations, image_points
from groundproc.imagery.bundle.rows import row_of, system_of
from groundproc.imagery.bundle.schur import nothing_kept, reduce
from groundproc.imagery.bundle.solve import moved_by
from groundproc.imagery.bundle.unknowns import OF_CAMERA, Unknowns
from groundproc.imagery.camera import Camera
from groundproc.imagery.rig import MOUNTING, Rig, RigCamera
from groundproc.imagery.rotations import STRAIGHT_DOWN, mat_of_vector

Array = npt.NDArray[np.float64]


def rolling_block(seed: int = 0) -> Block:
    """Four images of a rolling shutter on a moving, turning aircraft, with everything of the camera unknown."""
    rng = np.random.default_rng(seed)
    camera = Camera(1000, 800, 700.0, (495.0, 402.0), "radtan", (-0.1, 0.02, 1e-3, -1e-3, 0.001), 1.01)
    mat = mat_of_vector(np.array([[0.02, -0.03, 0.05]]))[0] @ STRAIGHT_DOWN
    one = RigCamera("cam0", camera, mat, np.array([0.1, -0.2, 0.3]), 0.01, 3e-5, estimate=camera.names)
    count = 4
    stations = Stations(
        np.arange(count), np.column_stack([10.0 * np.arange(count), rng.normal(0, 3, count), np.full(count, 60.0)]),
        mat_of_vector(rng.normal(0, 0.05, (count, 3))), rng.normal(0, 5, (count, 3)), rng.normal(0, 0.3, (count, 3)),
        np.zeros(count, np.int64),
    )  # fmt: skip
    points = np.column_stack([rng.uniform(0, 30, (12, 2)), rng.normal(0, 2, 12)])
    image, point = (grid.ravel() for grid in np.meshgrid(np.arange(count), np.arange(12)))
    pixels = rng.uniform([100, 100], [900, 700], (len(image), 2))
    measured = image_points(image, point, pixels, np.full(len(image), 0.7))
    images = tuple(f"{n}.jpg" for n in range(count))
    return Block(
        Rig((one,)),
        images,
        np.zeros(count, np.int64),
        np.arange(count),
        stations,
        points,
        measured,
        mounting=(MOUNTING,),
    )


def columns_of(block: Block) -> Unknowns:
    count = len(block.stations)
    station = np.arange(6 * count).reshape(count, 6)
    camera = 6 * count + np.arange(OF_CAMERA)[None]
    return Unknowns(station, camera, 6 * count + OF_CAMERA, "observed")


def test_rows_are_the_derivatives_of_residuals_by_every_unknown() -> None:
    block = rolling_block()
    unknowns = columns_of(block)
    system = system_of(block, unknowns)

    def residual_at(block: Block, points: Array) -> Array:
        out = np.zeros((len(block.measured), 2))
        blank = np.zeros((2, 6)), np.zeros((2, 3)), np.zeros((2, OF_CAMERA))
        moved = system_of(block, unknowns)
        for i in range(len(out)):
            assert row_of(moved, i, points[block.measured.point[i]], out[i], *blank)
        return out

    by_pose, by_point, by_camera = np.zeros((2, 6)), np.zeros((2, 3)), np.zeros((2, OF_CAMERA))
    rows = []
    for i in range(len(block.measured)):
        row_of(system, i, block.points_m[block.measured.point[i]], np.zeros(2), by_pose, by_point, by_camera)
        rows.append((by_pose.copy(), by_point.copy(), by_camera.copy()))
    for axis in range(3):
        step = 1e-5 * np.eye(3)[axis]
        numeric = (residual_at(block, block.points_m + step) - residual_at(block, block.points_m - step)) / 2e-5
        np.testing.assert_allclose([row[1][:, axis] for row in rows], numeric, rtol=0, atol=1e-4)
    shift = lenses.FREE + MOUNTING.index("timeshift")
    for column in range(unknowns.size):
        if column == 6 * len(block.stations) + shift:
            continue  # it moves the station, not the row
        size = 1e-7 if column >= 6 * len(block.stations) else 1e-6
        step = size * np.eye(unknowns.size)[column]
        still = np.zeros_like(block.points_m)
        ahead, behind = (moved_by(block, unknowns, sign * step, still) for sign in (1.0, -1.0))
        numeric = (residual_at(ahead, block.points_m) - residual_at(behind, block.points_m)) / (2 * size)
        for i, row in enumerate(rows):
            if column < 6 * len(block.stations):
                station = block.station[block.measured.image[i]]
                expected = row[0][:, column - 6 * station] if column // 6 == station else np.zeros(2)
            else:
                expected = row[2][:, column - 6 * len(block.stations)]
            np.testing.assert_allclose(expected, numeric[i], rtol=0, atol=2e-5 * max(1.0, np.abs(numeric).max()))


def test_the_reduced_system_is_the_schur_complement_of_dense_normal_equations() -> None:
    block = rolling_block(1)
    unknowns = columns_of(block)
    system = system_of(block, unknowns)
    n, points = unknowns.size, len(block.points_m)
    dense, right = [], []
    for i in range(len(block.measured)):
        by_pose, by_point, by_camera = np.zeros((2, 6)), np.zeros((2, 3)), np.zeros((2, OF_CAMERA))
        residual = np.zeros(2)
        point, station = block.measured.point[i], block.station[block.measured.image[i]]
        row_of(system, i, block.points_m[point], residual, by_pose, by_point, by_camera)
        row = np.zeros((2, n + 3 * points))
        row[:, 6 * station : 6 * station + 6], row[:, 6 * len(block.stations) : n] = by_pose, by_camera
        row[:, n + 3 * point : n + 3 * point + 3] = by_point
        dense.append(row)
        right.append(residual)
    matrix, gradient = np.concatenate(dense), np.concatenate(right)
    normal = matrix.T @ matrix
    mixed, own = normal[:n, n:], normal[n:, n:]
    expected = normal[:n, :n] - mixed @ np.linalg.solve(own, mixed.T)
    expected_gradient = matrix[:, :n].T @ gradient - mixed @ np.linalg.solve(own, matrix[:, n:].T @ gradient)
    found, found_gradient, kept = np.zeros((n, n)), np.zeros(n), nothing_kept(points)
    reduce(system, block.points_m, 0.0, found, found_gradient, kept)
    assert kept.determined.all()
    scale = np.maximum(np.sqrt(np.diag(normal)[:n]), 1e-9)  # the shift has no rows here
    np.testing.assert_allclose(found / np.outer(scale, scale), expected / np.outer(scale, scale), rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        found_gradient / scale, expected_gradient / scale, rtol=0, atol=1e-8 * np.abs(gradient).max()
    )


def test_measurements_without_weight_say_nothing() -> None:
    block = rolling_block(2)
    weight = np.where(block.measured.point == 3, 0.0, 1.0)
    block = replace(block, measured=replace(block.measured, weight=weight))
    unknowns = columns_of(block)
    matrix, gradient, kept = np.zeros((unknowns.size,) * 2), np.zeros(unknowns.size), nothing_kept(12)
    reduce(system_of(block, unknowns), block.points_m, 0.0, matrix, gradient, kept)
    assert kept.determined.tolist() == [n != 3 for n in range(12)]
