"""Clocks of a simulated flight, tied once for all tests of a file that look at it: the search takes as long as a cloud of seconds."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from groundproc.flight.flight import Flight
from groundproc.flight.pairing import Leg, legs

_known: dict[Path, list[Leg]] = {}


def timeline(log: Path, flight: Flight, mat_ins_lidar: npt.NDArray[np.float64]) -> list[Leg]:
    """Legs of a flight by the rotation of its nominal mount; neither its log nor what was read of it may be changed."""
    if log not in _known:
        _known[log] = legs(flight.runs, flight.boots, mat_ins_lidar, "auto")
    return _known[log]
