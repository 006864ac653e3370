"""The autopilot's GNSS positions: metres, with errors that last for a minute and more."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.constants import NS_PER_S
from groundproc.estimation.consensus import POSITION_TAU_S, POSITION_WHITE_M, Steps, agreeing, doubt
from groundproc.estimation.method import Given
from groundproc.estimation.observations.measured import Heard, Learnt, Measured, Rows, Stated, turned_by
from groundproc.estimation.observations.moments import means, poses, seconds, spots, velocities, within
from groundproc.estimation.observations.observation import Flown, Observation, Outcome, State, Stretch
from groundproc.estimation.observations.rows import Errors, Factor, H, RowBuilder, Unknowns, cross, eye, whitened
from groundproc.estimation.observations.source import Clock
from groundproc.estimation.observations.states import (
    ATTITUDE,
    FIX_AGE,
    FIX_POSITION,
    FIX_VELOCITY,
    POSITION,
    VELOCITY,
)
from groundproc.estimation.odometry.matching import TELLS_M
from groundproc.estimation.odometry.spline import Path
from groundproc.estimation.odometry.stated import Positions
from groundproc.estimation.odometry.tracker import SURE_HELD_M
from groundproc.flight.autopilot import Boot
from groundproc.flight.sync.tracks import low_pass
from groundproc.flight.timeline import Leg
from groundproc.numerics.robust import huber, sigma_of_columns

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

LEAST_POSITION_SIGMA_M: Final = 0.02
DELAY_SIGMA_S: Final = 0.0
"""How well the delay of the fixes beyond that of the autopilot's clock is known; 0: it is none, and is held. Metres of lasting errors do
not tell a delay: 5 m/s and 0.1 s are half a metre, in a direction that changes with the course."""
DRIFT_S: Final = 10
SLID_SIGMAS: Final = 6.0
"""A path that slides away from the fixes by more, in `DRIFT_S`, is worth a warning."""
STEP_SIGMAS: Final = 4.0
"""A step of the positions that is off by more loses weight (Huber)."""
APART: Final = (4.0, 6.0)
"""Deviations from the median from which on, and up to which, a fix loses its say about where the whole lies."""
LEAST_SPREAD: Final = 0.5
"""Fixes are not taken to agree better than this, in their sigmas: over seconds they all have the same error."""
WRONG_SIGMAS: Final = 4.0
"""A path whose distance from the fixes is more, RMS, is worth a warning."""
UNHELD_M2: Final = 1.0
"""What a path may wander by in a slice [m^2] that does not hold it firmly: such a lidar judges nobody."""
BEARING_RAD: Final = 0.05
"""How far the odometry's map is turned (1 sigma): by the heading that it began with."""
AGE_S: Final = 0.2
"""How much older than stated a fix may be (1 sigma)."""
SLID: Final = "position_drift"
"""Of the figures of a step: how far the path slides away from the fixes."""


LIVELY_S: Final = 5
"""Seconds over which changes of the fixes' errors are added up to be judged: multipath changes with the walls that one passes."""
LIVELY_SIGMAS: Final = 3.0
"""Changes larger than stated by so much more than chance allows are what the receiver does."""


@dataclass(frozen=True, slots=True)
class Left:
    """What the lidar's path says of the fixes: some were left out because they contradict it.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (n,)
    farthest_m : float
        Largest distance from where the others have the path.
    doubt_m2 : ndarray, shape (3,)
        Variance of where the whole lies, where nobody can tell which of the fixes are right.
    strain : float
        How many times more than stated horizontal errors change within seconds.
    """

    time_ns: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    farthest_m: float = 0.0
    doubt_m2: Array = field(default_factory=lambda: np.zeros(3))
    strain: float = 1.0

    @classmethod
    def of_all(cls, parts: Sequence["Left"]) -> "Left":
        """Those of several windows."""
        if not parts:
            return cls()
        return cls(
            np.unique(np.concatenate([part.time_ns for part in parts])),
            max(part.farthest_m for part in parts),
            np.max([part.doubt_m2 for part in parts], axis=0),
            max(part.strain for part in parts),
        )


NOTHING_LEFT: Final = Left()


@dataclass(slots=True)
class Fixes(Observation):
    """The positions of one leg.

    Attributes
    ----------
    name : str
    given : Positions
    number : int
        Of the leg: each has a mean error of its own.
    clock : Clock
    left : Left
        What was left out.
    """

    name: str
    given: Positions
    number: int
    clock: Clock
    left: "Left" = field(default_factory=lambda: Left())

    def begin(self, stretch: Stretch) -> "Fixes":
        """Without those that go where the lidar does not, while it holds the path."""
        given, left = without_walks(self.given, stretch)
        return replace(self, given=given, left=replace(left, strain=strain_of(given, stretch)))

    def keep(self, state: State, frame: Path) -> "Left":
        """What was left out."""
        del state, frame
        return self.left

    def tell(self, state: State) -> "Left":
        """What was left out."""
        del state
        return self.left

    def joined(self, values: Mapping[str, Array], kept: Sequence[Any]) -> "Fixes":
        """With the delay as the windows found it, and without what they left out."""
        left = Left.of_all([each for each in kept if each is not None])
        given = self.given.only(~np.isin(self.given.time_ns, left.time_ns))
        return replace(self, clock=self.clock.held(values), given=given, left=left)

    def unknowns(self, unknowns: Unknowns) -> None:
        """The mean error, and the delay where it is free."""
        unknowns.add(fixes_name(self.number), np.full(3, 100.0), unit="m")
        self.clock.unknowns(unknowns)

    def factors(self, state: State, unknowns: Unknowns) -> list[Factor]:
        """The course of the positions, and their mean."""
        return position_factors(self.given, state.path, unknowns, self.number, self.clock, self.left)

    def take(self, part: Mapping[str, Array], path: Path) -> None:
        """The mean error is told anew in each step."""
        del path
        self.clock = self.clock.taken(part)

    def figures(self, factors: Sequence[Factor]) -> dict[str, float]:
        """Whether the path slides away."""
        return {f"{factor.name}_rms": factor.rms() for factor in factors} | {SLID: drift(factors, self.left.strain)}

    def warnings(self, outcome: Outcome) -> list[str]:
        """A path that goes where the fixes do not."""
        found = []
        left = Left.of_all([told[self.name] for told in outcome.told if self.name in told])
        if len(left.time_ns):
            found.append(
                f"{len(left.time_ns)} GNSS positions left out: the lidar holds the path, and they leave it by up to {left.farthest_m:.1f} m"
            )
        slid = outcome.largest(SLID)
        if slid > SLID_SIGMAS:
            found.append(
                f"for {DRIFT_S} s the path slides away from the GNSS positions by {slid:.1f} sigma, expected under {SLID_SIGMAS:.0f}; "
                + (
                    "the trajectory is what the adjustment began from"
                    if outcome.misled
                    else "the lidar may have been misled there"
                )
            )
        off = outcome.largest("position_rms")
        if off > WRONG_SIGMAS:
            found.append(
                f"the path differs from the GNSS positions by {off:.1f} sigma, expected 1; one of them is wrong"
            )
        return found


def of_run(flown: Flown) -> list[Observation]:
    """One for each leg."""
    return [
        Fixes(f"fixes{number}", position_track(flown.given, leg), number, Clock(f"fixes{number}.delay", DELAY_SIGMA_S))
        for number, leg in enumerate(flown.legs)
    ]


def without_walks(given: Positions, stretch: Stretch) -> tuple[Positions, Left]:
    """Positions without those that drift away from a path that the lidar holds, and what was left out.

    A receiver that is misled by walls and trees drifts by metres while the lidar sees that nothing moves. The longest
    chain of fixes that agrees with the lidar's path is right (`consensus`).
    """
    inside = within(given.time_ns, stretch.path)
    if stretch.unheld_m is None or inside.sum() < 2:
        return given, Left()
    time_ns = given.time_ns[inside]
    _, _, step, share = spots(time_ns, stretch.path)
    quat, position = poses(stretch.path, step, share)
    place = position + frames.mat_from_quat(quat) @ given.lever_m
    off = given.position_m[inside] - place
    gained = np.where(stretch.unheld_m <= SURE_HELD_M, np.square(stretch.unheld_m), UNHELD_M2)
    edges_s = np.arange(len(gained) + 1) * H
    time_s: Array = np.asarray((time_ns - stretch.path.start_ns) * 1e-9, np.float64)
    drift_m2 = np.interp(time_s, edges_s, np.concatenate([[0.0], np.cumsum(gained)]))
    loose = np.column_stack([BEARING_RAD * place[:, :2], AGE_S * velocities(stretch.path, step, given.lever_m)])
    steps = Steps(given.sigma_m[inside], given.tau_s, drift_m2, loose)
    kept = agreeing(time_s, off, steps)
    if kept.all():
        return given, Left()
    left = time_ns[~kept]
    right = np.stack([np.interp(time_s[~kept], time_s[kept], axis) for axis in off[kept].T], axis=1)
    farthest_m = float(np.linalg.norm(off[~kept] - right, axis=1).max())
    return given.only(~np.isin(given.time_ns, left)), Left(left, farthest_m, doubt(time_s, off, kept))


def strain_of(given: Positions, stretch: Stretch) -> float:
    """How many times more than stated the horizontal errors of the fixes change within seconds, 1 at least.

    Beside walls, a receiver errs by metres, and differently every ten metres of the path. Where the lidar holds the
    path, the deviation of the fixes from it is their error, except for a rotation of the map and their delay. The
    whitened changes of that error, added up over some seconds, should be of size one.
    """
    inside = within(given.time_ns, stretch.path)
    if stretch.unheld_m is None or inside.sum() < 2:
        return 1.0
    time_ns = given.time_ns[inside]
    _, _, step, share = spots(time_ns, stretch.path)
    quat, position = poses(stretch.path, step, share)
    place = position + frames.mat_from_quat(quat) @ given.lever_m
    group, middle = seconds(time_ns)
    off = means(given.position_m[inside] - place, group)[:, :2]
    way = means(place, group)[:, :2]
    time_s = (time_ns[middle] - time_ns[0]) * 1e-9
    # what a turn of the map, and an age of the fixes, make of the way
    bent = np.stack([np.stack([-way[:, 1], way[:, 0]], axis=1), np.gradient(way, axis=0)], axis=2)
    keep = np.exp(-np.diff(time_s)[:, None] / given.tau_s[:2])
    sigma = means(given.sigma_m[inside], group)[1:, :2]
    size = np.sqrt(sigma**2 * (1.0 - keep**2) + given.white_m**2 * (1.0 + keep**2))
    held = np.concatenate([[0], np.cumsum(stretch.unheld_m > TELLS_M)])
    edge = np.clip(np.round((time_ns[middle] - stretch.path.start_ns) * 1e-9 / H).astype(np.int64), 0, len(held) - 1)
    good = (np.diff(held[edge]) == 0) & (np.diff(time_s) < 1.5)
    changes = (off[1:] - keep * off[:-1]) / size
    bent = (bent[1:] - keep[:, :, None] * bent[:-1]) / size[:, :, None]
    if good.sum() < 2 * LIVELY_S:
        return 1.0
    explained, *_ = np.linalg.lstsq(bent[good].reshape(-1, 2), changes[good].ravel(), rcond=None)
    left = np.where(good[:, None], changes - bent @ explained, 0.0)
    whole = np.convolve(good, np.ones(LIVELY_S), mode="valid") == LIVELY_S
    sums = np.stack([np.convolve(axis, np.ones(LIVELY_S), mode="valid")[whole] for axis in left.T]) / np.sqrt(LIVELY_S)
    if not sums.size:
        return 1.0
    power = float(np.square(sums).mean())
    chance = LIVELY_SIGMAS * float(np.sqrt(2.0 * LIVELY_S / (2.0 * good.sum())))
    return float(np.sqrt(power)) if power > 1.0 + chance else 1.0


def drift(factors: Sequence[Factor], strain: float = 1.0) -> float:
    """Largest mean of ten whitened position residuals on end, in sigmas of such a mean: a path that slides away from the fixes.

    In the sigmas that are stated, whatever `strain` the rows were given.
    """
    largest = 0.0
    for factor in factors:
        if factor.name == "position" and len(factor.residual) > 3 * DRIFT_S:
            whitened = (factor.residual / factor.sigma).reshape(-1, 3) * [strain, strain, 1.0]
            sums = np.cumsum(whitened, axis=0)
            largest = max(largest, float(np.abs(sums[DRIFT_S:] - sums[:-DRIFT_S]).max()) / np.sqrt(DRIFT_S))
    return largest


def fixes_name(number: int) -> str:
    """The unknown that the mean error of the n-th source of positions is."""
    return f"world.fixes{number}"


def position_factors(
    given: Positions, path: Path, unknowns: Unknowns, number: int = 0, clock: Clock | None = None,
    left: Left = NOTHING_LEFT,
) -> list[Factor]:  # fmt: skip
    """Positions as means over a second: their course, and their mean; none where the path covers fewer than two.

    The course alone, with an unknown mean error, bends and turns the path. Where the whole lies is left to the plain
    mean of the fixes, weighted by 1 / sigma^2. The best linear weights for errors that last would put two thirds of a
    minute's weight on its first and last fix. They are better by a tenth at most, and only if the errors last exactly
    as long as stated.
    """
    stamps_ns = given.time_ns if clock is None else clock.ours_ns(given.time_ns)
    inside = within(stamps_ns, path)
    if inside.sum() < 2:
        return []
    time_ns = stamps_ns[inside]
    _, _, step, share = spots(time_ns, path)
    quat, position = poses(path, step, share)
    off = position + frames.mat_from_quat(quat) @ given.lever_m - given.position_m[inside]
    group, middle = seconds(time_ns)
    residual, sigma = means(off, group), means(given.sigma_m[inside], group)
    knot, weights, _, _ = spots(time_ns[middle], path)
    count = len(middle)
    builder, row = RowBuilder(3 * count, unknowns), 3 * np.arange(count)
    builder.at_times(row, knot, weights, 3, eye(count))
    builder.by(row, "world.turn", -cross(position[middle]))
    builder.by(row, "world.shift", eye(count))
    if fixes_name(number) in unknowns.names:
        builder.by(row, fixes_name(number), -eye(count))
    if clock is not None:
        clock.add(builder, row, means(velocities(path, step, given.lever_m), group))
    time_s = (time_ns[middle] - time_ns[0]) * 1e-9
    course = whitened("position", residual, builder.matrix(), time_s, sigma, given.tau_s, given.white_m, Errors.ANCHOR)
    course = replace(
        course,
        sigma=course.sigma * np.tile([left.strain, left.strain, 1.0], count),
        source=fixes_name(number),
        course=True,
        weakened=left.strain,
    )
    # a receiver that jumps, or is led astray by a wall, goes where no vehicle does: its steps lose weight
    course = replace(course, sigma=course.sigma / np.sqrt(huber(np.abs(course.residual) / course.sigma, STEP_SIGMAS)))
    if fixes_name(number) not in unknowns.names:
        return [course]
    mean = _mean_factor(residual, position[middle], (knot, weights), time_s, sigma, given, unknowns)
    return [course, replace(mean, sigma=np.sqrt(mean.sigma**2 + left.doubt_m2), source=course.source)]


SAMPLES: Final = 8
"""Moments of the flight by which the mean of the fixes is stated."""


def _mean_factor(
    residual: Array, position_m: Array, spline: tuple[Ints, Array], time_s: Array, sigma: Array, given: Positions,
    unknowns: Unknowns,
) -> Factor:  # fmt: skip
    """The mean of the residuals, shape (n, 3), as three rows.

    In terms of every coefficient of the spline these rows would be dense. So they are expressed by a few moments of
    the flight, with weights such that whatever moves or turns the path as a whole changes their mean as it changes the
    mean of all. Bends are represented a little wrongly. The residual is that of the actual path, so this costs a step,
    but does not change the result.
    """
    weights = mean_weights(residual, sigma)
    builder, row = RowBuilder(3, unknowns), np.zeros(1, np.int64)
    centre = weights.T @ position_m
    some = np.unique(np.linspace(0, len(time_s) - 1, SAMPLES).round().astype(np.int64))
    shares = np.stack([_shares(position_m[some] - centre[axis]) for axis in range(3)], axis=1)
    for i, share in zip(some, shares, strict=True):
        builder.at_times(row, spline[0][i : i + 1], spline[1][i : i + 1], 3, np.diag(share)[None])
    builder.by(row, "world.turn", np.stack([-cross(centre)[axis, axis] for axis in range(3)])[None])
    builder.by(row, "world.shift", eye(1))
    deviation = mean_sigma(time_s, sigma, weights, given.tau_s, given.white_m)
    mean = (weights * residual).sum(axis=0)
    return Factor("position mean", mean, builder.matrix(), deviation, errors=Errors.ANCHOR)


def mean_weights(off_m: Array, sigma: Array) -> Array:
    """Weights of fixes, shape (n, 3), sum 1 for each axis, by which their mean is taken; by 1 / sigma^2, without those that stand apart.

    Parameters
    ----------
    off_m : ndarray, shape (n, 3)
        What each is off the path. Those of a receiver that jumps or is led astray lie far from the median of all; of errors that last
        none does, and the mean is the plain one.
    sigma : ndarray, shape (n, 3)
    """
    middle = np.median(off_m, axis=0)
    scale = np.maximum(sigma_of_columns(off_m, middle), LEAST_SPREAD * np.median(sigma, axis=0))
    apart = (np.abs(off_m - middle) / scale).max(axis=1)
    near = np.clip((APART[1] - apart) / (APART[1] - APART[0]), 0.0, 1.0)[:, None]
    weights = near * sigma**-2.0
    return np.asarray(weights / weights.sum(axis=0))


def _shares(places: Array) -> Array:
    """Weights, sum 1, by which places, shape (n, 3), have their mean in the origin as nearly as may be; the most even ones."""
    even = np.full(len(places), 1.0 / len(places))
    asked = np.concatenate([np.ones((1, len(places))), places.T])
    return np.asarray(even + np.linalg.pinv(asked, 1e-6) @ (np.array([1.0, 0.0, 0.0, 0.0]) - asked @ even))


def mean_sigma(time_s: Array, sigma: Array, weights: Array, tau_s: Array, white: float) -> Array:
    """Sigma of a weighted mean of Gauss-Markov errors of `sigma`, shape (n, m), and white ones; in one pass over time."""
    part = weights * sigma
    variance = np.square(part).sum(axis=0) + white**2 * np.square(weights).sum(axis=0)
    keep = np.exp(-np.diff(time_s)[:, None] / tau_s)
    before = np.zeros_like(part[0])
    for i in range(1, len(part)):
        before = keep[i - 1] * (before + part[i - 1])
        variance += 2.0 * part[i] * before
    return np.asarray(np.sqrt(variance))


def position_track(given: Given, leg: Leg) -> Positions:
    """The autopilot's positions in the local frame."""
    fixes = given.fixes[list(given.placed).index(leg)]
    place = given.frame.from_geodetic(fixes.latitude_deg, fixes.longitude_deg, fixes.height_m)
    mat, lever = given.mount.mat_ins_lidar(), given.mount.lidar_position_m()
    antenna = np.zeros(3) if given.mount.gps_position_m is None else np.array(given.mount.gps_position_m)
    good = measured(leg.boot, fixes.time_ns)
    return Positions(
        leg.utc_from_boot(fixes.time_ns[good]),
        place[good],
        np.maximum(fixes.sigma_m[good], LEAST_POSITION_SIGMA_M),
        mat.T @ (antenna - lever),
        POSITION_TAU_S,
        POSITION_WHITE_M,
    )


RECOVERY_NS: Final = 30 * NS_PER_S
"""So long after a fix is back, the autopilot's position still comes back from where it had drifted to."""


def measured(boot: Boot, time_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Which positions rest on satellites: without a fix an autopilot goes on with a position that drifts away, and says so elsewhere."""
    if not boot.has("GPS_RAW_INT", 2):
        return np.ones(len(time_ns), np.bool_)
    gps_ns, fixed = boot.stamps_ns["GPS_RAW_INT"], boot.tables["GPS_RAW_INT"]["fix_type"] >= 3
    row = np.clip(np.searchsorted(gps_ns, time_ns, side="right") - 1, 0, len(gps_ns) - 1)
    # a message late: between the last with a fix and the first without, it may be lost already
    good = fixed[row] & fixed[np.minimum(row + 1, len(fixed) - 1)]
    # the first fix of a flight is none that came back: nothing had drifted away before
    before = np.maximum.accumulate(fixed)
    for regained_ns in gps_ns[1:][fixed[1:] & ~fixed[:-1] & before[:-1]].tolist():
        good &= (time_ns < regained_ns) | (time_ns > regained_ns + RECOVERY_NS)
    return np.asarray(good if good.sum() >= 2 else np.ones(len(time_ns), np.bool_))


NOISE: Final = {
    "fix position": Learnt("fix_noise_m", 0.02, 5.0),
    "fix velocity": Learnt("fix_velocity_noise_m_s", 0.02, 3.0),
}


@dataclass(frozen=True, slots=True)
class FixRows(Measured):
    """The same in the smoother, with the velocities that come along: there errors that last are states, and so is the fixes' age."""

    stated: Stated
    learnt: Mapping[str, Learnt] = field(default_factory=lambda: NOISE)

    def rows(self, rows: Rows) -> None:
        """Positions, and velocities where there are any."""
        stated, model = self.stated, rows.model
        place, inside = rows.at(stated.fix_s)
        mat = frames.mat_from_quat(place.quat)
        arm = mat @ stated.lever_m
        by_turn = turned_by(arm)
        left = stated.fix_m[inside] - place.position_m - arm
        for axis in range(3):
            columns = [(POSITION + axis, 1.0), (FIX_POSITION + axis, 1.0), (FIX_AGE, -place.velocity_m_s[:, axis])]
            if stated.lever_m.any():
                columns += [(ATTITUDE + i, by_turn[:, axis, i]) for i in range(3)]
            rows.add("fix position", place.node, columns, left[:, axis], model.fix_noise_m)
        if stated.fix_velocity_m_s is None:
            return
        swing = np.einsum("nij,nj->ni", mat, np.cross(place.rate_rad_s, stated.lever_m))
        left = stated.fix_velocity_m_s[inside] - place.velocity_m_s - swing
        step_s = rows.step_ns * 1e-9
        gaining = np.gradient(low_pass(rows.reference.velocity_m_s, 1.0, 1.0 / step_s), step_s, axis=0)[place.node]
        for axis in range(3):
            columns = [(VELOCITY + axis, 1.0), (FIX_VELOCITY + axis, 1.0), (FIX_AGE, -gaining[:, axis])]
            # the error of a position's own velocity is how fast the position's error changes, its decay included
            if stated.linked:
                columns.append((FIX_POSITION + axis, -1.0 / model.fix_tau_s))
            rows.add("fix velocity", place.node, columns, left[:, axis], model.fix_velocity_noise_m_s)


def of_leg(heard: Heard) -> list[Measured]:
    """The positions of a leg."""
    return [FixRows(heard.stated)]
