"""Pictures for people: to scale, lit, with path, length, north and the density that the cloud has."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from groundproc.products.pictures import CloudSample, density
from groundproc.products.plan import Plan, draw_plan, round_length
from groundproc.raster.cells import Cells

Pixels = npt.NDArray[np.int64]


def roof(count: int = 200_000) -> npt.NDArray[np.float64]:
    """A gable roof of 45 deg on level ground, its ridge from south-west to north-east; shape (n, 3)."""
    rng = np.random.default_rng(3)
    place = rng.uniform([500, 900, 0], [560, 940, 0], (count, 3))
    across = ((place[:, 0] - 530) - (place[:, 1] - 920)) / np.sqrt(2)
    place[:, 2] = np.maximum(8.0 - abs(across), 0.0)
    return place


def drawn(folder: Path, shaded: bool, paths: list[npt.NDArray[np.float64]]) -> Pixels:
    place = roof()
    draw_plan(folder / "p.png", Plan(place, place[:, 2] * 0 + 4.0, (0.0, 8.0), "h", "grey", "T", paths, shaded))
    return np.asarray(Image.open(folder / "p.png").convert("RGB")).astype(np.int64)


def test_a_slope_towards_the_light_is_brighter_than_one_away_from_it(tmp_path: Path) -> None:
    plan = Plan(roof(), roof()[:, 2], (-20.0, 30.0), "h", "grey", "T", [], shaded=True)
    draw_plan(tmp_path / "p.png", plan)
    pixels = np.asarray(Image.open(tmp_path / "p.png").convert("RGB")).astype(int)
    # the frame of the plan begins 1.2 inches from the left, and it is 62 x 42 m in 9 inches; north-west of the ridge, and south-east
    per_m = 900 / 62.0
    top = pixels.shape[0] - int((0.6 + 8.0 / 62 * 9 + 0.8 + 42 * 9 / 62.0) * 100) - int(2 / 62 * 900)

    def brightness(east: float, north: float) -> float:
        x, y = 120 + (east - 499) * per_m, top + (941 - north) * per_m
        return float(pixels[int(y) - 6 : int(y) + 7, int(x) - 6 : int(x) + 7].mean())

    towards, away, flat = brightness(527, 923), brightness(533, 917), brightness(506, 935)
    assert towards > flat > away


def test_the_path_of_the_flight_is_drawn_and_lengths_are_to_scale(tmp_path: Path) -> None:
    without = drawn(tmp_path, False, [])
    with_path = drawn(tmp_path, False, [np.array([[505.0, 920, 30], [555.0, 920, 30]])])
    changed = (abs(with_path - without).max(axis=2) > 60).any(axis=0).nonzero()[0]
    # 994 of 1000 of 60 m and a metre on both sides in 900 pixels; then the width of the line and its dot
    assert changed.max() - changed.min() == pytest.approx(50 / (60 * 0.994 + 2) * 900 + 7, abs=6)


@pytest.mark.parametrize(("width", "length"), [(100.0, 20.0), (39.0, 5.0), (41.0, 10.0), (2000.0, 500.0), (0.9, 0.2)])
def test_the_scale_is_round(width: float, length: float) -> None:
    assert round_length(width) == pytest.approx(length)


def test_the_density_is_the_median_of_square_metres_with_points() -> None:
    rng = np.random.default_rng(5)
    cells = Cells(1.0, {"count"})
    for _ in range(4):
        place = rng.uniform([10.0, 20.0, 0.0], [40.0, 50.0, 1.0], (45_000, 3))
        cells.add(place, place[:, 2])
    assert density(cells) == pytest.approx(4 * 45_000 / 900, rel=0.02)


def test_a_sample_stays_small_and_prefers_no_part_of_the_flight() -> None:
    sample = CloudSample()
    for number in range(60):
        sample.add(np.full((300_000, 3), float(number)), np.zeros(300_000, np.uint8))
    xyz, _ = sample.points()
    assert len(xyz) <= 500_000
    counts = np.bincount(xyz[:, 0].astype(int), minlength=60)
    assert counts.min() > 0.5 * counts.max()
