"""What the ground filter goes by."""

import math
from dataclasses import dataclass, replace
from typing import Final

from flightlog.errors import UsageError
from groundproc.raster.grid import checked_cell

COARSE_M: Final = 1.0
FINE_M: Final = 0.5
HALL_M: Final = 120.0
"""Longest side of a hall, along the raster."""
_DENSE: Final = 4.0
"""Points in a square metre from which cells of half a metre have one each, nearly everywhere."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Lengths in metres, slopes as rise over run.

    Attributes
    ----------
    cell_m : float
        Of the raster of lowest points.
    window_m : float
        Radius of the largest opening: half the shorter side of the largest object that is to go.
    hall_m : float
        Wider ones go by their walls, if no side is longer than this; 0 where the window is stated, which then is the largest.
    step_m, slope : float
        An object stands above an opening of radius r by more than step + slope r ...
    relief : float
        ... and so many times the ground's own deviation from its smoothed self, ...
    steepness : float
        ... and so many times r times the slope of the smoothed ground.
    smoothing_m : float
        Sigma of the smoothing.
    height_m, slack, bend : float
        A point is ground if it lies within height + slack times local slope + bend times how slopes around scatter of the ground's surface.
    """

    cell_m: float = COARSE_M
    window_m: float = 20.0
    hall_m: float = HALL_M
    step_m: float = 0.1
    slope: float = 0.08
    relief: float = 0.5
    steepness: float = 0.2
    smoothing_m: float = 4.0
    height_m: float = 0.45
    slack: float = 0.5
    bend: float = 1.0


PRESETS: Final = {
    "auto": Settings(),
    "flat": replace(Settings(), slope=0.05, relief=0.3, steepness=0.1, height_m=0.3),
    "hilly": Settings(),
    "steep": replace(Settings(), slope=0.1, relief=0.6, steepness=0.4),
    "urban": replace(Settings(), window_m=40.0),
}
"""By kind of terrain; `auto` adapts to slope and relief of each place, and fits most."""


def settings_for(preset: str, density_m2: float, cell_m: float | None, window_m: float | None) -> Settings:
    """Settings of a preset, with cells as the density of a cloud asks for, unless they are given.

    Raises
    ------
    UsageError
        There is no such preset, or a length is none.
    """
    if preset not in PRESETS:
        raise UsageError(f"--terrain {preset}: expected {', '.join(PRESETS)}")
    found = PRESETS[preset]
    cell = checked_cell((FINE_M if density_m2 >= _DENSE else COARSE_M) if cell_m is None else cell_m)
    window = found.window_m if window_m is None else window_m
    if not (math.isfinite(window) and cell <= window <= 500.0):
        raise UsageError(f"--window {window:g} m: expected {cell:g} to 500 m, half the width of the largest building")
    return replace(found, cell_m=cell, window_m=window, hall_m=found.hall_m if window_m is None else 0.0)


def radii(window_m: float, cell_m: float) -> list[int]:
    """Radii of openings in cells: each of the small ones, then in steps of a quarter."""
    largest = max(math.ceil(window_m / cell_m), 1)
    found, radius = [], 1
    while radius < largest:
        found.append(radius)
        radius += max(1, radius // 4)
    return [*found, largest]
