"""`swath trees` in a wood whose trees are known."""

import json
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj
import pytest

from groundproc.cli import main
from simulator import outdoors

ORIGIN = np.array([533_000.0, 6_472_000.0, 0.0])


def listed(
    folder: Path, xyz: np.ndarray, *words: str, kind: np.ndarray | None = None
) -> list[tuple[np.ndarray, dict[str, Any]]]:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, ORIGIN
    header.add_crs(pyproj.CRS.from_epsg(32633))
    las = laspy.LasData(header)
    las.x, las.y, las.z = (xyz + ORIGIN).T
    if kind is not None:
        las.classification = kind
    las.write(folder / "c.laz")
    assert (
        main(
            ["trees", str(folder / "c.laz"), "-o", str(folder / "t.geojson"), "--json", str(folder / "f.json"), *words]
        )
        == 0
    )
    tree = json.loads((folder / "t.geojson").read_text())
    return [(np.array(each["geometry"]["coordinates"]) - ORIGIN, each["properties"]) for each in tree["features"]]


def test_trees_of_a_wood_are_found_where_their_stems_are(tmp_path: Path) -> None:
    wood = outdoors.wood(seed=0, side_m=60.0, per_m2=50.0)
    found = listed(tmp_path, wood.xyz)
    places = np.array([place for place, _ in found])
    truth = np.array([(each.x, each.y) for each in wood.trees])
    away = np.hypot(*(places[:, None, :2] - truth).transpose(2, 0, 1))
    nearest, least = away.argmin(axis=0), away.min(axis=0)
    assert np.mean(least <= 0.5) >= 0.95
    assert np.mean(away.min(axis=1) > 1.5) < 0.05
    met = least <= 0.5
    heights = np.array([found[n][1]["height_m"] for n in nearest]) - [each.height_m for each in wood.trees]
    assert np.median(np.abs(heights[met])) < 0.2
    crown = np.array([found[n][1]["crown_m"] for n in nearest]) / [2 * each.crown_m for each in wood.trees]
    assert np.median(crown[met]) == pytest.approx(1.0, abs=0.15)
    assert np.mean([about["stem"] for _, about in found]) > 0.8
    feet = places[:, 2] - wood.ground(places[:, :2])
    assert np.abs(feet).max() < 0.5
    gone = np.array([each.dead for each in wood.trees])
    said = np.array([found[n][1]["kind"] == "dead" for n in nearest])
    assert np.mean(said[met & gone]) >= 0.6
    assert np.mean(said[met & ~gone]) < 0.05


def test_bushes_are_listed_when_asked_for(tmp_path: Path) -> None:
    village = outdoors.village(seed=2, side_m=60.0, per_m2=20.0)
    kinds = [about["kind"] for _, about in listed(tmp_path, village.xyz, "--bushes")]
    assert "bush" in kinds
    figures = json.loads((tmp_path / "f.json").read_text())
    assert figures["bushes"] == kinds.count("bush")


def test_houses_and_wires_are_no_trees(tmp_path: Path) -> None:
    """A roof of tiles, a wire aslant, two beside each other on edges of cells, and what another program classed as a building.

    Three trees are left.
    """
    rng = np.random.default_rng(4)
    ground = np.column_stack([rng.uniform(0, 50, (30_000, 2)), np.zeros(30_000)])
    house = (np.abs(ground[:, 0] - 15) < 5) & (np.abs(ground[:, 1] - 12) < 4)
    ground[house, 2] = 5.0 + 0.8 * (4 - np.abs(ground[house, 1] - 12)) + rng.normal(0, 0.02, house.sum())
    along = rng.uniform(0, 1, 700)
    wire = np.column_stack([50 * along, 20 + 25 * along, 9 + 4 * (along - 0.5) ** 2]) + rng.normal(0, 0.01, (700, 3))
    level = [
        np.column_stack([50 * along, np.full(700, y), 8 + along]) + rng.normal(0, 0.02, (700, 3)) for y in (2.0, 3.0)
    ]
    trees = [(30.0, 10.0), (40.0, 15.0), (10.0, 40.0)]
    crowns = [np.array([*at, 6.0]) + 1.5 * sphere(rng, 900) * (1, 1, 1.5) for at in trees]
    shed = np.column_stack([rng.uniform(30, 33, (900, 1)), rng.uniform(40, 43, (900, 1)), rng.uniform(0, 4, (900, 1))])
    xyz = np.concatenate([ground, wire, *level, *crowns, shed])
    kind = np.zeros(len(xyz), np.uint8)
    kind[-len(shed) :] = 6
    found = listed(tmp_path, xyz, kind=kind)
    places = np.array([place[:2] for place, _ in found])
    assert len(found) == 3
    assert all(np.hypot(*(places - at).T).min() < 0.5 for at in trees)


@pytest.mark.parametrize("apart", [(0.4, 0.0), (0.0, 0.4), (0.3, 0.3)], ids=["level", "upright", "aslant"])
def test_two_wires_close_to_each_other_are_no_trees(tmp_path: Path, apart: tuple[float, float]) -> None:
    """Bundled conductors, in which no single line is found; the tree beside them is."""
    rng = np.random.default_rng(6)
    ground = np.column_stack([rng.uniform(0, 60, 30_000), rng.uniform(0, 30, 30_000), np.zeros(30_000)])
    along = rng.uniform(0, 1, (2, 900))
    wires = [
        np.column_stack([60 * u, 10 + 3 * u + k * apart[0], 8 + k * apart[1] + 5 * (u - 0.5) ** 2])
        + rng.normal(0, 0.02, (900, 3))
        for k, u in enumerate(along)
    ]
    tree = np.array([30.0, 22.0, 6.0]) + 1.5 * sphere(rng, 900) * (1, 1, 1.5)
    found = listed(tmp_path, np.concatenate([ground, *wires, tree]))
    assert [np.hypot(place[0] - 30.0, place[1] - 22.0) < 0.5 for place, _ in found] == [True]


def sphere(rng: np.random.Generator, count: int) -> np.ndarray:
    """Points within a ball of radius 1, most of them near its rim."""
    way = rng.normal(size=(count, 3))
    return np.asarray(way / np.linalg.norm(way, axis=1)[:, None] * rng.uniform(0.6, 1, (count, 1)))


def test_bare_ground_has_no_trees_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    xy = np.random.default_rng(0).uniform(0, 30, (5000, 2))
    assert listed(tmp_path, np.column_stack([xy, outdoors.rolling(xy)])) == []
    assert "nothing grows higher than 3 m" in capsys.readouterr().err


def test_a_height_that_is_none_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    listed(tmp_path, np.random.default_rng(0).uniform(0, 5, (50, 3)))
    words = [str(tmp_path / "c.laz"), "-o", str(tmp_path / "u.geojson"), "--min-height", "nan"]
    capsys.readouterr()
    assert main(["trees", *words]) == 2
    assert "--min-height nan m: expected 1 m or more" in capsys.readouterr().err
