"""The batch: Gauss-Newton steps over a stretch of the flight and the parameters of the whole, coarse voxels first."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.estimation.adjustment.noise import noise_of
from groundproc.estimation.adjustment.posterior import Posterior, whole_covariance
from groundproc.estimation.adjustment.solve import problem
from groundproc.estimation.adjustment.straining import strains
from groundproc.estimation.observations.lidar import DEFLATION, Lidar
from groundproc.estimation.observations.observation import Observation, State
from groundproc.estimation.observations.rows import Factor, Unknowns, prior_factor, turned
from groundproc.estimation.odometry.grid import STEPS
from groundproc.estimation.odometry.spline import Path
from groundproc.machine.readahead import both
from groundproc.machine.system import give_back_memory

Array = npt.NDArray[np.float64]

ROUNDS: Final = ((1.0, False), (0.5, False), (0.5, True), (0.5, True))
"""Edge of the voxels [m], and whether outliers are cut, of each Gauss-Newton step."""
ROUGH: Final = 1e-3
"""Before outliers are cut, a step may leave this share of its gain."""
MORE_ROUNDS: Final = 5
SETTLED_M: Final = 0.003
"""The last step is repeated, at most so many times, until the path's shape moves by less than this, RMS."""
SWINGS: Final = -0.5
"""A step that takes back more than this share of the one before swings about where it leads: the next one is damped."""
LEAST_SHARE: Final = 0.5
"""Less of a step is not taken: what does not swing has to get where it leads within some steps."""
DRAWS: Final = 12
"""Draws of the path's error. The variance of the path in itself is right to two fifths, and better as a mean over a
second."""
WORLD_TURN_RAD: Final = np.deg2rad([5.0, 5.0, 20.0])
WORLD_SHIFT_M: Final = np.full(3, 100.0)
"""What the path as a whole may be turned and shifted by."""


@dataclass(slots=True)
class Batch:
    """A stretch of flight under adjustment.

    Attributes
    ----------
    path : Path
    lidar : Lidar
        What it saw: the one observation whose rows are never written down.
    observations : sequence of Observation
        All others.
    mat_sensor_ins : ndarray, shape (3, 3)
        Nominal boresight.
    free : float
        Share of the prior of the whole's turn and shift; next to nothing where the previous window fixes how the whole lies.
    log : list of dict
        What each step said.
    told : callable
        Called after each step.
    last : ndarray, shape (slices + 1, 3), or None
        What the step before would have moved the path's shape by [m].
    share : float
        How much of what is asked for is taken: less than all where steps swing.
    """

    path: Path
    lidar: Lidar
    observations: Sequence[Observation]
    mat_sensor_ins: Array
    free: float = 1.0
    log: list[dict[str, float]] = field(default_factory=list)
    told: Callable[[], None] = lambda: None
    last: Array | None = None
    share: float = 1.0

    def run(self, rounds: Sequence[tuple[float, bool]] = ROUNDS) -> Posterior:
        """All Gauss-Newton steps, and the posterior of the last."""
        for each in self.observations:
            self.path = each.lay(self.state())
        for number, (voxel_m, cut) in enumerate(rounds):
            last = None  # rows are large: those of the step before go before new ones are made
            last = self.step(voxel_m, cut, learn=number == 1)
        for _ in range(MORE_ROUNDS):
            if self.log[-1]["moved_m"] < SETTLED_M:
                break
            last = None
            last = self.step(*rounds[-1], learn=False)
        assert last is not None
        path = held(self.observations, self.state(), last)
        if path is None:
            return last
        self.path = path
        for number in range(MORE_ROUNDS):
            last = self.step(*rounds[-1], learn=False)
            if number and self.log[-1]["moved_m"] < SETTLED_M:
                break
        return last

    def state(self, learn: bool = False) -> State:
        """What the observations share."""
        spin = None if self.lidar.spin is None else self.lidar.spin.at_knots()
        return State(self.path, self.lidar.clusters, self.mat_sensor_ins, learn, spin)

    def unknowns(self) -> Unknowns:
        """The unknowns that this flight's instruments have."""
        unknowns = Unknowns(self.path.intervals)
        self.lidar.unknowns(unknowns)
        add_world(unknowns, self.free)
        for each in self.observations:
            each.unknowns(unknowns)
        return unknowns

    def step(self, voxel_m: float, cut: bool, learn: bool) -> Posterior:
        """One Gauss-Newton step; `learn`: set the noise that residuals tell first.

        That is done once, after the first step: done again and again, the path would follow the inertial units and their noise seem to
        vanish.
        """
        give_back_memory()
        unknowns = self.unknowns()
        state = self.state(learn)
        rows, (factors, figures) = both(
            lambda: self.lidar.rows(self.path, voxel_m, cut),
            lambda: linearised((self.lidar, *self.observations), state, unknowns),
        )
        give_back_memory()
        linear = problem(rows, factors, unknowns, DEFLATION, self.path)
        x, steps = linear.solve(-linear.gradient, share=0.0 if cut else ROUGH)
        cost, used = rows.cost()
        self.log.append(
            {
                "voxel_m": voxel_m, "rows": len(rows), "used": used, "steps": steps, "chi_square": cost / max(used, 1),
            }
            | figures
        )  # fmt: skip
        before, clusters = self.path, self.lidar.clusters
        asked = (corrected(before, unknowns, x).position_m - before.position_m)[::STEPS]
        asked -= asked.mean(axis=0)
        self._damp(asked)
        self.take(unknowns, self.share * x)
        self.log[-1]["moved_m"] = float(np.sqrt(np.square(asked).sum(axis=1).mean()))
        self.told()
        return Posterior(
            linear,
            unknowns,
            lambda: noise_of(
                rows, clusters, before, DEFLATION, factors, x, strains(factors, x, linear.coarse, figures)
            ),
        )

    def _damp(self, asked: Array) -> None:
        """Take less of steps that swing to and fro, as much as would have ended the last swing (Irons and Tuck 1969).

        What a slice does not tell is taken out of the rows' derivatives, but the rows feel it: a street that is moved along itself tilts
        by a millidegree, and accelerometers make decimetres of that the other way.
        """
        if self.last is not None:
            ratio = float((asked * self.last).sum()) / max(float(np.square(self.last).sum()), 1e-30)
            if ratio < SWINGS:
                self.share = max(self.share / (1.0 - ratio), LEAST_SHARE)
        self.last = asked

    def take(self, unknowns: Unknowns, x: Array) -> None:
        """Put a solution in."""
        part = {name: x[place] for name, place in unknowns.names.items()}
        self.path = self.lidar.turned(corrected(self.path, unknowns, x), part)
        for each in (self.lidar, *self.observations):
            each.take(part, self.path)

    def said(self) -> dict[str, Any]:
        """What the observations have to say of the end, by their names."""
        return told_by(self.observations, self.state())


def add_world(unknowns: Unknowns, free: float = 1.0) -> None:
    """Add the turn and the shift of the path as a whole."""
    unknowns.add("world.turn", WORLD_TURN_RAD * free, unit="deg")
    unknowns.add("world.shift", WORLD_SHIFT_M * free, unit="m")


def linearised(
    observations: Sequence[Observation], state: State, unknowns: Unknowns
) -> tuple[list[Factor], dict[str, float]]:
    """Rows of all observations and of what was known before, and their figures: of several with one name, the largest."""
    factors: list[Factor] = []
    figures: dict[str, float] = {}
    for each in observations:
        found = each.factors(state, unknowns)
        for name, value in each.figures(found).items():
            figures[name] = max(value, figures.get(name, value))
        factors += found
    prior = prior_factor(unknowns)
    return [*factors, prior], figures | {f"{prior.name}_rms": prior.rms()}


def corrected(path: Path, unknowns: Unknowns, x: Array) -> Path:
    """A path with a solution put in: its own corrections, then turn and shift of the whole."""
    names = unknowns.names
    bent = path.corrected(x[: unknowns.path_size].reshape(-1, 6))
    return bent.turned(turned(x[names["world.turn"]]), x[names["world.shift"]])


def held(observations: Sequence[Observation], state: State, last: Posterior) -> Path | None:
    """The path laid as a whole where observations have it, now that it is right in itself; None where none says so."""
    found = None
    for each in observations:
        path = each.hold(state, functools.partial(whole_covariance, last, state.path))
        if path is not None:
            found, state = path, replace(state, path=path)
    return found


def told_by(observations: Sequence[Observation], state: State) -> dict[str, Any]:
    """What observations have to say of the end of a window, by their names."""
    told = {each.name: each.tell(state) for each in observations}
    return {name: said for name, said in told.items() if said is not None}
