"""Painting against pictures that rays of their own have drawn (tests/helpers/hamlet.py): who sees what, NDVI, and how fast.

    python benchmarks/painting.py

JSON on the last line: `hidden_coloured_fraction` and `visible_rejected_fraction` (of views of points that are more than a spacing
from any edge, as the camera sees it), `coloured_fraction` (of the points that some image sees), `ndvi_error` (the worst of three
panels over three seeds) and `mpoint_views_per_s` (points in pictures, by all that paints, on the cores that there are).
"""

import contextlib
import io
import json
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import numpy.typing as npt

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "helpers"))

import hamlet  # noqa: E402 (found by the path above)

from groundproc.cli import main as swath  # noqa: E402
from groundproc.cloud import reader  # noqa: E402
from groundproc.imagery.painting import block, paint  # noqa: E402
from groundproc.imagery.painting.scene import Scene  # noqa: E402
from groundproc.imagery.painting.visibility import project  # noqa: E402

Array = npt.NDArray[np.float64]
DOWN = hamlet.Lens("down", 500, 375, 400.0, "radtan", (-0.1, 0.03, 0.001, -0.0005, 0.0))
ASIDE = hamlet.Lens("aside", 400, 300, 320.0)
SOME = 30_000
"""Points that rays are sent to."""


def visibility(folder: Path, density: float = 60.0, seed: int = 4) -> dict[str, float]:
    """Fractions of views that are wrong, and of points that have a colour."""
    scene, rng = hamlet.hamlet(), np.random.default_rng(seed)
    true, _ = scene.sampled(density, rng)
    hamlet.write_cloud(folder / "cloud.laz", true + rng.normal(0.0, 0.015, true.shape))
    shots = hamlet.flown([(DOWN, 0.0, 0.0), (ASIDE, 30.0, 0.0)], step=12.0, half=12.0)
    names = hamlet.write_block(folder / "images", scene, shots)
    some = np.sort(rng.choice(len(true), min(SOME, len(true)), replace=False))
    counts, ever, given = np.zeros(4), np.zeros(len(some), bool), np.zeros(len(some), bool)
    with looked_at(folder / "cloud.laz", folder / "images") as (found, those):
        images = {image.name: image for layer in found.layers for image in layer.images}
        for name, shot in zip(names, shots, strict=True):
            seen = np.zeros(len(true), bool)
            for square, views, _ in paint.visible(found, images[name], those):
                seen[those.number[square.points][views.number]] = True
            visible, hidden = hamlet.clear_cut(scene, shot, true[some], density**-0.5)
            counts += [hidden.sum(), (hidden & seen[some]).sum(), visible.sum(), (visible & ~seen[some]).sum()]
            ever, given = ever | visible, given | seen[some]
    return {
        "hidden_coloured_fraction": round(counts[1] / counts[0], 5),
        "visible_rejected_fraction": round(counts[3] / counts[2], 5),
        "coloured_fraction": round(float(given[ever].mean()), 5),
    }


@contextlib.contextmanager
def looked_at(cloud: Path, images: Path) -> Iterator[tuple[block.Block, Scene]]:
    """Block and scene of a cloud and its images."""
    look = reader.look(cloud)
    found = block.load(images, None, None, cloud)
    with tempfile.TemporaryDirectory() as scratch:
        yield found, Scene(look, found.site, Path(scratch), lambda _: None)


def speed(folder: Path, density: float = 400.0) -> dict[str, float]:
    """Points in pictures that are painted a second: the second time, when everything is compiled."""
    scene, rng = hamlet.hamlet(), np.random.default_rng(1)
    hamlet.write_cloud(folder / "dense.las", scene.sampled(density, rng)[0])
    lens = replace(DOWN, width=1000, height=750, focal=800.0)
    hamlet.write_block(folder / "large", scene, hamlet.flown([(lens, 0.0, 0.0)], step=12.0, half=12.0))
    with looked_at(folder / "dense.las", folder / "large") as (found, those):
        layer, views = found.layers[0], 0
        for image in layer.images:
            for square in those.squares:
                eye = image.eye._replace(place_m=image.eye.place_m - square.centre_m)
                views += len(project(eye, those.xyz_m[square.points]).number)
        best = np.inf
        for turn in range(3):
            place = folder / f"views{turn}"
            place.mkdir()
            room = paint.room(those.size, layer, place)
            begun = time.perf_counter()
            paint.paint(found, layer, those, room, lambda _: None)
            best = min(best, time.perf_counter() - begun)
    return {"mpoint_views_per_s": round(views / best / 1e6, 2)}


PANELS = {"dark": (-2.0, -3.0, 0.05, 0.06), "grey": (3.0, 3.0, 0.3, 0.32), "white": (-1.0, 7.0, 0.8, 0.78)}


def reflectances(places: Array, kind: npt.NDArray[np.int64]) -> Array:
    """Red and near infrared of a meadow with panels, and of roofs."""
    x, y = places[:, 0], places[:, 1]
    found = np.stack([0.09 + 0.04 * np.sin(0.5 * x), 0.45 + 0.15 * np.cos(0.4 * y)], axis=1)
    for east, north, red, nir in PANELS.values():
        found[np.hypot(x - east, y - north) < 1.0] = red, nir
    found[kind == hamlet.ROOF] = 0.3, 0.35
    return found


def ndvi(folder: Path, cloud: Path, seed: int) -> dict[str, float]:
    """The worst error of the index on panels: noise, dark corners, black level, exposures that EXIF does not state."""
    rng, scene, tables, rigs = np.random.default_rng(seed), hamlet.hamlet(), [], []
    for plane, band in enumerate(("red", "nir")):
        lens = hamlet.Lens(band, 320, 240, 256.0, bands=(band,), fall=(-0.4,), more={"black_level": 4096})
        shots = [
            replace(shot, exposure=(float(rng.uniform(0.4, 0.9)),))
            for shot in hamlet.flown([(lens, 0.0, 0.0)], step=8.0, half=8.0)
        ]

        def one(places: Array, kind: npt.NDArray[np.int64], plane: int = plane) -> Array:
            return reflectances(places, kind)[:, plane : plane + 1]

        hamlet.write_block(folder, scene, shots, one, 60_000.0, 4096.0, 0.01, "tif", seed + plane)
        tables.append((folder / "poses.csv").read_text().splitlines())
        rigs.append((folder / "rig.yaml").read_text())
    (folder / "poses.csv").write_text("\n".join([*tables[0], *tables[1][1:]]) + "\n")
    (folder / "rig.yaml").write_text("".join(rigs))
    lines = ["name,x,y,z,radius,red,green,blue,nir"]
    for name, (x, y, red, nir) in PANELS.items():
        e, n, h = hamlet.to_map(np.array([[x, y, 0.0]]))[0]
        lines.append(f"{name},{e:.3f},{n:.3f},{h:.3f},0.6,{red},,,{nir}")
    (folder / "panels.csv").write_text("\n".join(lines) + "\n")
    words = [
        "--images",
        str(folder),
        "--panels",
        str(folder / "panels.csv"),
        "--gsd",
        "0.15",
        "-o",
        str(folder / "i.tif"),
    ]
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        assert swath(["ndvi", str(cloud), *words, "--cloud", str(folder / "i.laz")]) == 0
    las = laspy.read(folder / "i.laz")
    places, found = np.asarray(las.xyz), np.asarray(las.ndvi)
    errors = []
    for x, y, red, nir in PANELS.values():
        e, n, _ = hamlet.to_map(np.array([[x, y, 0.0]]))[0]
        inside = np.hypot(places[:, 0] - e, places[:, 1] - n) < 0.7
        errors.append(abs(np.nanmedian(found[inside]) - (nir - red) / (nir + red)))
    return {"ndvi_error": round(float(max(errors)), 4)}


def figures(folder: Path) -> dict[str, float]:
    """All of them."""
    found = visibility(folder)
    worst = []
    for seed in range(3):
        own = folder / f"ndvi{seed}"
        own.mkdir()
        worst.append(ndvi(own, folder / "cloud.laz", seed)["ndvi_error"])
    return found | {"ndvi_error": max(worst)} | speed(folder)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        print(json.dumps(figures(Path(place))))
