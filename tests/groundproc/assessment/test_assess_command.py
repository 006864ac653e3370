"""`swath assess`: published figures, a survey with check points, and surfaces of which the truth is known."""

import json
import math
import os
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

from groundproc.assessment.figures import figures
from groundproc.cli import main

recordings = os.environ.get("SWATH_RECORDINGS")
with_recordings = pytest.mark.skipif(not recordings, reason="SWATH_RECORDINGS is not set")


def written(path: Path, xyz: np.ndarray) -> Path:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, np.floor(xyz.min(axis=0))
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.write(path)
    return path


def points(path: Path, rows: list[tuple[Any, ...]], head: str = "id,x,y,z") -> Path:
    path.write_text("\n".join([head, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def assessed(tmp_path: Path, *words: str | Path) -> dict[str, Any]:
    told = tmp_path / "told.json"
    assert main(["assess", *map(str, words), "--json", str(told), "--force"]) == 0
    found: dict[str, Any] = json.loads(told.read_text())
    return found


@with_recordings
def test_pairs_give_the_published_mean_absolute_errors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nagai et al., table 3: 0.325, 0.306, 0.115 m."""
    told = assessed(tmp_path, "--pairs", Path(str(recordings)) / "tables/nagai_table3.csv")
    assert told["mean_abs"] == pytest.approx([0.3252, 0.3060, 0.1154], abs=5e-5)
    assert len(told["points"]) == 10
    assert "0.3252" in capsys.readouterr().out


@with_recordings
def test_a_surveyed_marsh_is_judged_as_its_reference_states(tmp_path: Path) -> None:
    """USGS 2025-009-FA: 101 of 104 points have ground; RMSE 2.8, mean -0.2, largest 8.2 cm by the mean of 0.5 m cells."""
    folder = Path(str(recordings)) / "assess"
    xyz = np.fromfile(folder / "marsh_island_ground.f32", "<f4").reshape(-1, 3).astype(float)
    origin = np.array([340_303.0, 4_612_812.0, 0.0])
    checks = json.loads((folder / "marsh_island_checkpoints.json").read_text())["checkpoints"]
    cloud = written(tmp_path / "marsh.laz", xyz + origin)
    csv = points(tmp_path / "p.csv", [(c["id"], c["e"] + origin[0], c["n"] + origin[1], c["z"]) for c in checks])
    told = assessed(tmp_path, cloud, "--points", csv)
    assert told["count"][2] == 101
    assert len(told["unmatched"]) == 3
    assert told["rmse"][2] <= 0.0290
    assert told["mean"][2] == pytest.approx(-0.002, abs=0.001)
    assert told["up"]["asprs_2024_class_cm"] == 3
    # 76 have a point within 5 cm, which says how dense the cloud is; of its accuracy in plan it says nothing
    assert told["count"][0] == 76
    assert told["plan"] is None
    alone = assessed(tmp_path, cloud, "--points", csv, "--mode", "plane")
    assert alone["rmse"] == [None, None, told["rmse"][2]]


def slope(count: int = 20_000, seed: int = 1) -> np.ndarray:
    """A slope of 30 % with 1 cm of noise, and a few points high above it."""
    rng = np.random.default_rng(seed)
    xyz = np.column_stack([rng.uniform(0, 20, count), rng.uniform(0, 20, count), np.zeros(count)])
    xyz[:, 2] = 10.0 + 0.3 * xyz[:, 0] + rng.normal(0, 0.01, count)
    xyz[::10, 2] += rng.uniform(0.3, 3.0, len(xyz[::10]))
    return xyz


def test_heights_on_a_slope_under_plants_are_those_of_the_slope(tmp_path: Path) -> None:
    cloud = written(tmp_path / "c.laz", slope())
    rng = np.random.default_rng(2)
    places = rng.uniform(2, 18, (40, 2))
    csv = points(tmp_path / "p.csv", [(n, x, y, 10.0 + 0.3 * x - 0.05) for n, (x, y) in enumerate(places)])
    told = assessed(tmp_path, cloud, "--points", csv, "--mode", "plane")
    assert told["mean"][2] == pytest.approx(0.05, abs=0.002)
    errors = np.array([each["dz"] - 0.05 for each in told["points"]])
    sigmas = np.array([each["sigma_m"] for each in told["points"]])
    # some ten points of 1 cm to a plane: 3 mm; the sigma is estimated from few residuals
    assert np.sqrt(np.mean(errors**2)) < 0.008
    assert np.mean(np.abs(errors) <= 3.0 * sigmas) > 0.9


def test_points_beyond_the_cloud_or_at_its_edge_are_named_and_not_compared(tmp_path: Path) -> None:
    cloud = written(tmp_path / "c.laz", slope())
    csv = points(
        tmp_path / "p.csv", [("in", 10, 10, 13), ("far", 40, 10, 13), ("edge", 20.4, 10, 16.1), ("near", 5, 5, 11.5)]
    )
    told = assessed(tmp_path, cloud, "--points", csv)
    assert [each["id"] for each in told["points"]] == ["in", "near"]
    reasons = {each["id"]: each["reason"] for each in told["unmatched"]}
    assert reasons["far"] == "no point within 1 m"
    assert "lie to one side" in reasons["edge"]


def test_nearest_points_are_compared_on_all_axes(tmp_path: Path) -> None:
    xyz = np.array([[1.0, 2.0, 3.0], [5.0, 5.0, 5.0]])
    cloud = written(tmp_path / "c.laz", xyz)
    csv = points(tmp_path / "p.csv", [("a", 0.9, 2.2, 3.05)], "Name,Easting,Northing,Height")
    told = assessed(tmp_path, cloud, "--points", csv, "--mode", "point")
    only = told["points"][0]
    assert (only["dx"], only["dy"], only["dz"], only["mode"]) == pytest.approx((0.1, -0.2, -0.05, "point"))


def test_figures_are_those_of_their_definitions() -> None:
    d = np.random.default_rng(5).normal([0.01, -0.02, 0.03], [0.05, 0.06, 0.1], (200_000, 3))
    told = figures(d)
    assert told["mean"] == pytest.approx([0.01, -0.02, 0.03], abs=1e-3)
    assert told["rmse"][0] == pytest.approx(math.hypot(0.01, 0.05), rel=0.01)
    zero = figures(np.random.default_rng(6).normal(0, 0.1, (200_000, 3)))
    # the limits that follow from RMSE are the quantiles, where errors are normal and alike in x and y
    plan = np.hypot(*np.random.default_rng(6).normal(0, 0.1, (200_000, 3)).T[:2])
    assert zero["plan"]["ce90_m"] == pytest.approx(np.percentile(plan, 90), rel=0.01)
    assert zero["plan"]["ce95_m"] == pytest.approx(np.percentile(plan, 95), rel=0.01)
    assert zero["up"]["le95_m"] == pytest.approx(zero["p95_abs"][2], rel=0.01)
    assert zero["up"]["asprs_2024_class_cm"] in (10, 11)
    few = figures(d[:12])
    assert few["up"]["asprs_2024_class_cm"] is None
    assert few["up"]["asprs_2024_points_missing"] == 18


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["c.laz"], "expected swath assess CLOUD --points"),
        (["--pairs", "p.csv", "c.laz"], "expected swath assess"),
        (["c.laz", "--points", "p.csv"], "same CRS"),
        (["c.laz", "--points", "comma.csv"], "decimal point"),
        (["c.laz", "--points", "twice.csv"], "stands there twice"),
        (["c.laz", "--points", "short.csv"], "no column z"),
        (["c.laz", "--points", "none.csv"], "none.csv"),
        (["p.csv", "--points", "p.csv"], "p.csv"),
        (["--pairs", "p.csv"], "7 names"),
        (["--pairs", "bad.csv"], "six numbers"),
    ],
)
def test_what_cannot_be_compared_is_one_sentence(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "c.laz", slope(100))
    points(tmp_path / "p.csv", [("a", 5e5, 6e6, 1)])
    points(tmp_path / "comma.csv", [("a", '"5,1"', 3, 1)])
    points(tmp_path / "twice.csv", [("a", 1, 3, 1), ("a", 1, 3, 1)])
    points(tmp_path / "short.csv", [("a", 1, 3)], "id,x,y")
    points(tmp_path / "bad.csv", [("a", 1, 3, 1, 1, 1, "nan")], "id,x,y,z,x,y,z")
    assert main(["assess", *words]) in (1, 2)
    told = capsys.readouterr().err
    assert said in told
    assert told.count("\n") == 1
