"""The reference of the linearisation: rates and forces of each step, and the path that the iteration begins with."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog import frames
from groundproc.estimation.inertial.readings import UNKNOWN_FORCE_DENSITY, UNKNOWN_RATE_DENSITY, Readings
from groundproc.estimation.observations.measured import Reference
from groundproc.estimation.observations.states import ATTITUDE, POSITION, VELOCITY
from groundproc.machine.aside import aside
from groundproc.numerics.rotations import quat_difference_outside, quat_multiply, quat_turned_by

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

LONGEST_BRIDGE_S: Final = 60.0
"""Longest silence of the fixes that accelerometers bridge."""
LONGEST_ALONE_S: Final = 3.0
"""The same without them."""
LONGEST_BLIND_S: Final = 1.0
"""Longest silence of gyros and attitudes."""


@dataclass(frozen=True, slots=True)
class Steps:
    """Rates and forces of each step, with those of the reference where no sensor was."""

    rate: Array
    force: Array
    rate_density: Array
    force_density: Array
    known: Mask
    force_known: Mask


def steps_of(r: Readings) -> Steps:
    """Where no gyro was, the attitudes' own differences; where no accelerometer was, the velocities'. In a file, as the readings are."""
    steps = len(r.nodes_s) - 1
    middle = 0.5 * (r.nodes_s[1:] + r.nodes_s[:-1])
    left = np.clip(np.searchsorted(r.attitude_s, middle) - 1, 0, len(r.attitude_s) - 2)
    turn = frames.quat_log(frames.quat_multiply(frames.quat_inverse(r.quat[:-1]), r.quat[1:]))
    rate = (turn / np.diff(r.attitude_s)[:, None])[left]
    rate_density = np.full(steps, UNKNOWN_RATE_DENSITY)
    known = np.zeros(steps, np.bool_)
    if r.gyro is not None:
        known = r.gyro.known
        rate = np.where(known[:, None], r.gyro.mean, rate)
        rate_density = np.where(known, r.gyro.density, rate_density)
        # a lidar whose gyro nothing has been compared with may be off by tens of degrees a second
        if r.gyro.share == 0.0:
            rate = rate - np.where(
                known[:, None],
                np.median((r.gyro.mean - (turn / np.diff(r.attitude_s)[:, None])[left])[known], axis=0),
                0.0,
            )
    force = np.zeros((steps, 3))
    force_known = np.zeros(steps, np.bool_)
    force_density = np.full(steps, UNKNOWN_FORCE_DENSITY)
    if r.force is not None:
        force_known = r.force.known
        force = np.where(force_known[:, None], r.force.mean, 0.0)
        force_density = np.where(force_known, r.force.density, force_density)
    return Steps(*aside(rate, force, rate_density, force_density, known, force_known))


def begun(r: Readings, steps: Steps) -> Reference:
    """The autopilot's own solution on the nodes, its attitudes joined by the gyros."""
    position = np.stack([np.interp(r.nodes_s, r.fix_s, axis) for axis in r.fix_m.T], axis=1)
    if r.fix_velocity_m_s is not None and np.isfinite(r.fix_velocity_m_s).all():
        velocity = np.stack([np.interp(r.nodes_s, r.fix_s, axis) for axis in r.fix_velocity_m_s.T], axis=1)
    else:
        velocity = np.gradient(position, r.step_ns * 1e-9, axis=0)
    place = np.clip(np.rint(r.attitude_s / (r.step_ns * 1e-9)).astype(np.int64), 0, len(r.nodes_s) - 1)
    keep = np.diff(place, prepend=-1) > 0
    quat = np.empty((len(r.nodes_s), 4))
    _join(steps.rate * (r.step_ns * 1e-9), place[keep], r.quat[keep], quat)
    position = position - frames.mat_from_quat(quat) @ r.lever_m
    return Reference(position, velocity, quat)


@njit(cache=True, nogil=True)
def _join(angle: Array, place: npt.NDArray[np.int64], given: Array, out: Array) -> None:
    """Attitudes on nodes: turned on from each given one by the gyros, what is missed at the next one spread evenly before it."""
    nodes = len(out)
    missed, part, unit = np.empty(3), np.empty(4), np.array([1.0, 0.0, 0.0, 0.0])
    out[place[0]] = given[0]
    for k in range(place[0] - 1, -1, -1):
        quat_turned_by(out[k + 1], angle[k], -1.0, out[k])
    for i in range(len(place)):
        low = place[i]
        high = place[i + 1] if i + 1 < len(place) else nodes - 1
        out[low] = given[i]
        for k in range(low, high):
            quat_turned_by(out[k], angle[k], 1.0, out[k + 1])
        if i + 1 == len(place):
            break
        quat_difference_outside(given[i + 1], out[high], missed)
        for k in range(low + 1, high):
            quat_turned_by(unit, missed, (k - low) / (high - low), part)
            quat_multiply(part, out[k], out[k])


def corrected(reference: Reference, correction: Array) -> Reference:
    """The reference with corrections of position, velocity and attitude, shape (n, 9), taken in."""
    quat = frames.quat_multiply(frames.quat_exp(correction[:, ATTITUDE : ATTITUDE + 3]), reference.quat)
    return Reference(
        reference.position_m + correction[:, POSITION : POSITION + 3],
        reference.velocity_m_s + correction[:, VELOCITY : VELOCITY + 3],
        quat / np.linalg.norm(quat, axis=1, keepdims=True),
    )


def covered(r: Readings, steps: Steps) -> Mask:
    """For each interval from a node to the next, whether something says how the vehicle moved; False for the last node."""

    def silent(time_s: Array, longest_s: float) -> Mask:
        after = np.clip(np.searchsorted(time_s, r.nodes_s[:-1], side="right"), 1, len(time_s) - 1)
        return np.asarray(time_s[after] - time_s[after - 1] > longest_s)

    turning = steps.known | ~silent(r.attitude_s, LONGEST_BLIND_S)
    outside_s = [(fixes.time_ns - r.start_ns) * 1e-9 for fixes in r.outside]
    placed_s = np.unique(np.concatenate([r.fix_s, *outside_s]))
    moving = ~silent(placed_s, LONGEST_ALONE_S) | (steps.force_known & ~silent(placed_s, LONGEST_BRIDGE_S))
    return np.append(turning & moving, False)
