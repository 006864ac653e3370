"""The estimate: linearise about a reference, smooth, learn the noise from the residuals, and repeat."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.constants import NS_PER_S
from groundproc.estimation.inertial import kalman
from groundproc.estimation.inertial.motion import motion_about, start_about
from groundproc.estimation.inertial.readings import Readings, drives, standing
from groundproc.estimation.inertial.reference import Steps, begun, corrected, covered, steps_of
from groundproc.estimation.inertial.solution import Solution
from groundproc.estimation.method import Given
from groundproc.estimation.observations import measured_of
from groundproc.estimation.observations.measured import Heard, Learnt, Measured, Reference, Rows, System
from groundproc.estimation.observations.states import ATTITUDE, GYRO_BIAS, HEADING, POSE, POSITION, STATES, TILT, Model
from groundproc.flight.timeline import Leg
from groundproc.machine.system import let_go
from groundproc.numerics import robust

Array = npt.NDArray[np.float64]

ITERATIONS: Final = 6
FEWEST_ITERATIONS: Final = 3
"""The noise is learnt anew after each of them."""
DONE_M: Final = 0.01
DONE_RAD: Final = np.deg2rad(0.01)
"""Corrections under which the iteration ends."""
KEPT_NS: Final = NS_PER_S // 10
"""Spacing of the states and covariances that are kept."""
OUTLIER: Final = 4.0
"""Residuals in units of their noise from which a measurement counts less (Cauchy)."""
FEWEST_TO_LEARN: Final = 50
"""Rows of a kind from which its noise is learnt."""


@dataclass(frozen=True, slots=True)
class _Smoothed:
    """One iteration: what was smoothed about which rows, and where that leads."""

    model: Model
    reference: Reference
    system: System
    weight: Array | None
    out: kalman.Smoothed
    moved_m: float
    moved_rad: float

    @property
    def settled(self) -> bool:
        return self.moved_m < DONE_M and self.moved_rad < DONE_RAD


def solve(
    readings: Readings, model: Model | None = None, given: Given | None = None, leg: Leg | None = None
) -> Solution:
    """Estimate one leg.

    Parameters
    ----------
    readings : Readings
    model : Model, optional
    given : Given, optional
    leg : Leg, optional
        The flight, and which part of it this is, for observations that bring something of their own.
    """
    model = Model() if model is None else model
    steps = steps_of(readings)
    heard = Heard(readings, standing(readings), drives(readings), given, leg)
    sources = measured_of(heard)
    noise = {kind: learnt for source in sources for kind, learnt in source.learnt.items()}
    reference = begun(readings, steps)
    first = Reference(reference.position_m[:1].copy(), reference.velocity_m_s[:1].copy(), reference.quat[:1].copy())
    weight: Array | None = None
    out: kalman.Smoothed | None = None
    done: _Smoothed | None = None
    for iteration in range(1, ITERATIONS + 1):
        done = None  # its rows are large: they go before new ones are made
        system = _system(sources, readings, reference, steps, model)
        out = _room(readings, system) if out is None else out
        variance = system.variance if weight is None else system.variance / weight
        motion = motion_about(readings, model, steps, reference)
        let_go()
        kalman.smooth(
            motion,
            kalman.Rows(system.first, system.count, system.index, system.value, system.measured, variance),
            *start_about(readings, model, first, reference),
            out,
        )
        del motion
        reference = corrected(reference, out.correction)
        done = _Smoothed(model, reference, system, weight, out, _largest(out, POSITION), _largest(out, ATTITUDE))
        if iteration >= FEWEST_ITERATIONS and done.settled:
            break
        if iteration <= FEWEST_ITERATIONS:
            model = _learnt(model, noise, system, out)
        weight = robust.cauchy(out.residual / _noise(noise, system, model) / OUTLIER)
    assert done is not None
    return _solution(readings, heard, steps, done, iteration)


def _room(r: Readings, system: System) -> kalman.Smoothed:
    """Where the smoother writes; every iteration the same."""
    nodes = len(r.nodes_s)
    stride = max(KEPT_NS // r.step_ns, 1)
    kept = -(-nodes // stride)
    return kalman.Smoothed(
        stride=stride,
        correction=np.empty((nodes, POSE)),
        residual=np.zeros(len(system.measured)),
        states=np.empty((kept, STATES)),
        covariance=np.empty((kept, POSE, POSE), np.float32),
        variance=np.empty((kept, STATES)),
    )


def _largest(out: kalman.Smoothed, part: int) -> float:
    return float(np.abs(out.correction[:, part : part + 3]).max())


def _system(sources: Sequence[Measured], r: Readings, reference: Reference, steps: Steps, model: Model) -> System:
    """The rows of all observations about a reference."""
    rows = Rows(reference, steps.rate, model, r.nodes_s, r.step_ns)
    for source in sources:
        source.rows(rows)
    return rows.system()


def _noise(learnt: Mapping[str, Learnt], system: System, model: Model) -> Array:
    """Sigma of each row's noise by the model; as stated where none is learnt."""
    sigma = np.sqrt(system.variance)
    for kind, each in learnt.items():
        sigma[system.of(kind)] = getattr(model, each.field)
    return np.asarray(sigma)


def _learnt(model: Model, noise: Mapping[str, Learnt], system: System, out: kalman.Smoothed) -> Model:
    """White noise from the residuals' median, and the size of the correlated errors from the states themselves (expectation step)."""
    changed: dict[str, Any] = {}
    for kind, each in noise.items():
        chosen = out.residual[system.of(kind)]
        if len(chosen) >= FEWEST_TO_LEARN:
            changed[each.field] = float(np.clip(robust.sigma(chosen, 0.0), each.least, each.most))
    for name, part, least, most in (
        ("tilt_rad", slice(TILT, TILT + 2), np.deg2rad(0.2), np.deg2rad(10.0)),
        ("heading_rad", slice(HEADING, HEADING + 1), np.deg2rad(0.3), np.deg2rad(20.0)),
    ):
        expected = np.square(out.states[:, part]) + out.variance[:, part]
        changed[name] = float(np.clip(np.sqrt(expected.mean()), least, most))
    return replace(model, **changed)


def _solution(r: Readings, heard: Heard, steps: Steps, done: _Smoothed, iterations: int) -> Solution:
    out = done.out
    time_ns = r.start_ns + np.arange(len(r.nodes_s), dtype=np.int64) * r.step_ns
    kept_ns = time_ns[:: out.stride]
    # the rate at a node is the mean of the steps at both sides, less the bias
    bias = np.stack([np.interp(time_ns, kept_ns, out.states[:, GYRO_BIAS + i]) for i in range(3)], axis=1)
    rate = np.concatenate([steps.rate[:1], 0.5 * (steps.rate[1:] + steps.rate[:-1]), steps.rate[-1:]]) - bias
    rms, count, outliers = {}, {}, {}
    for number, kind in enumerate(done.system.kinds):
        chosen = done.system.kind == number
        if chosen.any():
            rms[kind] = float(np.sqrt(np.mean(out.residual[chosen] ** 2)))
            count[kind] = int(chosen.sum())
            outliers[kind] = 0 if done.weight is None else int((done.weight[chosen] < 0.5).sum())
    return Solution(
        readings=r,
        model=done.model,
        time_ns=time_ns,
        position_m=done.reference.position_m,
        velocity_m_s=done.reference.velocity_m_s,
        quat=done.reference.quat,
        rate_rad_s=rate,
        covered=covered(r, steps),
        kept_ns=kept_ns,
        states=out.states,
        covariance=out.covariance,
        variance=out.variance,
        residual_rms=rms,
        rows=count,
        outliers=outliers,
        stands_s=float(heard.stands.sum() * r.step_ns * 1e-9),
        driving=heard.driving,
        iterations=iterations,
        last_step_m=done.moved_m,
        last_step_rad=done.moved_rad,
    )
