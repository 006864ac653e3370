"""What TUM and KITTI have in common: the origin, the body's axes, the stamps."""

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.constants import NS_PER_S
from groundproc.flight.positions.localposes import QUAT_INS_BODY, Origin
from groundproc.trajectory.exports.source import Source

Array = npt.NDArray[np.float64]


def origin_of(source: Source) -> Origin:
    """Where the local frame of a trajectory lies."""
    frame = source.trajectory.frame
    return Origin(frame.latitude_deg, frame.longitude_deg, frame.height_m, source.height_reference)


def body_quats(quat_local_ins_wxyz: Array) -> Array:
    """Attitudes of the body (forward, left, up) of those of the ins frame, shape (n, 4), scalar first and not negative."""
    quat = frames.quat_multiply(quat_local_ins_wxyz, QUAT_INS_BODY)
    return np.asarray(np.where(quat[:, :1] < 0.0, -quat, quat))


def stamp(time_ns: int) -> str:
    """Seconds of a time [ns] with all its digits."""
    return f"{time_ns // NS_PER_S}.{time_ns % NS_PER_S:09d}"
