"""`swath displacement` on slides of known movement, and on recorded patches with a known shift."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import shapely

from groundproc.analysis.displacement import Vector, patch_moved
from groundproc.cli import main
from simulator import epochs
from tests.groundproc.analysis.test_ground_command import ORIGIN, write_cloud

MOVED = np.array([0.15, -0.10, -0.06])
SIDE_M, EDGE_M = 36.0, 18.0
"""West of the edge the ground stays, east of it it slides as a whole."""
NONE = np.zeros((3, 3))


def slid(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    height = epochs.rough(seed, (0.2, 0.1), 0.06)

    def after(xy: np.ndarray) -> np.ndarray:
        return np.where(xy[:, 0] < EDGE_M, height(xy), height(xy - MOVED[:2]) + MOVED[2])

    return (
        epochs.sampled(rng, height, SIDE_M, 120.0, 0.02),
        epochs.sampled(rng, after, SIDE_M, 120.0, 0.02),
    )


def table(path: Path) -> tuple[np.ndarray, dict[str, Any]]:
    meta, _, shapes, fields = pyogrio.raw.read(path)
    ends = np.array([shapely.get_coordinates(each, include_z=True) for each in shapely.from_wkb(shapes)])
    return ends.reshape(-1, 2, 3), dict(zip(meta["fields"], fields, strict=True))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("slide")
    a, b = slid(1)
    words = [str(write_cloud(folder / "a.laz", a)), str(write_cloud(folder / "b.laz", b)), "--registered"]
    assert main(["displacement", *words, "-o", str(folder / "v.geojson"), "--json", str(folder / "f.json")]) == 0
    return folder


def test_what_slid_has_its_vector_and_what_stayed_has_none(made: Path) -> None:
    ends, found = table(made / "v.geojson")
    x = ends[:, 0, 0] - ORIGIN[0]
    slides, stays = x > EDGE_M + 6.5, x < EDGE_M - 6.5
    assert slides.sum() >= 5
    assert stays.sum() >= 5
    vectors = np.column_stack([found["east_m"], found["north_m"], found["up_m"]])
    sigmas = np.column_stack([found["east_sigma_m"], found["north_sigma_m"], found["up_sigma_m"]])
    assert found["significant"][slides].all()
    assert found["significant"][stays].mean() <= 0.2
    assert np.abs(vectors[slides] - MOVED).max() < 0.03
    assert (np.abs(vectors[slides] - MOVED) < 4.0 * sigmas[slides]).mean() > 0.95
    assert np.median(sigmas[slides]) < 0.01
    assert sigmas[slides].max() < 0.05, "a patch with relief in one corner tells one way less well"
    assert np.allclose(np.diff(ends, axis=1)[:, 0], vectors, rtol=0, atol=1e-3)


# thirty-six values of one pair of clouds tell the scatter to an eighth; those of three to a fourteenth
@pytest.mark.parametrize("seeds", [1, pytest.param(3, marks=pytest.mark.soak)])
def test_sigmas_are_those_of_the_errors(seeds: int) -> None:
    off = []
    for seed in range(seeds):
        a, b = slid(seed)
        for x in (7.0, 11.0, 25.0, 29.0):
            for y in (8.0, 18.0, 28.0):
                parts = [each[np.hypot(*(each[:, :2] - (x, y)).T) < 6.0] for each in (a, b)]
                found = patch_moved(parts[0], parts[1], NONE)
                assert found is not None
                true = MOVED if x > EDGE_M else np.zeros(3)
                off.append((found.moved_m - true) / np.sqrt(np.diag(found.covariance)))
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 1.5


def test_a_plane_tells_no_slide_along_itself() -> None:
    rng = np.random.default_rng(1)
    parts = [epochs.sampled(rng, lambda xy: 0.3 * xy[:, 0], 11.0, 150.0, 0.02) for _ in range(2)]
    found = patch_moved(parts[0], parts[1], NONE)
    assert found is None or np.sqrt(np.linalg.eigvalsh(found.covariance)[1:]).min() > 0.2


def test_few_groups_make_the_test_of_significance_stricter() -> None:
    moved, covariance = np.array([0.0, 0.0, 0.03]), np.eye(3) * 0.01**2
    assert Vector(np.zeros(3), moved, covariance, 100.0, 0.0, 1.0).significant
    assert not Vector(np.zeros(3), moved, covariance, 8.0, 0.0, 1.0).significant


def test_py4dgeos_epochs_give_their_shift(tmp_path: Path) -> None:
    folder = os.environ.get("SWATH_RECORDINGS")
    if folder is None:
        pytest.skip("SWATH_RECORDINGS is not set: no recorded clouds")
    clouds = [str(Path(folder) / "clouds" / f"py4dgeo_epoch{number}.laz") for number in range(2)]
    words = ["displacement", *clouds, "--registered", "--radius", "60", "-o", str(tmp_path / "v.geojson")]
    assert main([*words, "--json", str(tmp_path / "f.json")]) == 0
    figures = json.loads((tmp_path / "f.json").read_text())
    assert figures["patches"] > 0
    _, found = table(tmp_path / "v.geojson")
    vectors = np.column_stack([found["east_m"], found["north_m"], found["up_m"]])
    assert np.median(vectors[found["told"] == 1], axis=0) == pytest.approx([0.30, -0.20, 0.10], abs=0.002)


@pytest.mark.parametrize(
    ("words", "said"), [(("--radius", "0"), "--radius 0 m: expected"), (("--spacing", "nan"), "--spacing nan")]
)
def test_what_cannot_be_is_one_sentence(
    made: Path, tmp_path: Path, words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["displacement", str(made / "a.laz"), str(made / "b.laz"), "-o", str(tmp_path / "v.geojson"), *words]
    assert main(given) in (1, 2)
    err = capsys.readouterr().err.strip()
    assert said in err
    assert "\n" not in err
    assert not (tmp_path / "v.geojson").exists()
