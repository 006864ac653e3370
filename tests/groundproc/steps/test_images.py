"""Photographs as steps of a flight: adjusted, laid on its cloud, told of, and done again only where needed."""

import json
import shutil
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import photographed
import pytest
import rasterio

from groundproc.cli import main
from groundproc.steps.ledger import INSIDE

COMPLETE = (0, 3)
WORDS = ("--method", "ins", "--products", "cloud.laz,report.html", "--ortho-gsd-m", "0.1", "--max-range", "12")


def process(log: Path, place: Path, out: Path, *words: str) -> int:
    given = ["--images", str(place / "images"), "--rig", str(place / "rig.yaml")]
    given += ["--image-times", str(place / "times.csv")]
    return main(["process", str(log), *WORDS, *given, *words, "-o", str(out)])


def finished(folder: Path) -> dict[str, str]:
    tree = json.loads((folder / INSIDE / "ledger.json").read_text())
    return {name: entry["finished"] for name, entry in tree["steps"].items()}


@pytest.fixture(scope="module")
def place(gps_flight: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photographed")
    # a line of 28 m at 10 m, each place in three pictures
    names = photographed.write_photographs(folder / "images", gps_flight.poses, (6.0, 14.0), 1.0, 3)
    assert len(names) == 8
    return folder


@pytest.fixture(scope="module")
def made(place: Path, gps_flight: Any) -> Path:
    assert process(gps_flight.log, place, place / "out") in COMPLETE
    return place / "out"


def test_every_step_leaves_what_it_is_for(made: Path) -> None:
    for name in ("block/poses.csv", "block/rig.yaml", "cloud_colour.laz", "ortho.tif", "ortho_images.tif"):
        assert (made / name).is_file(), name
    assert (made / "overlays" / "cam0.png").is_file()
    before, after = laspy.read(made / "cloud.laz"), laspy.read(made / "cloud_colour.laz")
    assert (np.asarray(before.X) == np.asarray(after.X)).all()
    seen = np.asarray(after.views) > 0
    assert 0.2 < seen.mean() < 1.0
    with rasterio.open(made / "ortho.tif") as file:
        assert file.count == 3
        assert (file.read() > 0).any()


def test_quality_and_report_tell_of_them(made: Path) -> None:
    told = json.loads((made / "quality.json").read_text())["images"]
    assert told["images"]["counts"]["images"] == 8
    assert told["images"]["residual_rms_px"] < 1.0
    assert set(told["colour"]["held_out"]) == {"red", "green", "blue"}
    assert told["colour"]["held_out_images"]
    assert told["ndvi"] == {"left_out": "no camera has band nir or red"}
    page = (made / "report.html").read_text()
    assert 'id="images"' in page
    assert page.count("data:image/jpeg") == 2
    assert "Held out" in page


def test_the_ground_has_the_colours_that_were_painted(made: Path) -> None:
    """Neighbours of a point share its place in any frame: the pattern's tint runs over metres and does not mind where exactly."""
    told = json.loads((made / "quality.json").read_text())["images"]["colour"]
    # the pattern's finest noise is 0.09 rms of the full scale at 16 cm: a pixel of 2.5 cm off would cost a sixth of that
    assert max(told["held_out"].values()) < 5.0


def test_only_what_looks_at_it_is_done_again(made: Path, place: Path, gps_flight: Any, tmp_path: Path) -> None:
    out = Path(shutil.copytree(made, tmp_path / "out"))
    before = finished(out)
    assert process(gps_flight.log, place, out) in COMPLETE
    assert finished(out) == before
    assert process(gps_flight.log, place, out, "--ortho-gsd-m", "0.2") in COMPLETE
    after = finished(out)
    changed = {name.partition(": ")[0] for name in after if after[name] != before[name]}
    assert changed == {"ortho", "ndvi", "quality", "products"}


def test_without_images_what_came_of_them_goes(made: Path, gps_flight: Any, tmp_path: Path) -> None:
    out = Path(shutil.copytree(made, tmp_path / "out"))
    assert main(["process", str(gps_flight.log), *WORDS[:4], "-o", str(out)]) in COMPLETE
    assert not (out / "cloud_colour.laz").exists()
    assert not (out / "block" / "poses.csv").exists()
    assert "images" not in json.loads((out / "quality.json").read_text())


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--rig", "rig.yaml"), "rig: rig.yaml given, but no images; expected with images: DIR"),
        (("--images", "nowhere"), "nowhere: no such file; expected images or folders of them"),
        (("--images", "{place}", "--products", "density.tif"), "images: they are laid on the points"),
    ],
)
def test_what_cannot_be_is_refused_before_the_work(
    words: tuple[str, ...],
    sentence: str,
    place: Path,
    gps_flight: Any,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    given = [word.format(place=place / "images") for word in words]
    assert main(["process", str(gps_flight.log), *given, "-o", str(tmp_path / "out")]) in (1, 2)
    told = capsys.readouterr().err
    assert sentence in told
    assert told.count("\n") == 1
    assert not (tmp_path / "out").exists()
