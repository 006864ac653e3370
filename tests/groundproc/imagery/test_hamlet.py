"""Colours, mosaics and indices of a hamlet that rays of their own have drawn: eaves, trees, a garden wall, slopes, grid north aside."""

import tempfile
from pathlib import Path

import hamlet
import laspy
import numpy as np
import numpy.typing as npt
import pytest

from groundproc.cli import main
from groundproc.cloud import reader
from groundproc.imagery.painting import block, paint
from groundproc.imagery.painting.scene import Scene

Array = npt.NDArray[np.float64]

SCENE = hamlet.hamlet()
DENSITY = 60.0
SPACING_M = DENSITY**-0.5
DOWN = hamlet.Lens("down", 500, 375, 400.0, "radtan", (-0.1, 0.03, 0.001, -0.0005, 0.0), fall=(-0.35, 0.05))
ASIDE = hamlet.Lens("aside", 400, 300, 320.0)
PIXEL_M = 30.0 / 400.0


def taken() -> list[hamlet.Shot]:
    """Two cameras at nine places, each picture with an exposure of its own."""
    return hamlet.exposed(hamlet.flown([(DOWN, 0.0, 0.0), (ASIDE, 30.0, 0.0)], step=12.0, half=12.0), 0.8, 1.1, 1)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hamlet")
    rng = np.random.default_rng(4)
    true, kind = SCENE.sampled(DENSITY, rng)
    hamlet.write_cloud(folder / "cloud.laz", true + rng.normal(0.0, 0.015, true.shape))
    np.savez(folder / "truth.npz", true=true, kind=kind)
    hamlet.write_block(folder / "images", SCENE, taken())
    return folder


@pytest.fixture(scope="module")
def coloured(place: Path) -> tuple[laspy.LasData, Array, npt.NDArray[np.int64]]:
    words = ["--images", str(place / "images"), "-o", str(place / "out.laz")]
    assert main(["colour", str(place / "cloud.laz"), *words]) == 0
    truth = np.load(place / "truth.npz")
    return laspy.read(place / "out.laz"), truth["true"], truth["kind"]


def clear_cut(shot: hamlet.Shot, true: Array) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Points that are seen, and those that are hidden, wherever within a spacing across the view they may be."""
    ways = [np.zeros(3), *(sign * SPACING_M * shot.turn[:, axis] for axis in (0, 1) for sign in (1, -1))]
    _, inside = shot.lens.pixels((true - shot.place) @ shot.turn)
    hidden = []
    for way in ways:
        eye = np.broadcast_to(shot.place, true.shape)
        distance, _ = SCENE.hit(eye, true + way - eye)
        # the surface itself leans away from a place beside the point
        hidden.append(distance < 1.0 - (1e-6 if not way.any() else 2.0 * SPACING_M / 30.0))
    return inside & ~np.any(hidden, axis=0), inside & np.all(hidden, axis=0)


def test_each_picture_colours_what_it_sees_and_nothing_behind_it(place: Path) -> None:
    """But for what lies within a spacing of an edge, as the camera sees it: there points do not say where it is."""
    truth = np.load(place / "truth.npz")
    some = np.sort(np.random.default_rng(1).choice(len(truth["true"]), 30_000, replace=False))
    true = truth["true"][some]
    cloud = reader.look(place / "cloud.laz")
    found = block.load(place / "images", None, None, cloud.path)
    shots = {f"{shot.lens.name}/{number:03d}.png": shot for number, shot in enumerate(taken())}
    counts = np.zeros(4, int)
    with tempfile.TemporaryDirectory() as folder:
        scene = Scene(cloud, found.site, Path(folder), lambda _: None)
        for image in [each for layer in found.layers for each in layer.images][::3]:
            seen = np.zeros(cloud.points, bool)
            for square, those, _ in paint.visible(found, image, scene):
                seen[scene.number[square.points][those.number]] = True
            visible, hidden = clear_cut(shots[image.name], true)
            counts += [hidden.sum(), (hidden & seen[some]).sum(), visible.sum(), (visible & ~seen[some]).sum()]
    assert counts[0] > 10_000
    assert counts[1] < 0.001 * counts[0]
    assert counts[3] < 0.01 * counts[2]


def test_colours_lie_on_the_points_to_a_tenth_of_a_pixel(
    coloured: tuple[laspy.LasData, Array, npt.NDArray[np.int64]],
) -> None:
    """Shift of what the points show against the truth, by its gradients; corners are a third darker than the middle."""
    las, true, kind = coloured
    shown = np.stack([las.red, las.green, las.blue], axis=1) / 65535.0
    for which in (hamlet.GROUND, hamlet.ROOF):
        chosen = (np.asarray(las.views) > 0) & (kind == which)
        truth = hamlet.colours(true[chosen], kind[chosen])
        factor = np.median(shown[chosen] / truth, axis=0)
        left = (shown[chosen] / factor - truth).ravel()
        slopes = [
            (hamlet.colours(true[chosen] + 1e-4 * way, kind[chosen]) - truth).ravel() / 1e-4 for way in np.eye(3)[:2]
        ]
        calm = np.abs(left) < 0.1
        shift, *_ = np.linalg.lstsq(np.stack(slopes, axis=1)[calm], left[calm], rcond=None)
        assert np.abs(shift).max() < 0.1 * PIXEL_M
        assert calm.mean() > 0.98
        assert np.sqrt((left[calm] ** 2).mean()) < 0.02
