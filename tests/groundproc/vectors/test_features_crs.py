"""What GeoJSON says of a CRS."""

import json
from pathlib import Path

import numpy as np
import pyproj
import pytest
import shapely

from groundproc.vectors.features import Features, write_features

PLACE = np.array([shapely.Point(533_000.0, 6_472_000.0, 12.0)], object)


def written(path: Path, crs: pyproj.CRS) -> dict[str, object]:
    write_features(path, Features(PLACE, {"n": np.array([1])}, crs), "Point Z", "places")
    tree: dict[str, object] = json.loads(path.read_text())
    return tree


def test_a_crs_with_a_code_is_named(tmp_path: Path) -> None:
    tree = written(tmp_path / "a.geojson", pyproj.CRS.from_epsg(32633))
    assert "EPSG::32633" in json.dumps(tree["crs"])
    assert "533000" in json.dumps(tree["features"])


def test_a_crs_without_a_code_becomes_wgs_84_and_is_not_taken_for_it(tmp_path: Path) -> None:
    own = pyproj.CRS.from_proj4(
        "+proj=tmerc +lat_0=0 +lon_0=15.2 +k=0.99965 +x_0=500123 +y_0=7 +ellps=GRS80 +units=m +no_defs"
    )
    tree = written(tmp_path / "a.geojson", own)
    (feature,) = tree["features"]  # type: ignore[misc, attr-defined]
    lon, lat, height = feature["geometry"]["coordinates"]
    expected = pyproj.Transformer.from_crs(own, 4326, always_xy=True).transform(533_000.0, 6_472_000.0)
    assert (lon, lat) == pytest.approx(expected, abs=1e-8)
    assert height == 12.0
