"""poses.csv: where each image was taken from, and how it looked; read and written."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import CaptureError
from groundproc.files import written_aside
from groundproc.imagery.rotations import mat_world_camera
from groundproc.text import open_text, table_of

Array = npt.NDArray[np.float64]

COLUMNS: Final = ("image", "utc_ns", "easting", "northing", "height", "omega_deg", "phi_deg", "kappa_deg")
SIGMAS: Final = (
    "sigma_easting", "sigma_northing", "sigma_height", "sigma_omega_deg", "sigma_phi_deg", "sigma_kappa_deg",
)  # fmt: skip
NO_TIME: Final = np.iinfo(np.int64).min
"""Stands for a time that nobody knows; empty in the file."""


@dataclass(frozen=True, slots=True)
class ImagePoses:
    """Poses of images, as poses.csv holds them.

    Attributes
    ----------
    images : tuple of str
        Path below the images' common folder.
    utc_ns : ndarray of int64, shape (n,)
        Of the middle row; `NO_TIME` where unknown.
    place_m : ndarray, shape (n, 3)
        Projection centre: easting, northing, height.
    angles_rad : ndarray, shape (n, 3)
        Omega, phi, kappa against grid east, grid north, up.
    sigma_place_m, sigma_angles_rad : ndarray, shape (n, 3)
        Not a number where nobody states them.
    """

    images: tuple[str, ...]
    utc_ns: npt.NDArray[np.int64]
    place_m: Array
    angles_rad: Array
    sigma_place_m: Array
    sigma_angles_rad: Array

    def __len__(self) -> int:
        return len(self.images)

    def mat_grid_camera(self) -> Array:
        """Column matrices grid axes from camera (x right, y down, z forward), shape (n, 3, 3)."""
        return mat_world_camera(*self.angles_rad.T)


def read_poses(path: Path) -> ImagePoses:
    """Read a poses.csv; utc_ns and sigmas may be left out.

    Raises
    ------
    CaptureError
        It cannot be read, a column is missing, or a line is not what the columns say.
    """
    needed = [name for name in COLUMNS if name != "utc_ns"]
    images: list[str] = []
    stamps: list[int] = []
    rows: list[list[float]] = []
    try:
        with open_text(path) as file:
            table = table_of(file, str(path), "image", CaptureError, f"poses of images have {', '.join(COLUMNS)}")
            missing = [name for name in needed if name not in table.names]
            if missing:
                raise CaptureError(f"{path}: column {missing[0]} is missing; expected {', '.join(COLUMNS)}")
            for number, words in table.rows():
                given = dict(zip(table.names, words, strict=True))
                try:
                    stamps.append(int(np.int64(int(given["utc_ns"]))) if given.get("utc_ns") else NO_TIME)
                    values = [float(given[name]) for name in needed[1:]]
                    values += [float(given.get(name) or "nan") for name in SIGMAS]
                except (ValueError, OverflowError):
                    values = [np.nan]
                if not np.isfinite(values[:6]).all():
                    raise CaptureError(f"{path}: line {number}: {table.blame(words, 'numbers in every column')}")
                images.append(given["image"])
                rows.append(values)
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror})") from None
    if not images:
        raise CaptureError(f"{path}: holds no poses")
    twice = {name for name in images if images.count(name) > 1} if len(set(images)) < len(images) else set()
    if twice:
        raise CaptureError(f"{path}: image {min(twice)} stands there more than once")
    array = np.array(rows, np.float64)
    return ImagePoses(
        tuple(images), np.array(stamps, np.int64), array[:, :3], np.deg2rad(array[:, 3:6]), array[:, 6:9],
        np.deg2rad(array[:, 9:12]),
    )  # fmt: skip


def write_poses(path: Path, poses: ImagePoses) -> None:
    """Write a poses.csv.

    Raises
    ------
    SourceError
        It cannot be written.
    """
    columns = np.concatenate(
        [poses.place_m, np.rad2deg(poses.angles_rad), poses.sigma_place_m, np.rad2deg(poses.sigma_angles_rad)], axis=1
    )
    form = "%.5f,%.5f,%.5f,%.7f,%.7f,%.7f"
    with written_aside(path) as aside, aside.open("w", encoding="utf-8", newline="\n") as file:
        file.write(",".join((*COLUMNS, *SIGMAS)) + "\n")
        for image, stamp, row in zip(poses.images, poses.utc_ns.tolist(), columns.tolist(), strict=True):
            sigmas = ",".join("" if np.isnan(value) else f"{value:.6g}" for value in row[6:])
            file.write(f"{quoted(image)},{'' if stamp == NO_TIME else stamp},{form % tuple(row[:6])},{sigmas}\n")


def quoted(name: str) -> str:
    """A name as it stands in a table with commas."""
    return '"' + name.replace('"', '""') + '"' if any(letter in name for letter in ',"\n') else name


def chosen(poses: ImagePoses, images: Sequence[str]) -> dict[str, int]:
    """Rows of images, by name; those that have none are left out. A name alone finds a path that ends in it, where one does."""
    rows = {name: number for number, name in enumerate(poses.images)}
    by_name: dict[str, list[int]] = {}
    for number, name in enumerate(poses.images):
        by_name.setdefault(name.rsplit("/", 1)[-1], []).append(number)
    found = {}
    for image in images:
        alike = by_name.get(image.rsplit("/", 1)[-1], [])
        if image in rows:
            found[image] = rows[image]
        elif len(alike) == 1:
            found[image] = alike[0]
    return found
