"""A mission file as Mission Planner and QGroundControl read it: QGC WPL 110, a line a command (ardupilot.org, MAVLink mission commands)."""

from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.files import written_aside

_GLOBAL: Final = 0
_RELATIVE: Final = 3
"""Frames: MAV_FRAME_GLOBAL, and MAV_FRAME_GLOBAL_RELATIVE_ALT, whose heights are above home."""
_WAYPOINT: Final = 16
_RETURN: Final = 20
_TAKEOFF: Final = 22
_CHANGE_SPEED: Final = 178
_GROUND_SPEED: Final = 1


def write_mission(
    path: Path,
    latitude_deg: npt.NDArray[np.float64],
    longitude_deg: npt.NDArray[np.float64],
    height_m: float,
    speed_m_s: float,
) -> None:
    """Write take-off, speed, all turning points and the return; home is the first of them until the autopilot knows better.

    Raises
    ------
    SourceError
        It cannot be written.
    """
    rows = [
        (_GLOBAL, _WAYPOINT, (0.0, 0.0, 0.0, 0.0), latitude_deg[0], longitude_deg[0], 0.0),
        (_RELATIVE, _TAKEOFF, (0.0, 0.0, 0.0, 0.0), 0.0, 0.0, height_m),
        (_RELATIVE, _CHANGE_SPEED, (_GROUND_SPEED, speed_m_s, -1.0, 0.0), 0.0, 0.0, 0.0),
        *(
            (_RELATIVE, _WAYPOINT, (0.0, 0.0, 0.0, 0.0), latitude, longitude, height_m)
            for latitude, longitude in zip(latitude_deg, longitude_deg, strict=True)
        ),
        (_RELATIVE, _RETURN, (0.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0),
    ]
    lines = ["QGC WPL 110"]
    for number, (frame, command, parameters, latitude, longitude, height) in enumerate(rows):
        words = [number, int(number == 0), frame, command, *(f"{value:.6f}" for value in parameters)]
        lines.append("\t".join(map(str, [*words, f"{latitude:.8f}", f"{longitude:.8f}", f"{height:.6f}", 1])))
    with written_aside(path) as aside:
        aside.write_text("\n".join(lines) + "\n", encoding="ascii")
