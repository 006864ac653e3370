"""Images: the adjustment against the reports of an independent one, and on rendered photographs with known truth; colours and indices.

The blocks of the reports lie in the folder that SWATH_RECORDINGS names. `--parts` measures some only, each within a few minutes of two
cores. The last line is one JSON object.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import laspy
import numpy as np
import numpy.typing as npt
import pyproj

from flightlog import frames
from groundproc.imagery import work
from groundproc.imagery.rig import read_rig
from groundproc.imagery.rotations import STRAIGHT_DOWN
from groundproc.imagery.session import Task

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "helpers"))

import dbat  # noqa: E402 (found by the path above)
import groundview  # noqa: E402 (found by the path above)
import imageblock  # noqa: E402 (found by the path above)
import imagery_painting  # noqa: E402 (it imports what is found by that path)

Array = npt.NDArray[np.float64]


def quiet(stage: str, count: float) -> None:
    """No progress."""
    del stage, count


def reports(folder: Path) -> dict[str, Any]:
    """Sigma0 of the two blocks of the Damped Bundle Adjustment Toolbox."""
    data = Path(os.environ["SWATH_RECORDINGS"]) / "images"
    figures: dict[str, Any] = {}
    for name, write in (("sxb", dbat.write_sxb), ("roma", dbat.write_roma)):
        own = folder / name
        own.mkdir()
        write(data / f"dbat_{name}", own)
        control = own / "control.csv" if name == "sxb" else None
        task = Task(
            own / "out", rig=own / "rig.yaml", image_points=own / "points.csv", start=own / "start.csv", control=control
        )
        begun = time.monotonic()
        figures[f"{name}_sigma0"] = round(work.run(task, quiet)["sigma0"], 6)
        if name == "roma":
            figures["roma_seconds"] = round(time.monotonic() - begun, 1)
    return figures


def cloud(path: Path) -> None:
    """The ground of the simulated flight as a lidar sees it."""
    rng = np.random.default_rng(3)
    plan = np.column_stack([rng.uniform(-40, 150, 400_000), rng.uniform(-40, 140, 400_000)])
    points = imageblock.site().map(np.column_stack([plan, imageblock.relief(plan) + rng.normal(0, 0.02, len(plan))]))
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.001), np.floor(points.min(axis=0))
    header.add_crs(pyproj.CRS.from_epsg(32633))
    record = laspy.LasData(header)
    record.x, record.y, record.z = points.T
    record.write(path)


def photographed(folder: Path) -> dict[str, Any]:
    """A block of 20 rendered photographs, 60 and 40 % over each other, GNSS to 2/2/3 cm, no control: with lidar and without."""
    camera = imageblock.true_camera().camera
    truth = imageblock.true_camera(camera=replace(camera, focal_px=1290.0), line_delay_s=2e-5)
    flown = imageblock.fly(truth, strips=4, per_strip=5, seed=11, spacing_m=(11.5, 22.5), height=30.0)
    trajectory = imageblock.disturbed(flown, 16, np.array([0.02, 0.02, 0.03]), np.array([0.05, 0.05, 0.1]))
    lens = replace(truth.camera, focal_px=1300.0, centre_px=(799.5, 599.5), coefficients=(-0.04, 0.01))
    guess = replace(
        truth, camera=lens, mat_cam_ins=STRAIGHT_DOWN.copy(), origin_cam_m=-STRAIGHT_DOWN @ np.array([0.05, 0.10, -0.08]),
        timeshift_s=0.0, estimate=("f", "pu", "pv", "k1", "k2"), sigma={"f": 20.0, "pu": 10.0, "pv": 10.0},
    )  # fmt: skip
    imageblock.write_block(flown, folder, guess, trajectory, 0.3, 20)
    groundview.write_marks(flown, folder / "control.csv", folder / "marks.csv")
    groundview.photographs(flown, folder / "photographs")
    cloud(folder / "cloud.laz")
    errors: dict[str, Array] = {}
    for name, surface in (("without", None), ("with", folder / "cloud.laz")):
        told = work.run(
            Task(
                folder / name, (folder / "photographs",), trajectory=folder / "trajectory.csv", rig=folder / "rig.yaml",
                marks=folder / "marks.csv", control=folder / "control.csv", times=folder / "times.csv", cloud=surface,
            ),
            quiet,
        )  # fmt: skip
        errors[name] = np.array([[one["dx"], one["dy"], one["dz"]] for one in told["check"]])
        sigmas = np.array([[one["sx"], one["sy"], one["sz"]] for one in told["check"]])
        said = {
            "images": told["counts"]["images"], "sigma0": told["sigma0"], "rms_m": np.sqrt(np.mean(errors[name] ** 2, axis=0)).tolist(),
            "within_2_sigma": float((np.abs(errors[name]) < 2.0 * sigmas).mean()), "lasting": told["lasting"],
            "focal_length_off": told["cameras"][0]["values"]["f"] / truth.camera.focal_px - 1.0,
            "clock_off_s": told["cameras"][0]["timeshift_s"] - truth.timeshift_s,
        }  # fmt: skip
        print(f"{name} lidar: {said}")
    found = read_rig(folder / "with" / "rig.yaml").cameras[0]
    turn = frames.quat_log(frames.quat_from_mat(found.mat_cam_ins @ truth.mat_cam_ins.T))
    return {
        "check_xy_m": round(float(np.sqrt(np.square(errors["with"][:, :2]).sum(axis=1).mean())), 4),
        "check_z_m": round(float(np.sqrt(np.square(errors["with"][:, 2]).mean())), 4),
        "check_z_without_lidar_m": round(float(np.sqrt(np.square(errors["without"][:, 2]).mean())), 4),
        "boresight_error_deg": round(float(np.rad2deg(np.abs(turn).max())), 4),
    }


def painting(folder: Path) -> dict[str, Any]:
    """Colours and indices."""
    return imagery_painting.figures(folder)


PARTS: Final = {"reports": reports, "photographed": photographed, "painting": painting}


def main() -> None:
    """Measure all parts, or those named."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), metavar="NAME", help=", ".join(PARTS))
    parts = parser.parse_args().parts
    figures: dict[str, Any] = {}
    others = os.getloadavg()[0] - 1.0 if hasattr(os, "getloadavg") else 0.0
    if others > 0.5:
        print(
            f"note: some {others:.0f} other programs were running meanwhile: seconds are longer and rates lower than on a quiet machine"
        )
    with tempfile.TemporaryDirectory() as place:
        for name in parts:
            if name == "reports" and "SWATH_RECORDINGS" not in os.environ:
                print("note: the blocks of the reports were not measured: SWATH_RECORDINGS is not set")
                continue
            folder = Path(place) / name
            folder.mkdir()
            figures |= PARTS[name](folder)
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
