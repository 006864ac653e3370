"""A trajectory as lines: read again by GDAL, which knows the formats."""

from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely

from groundproc.geodesy import LocalFrame, Projection, projected_crs
from groundproc.trajectory.trajectory import Trajectory
from groundproc.vectors import tracks

START_NS = 1_779_272_230_000_000_000
FRAME = LocalFrame(58.39, 15.57, 60.0)


def circle() -> Trajectory:
    """A circle of 50 m at 100 Hz, 20 s, with a gap from 8 to 9 s."""
    seconds = np.arange(0.0, 20.0, 0.01)
    seconds = seconds[(seconds < 8.0) | (seconds >= 9.0)]
    turn = seconds * 0.2
    n = len(seconds)
    covered = np.append(np.diff(seconds) < 0.5, False)
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    return Trajectory(
        FRAME, START_NS + np.rint(seconds * 1e9).astype(np.int64),
        np.column_stack([50 * np.cos(turn), 50 * np.sin(turn), 10.0 + 0.1 * seconds]),
        np.column_stack([-10 * np.sin(turn), 10 * np.cos(turn), np.full(n, 0.1)]),
        quat, np.zeros((n, 3)), np.full((n, 3), 0.02), np.full((n, 3), 1e-3), covered,
    )  # fmt: skip


@pytest.mark.parametrize("ending", ["gpkg", "gpx", "kml"])
def test_lines_follow_the_path_and_end_at_its_gap(ending: str, tmp_path: Path) -> None:
    path, trajectory = tmp_path / f"t.{ending}", circle()
    projection = Projection(FRAME, projected_crs(32633))
    if ending == "gpkg":
        tracks.write_gpkg(path, trajectory, projection, projection.crs)
    elif ending == "gpx":
        tracks.write_gpx(path, trajectory)
    else:
        tracks.write_kml(path, trajectory)
    pyogrio.set_gdal_config_options({"GPX_ELE_AS_25D": True})  # GDAL leaves heights out else
    meta, _, wkb, _ = pyogrio.raw.read(path, layer="tracks" if ending == "gpx" else None)
    lines = [part for each in shapely.from_wkb(wkb) for part in shapely.get_parts(each)]
    assert len(lines) == 2
    found = np.concatenate([shapely.get_coordinates(line, include_z=True) for line in lines])
    if ending == "gpkg":
        assert "32633" in meta["crs"]
        expected = projection.exact(trajectory.position_m)
    else:
        latitude, longitude, height = FRAME.to_geodetic(trajectory.position_m)
        expected = np.column_stack([longitude, latitude, height])
    # every vertex is a knot, some 0.2 s of 19 s apart
    digits = {"gpkg": 1e-6, "gpx": 1e-3, "kml": 1e-3}[ending]
    distance = np.abs(found[:, None] - expected[None]).max(axis=2).min(axis=1)
    assert distance.max() <= digits
    assert 95 <= len(found) <= 100
    np.testing.assert_allclose(found[[0, -1]], expected[[0, -1]], rtol=0, atol=digits)
