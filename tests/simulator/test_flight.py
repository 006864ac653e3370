"""The motion agrees with itself: rates with attitude, attitude with acceleration."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from simulator.config import FlightOptions
from simulator.flight import Flight, tilt_for
from simulator.route import Route

SQUARE = Route(((0.0, 0.0, 3.0), (0.0, 20.0, 6.0), (20.0, 20.0, 8.0), (20.0, 0.0, 5.0), (0.0, 0.0, 6.0)))


@pytest.fixture(scope="module")
def flight():
    return Flight(SQUARE, 40.0, FlightOptions(), seed=5)


def rotations(flight, time_s):
    """Attitudes by scipy: heading clockwise about z, then pitch about x, then roll about y."""
    poses = flight.poses(time_s)
    return Rotation.from_euler("ZXY", np.stack([-poses.heading_rad, poses.pitch_rad, poses.roll_rad], axis=1))


def test_rates_integrate_to_the_attitude(flight):
    # midpoint rule at 2 kHz: vibration of 40 Hz moves 0.13 rad of phase in a step
    time_s = np.arange(0.0, 20.0, 0.0005)
    turned = rotations(flight, time_s[:1])
    steps = Rotation.from_rotvec(flight.rates_rad_s(time_s[:-1] + 0.00025) * 0.0005)
    for step in steps:
        turned = turned * step
    left = turned.inv() * rotations(flight, time_s[-1:])
    assert np.degrees(left.magnitude()[0]) < 0.001


def test_specific_force_is_acceleration_plus_gravity_in_the_body(flight):
    time_s = np.arange(1.0, 30.0, 0.01)
    position = [flight.poses(time_s + d).position_m for d in (-0.002, 0.0, 0.002)]
    acceleration = (position[0] - 2 * position[1] + position[2]) / 0.002**2
    force = rotations(flight, time_s).inv().apply(acceleration + np.array([0, 0, 9.80665]))
    assert np.abs(force - flight.specific_force_m_s2(time_s)).max() < 0.01


def test_at_a_lever_arm_the_force_is_that_of_the_point_there(flight):
    # calm: differences over 2 ms of a vibration at 40 Hz would miss its acceleration by (2 pi 40 * 0.002)^2 / 12 = 2 %
    calm, lever = Flight(SQUARE, 20.0, FlightOptions(vibration_deg=0.0), seed=5), np.array([0.1, 0.3, -0.16])
    time_s = np.arange(1.0, 19.0, 0.01)
    position = [
        calm.poses(time_s + d).position_m + rotations(calm, time_s + d).apply(lever) for d in (-0.002, 0.0, 0.002)
    ]
    acceleration = (position[0] - 2 * position[1] + position[2]) / 0.002**2
    force = rotations(calm, time_s).inv().apply(acceleration + np.array([0, 0, 9.80665]))
    assert np.abs(force - calm.specific_force_m_s2(time_s, lever)).max() < 0.01
    # and it is another one than at the INS
    assert np.abs(force - calm.specific_force_m_s2(time_s)).max() > 0.3


def test_a_long_motion_is_the_same_in_blocks():
    calm = Flight(SQUARE, 60.0, FlightOptions(), seed=5)
    time_s = np.arange(0.0, 60.0, 0.002)  # more than one block
    some = slice(19_990, 20_010)
    assert (calm.poses(time_s).pitch_rad[some] == calm.poses(time_s[some]).pitch_rad).all()


def test_a_multirotor_feels_hardly_any_sideways_force(flight):
    time_s = np.arange(4.0, 36.0, 0.01)
    force = flight.specific_force_m_s2(time_s)
    # drag at 4 m/s, and vibration that turns the frame
    assert np.abs(force[:, :2]).max() < 0.25 * 6.0 + 9.81 * np.radians(0.2)
    assert force[:, 2].mean() == pytest.approx(9.81, abs=0.3)


@pytest.mark.parametrize(
    ("thrust", "heading_deg", "pitch_sign", "roll_sign"),
    [
        ((0.0, 1.0, 9.8), 0.0, -1, 0),  # north while facing north: nose down
        ((1.0, 0.0, 9.8), 0.0, 0, 1),  # east while facing north: right side down
        ((1.0, 0.0, 9.8), 90.0, -1, 0),  # east while facing east: nose down
        ((0.0, 1.0, 9.8), 90.0, 0, -1),  # north while facing east: left side down
    ],
)
def test_it_leans_into_its_acceleration(thrust, heading_deg, pitch_sign, roll_sign):
    pitch, roll = tilt_for(np.array([thrust]), np.radians([heading_deg]))
    assert np.sign(np.round(pitch[0], 9)) == pitch_sign
    assert np.sign(np.round(roll[0], 9)) == roll_sign
    up = Rotation.from_euler("ZXY", [[-np.radians(heading_deg), pitch[0], roll[0]]]).apply([0, 0, 1])[0]
    assert up == pytest.approx(np.array(thrust) / np.linalg.norm(thrust), abs=1e-12)


def test_the_first_seconds_are_gentle(flight):
    time_s = np.arange(0.0, 1.0, 0.01)
    assert np.linalg.norm(flight.velocity_m_s(time_s), axis=1).max() < 0.3


def test_the_nose_follows_the_course(flight):
    time_s = np.arange(6.0, 7.0, 0.1)
    velocity = flight.velocity_m_s(time_s)
    course = np.arctan2(velocity[:, 0], velocity[:, 1])
    assert np.degrees(np.abs(flight.poses(time_s).heading_rad - course)).max() < 12


def test_there_is_motion_for_gyros_to_correlate(flight):
    rates = np.degrees(flight.rates_rad_s(np.arange(4.0, 36.0, 0.01)))
    assert (rates.std(axis=0) > 5.0).all()
    assert np.abs(rates).max() < 200.0


def test_a_tripod_does_not_move():
    still = Flight(Route(((1.0, 2.0, 1.5),), heading_deg=30.0, kind="tripod"), 5.0, FlightOptions(), seed=1)
    poses = still.poses(np.linspace(0, 5, 50))
    assert np.abs(poses.position_m - [1.0, 2.0, 1.5]).max() < 1e-9
    assert np.abs(np.degrees(poses.heading_rad) - 30.0).max() < 1e-9
    assert np.abs(poses.pitch_rad).max() < 1e-12


def test_vibration_is_as_strong_as_asked_and_has_no_part_in_the_position():
    shaken, calm = (Flight(SQUARE, 10.0, FlightOptions(vibration_deg=v), seed=2) for v in (0.1, 0.0))
    time_s = np.arange(0.0, 10.0, 0.001)
    difference = np.degrees(shaken.poses(time_s).pitch_rad - calm.poses(time_s).pitch_rad)
    assert difference.std() == pytest.approx(0.1, rel=0.1)
    assert (shaken.poses(time_s).position_m == calm.poses(time_s).position_m).all()


def test_motors_shake_the_rates_as_asked_and_faster_than_gyros_are_read():
    """Rates of 0.5, 1.8 and 1.8 deg/s RMS above 85 Hz: next to nothing of it is motion, and none of it is in the position."""
    asked = (0.5, 1.8, 1.8)
    shaken, calm = (Flight(SQUARE, 10.0, FlightOptions(buzz_deg_s=b), seed=2) for b in (asked, (0.0, 0.0, 0.0)))
    time_s = np.arange(0.0, 10.0, 0.0005)
    poses, still = shaken.poses(time_s), calm.poses(time_s)
    assert (poses.position_m == still.position_m).all()
    for name, rms in zip(("heading_rad", "pitch_rad", "roll_rad"), asked, strict=True):
        angle = np.degrees(getattr(poses, name) - getattr(still, name))
        assert np.gradient(angle, time_s).std() == pytest.approx(rms, rel=0.15)
        assert angle.std() < rms / (2 * np.pi * 85)


def test_gusts_are_as_strong_as_asked():
    gusty, calm = (Flight(SQUARE, 10.0, FlightOptions(gust_deg=g), seed=2) for g in (0.05, 0.0))
    time_s = np.arange(0.0, 10.0, 0.001)
    for name in ("heading_rad", "pitch_rad", "roll_rad"):
        difference = np.degrees(getattr(gusty.poses(time_s), name) - getattr(calm.poses(time_s), name))
        assert difference.std() == pytest.approx(0.05, rel=0.15)
