"""The batch: Gauss-Newton over a stretch of the flight, coarse voxels first, with all that is common to it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.estimation.adjustment import lasers
from groundproc.estimation.adjustment.anchors import (
    COMPASS_TERMS,
    Tie,
    attitude_factor,
    fixes_name,
    position_factors,
    tie_factor,
)
from groundproc.estimation.adjustment.control import Held, held_to
from groundproc.estimation.adjustment.factors import (
    Factor,
    H,
    Unit,
    Unknowns,
    force_factor,
    prior_factor,
    robust_sigma,
    turn_factor,
)
from groundproc.estimation.adjustment.noise import Carrying, noise_of
from groundproc.estimation.adjustment.outside import DELAY, Outside, laid_by_pieces, outside_factors
from groundproc.estimation.adjustment.planes import rows_of
from groundproc.estimation.adjustment.posterior import Posterior, whole_covariance
from groundproc.estimation.adjustment.solve import problem
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.grid import SLICE_NS, STEP_NS, STEPS
from groundproc.estimation.odometry.motion import ImuTrack, on_grid
from groundproc.estimation.odometry.spline import Path
from groundproc.estimation.odometry.stated import Attitudes, Positions
from groundproc.flight.control import ControlPoint

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

ROUNDS: Final = ((1.0, False), (0.5, False), (0.5, True), (0.5, True))
"""Edge of the voxels [m], and whether outliers are cut, of each Gauss-Newton step."""
ROUGH: Final = 1e-3
"""Of a step that comes before outliers are cut, this share of what it gains may be missing."""
MORE_ROUNDS: Final = 5
SETTLED_M: Final = 0.003
"""The last step is taken again, so often at most, until the path's shape moves less than this, RMS."""
DEFLATION: Final = 4.0
"""The lidar's information is divided by this: errors of neighbouring clusters are not independent. Checked by the share of errors within
two sigmas (tests)."""
BLIND: Final = 50
"""Clusters of a slice below which it saw next to nothing."""
DRAWS: Final = 12
"""Draws of the path's error: its variance in itself is right to two fifths, and to less as a mean over a second."""

PRIORS: Final[dict[str, float]] = {
    "lidar.bias": np.deg2rad(50.0), "lidar.scale": 0.01, "lidar.shear": 0.01, "lidar.turn": np.deg2rad(0.3), "lidar.accel_bias": 0.5,
    "lidar.accel_turn": np.deg2rad(0.5), "lidar.lever": 0.15,
    "ins.bias": np.deg2rad(5.0), "ins.scale": 0.015, "ins.shear": 0.01, "ins.turn": np.deg2rad(3.0), "ins.accel_bias": 0.5,
    "ins.accel_turn": np.deg2rad(0.5), "ins.lever": 0.05, "ins.delay": 0.01, "ins.drift": 60e-6,
}  # fmt: skip
"""What is known before, one sigma: gyro bias [rad/s], scale, what an axis feels of the two others (scales of axes that lie askew in the
sensor's frame are of that kind), misalignment against the lidar's optics [rad], bias [m/s^2] and misalignment against the gyro of the
accelerometer, place against the nominal one [m], delay beyond the synchronisation's [s] and how it drifts, two
crystals against each other [s/s]."""
COMPASS_PRIOR: Final = np.deg2rad([5.0, 10.0, 10.0, 4.0, 4.0])


@dataclass(slots=True)
class Batch:
    """A stretch of flight under adjustment.

    Attributes
    ----------
    path : Path
    clusters : Clusters
    units : list of Unit
        The one that carries the motion between knots first.
    tracks : dict of str to ImuTrack
        What the units were made of.
    positions, attitudes
    mat_sensor_ins : ndarray, shape (3, 3)
        Nominal.
    lever_ins_m : ndarray, shape (3,)
        Nominal place of the ins origin in the sensor frame.
    compass : ndarray, shape (5,)
    most : int
        Rows of a slice.
    tie : Tie, optional
        To the window before.
    outside : sequence of Outside
        Positions and poses of another program.
    outside_delay_s : ndarray, shape (1,)
        Of these.
    corrections : ndarray, shape (64,)
        Of the lasers, so far; they stay 0 where the clusters have none.
    told : callable
        Is called after each step.
    control : sequence of ControlPoint
        In the local frame.
    held : Held, optional
        What of it the map meets.
    """

    path: Path
    clusters: Clusters
    units: list[Unit]
    tracks: dict[str, ImuTrack]
    positions: Sequence[Positions]
    attitudes: Sequence[Attitudes]
    mat_sensor_ins: Array
    lever_ins_m: Array
    compass: Array = field(default_factory=lambda: np.zeros(COMPASS_TERMS))
    most: int = 1000
    tie: Tie | None = None
    outside: Sequence[Outside] = ()
    outside_delay_s: Array = field(default_factory=lambda: np.zeros(1))
    corrections: Array = field(default_factory=lambda: np.zeros(lasers.UNKNOWNS))
    control: Sequence[ControlPoint] = ()
    held: Held | None = None
    log: list[dict[str, float]] = field(default_factory=list)
    told: Callable[[], None] = lambda: None

    def run(self, rounds: Sequence[tuple[float, bool]] = ROUNDS) -> Posterior:
        """All Gauss-Newton steps, and the posterior of the last."""
        if self.outside:
            slot = (self.clusters.time_ns - self.path.start_ns) // SLICE_NS
            view = np.bincount(np.clip(slot, 0, self.path.intervals - 1), minlength=self.path.intervals) >= BLIND
            self.path = laid_by_pieces(self.path, self.outside, view)
        for number, (voxel_m, cut) in enumerate(rounds):
            last = None  # rows are large: those of the step before go before new ones are made
            last = self.step(voxel_m, cut, weigh=number == 1)
        for _ in range(MORE_ROUNDS):
            if self.log[-1]["moved_m"] < SETTLED_M:
                break
            last = None
            last = self.step(*rounds[-1], weigh=False)
        assert last is not None
        return self.hold(last, *rounds[-1]) if self.control and self.tie is None else last

    def hold(self, last: Posterior, voxel_m: float, cut: bool) -> Posterior:
        """Lay a map that is right in itself on the control as a whole, and adjust it with that."""
        covariance = whole_covariance(last, self.path)
        self.held = held_to(self.control, self.clusters, self.path, covariance, DEFLATION)
        if self.held is None:
            return last
        self.path = self.path.turned(*self.held.datum.placing.as_turn())
        for number in range(MORE_ROUNDS):
            last = self.step(voxel_m, cut, weigh=False)
            if number and self.log[-1]["moved_m"] < SETTLED_M:
                break
        return last

    def unknowns(self) -> Unknowns:
        """The unknowns that this flight's instruments have."""
        unknowns = Unknowns(self.path.intervals)
        if self.clusters.laser is not None:
            for name, sigma in zip(lasers.NAMES, np.split(lasers.PRIOR, len(lasers.NAMES)), strict=True):
                unknowns.add(name, sigma)
        free = 1.0 if self.tie is None else 1e-6
        unknowns.add("world.turn", np.deg2rad([5.0, 5.0, 20.0]) * free)
        unknowns.add("world.shift", np.full(3, 100.0) * free)
        for number in range(len(self.positions)):
            unknowns.add(fixes_name(number), np.full(3, 100.0))
        for unit in self.units:
            names = ["bias", "scale", "shear", "turn"]
            if unit.force_known.any():
                names += ["accel_bias", "accel_turn", "lever"]
            if unit.name == "ins":
                names += ["delay", "drift"]
            for name in names:
                key = f"{unit.name}.{name}"
                unknowns.add(key, np.full(1 if name in ("delay", "drift") else 3, PRIORS[key]))
        unknowns.add("compass", COMPASS_PRIOR)
        if self.outside:
            unknowns.add(DELAY, np.array([self.outside[0].delay_sigma_s]))
        return unknowns

    def step(self, voxel_m: float, cut: bool, weigh: bool) -> Posterior:
        """One Gauss-Newton step; `weigh`: set the noise of the inertial units by their residuals first.

        That is done once, after the first step: done again and again, the path would follow the units and their noise seem to vanish.
        Nor below 0.4 of what their samples scatter, vibration included: where the lidar sees nothing, the path is the units' own.
        """
        unknowns = self.unknowns()
        rows = rows_of(self.clusters, self.path, voxel_m, self.most, cut)
        factors = self.factors(unknowns, weigh)
        linear = problem(rows, factors, unknowns, DEFLATION, self.path)
        x, steps = linear.solve(-linear.gradient, share=0.0 if cut else ROUGH)
        cost, used = rows.cost()
        self.log.append(
            {
                "voxel_m": voxel_m, "rows": len(rows), "used": used, "steps": steps, "chi_square": cost / max(used, 1),
            }
            | {f"{f.name}_rms": f.rms() for f in factors}
        )  # fmt: skip
        self.log[-1]["position_drift"] = drift(factors)
        before = self.path
        self.take(unknowns, x)
        moved = (self.path.position_m - before.position_m)[::STEPS]
        self.log[-1]["moved_m"] = float(np.sqrt(np.square(moved - moved.mean(axis=0)).sum(axis=1).mean()))
        self.told()
        by = self.units[0]
        carrying = Carrying(
            f"{by.name} gyro",
            np.asarray(by.known.reshape(-1, STEPS).all(axis=1)),
            by.sigma_turn_rad / float(np.sqrt(STEPS)),
        )
        return Posterior(
            linear,
            unknowns,
            lambda: noise_of(rows, self.clusters, before, DEFLATION, factors, x, carrying),
        )

    def factors(self, unknowns: Unknowns, weigh: bool) -> list[Factor]:
        """Everything but the lidar."""
        found: list[Factor] = []
        values: dict[str, Array] = {"compass": self.compass, DELAY: self.outside_delay_s}
        values |= dict(zip(lasers.NAMES, np.split(self.corrections, len(lasers.NAMES)), strict=True))
        for unit in self.units:
            found += self._inertial(unit, unknowns, weigh)
            values |= {f"{unit.name}.{name}": value for name, value in unit.values.items()}
        if "ins.lever" in values:
            values["ins.lever"] = values["ins.lever"] - self.lever_ins_m
        ins = next((unit for unit in self.units if unit.name == "ins"), None)
        mat = self.mat_sensor_ins if ins is None else turned(ins.values["turn"]) @ self.mat_sensor_ins
        for number, positions in enumerate(self.positions):
            found += position_factors(positions, self.path, unknowns, number)
        turn_name = None if ins is None else "ins.turn"
        for attitudes in self.attitudes:
            factor = attitude_factor(attitudes, self.path, unknowns, mat, self.compass, turn_name)
            if factor is not None:
                found.append(factor)
        for outside in self.outside:
            found += outside_factors(outside, self.path, unknowns, float(self.outside_delay_s[0]), mat, turn_name)
        if self.held is not None and (control := self.held.factor(self.clusters, self.path, unknowns)) is not None:
            found.append(control)
        if self.tie is not None:
            found.append(tie_factor(self.tie, self.path, unknowns))
        found.append(prior_factor(unknowns, values))
        return found

    def _inertial(self, unit: Unit, unknowns: Unknowns, weigh: bool) -> list[Factor]:
        """Gyro and accelerometer of a unit, with the noise that their residuals show where that is asked for."""
        found: list[Factor] = []
        turn = turn_factor(unit, self.path, unknowns)
        if weigh:
            unit.sigma_turn_rad = robust_sigma(turn.residual.reshape(-1, 3), 0.4 * unit.sigma_turn_rad)
            turn.sigma[:] = unit.sigma_turn_rad
        found.append(turn)
        if unit.force_known.any():
            force = force_factor(unit, self.path, unknowns)
            if weigh:
                unit.sigma_force_m_s2 = robust_sigma(force.residual.reshape(-1, 3), 0.4 * unit.sigma_force_m_s2)
                force.sigma[:] = unit.sigma_force_m_s2
            found.append(force)
        return found

    def take(self, unknowns: Unknowns, x: Array) -> None:
        """Put a solution in."""
        part = {name: x[place] for name, place in unknowns.names.items()}
        if self.clusters.laser is not None:
            offsets = np.concatenate([part[name] for name in lasers.NAMES])
            self.clusters.xyz_m = lasers.shifted(self.clusters.xyz_m, self.clusters.laser, offsets)
            self.corrections = self.corrections + offsets
        path = self.path.corrected(x[: unknowns.path_size].reshape(-1, 6))
        self.path = path.turned(turned(part["world.turn"]), part["world.shift"])
        self.compass = self.compass + part["compass"]
        self.outside_delay_s = self.outside_delay_s + part.get(DELAY, 0.0)
        for unit in self.units:
            for name in unit.values:
                change = part.get(f"{unit.name}.{name}")
                if change is None:
                    continue
                if name == "turn":
                    mat = turned(change) @ turned(unit.values["turn"])
                    unit.values["turn"] = frames.quat_log(frames.quat_from_mat(mat[None]))[0]
                else:
                    unit.values[name] = unit.values[name] + change
            if f"{unit.name}.delay" in part:
                place_on_grid(unit, self.tracks[unit.name], self.path)


DRIFT_S: Final = 10


def drift(factors: Sequence[Factor]) -> float:
    """Largest mean of ten whitened position residuals on end, in sigmas of such a mean: a path that slides away from the fixes."""
    largest = 0.0
    for factor in factors:
        if factor.name == "position" and len(factor.residual) > 3 * DRIFT_S:
            whitened = (factor.residual / factor.sigma).reshape(-1, 3)
            sums = np.cumsum(whitened, axis=0)
            largest = max(largest, float(np.abs(sums[DRIFT_S:] - sums[:-DRIFT_S]).max()) / np.sqrt(DRIFT_S))
    return largest


def turned(vector: Array) -> Array:
    """Matrix of a rotation vector, shape (3, 3)."""
    return np.asarray(frames.mat_from_quat(frames.quat_exp(vector[None]))[0])


def place_on_grid(unit: Unit, track: ImuTrack, path: Path) -> None:
    """Rates and forces of a unit on the path's grid, with its delay and what that drifts by taken off the stamps."""
    steps = path.intervals * STEPS
    since_middle_ns = track.time_ns - (path.start_ns + steps * STEP_NS // 2)
    late_ns = 1e9 * float(unit.values["delay"][0]) + float(unit.values["drift"][0]) * since_middle_ns
    time_ns = track.time_ns - np.rint(late_ns).astype(np.int64)
    unit.rate_rad_s, unit.known = on_grid(time_ns, track.rate_rad_s, path.start_ns, steps)
    unit.force_m_s2, unit.force_known = on_grid(time_ns, np.nan_to_num(track.force_m_s2), path.start_ns, steps)
    if not np.isfinite(track.force_m_s2).all():
        unit.force_known[:] = False


def make_unit(name: str, track: ImuTrack, path: Path, bias: Array, lever: Array) -> Unit:
    """A unit with nothing estimated yet but its gyro's bias."""
    values = {
        "bias": bias.copy(), "scale": np.zeros(3), "shear": np.zeros(3), "turn": np.zeros(3), "delay": np.zeros(1),
        "drift": np.zeros(1),        "accel_bias": np.zeros(3), "accel_turn": np.zeros(3), "lever": lever.copy(),
    }  # fmt: skip
    none = np.zeros((0, 3))
    unit = Unit(
        name, none, none, np.zeros(0, np.bool_), np.zeros(0, np.bool_), values, track.rate_density() * np.sqrt(H),
        track.force_density() * np.sqrt(2.0 / 3.0 / H),
    )  # fmt: skip
    place_on_grid(unit, track, path)
    return unit
