"""`swath change`: small boxes that come and go amid swaying shrubs, and shadows that are no change."""

import json
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from groundproc.analysis.registration import register
from groundproc.cli import main

Array = npt.NDArray[np.float64]
ORIGIN = np.array([533_000.0, 6_472_000.0, 100.0])
SIDE_M = 9.0
CENTRE = np.array([5.0, 5.0, 0.0])


def epoch(rng: np.random.Generator, boxes: Array, shrubs: Array, per_m2: float = 1000.0) -> Array:
    """Ground with waves, boxes of 1 dm3 on it, shrubs that sway by 10 cm; points with 2 cm of noise in height."""
    xy = rng.uniform(0, SIDE_M, (int(SIDE_M**2 * per_m2), 2))
    z = 0.3 * np.sin(xy[:, 0] / 2.0) + 0.2 * np.cos(xy[:, 1] / 1.5)
    for x, y in boxes:
        z[(np.abs(xy[:, 0] - x) < 0.05) & (np.abs(xy[:, 1] - y) < 0.05)] += 0.1
    parts = [np.column_stack([xy, z])]
    for x, y in shrubs:
        way = rng.standard_normal((int(500 * per_m2 / 1000), 3))
        way *= 0.5 * rng.uniform(0, 1, (len(way), 1)) ** (1 / 3) / np.linalg.norm(way, axis=1)[:, None]
        way[:, 2] = np.abs(way[:, 2])
        base = [x, y, 0.3 * np.sin(x / 2.0) + 0.2 * np.cos(y / 1.5)]
        parts.append(way + base + rng.normal(0, 0.1, 3) + rng.normal(0, 0.05, (len(way), 3)))
    xyz = np.concatenate(parts)
    return np.asarray(xyz + rng.normal(0, 1, xyz.shape) * (0.005, 0.005, 0.02))


def write(path: Path, xyz: Array, point_format: int = 6, epsg: int = 32633, **columns: Any) -> Path:
    header = laspy.LasHeader(version="1.4", point_format=point_format)
    header.scales, header.offsets = [0.001] * 3, ORIGIN
    header.add_crs(pyproj.CRS.from_epsg(epsg))
    las = laspy.LasData(header)
    las.xyz = xyz + ORIGIN
    las.intensity = np.arange(len(xyz)) % 1000
    las.return_number = las.number_of_returns = np.ones(len(xyz), np.uint8)
    for name, values in columns.items():
        las[name] = values
    las.write(path)
    return path


def changes(folder: Path) -> list[dict[str, Any]]:
    tree = json.loads((folder / "changes.geojson").read_text())
    return [each["properties"] for each in tree["features"]]


def test_boxes_of_a_cubic_decimetre_amid_shrubs(tmp_path: Path) -> None:
    rng = np.random.default_rng(11)
    grid = np.stack(np.meshgrid(np.arange(1.0, 8.5, 1.5), np.arange(1.0, 8.5, 1.5)), axis=-1).reshape(-1, 2)
    shrubs, places = grid[::5] + 0.7, grid + rng.uniform(-0.1, 0.1, grid.shape)
    new, gone = places[0::2], places[1::2]
    shift = np.array([0.21, -0.14, 0.06])
    turn = Rotation.from_rotvec(np.radians([0.1, -0.2, 0.5]))
    a, b = epoch(rng, gone, shrubs), epoch(rng, new, shrubs)
    moved = turn.apply(b - CENTRE) + CENTRE + shift
    write(tmp_path / "a.laz", a)
    write(tmp_path / "b.laz", moved, 7)
    out = tmp_path / "out"
    words = [
        "change",
        str(tmp_path / "a.laz"),
        str(tmp_path / "b.laz"),
        "-o",
        str(out),
        "--json",
        str(tmp_path / "c.json"),
    ]
    assert main(words) == 0
    matrix = np.array(json.loads((out / "registration.json").read_text())["matrix"])
    back = (moved + ORIGIN) @ matrix[:3, :3].T + matrix[:3, 3] - ORIGIN
    # slopes of 1 : 7 and 2 cm of noise: centimetres in plan, millimetres in height
    assert (np.abs((back - b).mean(axis=0)) < (0.015, 0.015, 0.002)).all()
    assert (Rotation.from_matrix(matrix[:3, :3]) * turn).magnitude() < np.radians(0.1)
    found = changes(out)
    for kind, true in (("appeared", new), ("vanished", gone)):
        place = np.array([[each["x"], each["y"]] for each in found if each["kind"] == kind]) - ORIGIN[:2]
        apart = np.linalg.norm(place[:, None] - true[None], axis=2)
        assert (apart.min(axis=0) < 0.1).mean() >= 0.9
        assert (apart.min(axis=1) > 0.2).sum() <= 5 * SIDE_M**2 / 100.0
        volumes = [each["volume_m3"] for each in found if each["kind"] == kind]
        assert 0.0005 < np.median(volumes) < 0.002
    cloud = laspy.read(out / "change.laz")
    assert len(cloud) == len(a) + len(b)
    np.testing.assert_allclose(cloud.xyz, np.concatenate([a, moved]) + ORIGIN, rtol=0, atol=0.00051)
    assert (np.asarray(cloud.intensity[: len(a)]) == np.arange(len(a)) % 1000).all()
    assert (np.asarray(cloud["epoch"]) == np.repeat([0, 1], [len(a), len(b)])).all()
    top = (np.abs(a[:, :2] - gone[0]) < 0.04).all(axis=1)
    assert np.mean(np.asarray(cloud["change"])[: len(a)][top] == 2) > 0.7


def test_what_was_not_looked_into_has_not_vanished(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    box = np.array([[4.0, 4.0]])
    a = epoch(rng, box, np.empty((0, 2)), 800.0)
    b = epoch(rng, np.empty((0, 2)), np.empty((0, 2)), 800.0)
    b = b[np.hypot(b[:, 0] - 4.0, b[:, 1] - 4.0) > 0.5]
    write(tmp_path / "a.laz", a)
    write(tmp_path / "b.laz", b)
    assert main(["change", str(tmp_path / "a.laz"), str(tmp_path / "b.laz"), "-o", str(tmp_path / "o")]) == 0
    assert not [each for each in changes(tmp_path / "o") if np.hypot(each["x"] - 533_004, each["y"] - 6_472_004) < 0.5]
    state = np.asarray(laspy.read(tmp_path / "o" / "change.laz")["change"])[: len(a)]
    assert (state[(np.abs(a[:, :2] - 4.0) < 0.04).all(axis=1)] == 3).mean() > 0.7


def test_another_place_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(3)
    a = epoch(rng, np.empty((0, 2)), np.empty((0, 2)), 300.0)
    write(tmp_path / "a.laz", a)
    write(tmp_path / "far.laz", a + np.array([500.0, 0.0, 0.0]))
    other = np.column_stack([a[:, :2], 2.0 * np.sin(a[:, 1]) * np.cos(2.0 * a[:, 0])])
    write(tmp_path / "other.laz", other)
    write(tmp_path / "crs.laz", a, epsg=32634)
    for name, expected in (("far", "of one place"), ("other", "of one place"), ("crs", "expected one CRS")):
        assert main(["change", str(tmp_path / "a.laz"), str(tmp_path / f"{name}.laz"), "-o", str(tmp_path / "o")]) == 1
        told = capsys.readouterr().err.strip()
        assert expected in told
        assert "\n" not in told
        assert not (tmp_path / "o").exists()


def house(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(0, 40, (80_000, 2)), np.zeros(80_000)])
    ground[:, 2] = 0.8 * np.sin(ground[:, 0] / 5) + 0.3 * np.cos(ground[:, 1] / 4)
    walls = [
        np.column_stack([rng.uniform(10, 20, 15_000), np.full(15_000, 15.0), rng.uniform(0, 5, 15_000)]),
        np.column_stack([np.full(15_000, 20.0), rng.uniform(15, 25, 15_000), rng.uniform(0, 5, 15_000)]),
    ]
    xyz = np.concatenate([ground, *walls])
    return np.asarray(xyz + rng.normal(0, 0.01, xyz.shape))


def test_registration_to_two_millimetres_on_a_centimetre_of_noise() -> None:
    a, b = house(1), house(2)
    turn, shift = Rotation.from_rotvec(np.radians([0.3, -0.2, 0.8])), np.array([0.4, -0.3, 0.2])
    found = register(a + ORIGIN, turn.apply(b - CENTRE) + CENTRE + shift + ORIGIN)
    left = found.move(turn.apply(b - CENTRE) + CENTRE + shift + ORIGIN) - ORIGIN - b
    assert np.abs(left).max() < 0.002
    assert (Rotation.from_matrix(found.matrix[:3, :3]) * turn).magnitude() < np.radians(0.01)


def test_synthetic_patches_give_their_shift(recordings: Path) -> None:
    a, b = (laspy.read(recordings / "clouds" / f"py4dgeo_epoch{n}.laz").xyz for n in (0, 1))
    found = register(a, b)
    np.testing.assert_allclose(found.move(b).mean(axis=0) - b.mean(axis=0), (-0.30, 0.20, -0.10), rtol=0, atol=0.002)
