"""Wires in clouds of hundreds of returns on a square metre, as a slow drone over a village leaves them."""

import json
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest

from groundproc.analysis.corridor.spans import conductors
from groundproc.analysis.corridor.strips import fences
from groundproc.cli import main


def hanging(start: float, end: float, sag: float, rng: np.random.Generator, spacing: float) -> np.ndarray:
    """Points of a wire along x that hangs between two poles, 2 cm of noise, shape (n, 3)."""
    x = rng.uniform(start, end, int((end - start) / spacing))
    u = (x - start) / (end - start)
    return np.column_stack([x, np.full(len(x), 5.0), 8.0 - 4 * sag * u * (1 - u)]) + rng.normal(0, 0.02, (len(x), 3))


@pytest.mark.parametrize("seed", [2, 5, 30])
def test_spans_that_no_pole_was_seen_between_are_one_wire_each(seed: int) -> None:
    """Through the lowest parts of neighbouring spans goes a wide curve that most of their points lie near."""
    rng = np.random.default_rng(seed)
    spans = ((-3.9, 33.6), (33.6, 71.1), (71.1, 108.6))
    chain = np.concatenate([hanging(*ends, 0.7, rng, 0.13) for ends in spans])
    chain = chain[(chain[:, 0] > 0.0) & (chain[:, 0] < 85.4)]
    found = sorted((min(ends), max(ends)) for ends in (
        [wire.origin_m[0] + s * wire.along[0] for s in (wire.start_m, wire.end_m)] for wire in conductors([chain])
    ))  # fmt: skip
    assert np.array(found) == pytest.approx(np.array([[0.0, 33.6], [33.6, 71.1], [71.1, 85.4]]), abs=3.0)


def test_stripes_of_a_roof_are_no_wires(tmp_path: Path) -> None:
    """Of a steep roof with 800 returns on a square metre one of each voxel is looked at: they lie on level lines, one above the other."""
    rng = np.random.default_rng(5)
    u, v = rng.uniform(0, 18, 90_000), rng.uniform(0, 7, 90_000)
    thinner = rng.uniform(0, 1, 90_000) < np.clip(1.3 - v / 7, 0.1, 1.0)
    roof = np.column_stack([u, 5.0 + v * np.cos(0.55), 6.0 + v * np.sin(0.55)])[thinner]
    roof += rng.normal(0, 0.015, roof.shape)
    ground = np.column_stack([rng.uniform(-10, 30, 60_000), rng.uniform(-10, 20, 60_000), rng.normal(0, 0.02, 60_000)])
    wire = hanging(-10.0, 30.0, 0.7, rng, 0.05) + np.array([0.0, -8.0, 1.0])
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, [533_000.0, 6_472_000.0, 0.0]
    header.add_crs(pyproj.CRS.from_epsg(32633))
    las = laspy.LasData(header)
    las.x, las.y, las.z = (np.concatenate([roof, ground, wire]) + header.offsets).T
    las.write(tmp_path / "c.laz")
    assert main(["wires", str(tmp_path / "c.laz"), "-o", str(tmp_path / "w.geojson")]) == 0
    lines = json.loads((tmp_path / "w.geojson").read_text())["features"]
    assert [each["properties"]["kind"] for each in lines] == ["conductor"]


def test_a_fence_of_many_thousand_returns_on_a_metre_is_one_line() -> None:
    """Of their pairs alone, 40,000 million, no memory would hold the numbers."""
    rng = np.random.default_rng(7)
    x, up = rng.uniform(0, 14, 280_000), rng.uniform(0.3, 1.5, 280_000)
    places = np.column_stack([x, 3.0 + rng.normal(0, 0.02, len(x)), up])
    low = np.hstack([places, np.tile([1.0, 0.0, 0.0], (len(x), 1)), up[:, None]])
    (line,) = fences(low)
    ends = np.array(line.coords)[[0, -1], 0]
    assert sorted(ends) == pytest.approx([0.5, 13.5], abs=0.1)
