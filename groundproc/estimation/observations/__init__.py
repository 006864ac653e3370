"""Observations: one file a kind of knowledge about the path, with its unknowns and priors, its rows and weights, and its report.

A kind is a module with one or both of

    of_run(flown: Flown) -> list[Observation]    for the adjustment: what of this kind a run of the lidar's clock has
    of_leg(heard: Heard) -> list[Measured]       for the smoother: what of this kind a leg has

and one name in `KINDS`; observations of no file of the survey are handed to `adjusted_estimate`. The engines (adjustment.batch,
adjustment.joining, inertial.smoother) know lists of observations and nothing of their kinds. docs/methods/observations.md has an
example.

observation, measured   what an observation is to the adjustment and to the smoother
rows, moments, source   sparse rows; times on a path; clock and lever arm of a source
lidar                   planes and what fills voxels (planes, filled, told, lasers, retiming, spin), applied without a matrix
fixes, attitudes        positions and attitudes of the autopilot, with the compass
inertial                units of gyro and accelerometer (unit, gyro, accelerometer)
outside, relative       poses from elsewhere: where they are, and how they follow each other
control                 points and planes that the map has to go through (held, datum, surfaces)
barometer, standing, course   what only the smoother uses
tie                     a window to the one before
"""

import importlib
from types import ModuleType
from typing import Any, Final

from groundproc.estimation.observations.measured import Heard, Measured
from groundproc.estimation.observations.observation import Flown, Observation

KINDS: Final[dict[str, str]] = {
    name: f"{__name__}.{name}"
    for name in (
        "fixes",
        "inertial",
        "attitudes",
        "outside",
        "control",
        "barometer",
        "standing",
        "course",
    )
}
"""Module of each kind, imported when it is asked for; unknowns and rows stand in this order."""


def observations_of(flown: Flown) -> list[Observation]:
    """All that the adjustment of a run goes by besides the lidar's planes."""
    return [each for module in _modules("of_run") for each in module.of_run(flown)]


def measured_of(heard: Heard) -> list[Measured]:
    """All that the smoother of a leg goes by besides the inertial sensors, which carry its states from node to node."""
    return [each for module in _modules("of_leg") for each in module.of_leg(heard)]


def _modules(function: str) -> list[ModuleType]:
    """Modules of the kinds that have a function."""
    modules: list[Any] = [importlib.import_module(path) for path in KINDS.values()]
    return [module for module in modules if hasattr(module, function)]
