"""Velocities from forces, of a vehicle whose motion is known."""

import numpy as np

from flightlog.constants import STANDARD_GRAVITY_M_S2
from groundproc.estimation.felt import felt


def test_forces_tell_the_change_of_velocity_and_silences_are_known() -> None:
    force_ns = np.arange(0, 20_000_000_000, 20_000_000)
    time_s = force_ns * 1e-9
    # level, pushed to the north with 2 sin(t), and heading turned by a quarter: forward is east
    up = np.full_like(time_s, STANDARD_GRAVITY_M_S2)
    quarter = np.array([np.cos(np.pi / 4.0), 0.0, 0.0, -np.sin(np.pi / 4.0)])
    force = np.stack([-2.0 * np.sin(time_s), np.zeros_like(time_s), up], axis=1)
    at_ns = np.arange(0, 20_000_000_000, 333_000_000)
    quat = np.tile(quarter, (len(force_ns), 1)) * np.where(np.arange(len(force_ns)) % 7 < 3, 1.0, -1.0)[:, None]
    found = felt(at_ns, (force_ns, force), (force_ns, quat))
    assert found is not None
    np.testing.assert_allclose(found.velocity_m_s[:, 1], 2.0 * (1.0 - np.cos(at_ns * 1e-9)), rtol=0, atol=2e-3)
    np.testing.assert_allclose(found.velocity_m_s[:, [0, 2]], 0.0, rtol=0, atol=1e-9)
    assert not found.unknown_m2_s2.any()
    heard = (time_s < 5.0) | (time_s > 6.0)
    found = felt(at_ns, (force_ns[heard], force[heard]), (force_ns, quat))
    assert found is not None
    gained = np.diff(found.unknown_m2_s2)
    assert (gained[(at_ns[1:] < 4_900_000_000) | (at_ns[:-1] > 6_100_000_000)] == 0.0).all()
    assert gained.sum() > 1e6


def test_forces_that_come_once_a_second_tell_nothing() -> None:
    slow_ns = np.arange(0, 20_000_000_000, 1_000_000_000)
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (len(slow_ns), 1))
    assert felt(slow_ns, (slow_ns, np.zeros((len(slow_ns), 3))), (slow_ns, quat)) is None
