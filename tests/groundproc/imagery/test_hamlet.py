"""Colours, mosaics and indices of a hamlet that rays of their own have drawn: eaves, trees, a garden wall, slopes, grid north aside."""

import tempfile
from dataclasses import replace
from pathlib import Path

import hamlet
import laspy
import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

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


def wrong(
    scene: hamlet.Hamlet, place: Path, shots: dict[str, hamlet.Shot], count: int, spacing_m: float
) -> tuple[npt.NDArray[np.int64], float]:
    """Views of hidden points, how many of them are seen; of visible ones, how many are refused; share with a colour of what is visible.

    But for what lies within a spacing of an edge, as the camera sees it: there points do not say where it is.
    """
    truth = np.load(place / "truth.npz")["true"]
    some = np.sort(np.random.default_rng(1).choice(len(truth), count, replace=False))
    cloud = reader.look(place / "cloud.laz")
    found = block.load(place / "images", None, None, cloud.path)
    counts, ever, given = np.zeros(4, np.int64), np.zeros(count, bool), np.zeros(count, bool)
    with tempfile.TemporaryDirectory() as folder:
        laid = Scene(cloud, found.site, Path(folder), lambda _: None)
        for image in [each for layer in found.layers for each in layer.images if each.name in shots]:
            seen = np.zeros(cloud.points, bool)
            for square, those, _ in paint.visible(found, image, laid):
                seen[laid.number[square.points][those.number]] = True
            visible, hidden = hamlet.clear_cut(scene, shots[image.name], truth[some], spacing_m)
            counts += [hidden.sum(), (hidden & seen[some]).sum(), visible.sum(), (visible & ~seen[some]).sum()]
            ever, given = ever | visible, given | seen[some]
    return counts, float(given[ever].mean())


def test_each_picture_colours_what_it_sees_and_nothing_behind_it(place: Path) -> None:
    shots = {f"{shot.lens.name}/{number:03d}.png": shot for number, shot in enumerate(taken())}
    counts, _ = wrong(SCENE, place, dict(list(shots.items())[::3]), 12_000, SPACING_M)
    assert counts[0] > 4_000
    assert counts[1] < 0.001 * counts[0]
    assert counts[3] < 0.01 * counts[2]


# a scene of its own, ten thousands of leaves; in the quick suite: the hamlet with its trees (above)
@pytest.mark.soak
def test_in_a_grove_leaves_and_branches_hide_what_is_behind_them_and_nothing_beside(tmp_path: Path) -> None:
    """They are thinner than the points stand apart, and the ground is seen between them."""
    scene, rng = hamlet.grove(), np.random.default_rng(4)
    true, _ = scene.sampled(DENSITY, rng)
    hamlet.write_cloud(tmp_path / "cloud.laz", true + rng.normal(0.0, 0.015, true.shape))
    np.savez(tmp_path / "truth.npz", true=true)
    shots = hamlet.flown([(replace(DOWN, fall=()), 0.0, 0.0), (ASIDE, 30.0, 0.0)], step=12.0, half=12.0)
    bare = replace(
        scene, triangle=scene.triangle[:2], kind=scene.kind[:2], ball=scene.ball[:0]
    )  # nobody looks at the pictures
    names = hamlet.write_block(tmp_path / "images", bare, shots)
    counts, coloured = wrong(scene, tmp_path, dict(zip(names, shots, strict=True)), 6_000, SPACING_M)
    assert counts[0] > 800
    thousandth = 0.001 * counts[0]
    assert counts[1] <= thousandth + 3.0 * np.sqrt(thousandth)  # as far as so few views tell
    assert counts[3] < 0.01 * counts[2]
    assert coloured > 0.998


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


def off(folder: Path, place: Path) -> float:
    """What colours of the ground are off, rms, by the images of a folder."""
    assert (
        main(["colour", str(place / "cloud.laz"), "--images", str(folder), "-o", str(folder / "o.laz"), "--force"]) == 0
    )
    truth, las = np.load(place / "truth.npz"), laspy.read(folder / "o.laz")
    chosen = (np.asarray(las.views) > 0) & (truth["kind"] == hamlet.GROUND)
    shown = np.stack([las.red, las.green, las.blue], axis=1)[chosen] / 65535.0
    known = hamlet.colours(truth["true"][chosen], truth["kind"][chosen])
    return float(np.median(np.abs(shown / np.median(shown / known, axis=0) - known)))


SMALL = hamlet.Lens("small", 320, 240, 256.0)


def test_rows_of_a_rolling_shutter_are_where_the_camera_was_by_then(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """At 5 m/s and 0.4 ms a row the outermost are 0.24 m off, two pixels: the speed is that of the images' places and times."""
    lens = replace(SMALL, line_delay_s=4e-4)
    hamlet.write_block(tmp_path, SCENE, hamlet.flown([(lens, 0.0, 0.0)], step=8.0, half=8.0))
    right = off(tmp_path, place)
    told = capsys.readouterr()
    assert "rolling shutter" not in told.err
    poses = (tmp_path / "poses.csv").read_text().splitlines()
    blank = [",".join(["" if n == 1 else word for n, word in enumerate(line.split(","))]) for line in poses[1:]]
    (tmp_path / "poses.csv").write_text("\n".join([poses[0], *blank]) + "\n")
    assert off(tmp_path, place) > 1.5 * right
    assert "rolling shutter of camera small: how fast 9 of 9 images moved is not known" in capsys.readouterr().err


def test_dark_corners_are_put_right(place: Path, tmp_path: Path) -> None:
    lens = replace(SMALL, fall=(-0.5,))
    hamlet.write_block(tmp_path, SCENE, hamlet.flown([(lens, 0.0, 0.0)], step=12.0, half=6.0))
    right = off(tmp_path, place)
    rig = (tmp_path / "rig.yaml").read_text()
    (tmp_path / "rig.yaml").write_text(rig.replace("- -0.5\n", "- 0.0\n"))
    assert right < 0.5 * off(tmp_path, place)


def test_temperatures_are_right_to_a_kelvin_and_a_warm_car_that_passes_is_voted_out(
    place: Path, tmp_path: Path
) -> None:
    more = {"response": {"scale": 0.01, "offset": -273.15}}
    lens = replace(SMALL, name="heat", bands=("temperature",), more=more)

    def heat(places: Array, kind: npt.NDArray[np.int64]) -> Array:
        celsius = 20.0 + 10.0 * np.sin(places[:, 0] / 5.0) + np.where(kind == hamlet.ROOF, 15.0, 0.0)
        return (celsius[:, None] + 273.15) / 655.35

    shots = hamlet.flown([(lens, 0.0, 0.0)], step=8.0, half=8.0)
    names = hamlet.write_block(tmp_path, SCENE, shots, heat, scale=65535.0, suffix="tif")
    with Image.open(tmp_path / names[4]) as file:
        shown = np.array(file)
    shown[100:140, 140:180] = (70.0 + 273.15) / 0.01
    Image.fromarray(shown).save(tmp_path / names[4])
    assert main(["colour", str(place / "cloud.laz"), "--images", str(tmp_path), "-o", str(tmp_path / "o.laz")]) == 0
    truth, las = np.load(place / "truth.npz"), laspy.read(tmp_path / "o.laz")
    chosen = (np.asarray(las.views) > 2) & np.isin(truth["kind"], (hamlet.GROUND, hamlet.ROOF))
    known = heat(truth["true"], truth["kind"])[:, 0] * 655.35 - 273.15
    wrong = np.abs(np.asarray(las.temperature) - known)[chosen]
    assert np.median(wrong) < 0.1
    assert (wrong > 1.0).mean() < 0.01


@pytest.mark.parametrize(
    "stated",
    [
        # the other half of a block, drawn and laid once more; that EXIF is read is told by test_exposures
        pytest.param(True, marks=pytest.mark.soak, id="exposures in EXIF"),
        pytest.param(False, id="exposures nobody knows"),
    ],
)
def test_the_index_is_right_to_two_hundredths_whether_or_not_exposures_are_known(
    place: Path, tmp_path: Path, stated: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    panels = {"dark": (-2.0, -3.0, 0.05, 0.06), "grey": (3.0, 3.0, 0.3, 0.32), "white": (-1.0, 7.0, 0.8, 0.78)}

    def bands(places: Array, kind: npt.NDArray[np.int64]) -> Array:
        x, y = places[:, 0], places[:, 1]
        found = np.stack([0.09 + 0.04 * np.sin(0.5 * x), 0.45 + 0.15 * np.cos(0.4 * y)], axis=1)
        for east, north, red, nir in panels.values():
            found[np.hypot(x - east, y - north) < 1.0] = red, nir
        found[kind == hamlet.ROOF] = 0.3, 0.35
        return found

    def one(plane: int) -> hamlet.Paint:
        return lambda places, kind: bands(places, kind)[:, plane : plane + 1]

    rng, rows, rigs = np.random.default_rng(2), [], []
    for plane, band in enumerate(("red", "nir")):
        lens = replace(SMALL, name=band, bands=(band,), fall=(-0.4,), more={"black_level": 4096})
        shots = []
        for shot in hamlet.flown([(lens, 0.0, 0.0)], step=8.0, half=8.0):
            factor = float(rng.uniform(0.5, 1.0))
            exif = {33434: factor * 1e-3} if stated else {}
            shots.append(replace(shot, exposure=(factor * (0.9, 0.7)[plane],), exif=exif))
        hamlet.write_block(tmp_path, SCENE, shots, one(plane), 60_000.0, 4096.0, 0.01, "tif", plane)
        rows.append((tmp_path / "poses.csv").read_text().splitlines())
        rigs.append((tmp_path / "rig.yaml").read_text())
    (tmp_path / "poses.csv").write_text("\n".join([*rows[0], *rows[1][1:]]) + "\n")
    (tmp_path / "rig.yaml").write_text("".join(rigs))
    where = hamlet.to_map(np.array([[x, y, 0.0] for x, y, *_ in panels.values()]))
    lines = [
        f"{name},{e:.3f},{n:.3f},{h:.3f},0.6,{red},,,{nir}"
        for (name, (_, _, red, nir)), (e, n, h) in zip(panels.items(), where, strict=True)
    ]
    (tmp_path / "panels.csv").write_text("\n".join(["name,x,y,z,radius,red,green,blue,nir", *lines]) + "\n")
    words = ["--images", str(tmp_path), "--panels", str(tmp_path / "panels.csv"), "--gsd", "0.15"]
    words += ["-o", str(tmp_path / "i.tif"), "--cloud", str(tmp_path / "i.laz")]
    assert main(["ndvi", str(place / "cloud.laz"), *words]) == 0
    assert ("brought to one exposure" in capsys.readouterr().err) != stated
    truth, las = np.load(place / "truth.npz"), laspy.read(tmp_path / "i.laz")
    x, y = truth["true"][:, 0], truth["true"][:, 1]
    rim = np.min([np.abs(np.hypot(x - e, y - n) - 1.0) for e, n, *_ in panels.values()], axis=0) < 0.2
    red, nir = bands(truth["true"], truth["kind"]).T
    known = (nir - red) / (nir + red)
    found = np.asarray(las.ndvi)
    on = np.isfinite(found) & ~rim & (truth["kind"] == hamlet.GROUND) & (np.hypot(x, y) < 14.0)
    assert np.median(np.abs(found - known)[on]) < 0.01
    for e, n, in_red, in_nir in panels.values():
        inside = on & (np.hypot(x - e, y - n) < 0.7)
        assert abs(np.median(found[inside]) - (in_nir - in_red) / (in_nir + in_red)) < 0.02
