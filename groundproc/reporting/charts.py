"""Which curves a report shows: what the estimate's arrays hold."""

from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.reporting.plots import Curve, Plot
from groundproc.trajectory.estimate import Estimate
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]

EAST_NORTH_UP: Final = ("east", "north", "up")
_TURNS: Final = ("roll", "pitch", "heading")
_FEW: Final = 50
"""Matched clusters of a tenth of a second below which the lidar has next to no planes."""


def charts(estimate: Estimate) -> list[Plot]:
    """All that there is to draw."""
    figures = estimate.figures
    return [
        *_flight(estimate.trajectory),
        *_sigmas(estimate.trajectory),
        *_adjustment(figures),
        *_trims(figures),
        *_lasers(figures),
    ]


def _flight(trajectory: Trajectory) -> Iterator[Plot]:
    seconds = _seconds(trajectory)
    held = _breaks(trajectory)
    yield Plot("Height", "time [s]", "above the start [m]", [Curve("", seconds, held(trajectory.position_m[:, 2]))])
    speed = np.linalg.norm(trajectory.velocity_m_s, axis=1)
    yield Plot("Speed", "time [s]", "speed [m/s]", [Curve("", seconds, held(speed))], zero=True)
    rate = np.rad2deg(np.linalg.norm(trajectory.rate_rad_s, axis=1))
    yield Plot("Turns", "time [s]", "rate of turn [deg/s]", [Curve("", seconds, held(rate))], zero=True)


def _sigmas(trajectory: Trajectory) -> Iterator[Plot]:
    seconds = _seconds(trajectory)
    held = _breaks(trajectory)
    position, attitude = trajectory.sigma_position_m, np.rad2deg(trajectory.sigma_attitude_rad)
    curves = [Curve(name, seconds, held(position[:, i])) for i, name in enumerate(EAST_NORTH_UP)]
    yield Plot("How well the position is known", "time [s]", "one sigma [m]", curves, zero=True)
    curves = [Curve(name, seconds, held(attitude[:, i])) for i, name in enumerate(_TURNS)]
    yield Plot("How well the attitude is known", "time [s]", "one sigma [deg]", curves, zero=True)


def _adjustment(figures: Mapping[str, npt.NDArray[Any]]) -> Iterator[Plot]:
    held = {
        name.removeprefix("adjustment."): values for name, values in figures.items() if name.startswith("adjustment.")
    }
    if "slice_s" not in held:
        return
    ends = held["slice_s"]
    blind = _stretches(ends, held["matched"] < _FEW)
    yield Plot(
        "Residuals of the lidar", "time [s]", "RMS off the planes [cm]", [Curve("", ends, 100.0 * held["residual_m"])], zero=True,
        about="Distances of each tenth of a second from the planes of what was seen before it.", marks=blind,
    )  # fmt: skip
    yield Plot(
        "What the lidar saw", "time [s]", "clusters in 0.1 s",
        [Curve("seen", ends, held["seen"].astype(float)), Curve("on a plane of the map", ends, held["matched"].astype(float))],
        zero=True, about="Shaded: next to no planes, and the inertial units carry on alone." if blind else "", marks=blind,
    )  # fmt: skip
    if len(held["position_s"]):
        off = held["position_off_m"]
        curves = [Curve(name, held["position_s"], off[:, i], dots=True) for i, name in enumerate(EAST_NORTH_UP)]
        yield Plot("Stated positions less the path", "time [s]", "difference [m]", curves)
    if len(held["heading_rad"]):
        curve = Curve("", np.rad2deg(held["heading_rad"]) % 360.0, np.rad2deg(held["heading_off_rad"]), dots=True)
        yield Plot("Stated heading less that of the path", "heading [deg]", "difference [deg]", [curve])


def _trims(figures: Mapping[str, npt.NDArray[Any]]) -> Iterator[Plot]:
    if "trims.time_ns" not in figures:
        return
    time_ns = figures["trims.time_ns"]
    seconds = (time_ns - time_ns[0]) * 1e-9
    names = ("yaw", "pitch", "roll")
    curves = [Curve(name, seconds, np.rad2deg(figures[f"trims.{name}_rad"])) for name in names]
    yield Plot("Trims of the attitude", "time [s]", "trim [deg]", curves)
    curves = [Curve(name, seconds, np.asarray(figures[f"trims.{name}_m"], float)) for name in ("altitude", "x", "y")]
    yield Plot("Trims of the position", "time [s]", "trim [m]", curves)


def _lasers(figures: Mapping[str, npt.NDArray[Any]]) -> Iterator[Plot]:
    if "lasers.range_m" not in figures:
        return
    elevation = np.rad2deg(figures["lasers.table_elevation_rad"])
    for kind, own, unit, scale in (("range", "m", "mm", 1e3), ("elevation", "rad", "deg", np.rad2deg(1.0))):
        value = np.where(figures[f"lasers.{kind}_found"], scale * figures[f"lasers.{kind}_{own}"], np.nan)
        yield Plot(
            f"Corrections of the lasers: {kind}", "elevation of the laser [deg]", f"offset [{unit}]",
            [Curve("", elevation, value, dots=True)],
        )  # fmt: skip


def _seconds(trajectory: Trajectory) -> Array:
    return np.asarray((trajectory.time_ns - trajectory.time_ns[0]) * 1e-9)


def _breaks(trajectory: Trajectory) -> Any:
    """A function that breaks a curve where the trajectory has a gap."""
    open_ = ~trajectory.covered.copy()
    open_[-1] = False
    return lambda values: np.where(open_, np.nan, np.asarray(values, np.float64))


def _stretches(ends_s: Array, flags: npt.NDArray[np.bool_]) -> list[tuple[float, float]]:
    """Begin and end in seconds of each run of slices."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    begin_s = np.concatenate([[0.0], ends_s])
    return [
        (float(begin_s[i]), float(begin_s[j])) for i, j in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
    ]
