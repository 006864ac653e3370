"""RTKLIB's .pos: positions with their covariance and velocities, without attitudes."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from flightlog import __version__
from groundproc.flight.positions.rtklib import POINT_OF_INS
from groundproc.flight.positions.rtklibwriter import write_pos
from groundproc.flight.positions.solution import ELLIPSOID, MSL, Quality
from groundproc.trajectory.exports.source import Source


def writers(name: Path) -> dict[Path, partial[None]]:
    """The one file."""
    return {name: partial(_write)}


def _write(source: Source, path: Path) -> None:
    solution = source.solution((ELLIPSOID, MSL))
    nothing = np.zeros(len(solution))
    covariance = np.nan_to_num(solution.covariance_m2)  # RTKLIB writes zeros where nobody states it
    # of RTKLIB's kinds the one that comes nearest: blended with an IMU is not one of them
    quality = np.full(len(solution), Quality.DEAD_RECKONING, np.uint8)
    rows = replace(
        solution, covariance_m2=covariance, quality=quality, satellites=nothing, age_s=nothing, ratio=nothing
    )
    with path.open("w", encoding="ascii", newline="\n") as file:
        write_pos(file, rows, (f"program   : swath {__version__}", POINT_OF_INS))
