"""What a sensor measured of a panel: its plane, the scatter about it by laser, intensity, how often an echo came, mixed echoes."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.numerics.robust import cauchy, sigma
from groundproc.sensors.model import Ranging
from groundproc.verification.aimed import Aimed
from groundproc.verification.panels import Panel

Array = npt.NDArray[np.float64]

FEWEST: Final = 10
"""Echoes, to say anything of ranges."""
_SEARCH_M: Final = 0.5
"""A panel stands so far from where it is said to be, at most."""
_FACING_RAD: Final = np.deg2rad(5.0)
"""How well it faces the sensor, one sigma: where one row of shots meets it, nothing else tells its tilt."""
_MARGIN_M: Final = 0.03
"""Inside its edge, beside half the footprint: edges are known as well as that."""
_NEARLY: Final = 0.97
_ON_SIGMAS: Final = 5.0
_LEAST_OFF_M: Final = 0.05
"""Echoes nearer to the plane than this are of the panel, however little others scatter."""


@dataclass(frozen=True, slots=True)
class Row:
    """Figures of one panel, of one laser or of all.

    Attributes
    ----------
    laser : int
        In firing order; -1: all of them.
    shots, echoes : int
        Fired at the panel itself, and come back from it.
    off_m, sigma_m : float
        Mean and scatter of ranges about the panel's plane.
    intensity, intensity_sigma : float
    """

    laser: int
    shots: int
    echoes: int
    off_m: float
    sigma_m: float
    intensity: float
    intensity_sigma: float

    @property
    def detected(self) -> float:
        """Share of the shots that came back."""
        return self.echoes / self.shots if self.shots else float("nan")

    @property
    def sigma_of_sigma_m(self) -> float:
        """How well the scatter is known, one sigma (normal errors)."""
        return float(self.sigma_m / np.sqrt(2.0 * max(self.echoes - 1, 1)))


@dataclass(frozen=True, slots=True)
class Measured:
    """Figures of one panel.

    Attributes
    ----------
    panel : Panel
    whole : Row
    lasers : list of Row
    distance_m : float
        Of its plane from the sensor; NaN where it was not seen.
    rim, mixed : int
        Echoes of shots that meet its edge, and how many of them lie between it and what is behind.
    elsewhere_m : float
        Range at which most shots at it came back from something else; NaN where that is not so.
    """

    panel: Panel
    whole: Row
    lasers: list[Row]
    distance_m: float
    rim: int
    mixed: int
    elsewhere_m: float = float("nan")

    @property
    def seen(self) -> bool:
        """Whether ranges can be told of."""
        return self.whole.echoes >= FEWEST

    def figures(self) -> dict[str, Any]:
        """For JSON."""
        panel = self.panel
        return {
            "name": panel.title, "reflectance": panel.reflectance, "stated_distance_m": panel.distance_m,
            "distance_m": _number(self.distance_m), "rim_echoes": self.rim, "mixed_echoes": self.mixed,
            **row_figures(self.whole), "lasers": [{"laser": each.laser, **row_figures(each)} for each in self.lasers],
        }  # fmt: skip


def row_figures(row: Row) -> dict[str, Any]:
    """For JSON."""
    return {
        "shots": row.shots, "echoes": row.echoes, "detected": _number(row.detected), "range_off_m": _number(row.off_m),
        "range_sigma_m": _number(row.sigma_m), "range_sigma_sigma_m": _number(row.sigma_of_sigma_m),
        "intensity": _number(row.intensity), "intensity_sigma": _number(row.intensity_sigma),
    }  # fmt: skip


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


@dataclass(frozen=True, slots=True)
class _Plane:
    """normal . p = 1, with the plane's own axes: right along the panel, upwards."""

    normal: Array
    middle: Array
    right: Array
    up: Array

    def ranges(self, direction: Array) -> Array:
        """Where beams meet it."""
        return np.asarray(1.0 / np.maximum(direction @ self.normal, 1e-6))

    @property
    def distance_m(self) -> float:
        """From the sensor."""
        return float(1.0 / np.linalg.norm(self.normal))


def measure(panel: Panel, aimed: Aimed, ranging: Ranging) -> Measured:
    """Find the panel, and say how it was measured.

    Parameters
    ----------
    panel : Panel
    aimed : Aimed
        Shots towards it and what is around it.
    ranging : Ranging
        Of the sensor: width of its beams, and the distance from which on two surfaces give two echoes.
    """
    plane = _found(panel, aimed, ranging)
    expected = plane.ranges(aimed.direction)
    off = aimed.range_m - expected
    places = aimed.direction * expected[:, None] - plane.middle
    across, above = places @ plane.right, places @ plane.up
    half = 0.5 * ranging.divergence_rad * expected
    margin = half + _MARGIN_M
    inside = (np.abs(across) < panel.size_m[0] / 2 - margin) & (np.abs(above) < panel.size_m[1] / 2 - margin)
    close = np.abs(off) < _SEARCH_M
    scatter = max(sigma(off[inside & close]), 0.5 * ranging.sigma_m) if (inside & close).any() else ranging.sigma_m
    on = inside & (np.abs(off) < max(_ON_SIGMAS * scatter, _LEAST_OFF_M))
    # what was stopped by something in front was not aimed at the panel
    free = ~aimed.second & ~(off < -_SEARCH_M)
    shots, lasers = inside & free, np.unique(aimed.laser[inside])
    rows = [_row(int(each), aimed, off, shots, on & (aimed.laser == each)) for each in lasers]
    rim = _rim(panel, across, above, half) & np.isfinite(aimed.range_m)
    between = rim & (off > max(_ON_SIGMAS * scatter, _LEAST_OFF_M)) & (off < ranging.pulse_m)
    whole = _row(-1, aimed, off, shots, on)
    distance_m = plane.distance_m if whole.echoes >= FEWEST else float("nan")
    back = aimed.range_m[inside & ~aimed.second & ~on & np.isfinite(aimed.range_m)]
    most = len(back) > 0.5 * (inside & ~aimed.second).sum()
    elsewhere_m = float(np.median(back)) if most else float("nan")
    return Measured(panel, whole, rows, distance_m, int(rim.sum()), int(between.sum()), elsewhere_m)


def _row(laser: int, aimed: Aimed, off: Array, shots: npt.NDArray[np.bool_], on: npt.NDArray[np.bool_]) -> Row:
    fired = shots if laser < 0 else shots & (aimed.laser == laser)
    echoes = int(on.sum())
    if echoes < 2:
        nan = float("nan")
        return Row(laser, int(fired.sum()), echoes, nan, nan, nan, nan)
    strength = aimed.intensity[on]
    return Row(
        laser, int(fired.sum()), echoes, float(off[on].mean()), float(off[on].std(ddof=1)), float(strength.mean()),
        float(strength.std(ddof=1)),
    )  # fmt: skip


def _rim(panel: Panel, across: Array, above: Array, half: Array) -> npt.NDArray[np.bool_]:
    """Shots whose footprint reaches over an edge."""
    beyond = np.maximum(np.abs(across) - panel.size_m[0] / 2, np.abs(above) - panel.size_m[1] / 2)
    return np.asarray(np.abs(beyond) < half)


def _found(panel: Panel, aimed: Aimed, ranging: Ranging) -> _Plane:
    """The panel's plane and middle by the echoes on it; as stated where there are too few."""
    middle = panel.middle_m
    facing = np.array([middle[0], middle[1], 0.0]) / np.hypot(middle[0], middle[1])
    right, up = np.array([facing[1], -facing[0], 0.0]), np.array([0.0, 0.0, 1.0])
    xyz = aimed.direction * aimed.range_m[:, None]
    depth, across, above = xyz @ facing, (xyz - middle) @ right, (xyz - middle) @ up
    half = 0.5 * ranging.divergence_rad * panel.distance_m + _MARGIN_M
    near = (np.abs(depth - panel.distance_m) < _SEARCH_M) & (np.abs(above) < panel.size_m[1] / 2 - half)
    near &= np.abs(across) < panel.size_m[0] / 2 + _SEARCH_M
    stated = _Plane(facing / panel.distance_m, middle, right, up)
    if near.sum() < FEWEST:
        return stated
    # the nearest surface that many echoes lie on: something behind may be in the search too
    counts, edges = np.histogram(
        depth[near], np.arange(panel.distance_m - _SEARCH_M, panel.distance_m + _SEARCH_M, 0.05)
    )
    first = int(np.argmax(counts > 0.5 * counts.max()))
    near &= np.abs(depth - edges[first] - 0.05) < 0.12
    if near.sum() < FEWEST:
        return stated
    # what something in front stopped may have met the panel or not
    there = aimed.direction * (panel.distance_m / (aimed.direction @ facing))[:, None] - middle
    stopped = (depth < panel.distance_m - _SEARCH_M) & (np.abs(there @ up) < panel.size_m[1] / 2 - half)
    shift = _shift(np.concatenate([across[near], (there @ right)[stopped]]), panel.size_m[0], half)
    moved = middle + shift * right
    inner = near & (np.abs(across - shift) < panel.size_m[0] / 2 - half)
    if inner.sum() < FEWEST:
        return stated
    c, a, b = _fit(depth[inner], across[inner] - shift, above[inner], ranging.sigma_m)
    normal = facing - a * right - b * up
    place = moved + (c - moved @ facing) * facing
    return _Plane(normal / (normal @ place), place, right, up)


def _shift(across: Array, width_m: float, margin_m: float) -> float:
    """Where along it the panel lies: the least shift of a window, narrower by margins, that holds nearly as many echoes as any can.

    Where another panel stands beside it, many shifts hold as many; of one that stands alone, those within its margins, and the midst is it.
    """
    shifts = np.arange(-_SEARCH_M, _SEARCH_M + 0.005, 0.01)
    ordered, half = np.sort(across), width_m / 2.0 - margin_m
    count = np.searchsorted(ordered, shifts + half) - np.searchsorted(ordered, shifts - half)
    full = np.flatnonzero(count >= _NEARLY * count.max())
    runs = np.split(full, np.flatnonzero(np.diff(full) > 1) + 1)
    run = min(runs, key=lambda each: float(np.abs(shifts[each]).min()))
    low, high = shifts[run[0]], shifts[run[-1]]
    inward = min(margin_m, (high - low) / 2.0)
    return float(np.clip(0.0, low + inward, high - inward))


def _fit(depth: Array, across: Array, above: Array, sigma_m: float) -> Array:
    """Depth = c + a across + b above, robustly; panels face the sensor as well as `_FACING_RAD`."""
    rows = np.stack([np.ones(len(depth)), across, above], axis=1)
    prior = np.diag([0.0, _FACING_RAD**-2, _FACING_RAD**-2])
    found = np.array([np.median(depth), 0.0, 0.0])
    for _ in range(10):
        left = depth - rows @ found
        scale = max(sigma(left), 0.2 * sigma_m)
        weight = cauchy(left / (2.5 * scale)) / scale**2
        hessian = (rows * weight[:, None]).T @ rows + prior
        step = np.linalg.solve(hessian, (rows * weight[:, None]).T @ left - prior @ found)
        found = found + step
        if np.abs(step).max() < 1e-7:
            break
    return found
