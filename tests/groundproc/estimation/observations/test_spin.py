"""The line of the spin: found in readings, and in what the surfaces of a room say while the vehicle turns."""

import numpy as np
import numpy.typing as npt
import pytest

from flightlog import frames
from groundproc.estimation.observations.planes import rows_of
from groundproc.estimation.observations.rows import Unknowns
from groundproc.estimation.observations.spin import NAME, SHARE, UNKNOWNS, Spin, spin_columns, spin_of
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.spline import Path

Array = npt.NDArray[np.float64]
START_NS = 1_779_000_000_000_000_000
INTERVALS = 40
RATE = 2.0 * np.pi * 9.37
FIRST = 1.234
LINE_RAD = np.deg2rad([0.016, 0.003, -0.008, 0.012, 0.004, -0.005])


def flown() -> Path:
    """4 s in a room of 20 m, once about the vertical."""
    seconds = np.arange(INTERVALS * STEPS + 1) * STEP_NS * 1e-9
    turn = np.stack([0.1 * np.sin(3 * seconds), 0.1 * np.cos(4 * seconds), np.pi * seconds / 2], axis=1)
    place = np.stack([np.sin(seconds), np.cos(seconds), 0.3 * np.cos(3 * seconds)], axis=1)
    heading = frames.quat_exp(turn * [0.0, 0.0, 1.0])
    return Path(START_NS, frames.quat_multiply(heading, frames.quat_exp(turn * [1.0, 1.0, 0.0])), place)


def room(path: Path, count: int = 30_000) -> Clusters:
    """What a spinning lidar sees of six walls, 9.7 m away, with a path's poses; 5 mm of noise."""
    rng = np.random.default_rng(1)
    step = np.sort(rng.integers(0, len(path.quat) - 1, count))
    azimuth = FIRST + RATE * step * STEP_NS * 1e-9
    elevation = rng.uniform(-0.6, 0.4, count)
    flat = np.cos(elevation)
    ray = np.stack([np.sin(azimuth) * flat, np.cos(azimuth) * flat, np.sin(elevation)], axis=1)
    out = np.einsum("nij,nj->ni", frames.mat_from_quat(path.quat)[step], ray)
    reach = ((9.7 - np.sign(out) * path.position_m[step]) / np.abs(out)).min(axis=1)
    xyz = (reach + 0.005 * rng.normal(size=count))[:, None] * ray
    return Clusters(
        START_NS + step * STEP_NS, xyz.astype(np.float32), np.zeros((count, 6), np.float32), np.full(count, 8, np.int32)
    )


def azimuth_on(path: Path) -> Array:
    return np.asarray(FIRST + RATE * np.arange(len(path.quat)) * STEP_NS * 1e-9)


def test_the_rotor_is_found_in_what_the_lidar_sees() -> None:
    path = flown()
    found = spin_of(room(path), path)
    assert found is not None
    assert found.rate_rad_s == pytest.approx(RATE, rel=1e-4)
    off = found.azimuth_rad - azimuth_on(path)
    off -= 2.0 * np.pi * np.rint(off[0] / (2.0 * np.pi))
    assert np.abs(off).max() < 0.01


def test_a_cloud_that_nothing_sweeps_has_no_rotor() -> None:
    path = flown()
    clusters = room(path)
    rng = np.random.default_rng(2)
    clusters.time_ns = clusters.time_ns[rng.permutation(len(clusters))]
    assert spin_of(clusters, path) is None


def test_the_line_that_a_gyro_reads_is_found_with_its_sigma() -> None:
    """A hundred draws of 20 s: what undoes the line's angle, off by its sigma; a third of the samples is not known."""
    rng = np.random.default_rng(3)
    azimuth = FIRST + RATE * np.arange(4001) * STEP_NS * 1e-9
    truth = np.stack(
        [LINE_RAD[0::2], LINE_RAD[1::2]]
    )  # sine and cosine of the angle by which the path has to be turned
    middle = 0.5 * (azimuth[1:] + azimuth[:-1])
    wrong = -RATE * (np.cos(middle)[:, None] * truth[0] - np.sin(middle)[:, None] * truth[1])
    known = np.arange(4000) % 3 > 0
    ratios = []
    for _ in range(100):
        spin = Spin(azimuth, RATE)
        spin.read([(wrong + np.deg2rad(2.0) * rng.normal(size=(4000, 3)), known)])
        ratios.append((spin.read_rad - LINE_RAD) / spin.read_sigma_rad)
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.15)
    # white noise: two over the samples, and three halves for the window
    assert spin.read_sigma_rad.mean() * RATE == pytest.approx(np.deg2rad(2.0) * np.sqrt(3.0 / known.sum()), rel=0.15)


def test_rows_change_by_the_columns_as_the_path_is_turned() -> None:
    path = flown()
    clusters = room(path, 4000)
    rows = rows_of(clusters, path, 1.0, 10**6, cut=False, spin=True)
    spin = Spin(azimuth_on(path), RATE)
    value = 0.1 * LINE_RAD
    at = ((clusters.time_ns - START_NS) // STEP_NS)[rows.cluster]
    turn = spin.turns(value)[at]
    expected = np.einsum("ni,ni->n", rows.jacobian[:, :3].astype(float), turn)
    columns = spin_columns(rows.jacobian, clusters.xyz_m[rows.cluster])
    np.testing.assert_allclose(columns.along(value), expected, rtol=0, atol=1e-4 * np.abs(expected).max())
    whole = sum(columns.column(number) * value[number] for number in range(UNKNOWNS))
    np.testing.assert_allclose(whole, columns.along(value), rtol=0, atol=1e-9)


def test_the_normal_matrix_is_that_of_all_columns_together() -> None:
    path = flown()
    rows = rows_of(room(path, 4000), path, 1.0, 10**6, cut=False, spin=True)
    rng = np.random.default_rng(5)
    x, y = rng.normal(size=(2, rows.size))
    assert rows.size == rows.path_size + UNKNOWNS
    np.testing.assert_allclose(
        rows.apply(x), rows.spread(rows.along(x)), rtol=1e-5, atol=1e-5 * np.abs(rows.apply(x)).max()
    )
    assert x @ rows.apply(y) == pytest.approx(y @ rows.apply(x), rel=1e-6)


def test_a_turning_vehicle_shows_the_line_in_the_surfaces() -> None:
    """A line of ten degrees per second is in the path; the rows, weighed for noise of 7 mm, tell it to a fourteenth."""
    true = flown()
    spin, line = Spin(azimuth_on(true), RATE), 10.0 * LINE_RAD
    clusters = room(true)
    path = Path(START_NS, frames.quat_multiply(true.quat, frames.quat_exp(-spin.turns(line))), true.position_m)
    found = np.zeros(UNKNOWNS)
    for _ in range(3):
        rows = rows_of(clusters, path, 1.0, 10**6, cut=False, spin=True)
        step = -np.linalg.solve(rows.corner, rows.gradient()[rows.path_size :])
        found += step
        path = Path(START_NS, frames.quat_multiply(path.quat, frames.quat_exp(spin.turns(step))), path.position_m)
    sigma = np.sqrt(np.diag(np.linalg.inv(rows.corner)))
    assert sigma.max() < 0.07 * np.abs(line).max()
    assert np.abs((found - line) / sigma).max() < 3.0


def test_the_line_is_a_share_of_what_the_gyro_reads() -> None:
    spin = Spin(
        np.zeros(41),
        RATE,
        value_rad=0.3 * LINE_RAD,
        read_rad=LINE_RAD,
        read_sigma_rad=np.full(UNKNOWNS, 1e-5),
        share=0.3,
    )
    unknowns = Unknowns(2)
    spin.unknowns(unknowns)
    (factor,) = spin.factors(unknowns)
    np.testing.assert_allclose(factor.residual, 0.0, rtol=0, atol=1e-12)
    x = np.zeros(unknowns.size)
    x[unknowns.names[NAME]], x[unknowns.names[SHARE]] = LINE_RAD, 1.0
    np.testing.assert_allclose(factor.matrix @ x, 0.0, rtol=0, atol=1e-12)
