"""`swath soil` on ground of known height in which patches of half a metre were dug up or filled by 3 cm."""

import json
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyogrio
import pytest
import shapely

from groundproc.cli import main
from simulator import epochs, outdoors
from tests.groundproc.analysis.test_ground_command import ORIGIN, write_cloud

SIDE_M, DEEP_M, DARKER = 24.0, 0.03, 0.75
PLACES = np.stack(np.meshgrid(np.arange(3.0, 22.0, 4.5), np.arange(3.0, 22.0, 4.5)), axis=-1).reshape(-1, 2)
SIGNS = np.where(np.arange(len(PLACES)) % 2, 1.0, -1.0)


def smooth(xy: np.ndarray) -> np.ndarray:
    return np.asarray(0.08 * xy[:, 0] + 0.2 * np.sin(xy[:, 1] / 6.0))


def ground(folder: Path, name: str, height: epochs.Heights, dug: bool, seed: int, lit: bool = True) -> Path:
    rng = np.random.default_rng(seed)
    xyz = epochs.sampled(rng, height, SIDE_M, 300.0, 0.02)
    strength = 30.0 * (1.0 + 0.2 * rng.standard_normal(len(xyz))).clip(0.1)
    if dug:
        for (x, y), sign in zip(PLACES, SIGNS, strict=True):
            inside = (np.abs(xyz[:, 0] - x) < 0.25) & (np.abs(xyz[:, 1] - y) < 0.25)
            xyz[inside, 2] += sign * DEEP_M
            strength[inside] *= DARKER
    path = write_cloud(folder / f"{name}.laz", xyz)
    las = laspy.read(path)
    las.intensity = (100.0 * strength if lit else 0.0 * strength).astype(np.uint16)
    las.write(path)
    return path


def found(path: Path) -> tuple[np.ndarray, dict[str, Any]]:
    meta, _, shapes, fields = pyogrio.raw.read(path)
    middles = np.array([(g.centroid.x, g.centroid.y) for g in shapely.from_wkb(shapes)]).reshape(-1, 2) - ORIGIN
    return middles, dict(zip(meta["fields"], fields, strict=True))


def judge(path: Path) -> tuple[float, int, dict[str, Any], np.ndarray]:
    """Share of the places found, claims that are none, attributes, and which claim is nearest to each place."""
    middles, table = found(path)
    apart = np.linalg.norm(middles[:, None] - PLACES[None], axis=2)
    return float((apart.min(axis=0) < 0.3).mean()), int((apart.min(axis=1) > 0.5).sum()), table, apart.argmin(axis=0)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("soil")
    ground(folder, "one", smooth, True, 1)
    words = ["soil", str(folder / "one.laz"), "-o", str(folder / "one.geojson"), "--json", str(folder / "one.json")]
    assert main(words) == 0
    return folder


def test_patches_of_3_cm_on_even_ground_are_found(made: Path) -> None:
    rate, false, table, nearest = judge(made / "one.geojson")
    assert rate >= 0.95
    assert false <= 1
    # 3 cm, and the patch of cells that straddle its edge: within a third
    height = table["height_m"][nearest]
    assert np.sign(height).tolist() == SIGNS.tolist()
    assert np.abs(height) == pytest.approx(DEEP_M, abs=0.012)
    assert np.median(table["reflectance_step"][nearest]) == pytest.approx(DARKER, abs=0.1)
    assert np.median(table["area_m2"][nearest]) == pytest.approx(0.25, rel=0.5)


def test_figures_say_how_many_and_by_what(made: Path) -> None:
    figures = json.loads((made / "one.json").read_text())
    assert figures["raised"] + figures["sunk"] == figures["patches"]
    assert figures["strength"] == "intensity"
    assert figures["registration_sigma_m"] is None
    assert figures["warnings"] == []


def test_between_two_epochs_stones_that_stayed_do_not_count(tmp_path: Path) -> None:
    """In the mean of two draws: over seven, 93 % are found and 0.3 a scene are none, but those two are in one scene."""
    height, rates, falses = epochs.rough(3, (0.1, 0.05), 0.06), [], []
    for seed in (4, 7):
        folder = tmp_path / str(seed)
        folder.mkdir()
        a = ground(folder, "a", height, False, seed)
        b = ground(folder, "b", height, True, seed + 1, lit=False)
        words = ["soil", str(b), "--before", str(a), "-o", str(folder / "s.geojson"), "--json", str(folder / "f.json")]
        assert main(words) == 0
        rate, false, _, _ = judge(folder / "s.geojson")
        rates.append(rate)
        falses.append(false)
        figures = json.loads((folder / "f.json").read_text())
        assert figures["registration_sigma_m"] < 0.01
        assert figures["strength"] is None
        assert any("height alone" in each for each in figures["warnings"])
    assert np.mean(rates) >= 0.9
    assert np.mean(falses) <= 1


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--size", "0"), "--size 0 m: expected 0.1 to 20 m"),
        (("--least-score", "nan"), "--least-score nan"),
        (("--registered",), "expected with --before"),
    ],
)
def test_what_cannot_be_is_one_sentence(
    made: Path, tmp_path: Path, words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["soil", str(made / "one.laz"), "-o", str(tmp_path / "o.geojson"), *words]) in (1, 2)
    err = capsys.readouterr().err.strip()
    assert said in err
    assert "\n" not in err
    assert not (tmp_path / "o.geojson").exists()


def test_on_a_village_where_nobody_dug_claims_are_rare(tmp_path: Path) -> None:
    side_m = 60.0
    place = outdoors.village(1, side_m, 100.0, 0.02)
    cloud = write_cloud(tmp_path / "c.laz", place.xyz)
    assert main(["soil", str(cloud), "-o", str(tmp_path / "s.geojson"), "--json", str(tmp_path / "f.json")]) == 0
    # walls, shrubs and crowns have feet that pass for ground: 6 in 100 m2 where they count
    assert json.loads((tmp_path / "f.json").read_text())["patches"] / (side_m**2 / 100.0) < 0.15


def test_a_cloud_with_hardly_a_point_on_a_patch_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Rasters of a decimetre over two square kilometres took minutes and gigabytes, to say nothing."""
    xy = np.random.default_rng(0).uniform(0, 1500.0, (6280, 2))
    cloud = write_cloud(tmp_path / "c.laz", np.column_stack([xy, 0.01 * xy[:, 0]]))
    assert main(["soil", str(cloud), "-o", str(tmp_path / "s.geojson")]) == 1
    assert "points of ground on a patch of 0.5 m, expected 0.1 or more" in capsys.readouterr().err
