"""When a smoother refutes an adjustment: both judged by what they state and by the same fixes."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from groundproc.estimation.adjustment.refuting import parted, parted_sigmas, slid_sigmas
from groundproc.estimation.consensus import POSITION_TAU_S, POSITION_WHITE_M
from groundproc.estimation.observations.fixes import SLID_SIGMAS
from groundproc.estimation.odometry.stated import Positions
from groundproc.geodesy import LocalFrame
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]

START_NS = 1_700_000_000 * 10**9
SECONDS = 60
SIGMA_M = np.array([2.5, 2.5, 3.0])


def flown(off_m: Array, sigma_m: float, heading_rad: float = 0.01) -> Trajectory:
    """There and back at 5 m/s, and so far off it, shape (n, 3), each tenth of a second."""
    seconds = np.arange(0, 10 * SECONDS + 1) * 0.1
    rows = len(seconds)
    way = np.column_stack([5.0 * np.minimum(seconds, SECONDS - seconds), 2.0 * np.sin(seconds), np.full(rows, 10.0)])
    place = way + off_m
    return Trajectory(
        LocalFrame(0.0, 0.0, 0.0), START_NS + np.round(seconds * 1e9).astype(np.int64), place,
        np.gradient(place, 0.1, axis=0), np.tile([1.0, 0.0, 0.0, 0.0], (rows, 1)), np.zeros((rows, 3)),
        np.full((rows, 3), sigma_m), np.tile([0.005, 0.005, heading_rad], (rows, 1)), np.ones(rows, np.bool_),
    )  # fmt: skip


def lasting(rng: np.random.Generator, sigma: Array) -> Array:
    """Errors that last as a receiver's do, each tenth of a second, shape (n, 3)."""
    keep = np.exp(-0.1 / POSITION_TAU_S)
    found = [sigma * rng.standard_normal(3)]
    for _ in range(10 * SECONDS):
        found.append(keep * found[-1] + np.sqrt(1.0 - keep**2) * sigma * rng.standard_normal(3))
    return np.array(found)


def fixes_at(path: Trajectory, error_m: Array) -> Positions:
    chosen = slice(None, None, 4)
    return Positions(
        path.time_ns[chosen], path.position_m[chosen] + error_m[chosen], np.tile(SIGMA_M, (len(path.time_ns[chosen]), 1)),
        np.zeros(3), POSITION_TAU_S, POSITION_WHITE_M,
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(5))
def test_a_smoother_that_follows_its_fixes_refutes_nothing_that_is_right(seed: int) -> None:
    """It wanders by metres, as it states; and an adjustment may be turned as a whole as far as it states."""
    rng = np.random.default_rng(seed)
    right = flown(np.zeros((601, 3)), 0.01)
    begun = flown(0.8 * lasting(rng, SIGMA_M), 2.2)
    assert not parted(right, begun)
    place = right.position_m
    swung = replace(right, position_m=place + 0.02 * np.column_stack([-place[:, 1], place[:, 0], np.zeros(601)]))
    assert not parted(swung, begun)


def test_an_adjustment_that_is_led_astray_is_refuted() -> None:
    """For ten seconds it goes by 1.5 m a second too little, and states centimetres: 15 m, where the smoother is off by 1.5 in 16 s."""
    rng = np.random.default_rng(3)
    seconds = np.arange(601) * 0.1
    slid = np.clip(seconds - 20.0, 0.0, 10.0)[:, None] * np.array([-1.5, 0.0, 0.0])
    error = lasting(rng, SIGMA_M)
    right, made = flown(np.zeros((601, 3)), 0.01), flown(slid, 0.01)
    begun = flown(0.8 * error, 2.2)
    fixes = [fixes_at(right, error)]
    assert parted(made, begun)
    assert slid_sigmas(made, np.zeros(3), fixes) > SLID_SIGMAS
    assert slid_sigmas(begun, np.zeros(3), fixes) < SLID_SIGMAS
    # one that knows that it knows little of its way is not wrong
    assert parted_sigmas(flown(slid, 5.0), begun) < 5.0


def test_what_a_whole_flight_shares_does_not_hide_a_slide() -> None:
    """Sigmas of metres are those of where the whole lies: within the flight the way is known to centimetres."""
    rng = np.random.default_rng(4)
    slid = np.clip(np.arange(601) * 0.1 - 20.0, 0.0, 10.0)[:, None] * np.array([-1.0, 0.0, 0.0])
    begun = flown(0.8 * lasting(rng, SIGMA_M), 2.2)
    shared = replace(flown(slid, 2.0), datum=np.diag([4.0, 4.0, 4.0, 0.0, 0.0, 0.0]))
    assert parted_sigmas(shared, begun) == pytest.approx(parted_sigmas(flown(slid, 1e-6), begun), rel=1e-3)


def test_trajectories_that_do_not_overlap_say_nothing_of_each_other() -> None:
    made = flown(np.zeros((601, 3)), 0.01)
    assert parted_sigmas(made, replace(made, time_ns=made.time_ns + 10**12)) == 0.0
