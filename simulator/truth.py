"""What really was: poses as a table in the layout of the ground's trajectory.csv, and everything else as JSON."""

import json
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Final, Self, TextIO

import numpy as np
import numpy.typing as npt

from simulator.clocks import Clocks
from simulator.flight import Flight
from simulator.geodesy import Origin, geodetic
from simulator.lidar import TRUTH_DTYPE

COLUMNS: Final = "utc_ns,latitude_deg,longitude_deg,height_m,east_m,north_m,up_m,roll_deg,pitch_deg,heading_deg"


def write_poses(
    stream: TextIO, flight: Flight, clocks: Clocks, origin: Origin, time_s: npt.NDArray[np.float64]
) -> None:
    """Append true poses of the INS at true times: heights above mean sea level, heading 0 to 360."""
    poses = flight.poses(time_s)
    latitude, longitude, height = geodetic(poses.position_m, origin)
    utc_ns = clocks.utc.shows_ns(time_s)
    angles = np.degrees(np.stack([poses.roll_rad, poses.pitch_rad, poses.heading_rad % (2 * np.pi)], axis=1))
    for i in range(len(time_s)):
        east, north, up = poses.position_m[i]
        roll, pitch, heading = angles[i]
        stream.write(
            f"{utc_ns[i]},{latitude[i]:.10f},{longitude[i]:.10f},{height[i]:.4f},{east:.4f},{north:.4f},{up:.4f},"
            f"{roll:.6f},{pitch:.6f},{heading:.6f}\n"
        )


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write the rest of the truth."""
    path.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")


class PointsWriter:
    """True echoes in a .npy file of TRUTH_DTYPE that grows as the simulation goes on."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream, self._count = stream, 0
        self._write_header()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.seek(0)
        self._write_header()

    def _write_header(self) -> None:
        # numpy pads the header for a first axis that grows, so that the final count fits in place
        description = np.lib.format.dtype_to_descr(TRUTH_DTYPE)
        header = {"descr": description, "fortran_order": False, "shape": (self._count,)}
        np.lib.format.write_array_header_2_0(self._stream, header)

    def write(self, truth: npt.NDArray[np.void]) -> None:
        """Append true echoes."""
        self._stream.write(truth.tobytes())
        self._count += len(truth)
