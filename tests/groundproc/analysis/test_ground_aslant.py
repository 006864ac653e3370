"""The floor of a corridor that runs aslant: only what holds points is work."""

from pathlib import Path

import numpy as np
import pytest

from groundproc.analysis.terrain import floor as module
from groundproc.analysis.terrain.filter import Bare, bare_ground
from groundproc.analysis.terrain.floor import Floor
from groundproc.analysis.terrain.settings import Settings
from groundproc.analysis.terrain.surfaces import BLOCK
from groundproc.cloud import reader
from groundproc.cloud.classes import GROUND
from tests.groundproc.analysis.test_ground_command import write_cloud


def test_the_ground_is_looked_for_where_points_are_and_a_stray_is_hardly_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes = []

    def measured(lowest_m: np.ndarray, settings: Settings) -> Bare:
        sizes.append(lowest_m.size)
        return bare_ground(lowest_m, settings)

    monkeypatch.setattr(module, "bare_ground", measured)
    rng = np.random.default_rng(1)
    along, across = rng.uniform(0, 1300, 90_000), rng.uniform(-8, 8, 90_000)
    way = np.deg2rad(20.0)
    x, y = along * np.cos(way) - across * np.sin(way), along * np.sin(way) + across * np.cos(way)
    line = np.column_stack([x + 50.0, y + 50.0, 0.05 * x + rng.normal(0, 0.02, len(x))])
    stray = np.array([[1200.0, 3600.0, 30.0]])
    cloud = reader.look(write_cloud(tmp_path / "c.laz", np.concatenate([line, stray])))
    floor = Floor(cloud, tmp_path, lambda count: None)
    assert min(sizes) < 1000
    assert max(sizes) < 0.7 * (BLOCK + 2 * 132 / floor.settings.cell_m) ** 2
    for _, xyz, noise in floor.pieces():
        above, kind = floor.heights(xyz, noise)
        assert np.isfinite(above).all()
        assert (kind[:-1] == GROUND).mean() > 0.99
        # beside what is known, as far as models reach
        beside = floor.above(xyz[:-1] + np.array([0.0, 2.0, 0.0]))
        assert np.isfinite(beside).all()
        assert np.abs(beside).max() < 0.6
