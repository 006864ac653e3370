"""A block that falls apart is refused with the names of what is loose."""

import json
from pathlib import Path

import numpy as np
import pytest

from flightlog.errors import CoverageError
from groundproc.cli import main
from groundproc.imagery.bundle.block import Block, Stations, image_points
from groundproc.imagery.bundle.covariance import LooseError, _undetermined, cofactors
from groundproc.imagery.bundle.solve import Solved
from groundproc.imagery.bundle.unknowns import OF_CAMERA, Unknowns, lay_out
from groundproc.imagery.camera import Camera
from groundproc.imagery.poses import NO_TIME, ImagePoses, write_poses
from groundproc.imagery.rig import Rig, RigCamera, write_rig
from groundproc.imagery.rotations import STRAIGHT_DOWN

MIDDLE_PX = (319.5, 239.5)


def block_of(place_m: np.ndarray, groups: list[tuple[list[int], np.ndarray]], estimate: tuple[str, ...] = ()) -> Block:
    """Pictures straight down at places; each group of them sees its own points."""
    count = len(place_m)
    image = np.concatenate([np.repeat(images, len(points)) for images, points in groups])
    first = np.cumsum([0, *(len(points) for _, points in groups)])
    point = np.concatenate(
        [np.tile(first[n] + np.arange(len(points)), len(images)) for n, (images, points) in enumerate(groups)]
    )
    points_m = np.concatenate([points for _, points in groups])
    ray = points_m[point] - place_m[image]
    pixel = np.array(MIDDLE_PX) + 500.0 * np.array([1.0, -1.0]) * ray[:, :2] / -ray[:, 2:]
    camera = RigCamera("camera", Camera(640, 480, 500.0, MIDDLE_PX), STRAIGHT_DOWN, estimate=estimate)
    still = np.zeros((count, 3))
    stations = Stations(
        np.arange(count), place_m, np.tile(np.eye(3), (count, 1, 1)), still, still, np.zeros(count, np.int64)
    )
    return Block(
        Rig((camera,)), tuple(f"{n}.jpg" for n in range(count)), np.zeros(count, np.int64), np.arange(count), stations, points_m,
        image_points(image, point, pixel, np.full(len(image), 0.3)), mounting=((),),
    )  # fmt: skip


def refused(block: Block) -> str:
    with pytest.raises(CoverageError) as caught:
        cofactors(Solved(block, lay_out(block), block.rig.cameras, 0.0, 0, True))
    return str(caught.value)


def ground(rng: np.random.Generator, x_m: float) -> np.ndarray:
    return np.column_stack(
        [rng.uniform(x_m - 3.0, x_m + 7.0, 30), rng.uniform(-4.0, 4.0, 30), rng.uniform(0.0, 3.0, 30)]
    )


def test_pictures_that_share_no_point_with_the_others_are_named() -> None:
    rng = np.random.default_rng(4)
    place_m = np.array([[0.0, 0, 20], [3, 0.5, 21], [40, 0, 20], [43, 1, 19], [46, 0, 20]])
    told = refused(block_of(place_m, [([0, 1], ground(rng, 0.0)), ([2, 3, 4], ground(rng, 40.0))]))
    assert "0.jpg, 1.jpg and the others are not held together" in told


def test_a_value_of_the_lens_that_nothing_tells_is_named() -> None:
    """All at one height over a plane, and no place known: a longer lens is a greater height."""
    rng = np.random.default_rng(5)
    place_m = np.array([[0.0, 0, 20], [3, 0, 20], [6, 0, 20]])
    flat = ground(rng, 2.0) * [1.0, 1.0, 0.0]
    told = refused(block_of(place_m, [([0, 1, 2], flat)], ("f", "aspect")))
    assert "nothing tells" in told
    assert "of camera; leave it out of the rig's estimate" in told


def test_images_that_nothing_holds_are_left_out_and_the_rest_goes_on(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    place_m = np.array([[0.0, 0, 20], [3, 0.5, 21], [40, 0, 20], [43, 1, 19], [46, 0, 20], [44, 3, 20]])
    block = block_of(place_m, [([0, 1], ground(rng, 0.0)), ([2, 3, 4, 5], ground(rng, 42.0))])
    corner = np.array([500_000.0, 5_500_000.0, 100.0])
    unknown = np.full((6, 3), np.nan)
    stamps = np.full(6, NO_TIME)
    write_poses(
        tmp_path / "start.csv", ImagePoses(block.images, stamps, place_m + corner, np.zeros((6, 3)), unknown, unknown)
    )
    write_rig(tmp_path / "rig.yaml", block.rig)
    shown = block.measured.pixel + rng.normal(0.0, 0.3, block.measured.pixel.shape)
    rows = [
        f"{block.images[image]},p{point},{x:.3f},{y:.3f},0.3"
        for image, point, (x, y) in zip(block.measured.image, block.measured.point, shown, strict=True)
    ]
    (tmp_path / "points.csv").write_text("\n".join(["image,point,x_px,y_px,sigma", *rows]))
    words = [
        f"--{key}={tmp_path / file}"
        for key, file in (("image-points", "points.csv"), ("rig", "rig.yaml"), ("start", "start.csv"))
    ]
    assert main(["images", *words, "--crs", "EPSG:32633", "-o", str(tmp_path / "out")]) == 3
    told = json.loads((tmp_path / "out" / "bundle.json").read_text())
    assert told["left_out"] == dict.fromkeys(
        ("0.jpg", "1.jpg"), "nothing holds it to the others: too few points, or all from one place"
    )
    assert told["counts"]["images"] == 4
    assert 0.7 < told["sigma0"] < 1.3


def test_a_block_that_moves_as_one_names_no_image() -> None:
    """Else it would be tried again without any image less, for ever."""
    place_m = np.array([[0.0, 0, 20], [3, 0.5, 21], [6, 0, 20]])
    block = block_of(place_m, [([0, 1, 2], ground(np.random.default_rng(7), 2.0))])
    every = Unknowns(np.arange(18).reshape(3, 6), np.full((1, OF_CAMERA), -1), 18, "observed")
    solved = Solved(block, every, block.rig.cameras, 0.0, 0, True)
    found = _undetermined(solved, np.eye(18) - np.full((18, 18), 1.0 / 18.0))
    assert not isinstance(found, LooseError)
    assert "all of it can be moved" in str(found)
