"""Flight lines of a trajectory: cut in turns and at pauses, at a cost that follows the poses."""

from pathlib import Path

import numpy as np
import pytest

from flightlog.errors import LogError, UsageError
from groundproc.estimation.dynamic.trims import read_yaw
from groundproc.geodesy import LocalFrame
from groundproc.imagery.poses import read_poses
from groundproc.raster.grid import LONGEST_SIDE, Grid
from groundproc.strips.cutting import line_begins_ns
from groundproc.trajectory.table import from_poses

STEP_NS = 20_000_000


def flown(pause_ns: int) -> tuple[np.ndarray, np.ndarray]:
    """30 s east, then 30 s north, a pause, and 30 s south, at 5 m/s; times and places."""
    steps = np.arange(1500)
    time_ns = np.arange(4500) * STEP_NS
    time_ns[3000:] += pause_ns
    way = 5.0 * STEP_NS * 1e-9 * steps
    east = np.concatenate([way, np.full(1500, way[-1]), np.full(1500, 400.0)])
    north = np.concatenate([np.zeros(1500), way, way[::-1]])
    return time_ns, np.stack([east, north, np.full(4500, 30.0)], axis=1)


@pytest.mark.parametrize("pause_ns", [120 * 10**9, 27 * 365 * 86400 * 10**9])
def test_a_line_begins_in_a_turn_and_after_a_pause(pause_ns: int) -> None:
    """Of two minutes, or of 27 years: one stamp that somebody spoilt."""
    time_ns, position = flown(pause_ns)
    count = len(time_ns)
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    nothing = np.zeros((count, 3))
    trajectory = from_poses(LocalFrame(58.0, 15.0, 0.0), time_ns, position, quat, nothing, nothing)
    begins = line_begins_ns(trajectory, 60.0)
    assert len(begins) == 2
    assert abs(begins[0] - 30 * 10**9) < 2 * 10**9
    assert begins[1] == time_ns[3000]


def test_numbers_that_no_column_holds_are_one_sentence(tmp_path: Path) -> None:
    trims, poses = tmp_path / "trims.csv", tmp_path / "poses.csv"
    trims.write_text(f"utc_ns,heading_deg,yaw_deg\n{10**30},1,2\n")
    with pytest.raises(LogError, match="is no table of trims"):
        read_yaw(trims)
    poses.write_text(f"image,utc_ns,easting,northing,height,omega_deg,phi_deg,kappa_deg\na.jpg,{10**30},1,2,3,4,5,6\n")
    with pytest.raises(Exception, match="expected numbers in every column"):
        read_poses(poses)


def test_a_raster_that_is_one_cell_wide_and_endless_is_refused() -> None:
    """Two points far apart: few cells, and minutes of writing empty blocks."""
    with pytest.raises(UsageError, match="take out the points that lie far from the others"):
        Grid(0, 0, 1, LONGEST_SIDE + 1, 0.25)
