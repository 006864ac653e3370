"""An inertial unit as an observation of the adjustment: its gyro and its accelerometer, which share axes, clock and place."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.estimation.observations import accelerometer, gyro
from groundproc.estimation.observations.observation import Flown, Observation, State, Stretch
from groundproc.estimation.observations.retiming import Retiming
from groundproc.estimation.observations.rows import Carrying, Factor, H, Unknowns, turned
from groundproc.estimation.observations.unit import (
    LEAST_FORCE,
    LEAST_TURN,
    Unit,
    learnt_sigma,
    make_unit,
    place_on_grid,
)
from groundproc.estimation.odometry.grid import STEPS
from groundproc.estimation.odometry.motion import ImuTrack
from groundproc.estimation.odometry.spline import Path

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

PRIORS: Final[dict[str, float]] = gyro.PRIORS | accelerometer.PRIORS | {
    "lidar.delay": 0.005, "ins.delay": 0.01, "ins.drift": 60e-6,
}  # fmt: skip
"""What is known before, one sigma, of the globals by their names. The lidar's own unit has the lidar's clock, but is read once in 5 ms,
through a filter that nobody states [s]; of the autopilot's are unknown the delay beyond the synchronisation's [s] and how it drifts, two
crystals against each other [s/s]."""
ORDER: Final = (
    "bias", "scale", "shear", "turn", "accel_bias", "accel_scale", "accel_shear", "accel_turn", "lever", "delay", "drift",
)  # fmt: skip
UNITS: Final = {
    "bias": "deg_s", "scale": "", "shear": "", "turn": "deg", "accel_bias": "m_s2", "accel_scale": "", "accel_shear": "",
    "accel_turn": "deg", "lever": "m", "delay": "s", "drift": "",
}  # fmt: skip
"""Of the globals in reports."""


@dataclass(slots=True)
class Inertial(Observation):
    """Gyro and accelerometer of one unit.

    Attributes
    ----------
    name : str
        "lidar" or "ins": prefix of its globals.
    track : ImuTrack
    lever_m : ndarray, shape (3,)
        Nominal place, sensor frame.
    carries : bool
        Its gyro is the path's motion between knots.
    unit : Unit
        On the grid of the window; None before it begins.
    held : ndarray of bool, shape (slices,), optional
        Where the lidar holds the path.
    """

    name: str
    track: ImuTrack
    lever_m: Array
    carries: bool
    unit: Unit | None = None
    held: npt.NDArray[np.bool_] | None = None

    def begin(self, stretch: Stretch) -> "Inertial":
        """With the bias that the odometry found, where it went by this gyro."""
        bias = stretch.bias_rad_s if self.track.name == stretch.carried_by else np.zeros(3)
        return replace(self, unit=make_unit(self.name, self.track, stretch.path, bias, self.lever_m), held=stretch.held)

    def joined(self, values: Mapping[str, Array], kept: Any) -> None:
        """The windows' shapes and tilts are its own."""

    def unknowns(self, unknowns: Unknowns) -> None:
        """Those of the accelerometer only where it was heard; not a delay that the lidar's rows tell too, and have brought."""
        unit = self._begun()
        names = [*gyro.NAMES, *(accelerometer.NAMES if unit.force_known.any() else ()), "delay", "drift"]
        for name in ORDER:
            key = f"{self.name}.{name}"
            if name in names and key in PRIORS and key not in unknowns.names:
                value = unit.values[name]
                expected = self.lever_m if name == "lever" else None
                unknowns.add(key, np.full(len(value), PRIORS[key]), value, expected, UNITS[name])

    def factors(self, state: State, unknowns: Unknowns) -> list[Factor]:
        """Turns of each slice and forces about each knot, with the noise of their residuals once it is to be learnt.

        If the noise were learnt in every step, the path would follow the units, and their noise would seem to vanish.
        The same happens where the lidar does not hold the path, so only residuals from elsewhere are used.
        """
        unit = self._begun()
        turn = gyro.turn_factor(unit, state.path, unknowns, state.spin_rad if self.carries else None)
        interval = np.flatnonzero(unit.known.reshape(-1, STEPS).all(axis=1))
        if state.learn:
            unit.sigma_turn_rad = self._learnt(turn, interval, interval, unit.sigma_turn_rad, LEAST_TURN)
            turn.sigma[:] = unit.sigma_turn_rad
        if self.carries:
            turn.carrying = Carrying(interval, unit.sigma_turn_rad / float(np.sqrt(STEPS)))
        if not unit.force_known.any():
            return [turn]
        force = accelerometer.force_factor(unit, state.path, unknowns)
        if state.learn:
            whole: npt.NDArray[np.bool_] = np.asarray(unit.force_known.reshape(-1, STEPS).all(axis=1))
            before = np.flatnonzero(whole[:-1] & whole[1:])
            unit.sigma_force_m_s2 = self._learnt(force, before, before + 1, unit.sigma_force_m_s2, LEAST_FORCE)
            force.sigma[:] = unit.sigma_force_m_s2
        return [turn, force]

    def _learnt(self, factor: Factor, first: Ints, last: Ints, scatter: float, least: float) -> float:
        """Noise of a factor's rows, three for each pair of slices `first` and `last` that they are of."""
        held = np.ones(len(first), np.bool_) if self.held is None else self.held[first] & self.held[last]
        return learnt_sigma(factor.residual.reshape(-1, 3), held, scatter, least)

    def take(self, part: Mapping[str, Array], path: Path) -> None:
        """A changed clock puts the samples elsewhere on the grid."""
        unit = self._begun()
        for name, value in unit.values.items():
            change = part.get(f"{self.name}.{name}")
            if change is None:
                continue
            if name == "turn":
                mat = turned(change) @ turned(value)
                unit.values[name] = frames.quat_log(frames.quat_from_mat(mat[None]))[0]
            else:
                unit.values[name] = value + change
        if f"{self.name}.delay" in part:
            place_on_grid(unit, self.track, path)

    def _begun(self) -> Unit:
        assert self.unit is not None, "the window has not begun"
        return self.unit


def gyro_readings(observations: Sequence[Observation]) -> list[tuple[Array, npt.NDArray[np.bool_]]]:
    """Rates that the carrying gyro reads on the grid of a window, and which are known: by themselves, and less those of the other unit."""
    units = [each for each in observations if isinstance(each, Inertial) and each.unit is not None]
    found = []
    for own in (each.unit for each in units if each.carries and each.unit is not None):
        found.append((own.rate_rad_s, own.known))
        others = (each.unit for each in units if not each.carries and each.unit is not None)
        found += [(own.rate_rad_s - other.rate_rad_s, own.known & other.known) for other in others]
    return found


def carried_density(observations: Sequence[Observation], otherwise: float) -> float:
    """Noise of the turns of the gyro that carries the motion, as a window has learnt it [rad/sqrt(s)]."""
    units = (
        each.unit for each in observations if isinstance(each, Inertial) and each.carries and each.unit is not None
    )
    return next((float(unit.sigma_turn_rad / np.sqrt(H)) for unit in units), otherwise)


def retiming_of(observations: Sequence[Observation], carried_by: str) -> Retiming | None:
    """The delay of the gyro by which an odometry went; None where no unit of an adjustment is that."""
    for each in observations:
        if isinstance(each, Inertial) and each.carries and each.track.name == carried_by:
            key = f"{each.name}.delay"
            return Retiming(key, PRIORS[key], each.track)
    return None


def of_run(flown: Flown) -> list[Observation]:
    """The units of a run, the one that carries the motion first."""
    at = {"ins": flown.in_sensor(np.zeros(3))}
    return [
        Inertial(name, track, at.get(name, np.zeros(3)), number == 0)
        for number, (name, track) in enumerate(flown.units.items())
    ]
