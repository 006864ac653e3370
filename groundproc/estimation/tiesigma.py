"""The uncertain tie of lidar and autopilot in the sigma of every pose: late by dt is off by speed x dt."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.constants import NS_PER_S
from groundproc.flight.timeline import Leg
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]

_SLACK_NS: Final = NS_PER_S
_MOST_RAD: Final = np.pi / np.sqrt(3.0)
"""Standard deviation of an angle of which nothing is known."""


def with_tie_sigma(trajectory: Trajectory, timeline: Sequence[Leg]) -> tuple[Trajectory, str]:
    """A trajectory whose sigmas include the share of the clocks, and a warning where that share is the larger one.

    Positions get speed times sigma; angles get the body's rate about their axis times sigma (to first order in pitch
    and roll). The sigma is that of the tie at its reference time, and grows with its drift away from there.

    Parameters
    ----------
    trajectory : Trajectory
        Of the autopilot's poses, placed on the lidar's clock by the timeline.
    timeline : sequence of Leg
    """
    sigma_s = _sigma_s(trajectory.time_ns, timeline)
    way = np.abs(trajectory.velocity_m_s) * sigma_s[:, None]
    # the ins frame: right, forward, up are the axes of pitch, roll and heading
    turn = np.minimum(np.abs(trajectory.rate_rad_s[:, [1, 0, 2]]) * sigma_s[:, None], _MOST_RAD)
    made = replace(
        trajectory,
        sigma_position_m=np.hypot(trajectory.sigma_position_m, way),
        sigma_attitude_rad=np.hypot(trajectory.sigma_attitude_rad, turn),
    )
    return made, _warning(trajectory, way, turn, sigma_s)


def _sigma_s(time_ns: npt.NDArray[np.int64], timeline: Sequence[Leg]) -> Array:
    """Standard deviation of the tie at UTC times [s], shape (n,); the largest where several legs hold."""
    found = np.zeros(len(time_ns))
    for leg in timeline:
        first_ns, last_ns = leg.utc_from_boot(np.array(leg.boot.span_ns(), np.int64)).tolist()
        end_ns, reference_ns = leg.utc_from_lidar(np.array([leg.last_lidar_ns, leg.sync.reference_ns])).tolist()
        inside = (time_ns >= first_ns - _SLACK_NS) & (time_ns <= min(last_ns, end_ns) + _SLACK_NS)
        since_s = (time_ns - reference_ns) * 1e-9
        sigma_s = np.hypot(leg.sync.sigma_offset_ns * 1e-9, leg.sync.sigma_drift_ppm * 1e-6 * since_s)
        found = np.where(inside, np.maximum(found, sigma_s), found)
    return found


def _warning(trajectory: Trajectory, way: Array, turn: Array, sigma_s: Array) -> str:
    """A sentence where the clocks are the larger part of a pose's sigma, in half of the poses or more."""
    used = trajectory.covered & (sigma_s > 0)
    if not used.any():
        return ""
    ours = (np.linalg.norm(way[used], axis=1), np.linalg.norm(turn[used], axis=1))
    theirs = (trajectory.sigma_position_m[used], trajectory.sigma_attitude_rad[used])
    if not any(
        np.median(own) > np.median(np.linalg.norm(other, axis=1)) for own, other in zip(ours, theirs, strict=True)
    ):
        return ""
    return (
        f"lidar and autopilot are tied within {np.median(sigma_s[used]) * 1e3:.0f} ms only (one sigma), which is worth "
        f"{np.median(ours[0]):.2f} m and {np.rad2deg(np.median(ours[1])):.2f} deg in the poses (median), more than all else; record the "
        "gyros of both (position packets, ATTITUDE at 25 Hz) and some motion"
    )
