"""`swath pipes` on pipes of known axis, diameter and height."""

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import shapely

from groundproc.analysis.corridor.cylinder import cylinder
from groundproc.cli import main
from tests.groundproc.analysis.test_ground_command import ORIGIN, write_cloud

NOISE_M = 0.015


def tube(
    rng: np.random.Generator, line: np.ndarray, radius: float, per_m2: float, arc_deg: float = 200.0
) -> np.ndarray:
    """Points on the upper part of a pipe along a polyline."""
    parts = []
    for a, b in itertools.pairwise(line):
        length = np.linalg.norm(b - a)
        count = int(length * radius * np.deg2rad(arc_deg) * per_m2)
        along = (b - a) / length
        u = np.cross(along, (0, 0, 1.0))
        u /= np.linalg.norm(u)
        v = np.cross(u, along)
        angle = np.deg2rad(90 + rng.uniform(-arc_deg / 2, arc_deg / 2, count))
        off = radius + NOISE_M * rng.standard_normal(count)
        place = a + rng.uniform(0, 1, (count, 1)) * (b - a)
        parts.append(place + off[:, None] * (np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v))
    return np.concatenate(parts)


LONG = np.array([[5.0, 8.0, 0.35], [35.0, 12.0, 0.35], [55.0, 14.0, 1.15]])
"""Half sunk in the ground at first (diameter 0.6 m, its middle 5 cm above), then rising to a bridge."""
SHORT = np.array([[10.0, 30.0, 0.9], [40.0, 30.0, 0.9]])
"""Diameter 1 m, on saddles 0.4 m high."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    rng = np.random.default_rng(3)
    ground = rng.uniform((0, 0), (60, 45), (60 * 45 * 60, 2))
    z = 0.3 * np.ones(len(ground))
    tufts = (np.sin(3.1 * ground[:, 0]) * np.sin(2.7 * ground[:, 1]) > 0.93) & (rng.random(len(ground)) < 0.5)
    z[tufts] += rng.uniform(0.0, 0.5, int(tufts.sum()))
    xyz = np.column_stack([ground, z + NOISE_M * rng.standard_normal(len(ground))])
    xyz[:, 2] -= 0.3
    wall = rng.uniform((45, 35, 0), (55, 35.3, 1.2), (4000, 3))  # no pipe
    car = np.concatenate([rng.uniform((20, 38, 0.4), (24, 39.7, 1.4), (3000, 3))])
    parts = [xyz, tube(rng, LONG, 0.3, 250), tube(rng, SHORT, 0.5, 250), wall, car]
    folder = tmp_path_factory.mktemp("pipes")
    write_cloud(folder / "c.laz", np.concatenate(parts))
    assert (
        main(["pipes", str(folder / "c.laz"), "-o", str(folder / "p.geojson"), "--json", str(folder / "f.json")]) == 0
    )
    figures: dict[str, Any] = json.loads((folder / "f.json").read_text())
    return folder, figures


def test_both_pipes_are_found_and_nothing_else(made: tuple[Path, dict[str, Any]]) -> None:
    _, figures = made
    assert len(figures["pipes"]) == 2
    lengths = [each["length_m"] for each in figures["pipes"]]
    assert lengths == pytest.approx([50.4, 30.0], abs=1.5)


def test_diameters_are_true_within_their_sigmas(made: tuple[Path, dict[str, Any]]) -> None:
    _, figures = made
    for each, true in zip(figures["pipes"], (0.6, 1.0), strict=True):
        assert each["diameter_m"] == pytest.approx(true, abs=0.015)
        assert abs(each["diameter_m"] - true) < 4.0 * each["diameter_sigma_m"]
        assert each["diameter_sigma_m"] < 0.02


def test_axes_lie_where_the_pipes_do(made: tuple[Path, dict[str, Any]]) -> None:
    folder, _ = made
    _, _, wkb, _ = pyogrio.raw.read(folder / "p.geojson")
    for geometry, true in zip(shapely.from_wkb(wkb), (LONG, SHORT), strict=True):
        places = shapely.get_coordinates(geometry, include_z=True) - [*ORIGIN, 0.0]
        off = shapely.distance(shapely.points(places[:, :2]), shapely.LineString(true[:, :2]))
        assert off.max() < 0.08
        assert np.median(off) < 0.02


def test_cover_and_free_spans_are_told(made: tuple[Path, dict[str, Any]]) -> None:
    _, figures = made
    long, short = figures["pipes"]
    # top of the short one: 1.4 m above the ground
    assert short["cover_m"] == pytest.approx(-1.4, abs=0.05)
    assert short["free_m"] == pytest.approx(30.0, abs=2.0)
    assert long["stations"][2]["cover_m"] == pytest.approx(-0.65, abs=0.06)
    assert long["cover_least_m"] == pytest.approx(-1.45, abs=0.1)
    assert 8.0 < long["free_m"] < 19.0


def test_sigmas_of_a_cylinder_cover_its_errors() -> None:
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(40):
        line = np.array([[0, 0, 0.0], [3.0, 0.4, 0.1]])
        found = cylinder(tube(rng, line, 0.25, 150, 150.0), np.array([1.0, 0.0, 0.0]))
        assert found is not None
        errors.append((found.radius_m - 0.25) / found.sigma_radius_m)
    assert 0.6 < np.std(errors) < 1.6
    assert np.mean(np.abs(errors) < 2.0) > 0.85


def test_a_cloud_without_pipes_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    write_cloud(tmp_path / "c.laz", np.column_stack([rng.uniform(0, 30, (20_000, 2)), np.zeros(20_000)]))
    assert main(["pipes", str(tmp_path / "c.laz"), "-o", str(tmp_path / "p.geojson")]) == 0
    assert "no pipe was found" in capsys.readouterr().err
    words = ["pipes", str(tmp_path / "c.laz"), "-o", str(tmp_path / "q.geojson"), "--min-length", "0"]
    assert main(words) == 2
    assert "expected 2 m or more" in capsys.readouterr().err
