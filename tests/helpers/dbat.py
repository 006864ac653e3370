"""The blocks of the Damped Bundle Adjustment Toolbox, written as the tables that `swath images` takes, and what its reports say."""

import gzip
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

SXB_RIG = """cam0:
  camera_model: pinhole
  intrinsics: [20656.533333333333, 20656.533333333333, 4429.5, 6468.5]
  distortion_model: none
  distortion_coeffs: []
  resolution: [8858, 12996]
"""
_PIXEL = 36.0 / 5616.0
ROMA_RIG = f"""cam0:
  camera_model: pinhole
  intrinsics: [{24.3581 / _PIXEL!r}, {24.3581 / _PIXEL!r}, {18.1143 / _PIXEL!r}, {12.0 / _PIXEL!r}]
  distortion_model: brown_photogrammetric
  distortion_coeffs: [2.174e-04, -1.518e-07, 0.0, 0.0, 0.0]
  pixel_mm: {_PIXEL!r}
  resolution: [5616, 3744]
  estimate: [f, pu, pv, k1, k2]
"""


@dataclass(frozen=True)
class Reported:
    """What a report says of an image: omega, phi, kappa [deg], X, Y, Z [m], and their deviations."""

    values: Array
    deviations: Array


def numbers(path: Path) -> Array:
    """Rows of numbers separated by commas, comments left out; packed or not."""
    text = gzip.decompress(path.read_bytes()).decode() if path.suffix == ".gz" else path.read_text()
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return np.array([[float(word) for word in line.split(",")] for line in lines])


def reported(path: Path) -> dict[str, Reported]:
    """Orientations in a report, by image."""
    found: dict[str, Reported] = {}
    for part in re.split(r"Photo \d+: ", path.read_text())[1:]:
        name = part.split("\n", 1)[0].strip()
        if name in found or "Omega" not in part:
            continue
        values, deviations = [], []
        for what in ("Omega", "Phi", "Kappa", "Xc", "Yc", "Zc"):
            value = re.search(rf"{what}:\s+Value:\s+(\S+) \w+(?:\s+Deviation: (\S+))?", part)
            assert value is not None
            values.append(float(value[1]))
            deviations.append(float(value[2] or 0.0))
        found[name] = Reported(np.array(values), np.array(deviations))
    return found


def write_sxb(data: Path, folder: Path) -> None:
    """rig.yaml, points.csv, control.csv and start.csv of the aerial block; the start is the report's, rounded to metres and degrees."""
    (folder / "rig.yaml").write_text(SXB_RIG)
    names = {1: "8811.jpg", 2: "8936.jpg", 3: "8937.jpg", 4: "8938.jpg", 5: "9111.jpg"}
    lines = ["image,point,x_px,y_px,sigma"]
    for file, sigma in (("markpts.txt", 0.5), ("smartpts.txt", 1.0)):
        lines += [f"{names[int(i)]},{int(p)},{x!r},{y!r},{sigma}" for p, i, x, y in numbers(data / file).tolist()]
    (folder / "points.csv").write_text("\n".join(lines) + "\n")
    rows = [line.split(",") for line in (data / "sxb-control.txt").read_text().splitlines() if line[:1].isdigit()]
    lines = ["name,x,y,z,sigma,sigma_z,use"]
    for row in rows:
        name, _, x, y, z, *_ = (word.strip() for word in row)
        lines.append(f"{name},{x},{y},{z},0.02,0.04,{'check' if name in ('351', '410') else 'control'}")
    (folder / "control.csv").write_text("\n".join(lines) + "\n")
    lines = ["image,easting,northing,height,omega_deg,phi_deg,kappa_deg"]
    for name, one in reported(data / "report.txt").items():
        angles, place = np.round(one.values[:3]), np.round(one.values[3:])
        lines.append(",".join([name, *(f"{value}" for value in (*place, *angles))]))
    (folder / "start.csv").write_text("\n".join(lines) + "\n")


def write_roma(data: Path, folder: Path, points: int | None = None) -> None:
    """rig.yaml, points.csv and start.csv of the free network; of every n-th point only where `points` says n."""
    (folder / "rig.yaml").write_text(ROMA_RIG)
    measured = numbers(data / "markpts.txt.gz")
    if points is not None:
        measured = measured[measured[:, 1] % points == 0]
    text = "\n".join(f"{int(i)},{int(p)},{x!r},{y!r},1" for i, p, x, y in measured.tolist())
    (folder / "points.csv").write_text(f"image,point,x_px,y_px,sigma\n{text}\n")
    lines = ["image,easting,northing,height,omega_deg,phi_deg,kappa_deg"]
    lines += [f"{int(row[0])}," + ",".join(map(str, row[1:])) for row in numbers(data / "initial_eo.txt").tolist()]
    (folder / "start.csv").write_text("\n".join(lines) + "\n")
