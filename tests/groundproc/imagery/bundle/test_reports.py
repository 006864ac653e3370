"""Against the reports of an independent adjustment (Damped Bundle Adjustment Toolbox)."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from dbat import numbers, reported, write_roma, write_sxb

from groundproc.cli import main
from groundproc.imagery.rig import read_rig

NAMES = ("omega_deg", "phi_deg", "kappa_deg", "easting", "northing", "height")
SIGMAS = tuple(f"sigma_{name}" for name in NAMES)


def adjusted(folder: Path, *more: str) -> tuple[dict, dict]:  # type: ignore[type-arg]
    words = ["images", "--image-points", str(folder / "points.csv"), "--rig", str(folder / "rig.yaml"), *more]
    assert main([*words, "-o", str(folder / "out")]) in (0, 3)
    told = json.loads((folder / "out" / "bundle.json").read_text())
    with (folder / "out" / "poses.csv").open() as file:
        return told, {row["image"]: row for row in csv.DictReader(file)}


@pytest.mark.parametrize("start", [True, False])
def test_the_aerial_block_has_the_sigma_and_the_poses_of_the_report(
    recordings: Path, tmp_path: Path, start: bool
) -> None:
    data = recordings / "images" / "dbat_sxb"
    write_sxb(data, tmp_path)
    more = ("--start", str(tmp_path / "start.csv")) if start else ()
    told, poses = adjusted(tmp_path, "--control", str(tmp_path / "control.csv"), *more)
    assert round(told["sigma0"], 4) == 1.1786
    assert (told["observations"], told["unknowns"]) == (2434, 1173)
    report = reported(data / "report.txt")
    assert len(report) == 5
    for name, one in report.items():
        values = np.array([float(poses[name][key]) for key in NAMES])
        np.testing.assert_allclose(values[3:], one.values[3:], rtol=0, atol=1e-3)
        np.testing.assert_allclose(values[:3], one.values[:3], rtol=0, atol=1e-5)
        np.testing.assert_allclose([float(poses[name][key]) for key in SIGMAS], one.deviations, rtol=0.01)
    # adjusted minus given, as the report lists them
    check = {one["name"]: [one["dx"], one["dy"], one["dz"]] for one in told["check"]}
    np.testing.assert_allclose(check["351"], [0.167, 0.008, -0.459], rtol=0, atol=6e-4)
    np.testing.assert_allclose(check["410"], [0.096, -0.296, 0.136], rtol=0, atol=6e-4)
    assert len(told["control"]) == 14
    points = np.genfromtxt(tmp_path / "out" / "points.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    sigma = {str(row["id"]): [row["sx"], row["sy"], row["sz"]] for row in points}
    np.testing.assert_allclose(np.linalg.norm(sigma["65265"]), 0.64, rtol=0.01)


# a second adjustment of the block; in the quick suite the one with control (above)
@pytest.mark.soak
def test_the_free_network_has_the_sigma_the_camera_and_the_deviations_of_the_report(
    recordings: Path, tmp_path: Path
) -> None:
    data = recordings / "images" / "dbat_roma"
    write_roma(data, tmp_path)
    told, poses = adjusted(tmp_path, "--start", str(tmp_path / "start.csv"))
    assert abs(told["sigma0"] - 0.582769) < 1e-6
    assert (told["observations"], told["unknowns"]) == (181_122, 79_321)
    camera = read_rig(tmp_path / "out" / "rig.yaml").cameras[0]
    pixel = 36.0 / 5616.0
    values, spread = camera.camera.values(), camera.spread
    assert spread is not None
    for name, unit, value, deviation in (
        ("f", pixel, 24.5425, 0.00254),
        ("pu", pixel, 18.0816, 0.00195),
        ("pv", pixel, 12.0164, 0.00189),
        ("k1", 1.0, 0.000221523, 2.54e-07),
        ("k2", 1.0, -1.86985e-07, 5.85e-10),
    ):
        sigma = spread.sigma(name)
        assert sigma is not None
        np.testing.assert_allclose(values[name] * unit, value, rtol=1e-5)
        np.testing.assert_allclose(sigma * unit, deviation, rtol=0.01)
    names = dict(enumerate(reported(data / "report.txt").items(), 1))
    for number in (2, 8, 19, 40, 60):
        _, one = names[number]
        values_of = np.array([float(poses[str(number)][key]) for key in NAMES])
        np.testing.assert_allclose(values_of, one.values, rtol=0, atol=2e-5)
        stated = np.array([float(poses[str(number)][key]) for key in SIGMAS])
        np.testing.assert_allclose(stated[one.deviations > 0], one.deviations[one.deviations > 0], rtol=0.01)


def test_every_twelfth_point_of_the_free_network_finds_the_camera(recordings: Path, tmp_path: Path) -> None:
    data = recordings / "images" / "dbat_roma"
    write_roma(data, tmp_path, 12)
    told, _ = adjusted(tmp_path, "--start", str(tmp_path / "start.csv"))
    count = (numbers(data / "markpts.txt.gz")[:, 1] % 12 == 0).sum()
    assert told["observations"] == 2 * count
    assert 0.55 < told["sigma0"] < 0.62
    camera = read_rig(tmp_path / "out" / "rig.yaml").cameras[0]
    assert camera.spread is not None
    off = camera.camera.values()["f"] * 36.0 / 5616.0 - 24.5425
    assert abs(off) < 4.0 * camera.spread.matrix[0, 0] ** 0.5 * 36.0 / 5616.0
