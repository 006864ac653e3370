"""A cloud in squares and tiles: every point once, and none of a picture lost with a tile."""

import errno
import os
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import rendered

from flightlog.errors import SourceError
from groundproc.cloud import reader
from groundproc.imagery.painting.block import half_angle_rad, load
from groundproc.imagery.painting.scene import Scene, localised, mapped, side_by_side, towards
from groundproc.imagery.painting.visibility import project
from groundproc.imagery.site import cartesian

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    folder = tmp_path_factory.mktemp("scene")
    rendered.write_cloud(folder / "cloud.laz", rendered.points(20.0, 1)[0], epsg=None)
    cloud = reader.look(folder / "cloud.laz")
    return Scene(cloud, cartesian(np.zeros((1, 3))), folder, lambda _: None)


def test_every_point_is_in_one_tile_and_tiles_follow_each_other(scene: Scene) -> None:
    assert np.array_equal(np.sort(scene.number), np.arange(scene.size))
    for square in scene.squares:
        tiles, xyz = square.tiles, scene.xyz_m[square.points]
        assert tiles.first[0] == 0
        assert tiles.first[-1] == len(xyz)
        assert (np.diff(tiles.first) > 0).all()
        of = np.repeat(np.arange(len(tiles.radius_m)), np.diff(tiles.first))
        assert (np.linalg.norm(xyz - tiles.centre_m[of], axis=1) < tiles.radius_m[of] + 1e-4).all()
        assert tiles.radius_m.max() < 0.5 * np.linalg.norm([4.0, 4.0, 8.2]) + 0.1


def test_no_point_of_a_picture_is_lost_with_its_tile(scene: Scene, tmp_path: Path) -> None:
    taken = rendered.shots()[::5]
    rendered.write_block(tmp_path, taken, epsg=None)
    block = load(tmp_path, None, None, tmp_path / "cloud.laz")
    angle, skipped = half_angle_rad(rendered.CAMERA), 0
    for image in block.layers[0].images:
        near = towards(scene.squares, image.eye.place_m, image.axis, angle)
        for square in scene.squares:
            eye = image.eye._replace(place_m=image.eye.place_m - square.centre_m)
            every = project(eye, scene.xyz_m[square.points])
            spans = square.spans(image.eye.place_m, image.axis, angle)
            some = project(eye, scene.xyz_m[square.points], spans)
            assert all(np.array_equal(a, b) for a, b in zip(every, some, strict=True))
            assert square in near or not len(every.number)
            skipped += square.points.stop - square.points.start - int(np.diff(spans).sum())
    assert skipped > scene.size


def test_normals_of_a_box_look_outwards(scene: Scene) -> None:
    """But for its edges, where a cell holds two surfaces, and the corners of walls and plain."""
    for square in scene.squares:
        surface = scene.surface(square)
        xyz = surface.xyz_m + square.centre_m
        inner = (np.abs(xyz[:, 1]) < 3.0) & (xyz[:, 2] > 1.0) & (xyz[:, 2] < 7.0)
        for side in (-1.0, 1.0):
            wall = inner & (np.abs(xyz[:, 0] - 5.0 * side) < 0.05)
            assert (surface.normal[wall, 0] * side > 0.95).mean() > 0.97 if wall.any() else True


def test_a_polynomial_stands_for_the_map_over_a_square() -> None:
    site, rng = cartesian(np.zeros((1, 3))), np.random.default_rng(1)
    places = rng.uniform(-30.0, 30.0, (1000, 3)).astype(np.float32)
    corner = np.array([1e3, 2e3, 50.0])
    assert np.allclose(localised(site, corner, places), site.local(corner + places), rtol=0, atol=1e-6)


def test_work_side_by_side_keeps_the_order_and_hands_errors_on() -> None:
    def work(number: int) -> npt.NDArray[np.int64]:
        if number == 7:
            raise ValueError("seven")
        return np.full(3, number)

    assert [int(found[0]) for found in side_by_side(work, range(5))] == [0, 1, 2, 3, 4]
    with pytest.raises(ValueError, match="seven"):
        list(side_by_side(work, range(20)))


@pytest.mark.skipif(
    not hasattr(os, "posix_fallocate"), reason="this system takes room on the disk when it is written to"
)
def test_a_full_disk_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is mapped has its room before it is written to: a hole that finds none would be a signal that kills the process."""
    found = mapped(tmp_path / "here", np.float32, (1000, 100))
    assert (tmp_path / "here.npy").stat().st_blocks * 512 >= found.nbytes

    def full(file: int, begin: int, size: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(SourceError, match=r"no room for temporary files, 40,\d{3} bytes asked for \(No space left"):
        mapped(tmp_path / "there", np.float32, (100, 100))
