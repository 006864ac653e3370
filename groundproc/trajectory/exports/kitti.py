"""KITTI: the first three rows of a homogeneous matrix a line, and the times in a second file."""

from functools import partial
from pathlib import Path

import numpy as np

from flightlog import frames
from groundproc.flight.positions.localposes import times_beside
from groundproc.trajectory.exports.local import body_quats, origin_of, stamp
from groundproc.trajectory.exports.source import Source


def writers(name: Path) -> dict[Path, partial[None]]:
    """Poses and times."""
    return {name: partial(_write), times_beside(name): partial(_write_times)}


def _write(source: Source, path: Path) -> None:
    trajectory = source.trajectory
    rotation = frames.mat_from_quat(body_quats(trajectory.quat_local_ins_wxyz))
    rows = np.concatenate([rotation, trajectory.position_m[:, :, None]], axis=2).reshape(-1, 12)
    with path.open("w", encoding="ascii", newline="\n") as file:
        np.savetxt(file, rows, fmt="%.9e")


def _write_times(source: Source, path: Path) -> None:
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.write("# Unix seconds (UTC) of each pose\n" + origin_of(source).line())
        file.writelines(f"{stamp(time_ns)}\n" for time_ns in source.trajectory.time_ns.tolist())
