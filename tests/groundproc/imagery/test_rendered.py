"""From a flight log and its photographs to poses: rendered pictures, SIFT, exposures noted by the autopilot, RTK, no control."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from groundproc.cli import main
from groundproc.imagery.painting import block as painted
from simulator import cameras, plans
from simulator.render import render
from simulator.simulation import Job

# 44 s of photographs are drawn and matched; in the quick suite: photographs of a plane, as steps of a flight (steps/test_images)
pytestmark = pytest.mark.soak

GSD_M = 32.0 / 312.5


@pytest.fixture(scope="module")
def adjusted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("flown")
    plan = plans.plan("block")
    options = replace(plan.options, lidar=replace(plan.options.lidar, dark=True))
    render(Job(plan.scene, 44.0, 2, folder, options, 2, cameras=cameras.rig("small")))
    images = folder / "images"
    words = ["--rig", images / "rig.yaml", "--positions", folder / "rtk.pos", "--geoid", "29.354"]
    words += ["--marks", images / "marks.csv", "--control", images / "control.csv", "-o", folder / "out"]
    assert main(["images", str(folder / "flight.mcap"), str(images), *map(str, words)]) in (0, 3)
    return images, folder / "out"


def test_every_image_finds_its_place_without_control(adjusted: tuple[Path, Path]) -> None:
    images, out = adjusted
    told = json.loads((out / "bundle.json").read_text())
    assert told["counts"]["images"] == len(list(images.glob("*.jpg")))
    assert not told["left_out"]
    assert "CAMERA_FEEDBACK" in told["times"]["note"]
    assert told["times"]["utc_minus_exif_s"] == pytest.approx(-0.05, abs=1e-3)
    assert 0.9 < told["sigma0"] < 1.1
    assert [one["accepted"] for one in told["held_out"]] == [True, True]
    errors = np.array([[one["dx"], one["dy"], one["dz"]] for one in told["check"]])
    rms = np.sqrt(np.mean(errors**2, axis=0))
    # two strips of pixels of 10 cm: well below a pixel in plan; in height a base of a third of the distance
    assert len(errors) >= 15
    assert max(rms[:2]) < 0.7 * GSD_M
    assert rms[2] < 2.0 * GSD_M


def test_poses_are_those_of_the_truth(adjusted: tuple[Path, Path]) -> None:
    images, out = adjusted
    found, truth = (
        {row["image"]: row for row in csv.DictReader(path.read_text().splitlines())}
        for path in (out / "poses.csv", images / "truth" / "poses.csv")
    )
    for name, row in found.items():
        place = [float(row[key]) - float(truth[name][key]) for key in ("easting", "northing", "height")]
        turn = [float(row[key]) - float(truth[name][key]) for key in ("omega_deg", "phi_deg", "kappa_deg")]
        assert np.abs(place).max() < 0.15, name
        assert np.abs((np.array(turn) + 180.0) % 360.0 - 180.0).max() < 0.4, name


def test_pictures_are_found_again_by_what_paints_clouds(adjusted: tuple[Path, Path]) -> None:
    images, out = adjusted
    assert painted._found_before(out) == [Path(json.loads((out / "bundle.json").read_text())["images_folder"])]
    assert painted._found_before(out)[0].samefile(images)
