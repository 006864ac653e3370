"""Rasters gathered side by side, against each gathered by itself."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from groundproc.cloud.classes import LOW_NOISE
from groundproc.cloud.points import Points
from groundproc.cloud.selection import SURFACES, Selection
from groundproc.raster import geotiff
from groundproc.raster.kinds import gathering, kind
from groundproc.raster.layers import Layers

SORTS = (("dsm", None), ("hillshade", None), ("density", None), ("intensity", None), ("sigma", None), ("dsm", "sigma"),
         ("dsm", "median"), ("strip-difference", None))  # fmt: skip


def points(count: int, seed: int) -> Points:
    """Points about a place, one in ten noise, of two lines, some without a sigma."""
    rng = np.random.default_rng(seed)
    classes = np.where(rng.uniform(size=count) < 0.1, LOW_NOISE, 1).astype(np.uint8)
    sigma = rng.uniform(0.01, 0.1, count).astype(np.float32)
    sigma[::7] = np.nan
    columns: dict[str, npt.NDArray[Any]] = {
        "intensity": rng.integers(0, 255, count).astype(np.uint8), "classification": classes,
        "sigma_h": sigma, "sigma_v": sigma, "point_source_id": rng.integers(1, 3, count).astype(np.uint16),
    }  # fmt: skip
    return Points(np.arange(count, dtype=np.int64), rng.normal(0.0, [20.0, 30.0, 2.0], (count, 3)), columns)


def values(path: Path) -> npt.NDArray[Any]:
    with geotiff.opened(path) as raster:
        return np.asarray(raster.file.read(1))


@pytest.mark.parametrize("all_classes", [True, False])
def test_rasters_side_by_side_are_what_each_is_by_itself(all_classes: bool, tmp_path: Path) -> None:
    layers, chosen = Layers(), [kind(*sort) for sort in SORTS]
    together = [layers.layer(each, 0.5, tmp_path, all_classes) for each in chosen]
    alone = [gathering(each, 0.5, tmp_path) for each in chosen]
    selection = Selection(() if all_classes else (SURFACES,))
    for seed in range(3):
        some = points(20_000, seed)
        for layer, own in zip(together, alone, strict=True):
            layer.add(some)
            own.add(selection.of(some))
    for sort, layer, own in zip(SORTS, together, alone, strict=True):
        layer.write(tmp_path / "together.tif", None)
        own.write(tmp_path / "alone.tif", None)
        np.testing.assert_array_equal(values(tmp_path / "together.tif"), values(tmp_path / "alone.tif"), str(sort))


def test_a_raster_asked_for_after_points_came_has_none_of_them(tmp_path: Path) -> None:
    layers, some = Layers(), points(1000, 1)
    first = layers.layer(kind("density"), 1.0, tmp_path, True)
    first.add(some)
    second = layers.layer(kind("density"), 1.0, tmp_path, True)
    second.add(some)
    for layer in (first, second):
        layer.write(tmp_path / "density.tif", None)
        assert values(tmp_path / "density.tif").sum() == 1000.0
