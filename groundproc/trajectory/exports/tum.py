"""TUM: a line a pose, for evo and most odometry programs."""

from functools import partial
from pathlib import Path

from groundproc.trajectory.exports.local import body_quats, origin_of, stamp
from groundproc.trajectory.exports.source import Source


def writers(name: Path) -> dict[Path, partial[None]]:
    """The one file."""
    return {name: partial(_write)}


def _write(source: Source, path: Path) -> None:
    trajectory = source.trajectory
    quat = body_quats(trajectory.quat_local_ins_wxyz)
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.write(
            "# time x y z qx qy qz qw: Unix seconds (UTC); east, north, up of the origin; body forward, left, up\n"
        )
        file.write(origin_of(source).line())
        for time_ns, (x, y, z), (w, a, b, c) in zip(
            trajectory.time_ns.tolist(), trajectory.position_m.tolist(), quat.tolist(), strict=True
        ):
            file.write(f"{stamp(time_ns)} {x:.6f} {y:.6f} {z:.6f} {a:.9f} {b:.9f} {c:.9f} {w:.9f}\n")
