"""Clouds to look at."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from groundproc.cloud import exports, reader
from groundproc.cloud.points import Points
from groundproc.cloud.writer import CloudWriter
from groundproc.geodesy import projected_crs

ORIGIN_M = np.array([533_000.0, 6_472_000.0, 60.0])


def ground(count: int, seed: int = 4) -> Points:
    """Level ground of 80 x 60 m with a house on it, denser in one corner."""
    rng = np.random.default_rng(seed)
    place = rng.uniform([0, 0, 0], [80, 60, 0.02], (count, 3))
    place[: count // 3, :2] *= 0.3
    house = (abs(place[:, 0] - 50) < 6) & (abs(place[:, 1] - 30) < 5)
    place[house, 2] += 7.0
    columns: dict[str, Any] = {
        "intensity": rng.integers(0, 256, count).astype(np.uint16),
        "classification": np.where(house, 6, 2).astype(np.uint8),
        "point_source_id": (1 + (place[:, 0] > 40)).astype(np.uint16),
        "range": rng.uniform(5, 60, count).astype(np.float32),
    }
    return Points(1_779_272_223_000_000_000 + np.arange(count) * 10**5, ORIGIN_M + place, columns)


@pytest.fixture(scope="session")
def clouds(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], tuple[Path, Path]]:
    """A function that gives LAZ and COPC of so many points."""
    made: dict[int, tuple[Path, Path]] = {}

    def get(count: int) -> tuple[Path, Path]:
        if count not in made:
            folder = tmp_path_factory.mktemp("clouds")
            plain, octree = folder / "cloud.laz", folder / "cloud.copc.laz"
            points = ground(count)
            with CloudWriter(
                plain, points.columns, crs=projected_crs(32633), offset_m=(533_000.0, 6_472_000.0, 0.0)
            ) as writer:
                writer.write(points)
            exports.write(reader.look(plain), octree, octree, lambda done: None)
            made[count] = plain, octree
        return made[count]

    return get
