"""The autopilot's attitudes: tilt to a degree, and a heading with the compass's error as a curve over heading."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.estimation import ownsolution
from groundproc.estimation.observations.measured import Heard, Learnt, Measured, Rows, Stated
from groundproc.estimation.observations.moments import means, poses, rates, seconds, spots, within
from groundproc.estimation.observations.observation import Flown, Observation, State
from groundproc.estimation.observations.rows import Errors, Factor, RowBuilder, Unknowns, eye, whitened
from groundproc.estimation.observations.source import Clock
from groundproc.estimation.observations.states import ATTITUDE, HEADING, TILT
from groundproc.estimation.observations.states import COMPASS as CURVE
from groundproc.estimation.odometry.spline import Path
from groundproc.estimation.odometry.stated import Attitudes
from groundproc.flight.timeline import Leg

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

ATTITUDE_SIGMA_RAD: Final = np.deg2rad([1.0, 1.0, 2.0])
ATTITUDE_TAU_S: Final = 10.0
"""Of an AHRS of the APM class: tilt, and heading beyond the compass's curve; its errors last for the time of its own filter."""
COMPASS_TERMS: Final = 5
"""Constant, sine and cosine of the heading, sine and cosine of twice the heading."""
COMPASS: Final = "compass"
COMPASS_PRIOR: Final = np.deg2rad([5.0, 10.0, 10.0, 4.0, 4.0])
DELAY_SIGMA_S: Final = 0.0
"""How well the delay of the attitudes beyond that of the autopilot's clock is known; 0: it is none, and is held."""


@dataclass(slots=True)
class StatedAttitudes(Observation):
    """The attitudes of all legs: they have one compass.

    Attributes
    ----------
    given : sequence of Attitudes
    clock : Clock
    curve_rad : ndarray, shape (5,)
        The compass's error as estimated so far.
    """

    given: Sequence[Attitudes]
    clock: Clock = field(default_factory=lambda: Clock("attitude.delay", DELAY_SIGMA_S))
    curve_rad: Array = field(default_factory=lambda: np.zeros(COMPASS_TERMS))
    name: str = "attitude"

    def joined(self, values: Mapping[str, Array], kept: Sequence[Any]) -> "StatedAttitudes":
        """With curve and delay as the windows found them; the curve goes on from there."""
        del kept
        return replace(self, clock=self.clock.held(values), curve_rad=values.get(COMPASS, self.curve_rad))

    def unknowns(self, unknowns: Unknowns) -> None:
        """The curve, and the delay where it is free."""
        unknowns.add(COMPASS, COMPASS_PRIOR, self.curve_rad, unit="deg")
        self.clock.unknowns(unknowns)

    def factors(self, state: State, unknowns: Unknowns) -> list[Factor]:
        """Three rows a second for each leg."""
        mat, turn_name = state.boresight(unknowns)
        found = [
            attitude_factor(given, state.path, unknowns, mat, self.curve_rad, turn_name, self.clock)
            for given in self.given
        ]
        return [factor for factor in found if factor is not None]

    def take(self, part: Mapping[str, Array], path: Path) -> None:
        """Curve and delay."""
        del path
        self.curve_rad = self.curve_rad + part[COMPASS]
        self.clock = self.clock.taken(part)


def of_run(flown: Flown) -> list[Observation]:
    """One for all legs; where none states an attitude the curve is what it was before."""
    return [StatedAttitudes([given for leg in flown.legs if (given := attitude_track(leg)) is not None])]


def compass_terms(heading_rad: Array) -> Array:
    """What the curve is linear in, shape (n, 5)."""
    sine, cosine = np.sin(heading_rad), np.cos(heading_rad)
    return np.stack([np.ones_like(sine), sine, cosine, np.sin(2 * heading_rad), np.cos(2 * heading_rad)], axis=1)


def attitude_factor(
    given: Attitudes,
    path: Path,
    unknowns: Unknowns,
    mat_sensor_ins: Array,
    compass: Array,
    turn_name: str | None,
    clock: Clock | None = None,
) -> Factor | None:
    """Attitudes in means of a second, with the compass's error as a curve over heading.

    Parameters
    ----------
    mat_sensor_ins : ndarray, shape (3, 3)
        Boresight as estimated so far included.
    compass : ndarray, shape (5,)
        The curve so far [rad].
    turn_name : str, optional
        The global that corrects the boresight.
    clock : Clock, optional
        Of these attitudes.
    """
    stamps_ns = given.time_ns if clock is None else clock.ours_ns(given.time_ns)
    inside = within(stamps_ns, path)
    if inside.sum() < 2:
        return None
    time_ns = stamps_ns[inside]
    _, _, step, share = spots(time_ns, path)
    quat, _ = poses(path, step, share)
    mat = frames.mat_from_quat(quat)
    made = mat @ mat_sensor_ins
    off = frames.quat_log(frames.quat_from_mat(made @ np.swapaxes(frames.mat_from_quat(given.quat[inside]), 1, 2)))
    heading = frames.attitude_of(made)[0]
    terms = compass_terms(heading)
    off[:, 2] -= terms @ compass
    group, middle = seconds(time_ns)
    count = len(middle)
    knot, weights, _, _ = spots(time_ns[middle], path)
    builder, row = RowBuilder(3 * count, unknowns), 3 * np.arange(count)
    builder.at_times(row, knot, weights, 0, mat[middle])
    builder.by(row, "world.turn", eye(count))
    curve = np.zeros((count, 3, COMPASS_TERMS))
    curve[:, 2] = -means(terms, group)
    builder.by(row, "compass", curve)
    if turn_name is not None:
        builder.by(row, turn_name, mat[middle])
    if clock is not None:
        clock.add(builder, row, means(rates(path, step), group))
    sigma = np.tile(given.sigma_rad, (count, 1))
    return whitened(
        "attitude",
        means(off, group),
        builder.matrix(),
        time_ns[middle].astype(np.float64) * 1e-9,
        sigma,
        np.full(3, given.tau_s),
        float(0.1 * given.sigma_rad[0]),
        Errors.ANCHOR,
    )


def attitude_track(leg: Leg) -> Attitudes | None:
    """The autopilot's attitudes."""
    if ownsolution.attitude_source(leg.boot) is None:
        return None
    _, time_ns, quat, _ = ownsolution.attitudes(leg.boot)
    return Attitudes(leg.utc_from_boot(time_ns), quat, ATTITUDE_SIGMA_RAD, ATTITUDE_TAU_S)


NOISE: Final = {
    "tilt": Learnt("tilt_noise_rad", np.deg2rad(0.02), np.deg2rad(2.0)),
    "heading": Learnt("heading_noise_rad", np.deg2rad(0.02), np.deg2rad(5.0)),
}


@dataclass(frozen=True, slots=True)
class AttitudeRows(Measured):
    """The same in the smoother: tilt and heading apart, their lasting errors and the compass's curve being states."""

    stated: Stated
    learnt: Mapping[str, Learnt] = field(default_factory=lambda: NOISE)

    def rows(self, rows: Rows) -> None:
        """Two rows of tilt, about the right and the forward axis of the heading, and one of heading."""
        place, inside = rows.at(self.stated.attitude_s)
        left = frames.quat_log(frames.quat_multiply(self.stated.quat[inside], frames.quat_inverse(place.quat)))
        heading, _, _ = frames.attitude_of(frames.mat_from_quat(place.quat))
        sine, cosine = np.sin(heading), np.cos(heading)
        for number, (east, north) in enumerate(((cosine, -sine), (sine, cosine))):
            tilted = [(ATTITUDE, east), (ATTITUDE + 1, north), (TILT + number, 1.0)]
            lean = left[:, 0] * east + left[:, 1] * north
            rows.add("tilt", place.node, tilted, lean, rows.model.tilt_noise_rad)
        # headings count clockwise, rotations about the upward axis the other way
        columns: list[tuple[int, Any]] = [(ATTITUDE + 2, 1.0), (HEADING, -1.0)]
        columns += [(CURVE + i, -term) for i, term in enumerate(compass_terms(heading).T)]
        rows.add("heading", place.node, columns, left[:, 2], rows.model.heading_noise_rad)


def of_leg(heard: Heard) -> list[Measured]:
    """The attitudes of a leg."""
    return [AttitudeRows(heard.stated)]
