"""`swath windows` on a house whose every beam is known."""

import json
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyogrio
import pytest
from strips import GPS_S, ORIGIN, Scene, Strip

from groundproc.cli import main
from groundproc.cloud.classes import PANE

Array = np.ndarray
WINDOWS = [(x, x + 1.4, z, z + 1.5) for x in (-8.5, -4.0, 0.5, 5.0) for z in (0.9, 3.6)]
"""Left, right, lower and upper edge, of the south wall of a house of 20 x 9 x 6 m."""
ROOM_M = 4.0
STRIP = Strip((-20.0, -18.0, 9.0), (2.0, 0.0, 0.0), 0.0, 20.0)
GROUND, WALL, ROOM, PANES, TREE = range(5)


def hits(origin: Array, beam: Array, rng: np.random.Generator) -> tuple[Array, Array, Array, Array]:
    """Distance and kind of the echo of each beam, and distance to a pane that gave one too (NaN for none)."""
    best, kind = np.full(len(beam), np.inf), np.full(len(beam), -1)
    glass = np.full(len(beam), np.nan)

    def meet(axis: int, at: float, low: tuple[float, float], high: tuple[float, float], what: int) -> Array:
        nonlocal best, kind
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (at - origin[:, axis]) / beam[:, axis]
            place = origin + t[:, None] * beam
        u, v = (place[:, other] for other in range(3) if other != axis)
        inside = (t > 0) & (u > low[0]) & (u < high[0]) & (v > low[1]) & (v < high[1])
        if axis == 1 and at == 0.0:
            hole = np.zeros(len(beam), bool)
            for left, right, lower, upper in WINDOWS:
                hole |= (u > left) & (u < right) & (v > lower) & (v < upper)
            mirrored = inside & hole & (rng.random(len(beam)) < 0.3)
            glass[mirrored] = t[mirrored] * 1.0 + 0.12 / np.maximum(np.abs(beam[mirrored, 1]), 0.1)
            inside &= ~hole
        closer = inside & (t < best)
        best[closer], kind[closer] = t[closer], what
        return closer

    meet(2, 0.0, (-60, -60), (60, 60), GROUND)
    for at in (0.0, 9.0):
        meet(1, at, (-10, 0), (10, 6), WALL)
    for at in (-10.0, 10.0):
        meet(0, at, (0, 0), (9, 6), WALL)
    meet(2, 6.0, (-10.5, -0.5), (10.5, 9.5), WALL)
    meet(1, ROOM_M, (-10, 0), (10, 6), ROOM)
    meet(1, 14.0, (-14, 0), (-6, 5), TREE)  # a hedge beyond the house
    glass[~(glass < best)] = np.nan
    return best, kind, glass, kind == ROOM


def house(seed: int = 2, count: int = 350_000) -> dict[str, Array]:
    rng = np.random.default_rng(seed)
    time = np.sort(rng.uniform(0, 20, count))
    origin = STRIP.at(time)
    turn, down = rng.uniform(-1.2, 1.2, count), rng.uniform(-0.9, 0.05, count)
    beam = np.stack([np.cos(down) * np.sin(turn), np.cos(down) * np.cos(turn), np.sin(down)], axis=1)
    best, kind, glass, _ = hits(origin, beam, rng)
    back = np.isfinite(best) & ((kind != ROOM) | (rng.random(count) < 0.5))  # glass takes some of them
    both = back & np.isfinite(glass)
    noise = 0.015 * rng.standard_normal((2, count))
    parts = []
    for some, range_m, what, rank in (
        (back, best + noise[0], kind, np.where(both, 2, 1)), (both, glass + noise[1], np.full(count, PANES), np.ones(count)),
    ):  # fmt: skip
        parts.append(np.column_stack([
            (origin + range_m[:, None] * beam)[some], time[some], what[some], rank[some], np.where(both, 2, 1)[some],
        ]))  # fmt: skip
    rows = np.concatenate(parts)
    rows = rows[np.argsort(rows[:, 3], kind="stable")]
    return {
        "xyz": rows[:, :3],
        "time": rows[:, 3],
        "kind": rows[:, 4].astype(int),
        "rank": rows[:, 5],
        "of": rows[:, 6],
    }


def write(path: Path, echoes: dict[str, Array], point_format: int = 6) -> Path:
    header = laspy.LasHeader(version="1.4" if point_format > 5 else "1.2", point_format=point_format)
    header.scales, header.offsets = [0.001] * 3, ORIGIN
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    import pyproj

    header.add_crs(pyproj.CRS.from_epsg(32633))
    las = laspy.LasData(header)
    las.xyz = echoes["xyz"] + ORIGIN
    if "gps_time" in las.point_format.dimension_names:
        las.gps_time = echoes["time"] + GPS_S
    las.return_number, las.number_of_returns = echoes["rank"].astype(np.uint8), echoes["of"].astype(np.uint8)
    las.classification = np.ones(len(echoes["xyz"]), np.uint8)
    las.write(path)
    return path


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Array]]:
    folder, echoes = tmp_path_factory.mktemp("house"), house()
    write(folder / "c.laz", echoes)
    Scene([], [STRIP]).write_trajectory(folder / "t.csv")
    words = ["windows", str(folder / "c.laz"), "-t", str(folder / "t.csv"), "-o", str(folder / "out.laz")]
    assert main([*words, "--walls", str(folder / "w.geojson"), "--json", str(folder / "f.json")]) == 0
    return folder, echoes


def test_what_is_behind_panes_is_kept_and_classed(made: tuple[Path, dict[str, Array]]) -> None:
    folder, echoes = made
    out = laspy.read(folder / "out.laz")
    kind = np.asarray(out.classification)
    assert np.allclose(out.xyz, echoes["xyz"] + ORIGIN, rtol=0, atol=0.001)
    room = echoes["kind"] == ROOM
    assert room.sum() > 500
    assert (kind[room] == PANE).mean() >= 0.95


def test_nothing_else_is_taken_for_a_window(made: tuple[Path, dict[str, Array]]) -> None:
    folder, echoes = made
    kind = np.asarray(laspy.read(folder / "out.laz").classification)
    # what came through the south wall's face came through a window: floor and side walls of the room as well
    origin, xyz = STRIP.at(echoes["time"]), echoes["xyz"]
    at_wall = origin + (origin[:, 1] / (origin[:, 1] - xyz[:, 1]))[:, None] * (xyz - origin)
    indoors = (xyz[:, 1] > 0.15) & (np.abs(at_wall[:, 0]) < 10) & (at_wall[:, 2] > 0) & (at_wall[:, 2] < 6)
    others = np.isin(echoes["kind"], [GROUND, WALL, TREE]) & ~indoors
    assert (kind[indoors] == PANE).mean() > 0.95
    assert (kind[others] == PANE).mean() < 0.001


def test_first_echoes_of_panes_are_told(made: tuple[Path, dict[str, Array]]) -> None:
    folder, echoes = made
    kind = np.asarray(laspy.read(folder / "out.laz").classification)
    glass = echoes["kind"] == PANES
    assert glass.sum() > 200
    assert (kind[glass] == PANE).mean() > 0.9


def test_the_plane_behind_the_facade_is_found(made: tuple[Path, dict[str, Array]]) -> None:
    folder, _ = made
    figures: dict[str, Any] = json.loads((folder / "f.json").read_text())
    assert figures["planes_behind"] == 1
    meta, _, _, fields = pyogrio.raw.read(folder / "w.geojson")
    table = dict(zip(meta["fields"], fields, strict=True))
    seen = int(np.argmax(table["behind"]))
    assert table["depth_m"][seen] == pytest.approx(ROOM_M, abs=0.05)
    assert table["area_m2"][seen] == pytest.approx(20 * 6, rel=0.1)


def test_without_beams_the_outside_is_where_the_ground_is(made: tuple[Path, dict[str, Array]], tmp_path: Path) -> None:
    _, echoes = made
    path = write(tmp_path / "plain.las", echoes, 0)
    assert main(["windows", str(path), "-o", str(tmp_path / "out.las"), "--json", str(tmp_path / "f.json")]) == 0
    figures = json.loads((tmp_path / "f.json").read_text())
    assert "no beams" in figures["beams"]
    room = int((echoes["kind"] == ROOM).sum())
    assert figures["points_behind"] > 0.95 * room
    assert any("classes up to 31 only" in each for each in figures["warnings"])
    assert any("give the trajectory with -t" in each for each in figures["warnings"])


def test_a_trajectory_of_another_time_is_one_sentence(
    made: tuple[Path, dict[str, Array]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = made
    text = (folder / "t.csv").read_text().splitlines()
    moved = [text[0]] + [f"{int(line.split(',')[0]) + 10**12},{line.partition(',')[2]}" for line in text[1:]]
    (tmp_path / "t.csv").write_text("\n".join(moved) + "\n")
    words = ["windows", str(folder / "c.laz"), "-t", str(tmp_path / "t.csv"), "-o", str(tmp_path / "o.laz")]
    assert main(words) == 1
    err = capsys.readouterr().err.strip()
    assert "is it of this flight" in err
    assert "\n" not in err
    assert not (tmp_path / "o.laz").exists()
