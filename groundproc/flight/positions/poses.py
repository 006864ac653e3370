"""Poses with covariance in our own table: trajectory.csv, and what other programs write with the same column names."""

from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import LogError
from groundproc.flight.positions.posetable import read_pose_table
from groundproc.flight.positions.solution import ELLIPSOID, INS, Quality, Solution, diagonal_covariance, tidied
from groundproc.text import names_of, open_text, table_of

Array = npt.NDArray[np.float64]

FORMAT: Final = "poses"
"""What a solution of such a table says of itself."""
_CROSS: Final = {
    "covariance_east_north_m2": (0, 1), "covariance_north_up_m2": (1, 2), "covariance_east_up_m2": (0, 2),
}  # fmt: skip
_CROSS_ATTITUDE: Final = {
    "covariance_roll_pitch_deg2": (0, 1), "covariance_pitch_heading_deg2": (1, 2), "covariance_roll_heading_deg2": (0, 2),
}  # fmt: skip
_LARGEST: Final = 1e12
_DEG2: Final = np.deg2rad(1.0) ** 2


def looks_like_poses(head: str) -> bool:
    """Whether a text begins with our column names."""
    first = next((line for line in head.splitlines() if line.strip() and not line.lower().startswith("sep=")), "")
    found = names_of(first, "utc_ns")
    return found is not None and "utc_ns" in found[0]


def read_poses(path: Path, *, height_reference: str = ELLIPSOID) -> Solution:
    """Read poses of the ins frame's origin.

    Columns as `posetable` has them; sigmas are optional, and so are six columns that those files do not have:
    covariance_east_north_m2, covariance_north_up_m2, covariance_east_up_m2, covariance_roll_pitch_deg2, covariance_pitch_heading_deg2 and
    covariance_roll_heading_deg2.

    Parameters
    ----------
    path : Path
    height_reference : str
        What its heights are above: "ellipsoid" or "msl"; the file does not say.

    Raises
    ------
    LogError
        It is no such table, or a covariance is larger than its sigmas allow.
    """
    poses = read_pose_table(path)
    position = diagonal_covariance(poses.sigma_position_m)
    attitude = diagonal_covariance(poses.sigma_attitude_rad)
    extra = _extra(path, [*_CROSS, *_CROSS_ATTITUDE])
    _fill(position, extra, _CROSS, 1.0, path)
    _fill(attitude, extra, _CROSS_ATTITUDE, _DEG2, path)
    return tidied(
        Solution(
            source=path.name,
            format=FORMAT,
            point=INS,
            height_reference=height_reference,
            sigma_source="the file" if np.isfinite(poses.sigma_position_m).all() else "nobody",
            time_ns=poses.time_ns,
            latitude_deg=poses.latitude_deg,
            longitude_deg=poses.longitude_deg,
            height_m=poses.height_m,
            covariance_m2=position,
            quality=np.full(len(poses.time_ns), Quality.INERTIAL, np.uint8),
            quat_place_ins_wxyz=poses.quat_local_ins_wxyz,
            attitude_covariance_rad2=attitude if np.isfinite(poses.sigma_attitude_rad).any() else None,
        ),
        str(path),
    )


def _extra(path: Path, names: list[str]) -> dict[str, Array]:
    """The columns of a table, whose rows are known to be whole, that have one of these names."""
    with open_text(path) as file:
        rows_of = table_of(file, str(path), "utc_ns", LogError, "expected poses")
        header = rows_of.names
        found = {name: header.index(name) for name in names if name in header}
        if not found:
            return {}
        rows = []
        for number, words in rows_of.rows():
            try:
                rows.append([float(words[place]) for place in found.values()])
            except ValueError:
                raise LogError(f"{path}: line {number}: a covariance is no number") from None
    table = np.array(rows)
    if (np.abs(table) > _LARGEST).any():
        raise LogError(f"{path}: a covariance of {np.nanmax(np.abs(table)):g} found, expected {_LARGEST:g} at most")
    return {name: table[:, i] for i, name in enumerate(found)}


def _fill(
    covariance: Array, extra: dict[str, Array], places: dict[str, tuple[int, int]], unit: float, path: Path
) -> None:
    """Put covariances beside the diagonal."""
    for name, (i, j) in places.items():
        if name in extra:
            covariance[:, i, j] = covariance[:, j, i] = extra[name] * unit
    known = np.isfinite(covariance).all(axis=(1, 2))
    if known.any() and np.linalg.eigvalsh(covariance[known]).min() < -1e-12 * float(np.abs(covariance[known]).max()):
        first = next((name for name in places if name in extra), next(iter(places)))
        raise LogError(f"{path}: covariances such as {first} are larger than the sigmas allow")
