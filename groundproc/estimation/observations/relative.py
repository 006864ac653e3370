"""Poses relative to each other: odometry of another program, by lidar or images. Its steps are good, but it drifts.

For each stamp, the pose of the airframe relative to the stamp before is stated, with a 6 x 6 covariance. Where the
whole lies is not used. No file that the survey names states steps; the caller hands them to `adjusted_estimate`. A
source has a clock and a lever arm of its own; the lever arm is that of the point whose poses they are.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np
import numpy.typing as npt
from scipy import sparse

from flightlog import frames
from groundproc.estimation.observations.moments import poses, rates, spots, velocities, within
from groundproc.estimation.observations.observation import Observation, Outcome, State
from groundproc.estimation.observations.rows import Errors, Factor, RowBuilder, Unknowns, cross
from groundproc.estimation.observations.source import Arm, Clock
from groundproc.estimation.odometry.spline import Path
from groundproc.numerics import robust

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

OUTLIER: Final = 3.0
"""Times the usual distance beyond which a step loses weight (Huber)."""
MEDIAN_DISTANCE: Final = 2.31
"""Median of the distance of six unit normals (chi distribution)."""


@dataclass(frozen=True, slots=True)
class Steps:
    """Poses, each against the one before.

    Attributes
    ----------
    source : str
    time_ns : ndarray of int64, shape (n + 1,)
        UTC, increasing.
    shift_m : ndarray, shape (n, 3)
        Of the point, in the axes of the ins frame at the earlier stamp.
    turn_quat : ndarray, shape (n, 4)
        Ins frame at the earlier stamp from that at the later one.
    covariance : ndarray, shape (n, 6, 6)
        Of shift [m] and of a small rotation vector [rad] in the axes of the earlier stamp.
    lever_m : ndarray, shape (3,)
        From the sensor to the point, sensor frame.
    delay_sigma_s : float
        How well its clock is known; 0: exactly.
    """

    source: str
    time_ns: Ints
    shift_m: Array
    turn_quat: Array
    covariance: Array
    lever_m: Array
    delay_sigma_s: float = 0.0


@dataclass(slots=True)
class RelativePoses(Observation):
    """One source of steps.

    Attributes
    ----------
    name : str
        Prefix of its globals.
    given : Steps
    clock : Clock
    arm : Arm
    """

    name: str
    given: Steps
    clock: Clock
    arm: Arm
    leads: ClassVar[bool] = True

    def joined(self, values: Mapping[str, Array], kept: Any) -> None:
        """The windows' shapes have all of it."""

    def unknowns(self, unknowns: Unknowns) -> None:
        """Delay and lever arm where they are free."""
        self.clock.unknowns(unknowns)
        self.arm.unknowns(unknowns)

    def factors(self, state: State, unknowns: Unknowns) -> list[Factor]:
        """Six rows a step."""
        mat, turn_name = state.boresight(unknowns)
        return relative_factors(self, state.path, unknowns, mat, turn_name)

    def take(self, part: Mapping[str, Array], path: Path) -> None:
        """Delay and lever arm."""
        del path
        self.clock, self.arm = self.clock.taken(part), self.arm.taken(part)

    def report(self, outcome: Outcome) -> dict[str, Any]:
        """Where they came from, and how well they agree."""
        inside = within(self.given.time_ns, outcome.path)
        off = outcome.largest(f"{self.name} step_rms")
        return {"relative": [{"source": self.given.source, "poses": int(inside.sum()), "residual_rms": off}]}


def observed(given: Steps, name: str = "relative", arm_sigma_m: float = 0.0) -> RelativePoses:
    """A source with a clock of its own, and a lever arm that is held unless a sigma is given."""
    return RelativePoses(
        name, given, Clock(f"{name}.delay", given.delay_sigma_s), Arm(f"{name}.lever", given.lever_m, arm_sigma_m)
    )


def steps_of(
    source: str,
    time_ns: Ints,
    position_m: Array,
    quat: Array,
    covariance: Array,
    lever_m: Array,
    delay_sigma_s: float = 0.0,
) -> Steps:
    """Steps of a course of poses in any frame of its own.

    Parameters
    ----------
    source : str
    time_ns : ndarray of int64, shape (n + 1,)
    position_m, quat : ndarray, shape (n + 1, 3), (n + 1, 4)
        Of the point, and "frame from ins".
    covariance : ndarray, shape (n, 6, 6)
        Of the steps, as of `Steps`.
    lever_m, delay_sigma_s
        As of `Steps`.
    """
    back = frames.quat_inverse(quat[:-1])
    shift = np.einsum("nij,nj->ni", frames.mat_from_quat(back), np.diff(position_m, axis=0))
    return Steps(source, time_ns, shift, frames.quat_multiply(back, quat[1:]), covariance, lever_m, delay_sigma_s)


def relative_factors(
    own: RelativePoses, path: Path, unknowns: Unknowns, mat_sensor_ins: Array, turn_name: str | None
) -> list[Factor]:
    """The steps that lie within a path; none where it covers fewer than two poses."""
    given, lever = own.given, own.arm.lever_m
    time_ns = own.clock.ours_ns(given.time_ns)
    inside = within(time_ns, path)
    chosen = np.flatnonzero(inside[1:] & inside[:-1])
    if not len(chosen):
        return []
    knot, weights, step, share = spots(time_ns, path)
    quat, position = poses(path, step, share)
    mats = frames.mat_from_quat(quat)
    point = position + mats @ lever
    now, then, count = chosen, chosen + 1, len(chosen)
    to_ins = np.swapaxes(mats @ mat_sensor_ins, 1, 2)[now]
    ahead = point[then] - point[now]
    made = np.einsum("nij,nj->ni", to_ins, ahead)
    turn = to_ins @ mats[then] @ mat_sensor_ins
    off = frames.quat_log(frames.quat_from_mat(turn @ np.swapaxes(frames.mat_from_quat(given.turn_quat[chosen]), 1, 2)))
    residual = np.concatenate([made - given.shift_m[chosen], off], axis=1)
    builder, row = RowBuilder(6 * count, unknowns), 6 * np.arange(count)
    arm = np.tile(cross(lever[None]), (count, 1, 1))
    for at, sign in ((then, 1.0), (now, -1.0)):
        builder.at_times(row, knot[at], weights[at], 3, sign * to_ins)
        # the later end moves with its lever arm; both turn the step
        builder.at_times(row, knot[at], weights[at], 0, -sign * to_ins @ mats[at] @ arm)
        builder.at_times(row + 3, knot[at], weights[at], 0, sign * to_ins @ mats[at])
    builder.at_times(row, knot[now], weights[now], 0, to_ins @ cross(ahead) @ mats[now])
    if turn_name is not None:
        back = np.broadcast_to(mat_sensor_ins.T, (count, 3, 3))
        in_sensor = np.einsum("nji,nj->ni", mats[now], ahead)
        builder.by(row, turn_name, back @ cross(in_sensor))
        builder.by(row + 3, turn_name, to_ins @ (mats[then] - mats[now]))
    speed, turning = velocities(path, step, lever), rates(path, step)
    slid = np.einsum("nij,nj->ni", to_ins, speed[then] - speed[now] - np.cross(turning[now], ahead))
    spun = np.einsum("nij,nj->ni", to_ins, turning[then] - turning[now])
    own.clock.add(builder, row, np.concatenate([slid, spun], axis=1))
    own.arm.add(builder, row, to_ins @ (mats[then] - mats[now]))
    return [_weighed(f"{own.name} step", residual, builder.matrix(), given.covariance[chosen])]


def _weighed(name: str, residual: Array, matrix: sparse.csr_matrix, covariance: Array) -> Factor:
    """Rows made independent and of unit noise; steps that are far off have less weight (Huber)."""
    spread = np.linalg.cholesky(covariance)
    distance = np.linalg.norm(np.linalg.solve(spread, residual[:, :, None])[:, :, 0], axis=1)
    usual = OUTLIER * max(1.0, float(np.median(distance)) / MEDIAN_DISTANCE)
    share = robust.huber(distance, usual)
    white = sparse.block_diag(np.linalg.inv(spread) * np.sqrt(share)[:, None, None], format="csr")
    return Factor(
        name, white @ residual.ravel(), (white @ matrix).tocsr(), np.ones(residual.size), errors=Errors.LASTING
    )
