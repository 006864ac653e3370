"""`swath passability` on a yard of known slopes, steps, walls and holes."""

import itertools
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import rasterio
import shapely

from groundproc.analysis import passability
from groundproc.analysis.passage.relief import planes, steps
from groundproc.analysis.passage.route import best_route
from groundproc.cli import main
from tests.groundproc.analysis.test_ground_command import ORIGIN, write_cloud

SIDE_M = 60.0
GATE = (38.0, 42.0)
"""Along y: where the wall at x = 30 is open."""
KERB_M = 0.35


def ground(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Level; east of x = 45 a slope of 10 deg that becomes one of 32 deg south of y = 20; a kerb at x = 15, ramped from y = 25 to 31."""
    steep = np.where(y < 20.0, np.tan(np.deg2rad(32.0)), np.tan(np.deg2rad(10.0)))
    z = np.where(x > 45.0, (x - 45.0) * steep, 0.0)
    ramp = np.clip((x - 12.0) / 6.0, 0.0, 1.0) * KERB_M
    return z + np.where((y > 25.0) & (y < 31.0), ramp, np.where(x > 15.0, KERB_M, 0.0))


def yard(seed: int = 1, per_m2: float = 60.0) -> np.ndarray:
    rng = np.random.default_rng(seed)

    def spread(west: float, south: float, east: float, north: float, times: float = 1.0) -> np.ndarray:
        count = int((east - west) * (north - south) * per_m2 * times)
        return rng.uniform((west, south), (east, north), (count, 2))

    at = spread(0, 0, SIDE_M, SIDE_M)
    hole = np.hypot(at[:, 0] - 7.0, at[:, 1] - 45.0) < 4.0  # nobody saw this
    at = at[~hole]
    z = ground(at[:, 0], at[:, 1])
    wall = (np.abs(at[:, 0] - 30.0) < 0.3) & ~((at[:, 1] > GATE[0]) & (at[:, 1] < GATE[1]))
    z[wall] += 1.2
    boulder = np.hypot(at[:, 0] - 22.0, at[:, 1] - 28.0) < 0.6
    z[boulder] += 0.8
    roof = spread(20, 48, 26, 54)  # a branch to drive below
    high = ground(roof[:, 0], roof[:, 1]) + 4.0
    xyz = np.vstack([np.column_stack([at, z]), np.column_stack([roof, high])])
    xyz[:, 2] += 0.015 * rng.standard_normal(len(xyz))
    return xyz


def place(x: float, y: float) -> str:
    return f"{x + ORIGIN[0]},{y + ORIGIN[1]}"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("yard")
    write_cloud(folder / "c.laz", yard())
    assert main([
        "passability", str(folder / "c.laz"), "-o", str(folder / "out"), "--from", place(5, 10), "--to", place(40, 10),
        "--json", str(folder / "f.json"),
    ]) == 0  # fmt: skip
    return folder


def value(path: Path, x: float, y: float) -> float:
    with rasterio.open(path) as file:
        return float(next(file.sample([(x + ORIGIN[0], y + ORIGIN[1])]))[0])


def test_slopes_are_those_of_the_ground(made: Path) -> None:
    slope = made / "out" / "slope.tif"
    for x, y, true in ((52.0, 40.0, 10.0), (52.0, 10.0, 32.0), (8.0, 15.0, 0.0)):
        assert value(slope, x, y) == pytest.approx(true, abs=1.0)


def test_steps_are_told_where_they_are_and_not_on_slopes(made: Path) -> None:
    with rasterio.open(made / "out" / "step.tif") as file:
        step, west, north, cell = (
            file.read(1),
            file.transform.c - ORIGIN[0],
            file.transform.f - ORIGIN[1],
            file.transform.a,
        )
    row, column = (int((north - 10.0) / cell), int((15.0 - west) / cell))
    assert step[row, column - 1 : column + 2].max() == pytest.approx(KERB_M, abs=0.06)
    slope = step[
        int((north - 17.0) / cell) : int((north - 3.0) / cell), int((48.0 - west) / cell) : int((57.0 - west) / cell)
    ]
    assert np.median(slope) < 0.06
    assert np.percentile(slope, 99.5) < 0.2


def test_cells_are_what_the_yard_is(made: Path) -> None:
    kind = made / "out" / "passability.tif"
    for x, y, true in (
        (8.0, 10.0, 1), (52.0, 45.0, 1), (52.0, 10.0, 2), (15.0, 10.0, 3), (22.0, 28.0, 4), (30.0, 10.0, 4), (7.0, 45.0, 0),
        (23.0, 51.0, 1), (29.0, 10.0, 5), (15.0, 28.0, 1), (30.0, 40.0, 1),
    ):  # fmt: skip
        assert value(kind, x, y) == true, (x, y)


def test_heights_of_obstacles_are_true(made: Path) -> None:
    obstacle = made / "out" / "obstacle.tif"
    assert value(obstacle, 30.0, 10.0) == pytest.approx(1.2, abs=0.1)
    assert value(obstacle, 22.0, 28.0) == pytest.approx(0.8, abs=0.1)
    assert value(obstacle, 8.0, 10.0) < 0.1


def test_the_route_takes_ramp_and_gate(made: Path) -> None:
    meta, _, wkb, fields = pyogrio.raw.read(made / "out" / "route.geojson")
    line = shapely.from_wkb(wkb)[0]
    xy = shapely.get_coordinates(line) - ORIGIN
    found = dict(zip(meta["fields"], (each[0] for each in fields), strict=True))
    at_wall = xy[np.abs(xy[:, 0] - 30.0) < 0.5]
    assert ((at_wall[:, 1] > GATE[0] + 0.9) & (at_wall[:, 1] < GATE[1] - 0.9)).all()
    at_kerb = xy[np.abs(xy[:, 0] - 15.0) < 0.5]
    assert ((at_kerb[:, 1] > 25.5) & (at_kerb[:, 1] < 30.5)).all()
    shortest = sum(
        np.hypot(b[0] - a[0], b[1] - a[1]) for a, b in itertools.pairwise([(5, 10), (15, 26), (30, 39), (40, 10)])
    )
    # eight directions are 8 % longer than straight lines at most
    assert shortest * 0.98 < found["length_m"] < shortest * 1.12
    assert found["rise_m"] == pytest.approx(KERB_M, abs=0.25)
    assert found["steepest_deg"] < 20.0


def test_figures_add_up_to_what_was_seen(made: Path) -> None:
    area: dict[str, Any] = json.loads((made / "f.json").read_text())["area_m2"]
    hole = np.pi * 4.0**2
    assert area["unseen"] == pytest.approx(hole, abs=0.15 * hole)
    assert sum(area.values()) == pytest.approx(SIDE_M**2, rel=0.02)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--from", place(5, 10)], "expected both or none"),
        (
            ["--from", place(5, 10), "--to", place(30, 10)],
            "there is an obstacle, expected a passable place; the nearest is",
        ),
        (["--from", place(5, 10), "--to", place(300, 10)], "lies outside of the cloud"),
        (["--from", "5;10", "--to", place(300, 10)], "expected 2 numbers between commas"),
        (["--max-slope", "95"], "max_slope_deg: 95.0 found, expected 1.0 to 60.0"),
        (["--max-obstacle", "3"], "expected less than height_m"),
    ],
)
def test_bad_wishes_are_one_sentence(
    made: Path, tmp_path: Path, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["passability", str(made / "c.laz"), "-o", str(tmp_path / "out"), *words]) in (1, 2)
    err = capsys.readouterr().err.strip()
    assert said.replace(".0", "") in err.replace(".0", "")
    assert "\n" not in err
    assert not (tmp_path / "out").exists()


def test_where_there_is_no_way_it_is_said(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--from", place(5, 10), "--to", place(40, 10), "--width", "4"]
    assert main(["passability", str(made / "c.laz"), "-o", str(tmp_path / "out"), *words]) == 0
    assert "there is no way" in capsys.readouterr().err
    assert not (tmp_path / "out" / "route.geojson").exists()


def test_nothing_goes_half_beyond_what_was_seen(tmp_path: Path) -> None:
    """The edge of the cloud is as closed as a hole in it, on all four sides."""
    xy = np.random.default_rng(2).uniform(0.05, 19.95, (30_000, 2))
    write_cloud(tmp_path / "c.laz", np.column_stack([xy, np.zeros(len(xy))]))
    assert (
        main(["passability", str(tmp_path / "c.laz"), "-o", str(tmp_path / "o"), "--json", str(tmp_path / "f.json")])
        == 0
    )
    for x, y, true in ((0.4, 10, 5), (19.6, 10, 5), (10, 0.4, 5), (10, 19.6, 5), (1.6, 10, 1), (10, 18.4, 1)):
        assert value(tmp_path / "o" / "passability.tif", x, y) == true, (x, y)
    area = json.loads((tmp_path / "f.json").read_text())["area_m2"]
    assert area["passable"] == pytest.approx(18.0**2, rel=0.06)


# On arrays -----------------------------------------------------------------------------------------------------------


def test_a_plane_is_met_exactly_with_gaps() -> None:
    row, column = np.indices((30, 40))
    z = 1000.0 + 0.3 * column - 0.2 * row
    z[10:13, 5:8] = np.nan
    found = planes(z, 0.5, 2)
    assert np.allclose(found.slope[2:-2, 2:-2][np.isfinite(found.slope[2:-2, 2:-2])], np.hypot(0.3, 0.2) / 0.5)
    assert np.allclose(found.height_m[15, 20], z[15, 20])


def test_a_step_is_its_height_and_a_hill_none() -> None:
    row, column = np.indices((20, 40), np.float64)
    hill = -0.01 * ((column - 20) ** 2 + row**2)
    assert np.nanmax(steps(hill)[4:-4, 4:-4]) < 1e-9
    edge = np.where(column > 19, 0.5, 0.0) + 0.3 * column
    assert steps(edge)[10, 20] == pytest.approx(0.5)


def test_the_best_route_is_that_of_a_plain_search() -> None:
    """Against relaxation until nothing changes."""
    rng = np.random.default_rng(0)
    for _ in range(5):
        cost = rng.uniform(1.0, 3.0, (12, 14))
        cost[rng.random(cost.shape) < 0.25] = np.nan
        cost[0, 0], cost[-1, -1] = 1.0, 1.0
        least = np.full(cost.shape, np.inf)
        least[0, 0] = 0.0
        for turn in range(200):
            for i, j in np.ndindex(*cost.shape):
                for di, dj in itertools.product((-1, 0, 1), repeat=2):
                    k, m = i + di, j + dj
                    if (
                        (di or dj)
                        and 0 <= k < 12
                        and 0 <= m < 14
                        and np.isfinite(cost[[i, k, i, k], [j, m, m, j]]).all()
                    ):
                        least[i, j] = min(least[i, j], least[k, m] + np.hypot(di, dj) * (cost[i, j] + cost[k, m]) / 2)
            if turn > 60:
                break
        row, column = np.nonzero(np.isfinite(cost))
        way = best_route((row, column), cost[row, column], (0, 0), (11, 13))
        if way is None:
            assert np.isinf(least[-1, -1])
            continue
        spent = sum(np.hypot(*(b - a)) * (cost[tuple(a)] + cost[tuple(b)]) / 2 for a, b in itertools.pairwise(way))
        assert spent == pytest.approx(least[-1, -1])


def test_a_place_beyond_the_cloud_is_refused_before_its_ground_is_looked_for(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def looked_for(*given: Any) -> None:
        raise AssertionError("the ground is looked for")

    monkeypatch.setattr(passability, "Floor", looked_for)
    words = ["passability", str(made / "c.laz"), "-o", str(tmp_path / "out"), "--from", place(5, 10)]
    assert main([*words, "--to", place(3000, 10)]) == 1
    assert "lies outside of the cloud, which spans" in capsys.readouterr().err
    # a head that states too little is not believed
    head = bytearray((made / "c.laz").read_bytes())
    struct.pack_into("<4d", head, 179, *(ORIGIN[0] + 1.0, ORIGIN[0], ORIGIN[1] + 1.0, ORIGIN[1]))
    (tmp_path / "short.laz").write_bytes(head)
    with pytest.raises(AssertionError, match="the ground is looked for"):
        main(["passability", str(tmp_path / "short.laz"), *words[2:], "--to", place(10, 10)])
