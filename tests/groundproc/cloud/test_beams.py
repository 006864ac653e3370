"""Where beams come from, and their angle across the line of flight."""

from dataclasses import replace

import numpy as np
import pytest

from flightlog import frames
from flightlog.mount import LidarMount, Mount
from groundproc.cloud.beams import Beams
from groundproc.geodesy import LocalFrame
from groundproc.trajectory.trajectory import Trajectory

START_NS = 1_779_272_223_000_000_000
MOUNT = Mount(LidarMount((0.1, 0.2, -0.16), 0.0, -20.0, 0.0))


def flight(velocity: tuple[float, float, float], heading: float = 0.0) -> Trajectory:
    """Two seconds straight on, as it points or not."""
    time_ns = START_NS + np.arange(5) * 500_000_000
    quat = frames.quat_from_mat(frames.mat_local_ins(np.array([heading]), np.zeros(1), np.zeros(1)))
    position = np.array([10.0, 20.0, 50.0]) + np.arange(5)[:, None] * 0.5 * np.array(velocity)
    zero = np.zeros((5, 3))
    covered = np.array([True, True, True, True, False])
    return Trajectory(
        LocalFrame(58.4, 15.5, 60.0), time_ns, position, np.tile(velocity, (5, 1)), np.tile(quat[0], (5, 1)), zero, zero, zero, covered
    )  # fmt: skip


def test_a_beam_comes_from_where_the_sensor_was_at_its_own_instant() -> None:
    rng = np.random.default_rng(3)
    trajectory = replace(flight((3.0, 8.0, -0.5)), rate_rad_s=np.tile([0.3, -0.2, 0.5], (5, 1)))
    time_ns = np.sort(START_NS + rng.integers(0, 2 * 10**9, 4000))
    origins = Beams.of(time_ns, trajectory, MOUNT).origins(time_ns)
    poses = trajectory.at(time_ns)
    expected = poses.position_m + frames.mat_from_quat(poses.quat_local_ins_wxyz) @ MOUNT.lidar_position_m()
    np.testing.assert_allclose(origins, expected, rtol=0, atol=1e-4)


def test_at_the_edges_of_what_is_covered_a_beam_comes_from_the_nearest_pose() -> None:
    trajectory = replace(flight((0.0, 5.0, 0.0)), covered=np.array([False, True, False, False, False]))
    time_ns = START_NS + np.array([500_000_001, 700_000_000, 999_999_999])
    origins = Beams.of(time_ns, trajectory, MOUNT).origins(time_ns)
    expected = trajectory.at(time_ns).position_m + MOUNT.lidar_position_m()
    np.testing.assert_allclose(origins, expected, rtol=0, atol=0.03)  # 5 m/s for a step of 5 ms


@pytest.mark.parametrize(
    ("velocity", "heading", "beam", "expected_deg"),
    [
        ((0.0, 5.0, 0.0), 0.0, (0.0, 0.0, -10.0), 0.0),
        ((0.0, 5.0, 0.0), 0.0, (10.0, 0.0, -10.0), 45.0),  # flown north, the east is on the right
        ((0.0, 5.0, 0.0), 0.0, (10.0, 30.0, -10.0), 45.0),  # however far ahead
        ((0.0, 5.0, 0.0), 2.0, (-10.0, 0.0, -10.0), -45.0),  # the line of flight counts, not the heading
        ((-5.0, 0.0, 0.0), 0.0, (0.0, 10.0, 0.0), 90.0),
        ((0.0, 0.2, 0.0), np.pi / 2, (0.0, -10.0, -10.0), 45.0),  # a hover has no line of flight: the way it looks, east
        ((0.0, 5.0, 0.0), 0.0, (0.0, 1.0, 10.0), 180.0),
    ],
)  # fmt: skip
def test_the_scan_angle_is_across_the_line_of_flight_right_positive(
    velocity: tuple[float, float, float], heading: float, beam: tuple[float, float, float], expected_deg: float
) -> None:
    time_ns = np.array([START_NS + 700_000_000])
    beams = Beams.of(time_ns, flight(velocity, heading), MOUNT)
    origins = beams.origins(time_ns)
    angle = beams.scan_angle_deg(origins + beam, time_ns, origins)
    assert abs(angle[0]) == pytest.approx(abs(expected_deg), abs=0.26)
    assert expected_deg in (0.0, 180.0) or np.sign(angle[0]) == np.sign(expected_deg)
