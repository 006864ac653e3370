"""Noise and what moved in the cloud: it hides nothing and is painted by nobody, and still goes out as it came in."""

import json
from pathlib import Path

import laspy
import numpy as np
import numpy.typing as npt
import pytest
import rasterio
import rendered

from groundproc.cli import main

pytestmark = pytest.mark.filterwarnings("ignore:Dataset has no geotransform")

KINDS = (7, 18, 69)


def write(path: Path, xyz: npt.NDArray[np.float64], kind: npt.NDArray[np.uint8]) -> None:
    """A cloud without a coordinate system, of classes."""
    las = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    las.header.scales = [0.001] * 3
    las.xyz, las.classification = xyz, kind
    las.write(path)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A box on a plain; then the same among a sheet of noise and movers 12 m up, and some noise on the ground, every third point."""
    folder = tmp_path_factory.mktemp("noise")
    rendered.write_block(folder / "images", rendered.shots()[:12:2], epsg=None)
    rng = np.random.default_rng(2)
    xyz, _ = rendered.points(20.0, 1)
    count = len(xyz) // 2
    noise = np.column_stack([rng.uniform([-25.0, -20.0], [25.0, 20.0], (count, 2)), rng.normal(12.0, 0.05, count)])
    noise[::5, 2] = rng.uniform(-3.0, 0.5, len(noise[::5]))
    kinds = np.concatenate([np.full(len(xyz), 2, np.uint8), rng.choice(np.array(KINDS, np.uint8), count)])
    order = rng.permutation(len(xyz) + count)
    every = np.concatenate([xyz, noise])[order]
    write(folder / "plain.laz", every[kinds[order] == 2], np.full(len(xyz), 2, np.uint8))
    write(folder / "noisy.laz", every, kinds[order])
    write(folder / "nothing.laz", noise, np.full(count, 7, np.uint8))
    return folder


def made(place: Path, command: str, cloud: str, out: str, *words: str) -> Path:
    given = [command, str(place / f"{cloud}.laz"), "--images", str(place / "images"), "-o", str(place / out), *words]
    assert main(given) == 0
    return place / out


def test_points_that_stand_have_the_colours_that_they_have_without_it(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = laspy.read(made(place, "colour", "plain", "plain_out.laz"))
    capsys.readouterr()
    noisy = laspy.read(made(place, "colour", "noisy", "noisy_out.laz", "--json", str(place / "told.json")))
    stands = np.asarray(noisy.classification) == 2
    for name in ("X", "Y", "Z", "views", "red", "green", "blue"):
        assert np.array_equal(np.asarray(noisy[name])[stands], np.asarray(plain[name])), name
    assert not np.asarray(noisy.views)[~stands].any()
    assert not np.asarray(noisy.red)[~stands].any()
    told = json.loads((place / "told.json").read_text())
    assert (told["points"], told["no_surface"]) == (len(noisy.X), int((~stands).sum()))
    assert f"{told['no_surface']:,} are noise or moved, and have no colour" in capsys.readouterr().out


def test_who_asks_for_all_classes_gets_them(place: Path) -> None:
    """The sheet then hides half and more of the ground, and is painted with it."""
    every = laspy.read(made(place, "colour", "noisy", "every.laz", "--all-classes"))
    stands = np.asarray(every.classification) == 2
    views = np.asarray(every.views)
    assert (views[~stands] > 0).mean() > 0.5
    assert views[stands].mean() < 0.5 * np.asarray(laspy.read(place / "plain_out.laz").views).mean()


def test_mosaics_and_meshes_are_those_without_it(place: Path) -> None:
    told = {}
    for cloud in ("plain", "noisy"):
        made(place, "ortho", cloud, f"{cloud}.tif", "--gsd", "0.4")
        made(place, "mesh", cloud, f"{cloud}.glb", "--json", str(place / f"{cloud}.json"))
        told[cloud] = json.loads((place / f"{cloud}.json").read_text())
    for suffix in ("", "_images"):
        with rasterio.open(place / f"plain{suffix}.tif") as one, rasterio.open(place / f"noisy{suffix}.tif") as other:
            assert np.array_equal(one.read(), other.read())
    assert told["plain"] == told["noisy"]
    assert (place / "plain.glb").read_bytes() == (place / "noisy.glb").read_bytes()


def test_a_cloud_of_noise_alone_is_refused_in_one_sentence(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ["--images", str(place / "images"), "-o", str(place / "none.laz")]
    assert main(["colour", str(place / "nothing.laz"), *given]) == 1
    told = capsys.readouterr().err
    assert "has noise and what moved only (classes 7, 18 and 69)" in told
    assert told.count("\n") == 1
    assert not (place / "none.laz").exists()
