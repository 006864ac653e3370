"""`swath banks`: edges of banks, lines of waters, retreat and volume between two epochs, on made-up banks whose truth is known."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import shapely

from groundproc.analysis.banks.profile import fitted
from groundproc.cli import main
from groundproc.vectors.features import read_features
from simulator.banks import Bank, later
from tests.groundproc.analysis.test_ground_command import ORIGIN, write_cloud

Array = npt.NDArray[np.float64]

NOISE_M = 0.02
END_M = 1.5
"""Of the scene's ends, where half of a profile is missing."""


def lines(path: Path, kind: str, epoch: int = 1) -> list[tuple[Array, dict[str, Any]]]:
    """Lines of a kind at the origin of the scene, with their columns."""
    features = read_features(path, "LineString")
    out = []
    for number, shape in enumerate(features.geometry):
        columns = {name: values[number] for name, values in features.columns.items()}
        if columns["kind"] == kind and columns["epoch"] == epoch:
            out.append((shapely.get_coordinates(shape, include_z=True) - (*ORIGIN, 0.0), columns))
    return out


def off(places: Array, bank: Bank, which: str) -> tuple[Array, Array]:
    """How far places lie from an edge across it, towards the water, and above it."""
    x, y = places[:, 0], places[:, 1]
    inner = (y > END_M) & (y < bank.length_m - END_M)
    x, y, z = x[inner], y[inner], places[inner, 2]
    edge = bank.upper_x if which == "upper" else bank.lower_x
    turn = (edge(y + 0.01) - edge(y - 0.01)) / 0.02
    side = -1e-6 if which == "upper" else 1e-6
    return (x - edge(y)) / np.hypot(1.0, turn), z - bank.height(np.column_stack([edge(y) + side, y]))


@pytest.mark.parametrize("width_m", [0.05, 1.0, 2.5], ids=["upright", "steep", "slope"])
def test_edges_of_a_bank_are_drawn_within_centimetres_and_their_sigma_holds(tmp_path: Path, width_m: float) -> None:
    bank = Bank(1, length_m=40.0, width_m=width_m)
    cloud = write_cloud(tmp_path / "c.laz", bank.points(np.random.default_rng(1), 60.0, NOISE_M))
    assert main(["banks", str(cloud), "-o", str(tmp_path / "b.geojson"), "--json", str(tmp_path / "f.json")]) == 0
    for which in ("upper", "lower"):
        ((places, told),) = lines(tmp_path / "b.geojson", which)
        across, up = off(places, bank, which)
        assert len(across) >= 30
        assert np.sqrt(np.mean(across**2)) < min(0.05, 1.5 * told["sigma_m"])
        assert np.sqrt(np.mean(up**2)) < min(0.05, 1.5 * told["height_sigma_m"])
        assert told["sigma_m"] < 0.1
        assert told["drop_m"] == pytest.approx(bank.height_m, abs=0.1)
    figures = json.loads((tmp_path / "f.json").read_text())
    assert figures["banks"] == 1
    assert figures["upper_m"] >= 35
    assert figures["lower_m"] >= 35


@pytest.mark.parametrize(
    ("echoes", "words", "told_by"),
    [(5.0, [], "echoes"), (0.0, [], "lack of echoes"), (0.0, ["--water-level", "-0.5"], "given")],
)
def test_the_line_of_the_water_is_where_the_beach_goes_under(
    tmp_path: Path, echoes: float, words: list[str], told_by: str
) -> None:
    bank = Bank(2, length_m=40.0, fall=0.0 if words else 0.002)
    cloud = write_cloud(tmp_path / "c.laz", bank.points(np.random.default_rng(2), 60.0, NOISE_M, echoes))
    assert main(["banks", str(cloud), "-o", str(tmp_path / "b.geojson"), *words]) == 0
    found = lines(tmp_path / "b.geojson", "water")
    assert {told["told_by"] for _, told in found} == {told_by}
    places = np.concatenate([each for each, _ in found])
    assert np.ptp(places[:, 1]) > 20.0
    level = bank.level_m + bank.fall * places[:, 1]
    assert np.abs(places[:, 2] - level).max() < 0.03  # waves of the beach are 2 cm
    away = places[:, 0] - bank.water_x(places[:, 1])
    sigma = float(np.mean([told["sigma_m"] for _, told in found]))
    assert np.sqrt(np.mean(away**2)) < 2.0 * sigma < 1.2
    # 2 cm of height are 17 cm on a beach of 0.12
    assert abs(np.median(away)) < 0.25


def test_retreat_and_volume_are_told_by_stretches(tmp_path: Path) -> None:
    before = Bank(3, length_m=48.0)
    after = later(before, 0.8)
    rng = np.random.default_rng(3)
    a = write_cloud(tmp_path / "a.laz", before.points(rng, 60.0, NOISE_M))
    b = write_cloud(tmp_path / "b.laz", after.points(rng, 60.0, NOISE_M))
    words = ["banks", str(b), "--before", str(a), "--registered", "-o", str(tmp_path / "r.gpkg"), "--stretch", "8"]
    assert main([*words, "--json", str(tmp_path / "f.json")]) == 0
    found = lines(tmp_path / "r.gpkg", "stretch")
    assert len(found) == 6
    lost = 0.0
    for places, told in found:
        y = places[:, 1]
        turn = (before.upper_x(y + 0.01) - before.upper_x(y - 0.01)) / 0.02
        true = float(np.mean(after.moved(y) / np.hypot(1.0, turn)))  # across the edge, not along x
        assert told["retreat_m"] == pytest.approx(true, abs=max(4.0 * told["retreat_sigma_m"], 0.03))
        # below the face the land is bent now, where the beach began: straight pieces tell its edge to half the width of that
        assert told["foot_retreat_m"] == pytest.approx(true, abs=0.05)
        assert bool(told["significant"]) == (true > 0.05)
        lost += told["lost_m3"]
    grid = np.stack(np.meshgrid(np.arange(5.0, 22.0, 0.02), np.arange(0.25, 48.0, 0.5)), axis=-1).reshape(-1, 2)
    by = before.height(grid) - after.height(grid)
    assert lost == pytest.approx(float(by.sum()) * 0.02 * 0.5, rel=0.05)
    figures = json.loads((tmp_path / "f.json").read_text())
    assert figures["moved"] == 4
    assert figures["gained_m3"] < 0.02 * figures["lost_m3"]


def test_a_house_on_a_plain_is_no_bank_and_a_plain_has_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(4)
    xy = rng.uniform(0, 40, (60_000, 2))
    inside = (np.abs(xy - 20.0) < 5.0).all(axis=1)
    z = np.where(inside, 4.0, 0.0) + NOISE_M * rng.standard_normal(len(xy))
    cloud = write_cloud(tmp_path / "c.laz", np.column_stack([xy, z]))
    assert main(["banks", str(cloud), "-o", str(tmp_path / "b.geojson"), "--json", str(tmp_path / "f.json")]) == 0
    figures = json.loads((tmp_path / "f.json").read_text())
    assert (figures["banks"], figures["standing_alone"], figures["water_m"]) == (0, 1, 0)
    assert "no bank of 0.5 m and 30 deg was found, and no water" in capsys.readouterr().err


def test_an_overhang_is_told() -> None:
    """A face that leans out over its foot by 0.3 m."""
    rng = np.random.default_rng(5)
    share = rng.uniform(0, 1, 120)
    parts = [
        np.column_stack([rng.uniform(-3, 0.3, 200), np.full(200, 2.0)]),
        np.column_stack([0.3 * (1 - share), 2.0 * (1 - share)]),
        np.column_stack([rng.uniform(0.0, 3, 150), np.zeros(150)]),
    ]
    s, z = (np.concatenate(parts) + 0.01 * rng.standard_normal((470, 2))).T
    found = fitted(s, z, 0.5)
    assert found is not None
    assert found.upper
    assert found.lower
    assert found.values[:4] == pytest.approx([0.3, 2.0, 0.0, 0.0], abs=0.02)
    assert np.pi / 2 < found.slope_rad < np.deg2rad(110)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--registered"], "--registered given, but nothing uses it"),
        (["--least-drop", "0"], "--least-drop 0 m: expected 0.1 to 100 m"),
        (["--least-slope", "90"], "--least-slope 90 deg: expected 10 to 85 deg"),
    ],
)
def test_options_that_cannot_be_are_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str
) -> None:
    bank = replace(Bank(1), length_m=10.0)
    cloud = write_cloud(tmp_path / "c.laz", bank.points(np.random.default_rng(1), 10.0, NOISE_M))
    assert main(["banks", str(cloud), "-o", str(tmp_path / "b.geojson"), *words]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "b.geojson").exists()
