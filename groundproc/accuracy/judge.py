"""All figures of one trajectory against the truth, and the courses of its errors for plots."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from flightlog.errors import CoverageError
from flightlog.logfile import LogReader
from flightlog.mount import Mount
from groundproc.accuracy import poses
from groundproc.accuracy.alignment import align
from groundproc.accuracy.cloud import judge_cloud
from groundproc.accuracy.cloudfigures import CloudErrors, Section
from groundproc.accuracy.truth import Truth
from groundproc.sensors.shots import LaserTable
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Judgement:
    """One trajectory judged.

    Attributes
    ----------
    figures : dict
        Name to value; a value that cannot be told is None.
    courses : dict
        Name to array, for plots: seconds since the flight's start (`time_s`, `cloud_time_s`), aligned positions, errors, the section.
    """

    figures: dict[str, Any]
    courses: dict[str, npt.NDArray[Any]]


def judge(
    readers: Sequence[LogReader],
    truth: Truth,
    estimated: Trajectory,
    mount: Mount,
    lasers: LaserTable | None = None,
    section: Section | None = None,
    absolute: bool = True,
) -> Judgement:
    """Compare a trajectory and its cloud with the truth.

    Parameters
    ----------
    readers : sequence of LogReader
        The flight's logs; without any, only poses are judged.
    truth : Truth
    estimated : Trajectory
        On the lidar's clock and in the truth's frame: `truth.on_lidar_clock`.
    mount : Mount
        The one that the estimate comes with.
    lasers : LaserTable, optional
    section : Section, optional
    absolute : bool
        Whether the trajectory means to be in the world's frame; a lidar odometry only has a frame of its own.

    Raises
    ------
    CoverageError
        Fewer than two common poses.
    """
    ours, theirs, share = poses.common_poses(estimated, truth.trajectory)
    if len(ours.time_ns) < 2:
        raise CoverageError(
            f"trajectory: {len(ours.time_ns)} of its poses lie within the flight's true ones, expected two or more"
        )
    lidar, true_lidar = ours.times_mount(mount), theirs.times_mount(truth.mount)
    motion = align(lidar.position_m, lidar.mat_local_body, true_lidar.position_m, true_lidar.mat_local_body)
    lidar = lidar.moved(motion)
    alone = align(ours.position_m, ours.mat_local_body, theirs.position_m, theirs.mat_local_body)
    figures: dict[str, Any] = asdict(poses.pose_figures(lidar, true_lidar))
    figures |= {"covered_time_share": share, "aligned_by_attitude": motion.by_attitude}
    figures |= {f"ins_{name}": value for name, value in asdict(poses.pose_figures(ours.moved(alone), theirs)).items()}
    figures["time_error_ms"] = poses.time_error_ms(lidar, true_lidar)
    if absolute:
        figures["boresight_error_deg"], figures["lever_error_m"] = poses.mount_errors(mount, truth.mount)
    heading = poses.heading_errors_deg(ours.moved(motion), theirs)
    settled = poses.wrapped_deg(heading - poses.settled_offset_deg(heading))
    figures["heading_settle_s"] = poses.settle_s(ours.time_ns, settled)
    figures["heading_rms_deg"] = float(np.sqrt(np.square(settled).mean()))
    figures |= _absolute(estimated, ours, theirs) if absolute else dict.fromkeys(_ABSOLUTE)
    aligned = poses.sigma_figures(estimated, ours.moved(alone), theirs)
    figures |= {f"aligned_{name}": value for name, value in asdict(aligned).items()}
    seconds = truth.lidar.elapsed_s(ours.time_ns)
    courses: dict[str, npt.NDArray[Any]] = {
        "time_s": seconds,
        "position_m": lidar.position_m,
        "true_position_m": true_lidar.position_m,
        "position_error_m": poses.position_errors(lidar, true_lidar),
        "rotation_error_deg": poses.rotation_errors_deg(lidar, true_lidar),
        "heading_error_deg": settled,
    }
    if absolute:
        courses["absolute_heading_error_deg"] = poses.heading_errors_deg(ours, theirs)
    if readers:
        errors = judge_cloud(readers, truth, estimated, mount, motion, lasers, section)
        figures |= asdict(errors.figures)
        courses |= _cloud_courses(errors, truth)
    return Judgement({name: _told(value) for name, value in figures.items()}, courses)


_ABSOLUTE = (
    "absolute_mean_error_m", "absolute_rms_m", "absolute_heading_mean_deg", "absolute_heading_rms_deg", "absolute_heading_settle_s",
    "position_within_2_sigma", "position_error_over_sigma", "attitude_within_2_sigma", "attitude_error_over_sigma",
)  # fmt: skip


def _absolute(estimated: Trajectory, ours: poses.PoseSeries, theirs: poses.PoseSeries) -> dict[str, Any]:
    """Errors of the INS poses as they stand, without any alignment."""
    away = ours.position_m - theirs.position_m
    heading = poses.heading_errors_deg(ours, theirs)
    values = (
        tuple(away.mean(axis=0).tolist()),
        float(np.sqrt(np.square(away).sum(axis=1).mean())),
        float(heading.mean()),
        float(np.sqrt(np.square(heading).mean())),
        poses.settle_s(ours.time_ns, heading),
        *asdict(poses.sigma_figures(estimated, ours, theirs)).values(),
    )
    return dict(zip(_ABSOLUTE, values, strict=True))


def _cloud_courses(errors: CloudErrors, truth: Truth) -> dict[str, npt.NDArray[Any]]:
    return {
        "cloud_time_s": truth.lidar.elapsed_s(errors.time_ns),
        "point_rms_m": errors.point_rms_m,
        "floor_point_rms_m": errors.floor_point_rms_m,
        "section_m": errors.section_m,
        "section_time_s": truth.lidar.elapsed_s(errors.section_time_ns),
    }


def _told(value: Any) -> Any:
    """A figure as JSON can hold it."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
