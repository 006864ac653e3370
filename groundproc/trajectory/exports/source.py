"""A trajectory of any format that is read, with what its heights refer to."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from pyproj.exceptions import ProjError

from flightlog import frames
from flightlog.errors import LogError, UsageError
from groundproc import geodesy
from groundproc.flight.positions.fixes import mat_frame_place
from groundproc.flight.positions.localposes import RELATIVE
from groundproc.flight.positions.poses import FORMAT as POSES
from groundproc.flight.positions.reading import read_solution
from groundproc.flight.positions.solution import ELLIPSOID, INS, MSL, Quality, Solution
from groundproc.geodesy import LocalFrame
from groundproc.trajectory.estimate import EXACT, TRAJECTORY, read_knots
from groundproc.trajectory.table import from_poses, read_trajectory
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]

UNKNOWN: Final = "unknown"
_QUALITY: Final = "quality.json"


@dataclass(frozen=True, slots=True)
class Source:
    """What is exported.

    Attributes
    ----------
    name : str
        For sentences.
    trajectory : Trajectory
    height_reference : str
        "ellipsoid", "msl", "relative" (to the take-off), or "unknown".
    geoid : str, optional
        Its height above the ellipsoid [m], or a grid file.
    """

    name: str
    trajectory: Trajectory
    height_reference: str
    geoid: str | None = None

    def solution(self, references: tuple[str, ...]) -> Solution:
        """Its knots as poses at their places, with heights of one of some references: the own one, or the ellipsoid by the geoid.

        Raises
        ------
        UsageError
            Such heights cannot be had.
        """
        trajectory = self.trajectory
        latitude, longitude, height = trajectory.frame.to_geodetic(trajectory.position_m)
        reference = self.height_reference
        if self.geoid is not None or reference not in references:
            height = height + self._undulation_m(float(latitude[0]), float(longitude[0]))
            reference = ELLIPSOID
        turn = np.swapaxes(mat_frame_place(trajectory.frame, latitude, longitude), -1, -2)
        covariance = trajectory.covariance_at(trajectory.time_ns)
        return Solution(
            source=self.name,
            format=POSES,
            point=INS,
            height_reference=reference,
            sigma_source="the trajectory",
            time_ns=trajectory.time_ns,
            latitude_deg=latitude,
            longitude_deg=longitude,
            height_m=height,
            covariance_m2=turn @ covariance[:, :3, :3] @ np.swapaxes(turn, -1, -2),
            quality=np.full(len(trajectory), Quality.INERTIAL, np.uint8),
            velocity_m_s=np.einsum("nij,nj->ni", turn, trajectory.velocity_m_s),
            quat_place_ins_wxyz=frames.quat_multiply(frames.quat_from_mat(turn), trajectory.quat_local_ins_wxyz),
            attitude_covariance_rad2=covariance[:, 3:, 3:],
        )

    def _undulation_m(self, latitude_deg: float, longitude_deg: float) -> float:
        if self.height_reference == ELLIPSOID:
            raise UsageError(f"--geoid {self.geoid}: heights of {self.name} are above the ellipsoid already")
        if self.height_reference == UNKNOWN:
            raise UsageError(
                f"{self.name}: does not say what its heights are above, and the format does; give --height ellipsoid or msl"
            )
        if self.height_reference == RELATIVE:
            raise UsageError(
                f"{self.name}: its heights are above the take-off, expected above the ellipsoid; process with --height ellipsoid or msl"
            )
        if self.geoid is None:
            raise UsageError(
                f"{self.name}: its heights are above sea level, expected above the ellipsoid; give the geoid's height with --geoid"
            )
        return geodesy.undulation(self.geoid, latitude_deg, longitude_deg)


def read_source(path: Path, *, height: str | None = None, geoid: str | None = None, week: int | None = None) -> Source:
    """Read a trajectory.csv (without rounding where its folder is an estimate's), TUM, KITTI, or an SBET.

    Parameters
    ----------
    path : Path
    height : str, optional
        What its heights are above, where the file and the quality.json beside do not say it.
    geoid : str, optional
        Height of the geoid above the ellipsoid [m] or a grid file: heights become those above the ellipsoid.
    week : int, optional
        GPS week of an SBET.

    Raises
    ------
    LogError, UsageError
        It cannot be read, has no attitudes, or says something else than `height`.
    """
    if path.name == TRAJECTORY and path.with_name(EXACT).is_file():
        trajectory, _ = read_knots(path.parent)
        _, stated = _beside(path)
    else:
        solution = read_solution(path, week=week)
        if solution.format == POSES:
            frame, stated = _beside(path)
            trajectory = read_trajectory(path, frame)
        else:
            trajectory, stated = _of_solution(solution, path), solution.height_reference
    if height is not None and stated not in (height, UNKNOWN):
        raise UsageError(f"--height {height}: heights of {path} are {stated}, as it is written there")
    return Source(str(path), trajectory, height or stated, geoid)


def _beside(path: Path) -> tuple[LocalFrame | None, str]:
    """The local frame of a trajectory.csv, and what its heights are above, by the quality.json beside it; None where there is none."""
    try:
        said = json.loads(path.with_name(_QUALITY).read_text(encoding="utf-8"))
        place = (float(said["local_frame"][name]) for name in ("latitude_deg", "longitude_deg", "height_m"))
        frame, reference = LocalFrame(*place), said["height"]["reference"]
    except (OSError, ValueError, KeyError, TypeError, ProjError):
        return None, UNKNOWN
    return frame, reference if reference in (ELLIPSOID, MSL, RELATIVE) else UNKNOWN


def _of_solution(solution: Solution, path: Path) -> Trajectory:
    attitude = solution.quat_place_ins_wxyz
    if attitude is None:
        raise LogError(
            f"{path}: {solution.format} has no attitudes, expected a trajectory (trajectory.csv, TUM, KITTI or SBET)"
        )
    if len(solution) < 2:
        raise LogError(f"{path}: 1 pose found, expected two or more")
    place = (float(values[0]) for values in (solution.latitude_deg, solution.longitude_deg, solution.height_m))
    frame = LocalFrame(*place)
    turn = mat_frame_place(frame, solution.latitude_deg, solution.longitude_deg)
    covariance = solution.attitude_covariance_rad2
    unknown = np.full((len(solution), 3), np.nan)
    return from_poses(
        frame,
        solution.time_ns,
        frame.from_geodetic(solution.latitude_deg, solution.longitude_deg, solution.height_m),
        frames.quat_multiply(frames.quat_from_mat(turn), attitude),
        solution.sigma_m,
        unknown if covariance is None else np.sqrt(np.einsum("nii->ni", covariance)),
    )
