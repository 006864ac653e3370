"""Between two plain walls nothing tells the way along them, whatever the planes of single voxels seem to."""

import numpy as np
import numpy.typing as npt
import pytest

from flightlog import frames
from groundproc.estimation.observations import told
from groundproc.estimation.observations.planes import Rows, rows_of
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.spline import Path

Array = npt.NDArray[np.float64]

SLICES, SEEN, SPEED_M_S = 60, 300, 5.0
WAY = np.array([np.cos(0.1), np.sin(0.1), 0.0])
START_NS = 1_779_000_000_000_000_000


def street(across: bool) -> tuple[Clusters, Path]:
    """Walls 12 m apart and the ground between; `across`: and a wall at the street's end."""
    rng, count = np.random.default_rng(3), SLICES * SEEN
    time_ns = START_NS + rng.integers(0, SLICES * STEPS * STEP_NS, count)
    seconds = (time_ns - START_NS) * 1e-9
    along, side, up = (
        SPEED_M_S * seconds + rng.uniform(-12, 12, count),
        rng.uniform(-6, 6, count),
        rng.uniform(0, 4, count),
    )
    kind = rng.integers(0, 4, count)
    world = np.stack([along, side, np.full(count, 0.03)], axis=1)
    for number, y in ((1, -6.21), (2, 6.23)):
        world[kind == number] = np.stack([along, np.full(count, y), up], axis=1)[kind == number]
    if across:
        world[kind == 3] = np.stack([np.full(count, 42.3), side, up], axis=1)[kind == 3]
    mat = frames.mat_from_quat(frames.quat_exp(np.array([[0.0, 0.0, 0.1]])))[0]
    grid: Array = np.arange(SLICES * STEPS + 1) * STEP_NS * 1e-9
    place = SPEED_M_S * grid[:, None] * WAY + [0.0, 0.0, 1.7]
    # a slice is a centimetre off as a whole, as an odometry's are, and its returns besides
    off = 0.01 * rng.normal(size=(SLICES, 3))[np.minimum((seconds * 10).astype(int), SLICES - 1)]
    world = world @ mat.T + off + 0.01 * rng.normal(size=world.shape)
    here = np.stack([np.interp(seconds, grid, axis) for axis in place.T], axis=1)
    clusters = Clusters(
        time_ns, (world - here).astype(np.float32), np.zeros((count, 6), np.float32), np.full(count, 8, np.int32)
    )
    return clusters, Path(START_NS, np.tile([1.0, 0.0, 0.0, 0.0], (len(grid), 1)), place)


def rows(across: bool, doubted: bool) -> Rows:
    clusters, path = street(across)
    return rows_of(clusters, path, 0.5, 10**6, cut=False, doubted=np.full(SLICES, doubted))


def holds(of: Rows) -> float:
    """Information on a slide along the street that grows by a metre over the whole, and on all else of that kind that goes with it [1/m^2].

    Errors of the slices turn the map's way by some tenths of a degree: what goes into a wall by as much is found with it.
    """
    slides = np.zeros((3, SLICES + 3, 6))
    for number, axis in enumerate((WAY, np.cross([0.0, 0.0, 1.0], WAY), np.array([0.0, 0.0, 1.0]))):
        slides[number, :, 3:] = np.linspace(-0.5, 0.5, SLICES + 3)[:, None] * axis
    columns = slides.reshape(3, -1).T
    return float(1.0 / np.linalg.inv(columns.T @ of.apply_all(columns))[0, 0])


def test_what_slides_along_the_street_is_held_by_nothing() -> None:
    held = holds(rows(across=False, doubted=True))
    assert held < 0.01 * holds(rows(across=False, doubted=False))
    assert held < 20.0  # 0.2 m in a metre


def test_slices_judged_each_for_itself_would_hold_it(monkeypatch: pytest.MonkeyPatch) -> None:
    steady = holds(rows(across=False, doubted=True))
    monkeypatch.setattr(told, "STEADY_SLICES", 0.1)
    assert holds(rows(across=False, doubted=True)) > 10.0 * steady


def test_a_wall_across_it_tells_the_way_though_it_is_doubted() -> None:
    doubted, plain = rows(across=True, doubted=True), rows(across=True, doubted=False)
    assert holds(doubted) == pytest.approx(holds(plain))
