"""Mount, clock offset and compass from several flights together, with the result of each flight and their agreement.

Every flight is adjusted on its own. The normal equations of the parameters that belong to the airframe are combined,
with the nominal values counted once. What the flights could not determine stays as it was.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2

from flightlog import frames
from flightlog.mount import Mount
from groundproc.estimation.adjustment.posterior import joined
from groundproc.estimation.adjustment.skew import MISALIGNMENT_RAD
from groundproc.estimation.adjustment.windows import LEVER_FLOOR_M, Window, corrections_over
from groundproc.estimation.calibration.compass import BINS, CompassCurve, curve_of_errors, sector_of
from groundproc.estimation.observations import lasers
from groundproc.estimation.observations.attitudes import COMPASS_PRIOR, compass_terms
from groundproc.estimation.observations.inertial import PRIORS
from groundproc.estimation.observations.lasers import Corrections
from groundproc.estimation.observations.rows import turned
from groundproc.estimation.odometry.grid import STEPS

Array = npt.NDArray[np.float64]

SHARED: Final = ("ins.turn", "ins.lever")
"""What stays the same from flight to flight, in the order of the covariance: misalignment [rad] and lever arm [m], sensor frame."""
COMPASS: Final = ("compass",)
"""So does its curve, as long as the airframe carries the same iron."""
FEWEST: Final = 10
"""Slices, a second, that a heading must have been flown for to count as seen."""
KNOWN: Final = 0.5
"""A parameter counts as found where its sigma is below this share of what was known before."""
SIGNIFICANT: Final = 3.0
"""A parameter that differs from its old value by less than so many sigmas, those of the axes included, is not reported
as changed."""
DOUBTFUL: Final = 0.001
"""Flights that differ so much that chance makes it rarer than this do not agree."""


@dataclass(frozen=True, slots=True)
class FlightResult:
    """What one flight says.

    Attributes
    ----------
    name : str
    value : ndarray, shape (6,)
        `SHARED`: off the nominal mount.
    covariance : ndarray, shape (6, 6)
        With the prior in it.
    delay_s, sigma_delay_s : float
        Delay of the autopilot's gyro beyond what the synchronisation found.
    offset_s : float
        Autopilot time less lidar time.
    compass_rad : ndarray, shape (5,)
        Stated less true heading: constant, sine and cosine of the true heading, and of twice that.
    compass_covariance : ndarray, shape (5, 5)
        With the prior in it.
    headings : ndarray of bool, shape (BINS,)
        Sectors of the stated heading that were flown.
    lasers : tuple of (ndarray, ndarray), optional
        Corrections, shape (64,), and their covariance, where they were asked for.
    seconds : float
    warning : str
    """

    name: str
    value: Array
    covariance: Array
    delay_s: float
    sigma_delay_s: float
    offset_s: float
    compass_rad: Array
    compass_covariance: Array
    headings: npt.NDArray[np.bool_]
    lasers: tuple[Array, Array] | None
    seconds: float
    warning: str


@dataclass(frozen=True, slots=True)
class MountCalibration:
    """All flights together.

    Attributes
    ----------
    flights : sequence of FlightResult
    value : ndarray, shape (6,)
    covariance : ndarray, shape (6, 6)
        Of the flights; what the axes of gyro and accelerometer may differ from their board's is not in it.
    found : ndarray of bool, shape (6,)
    chi_square : float
    freedom : int
        Degrees of freedom of that.
    compass : CompassCurve
    headings : ndarray of bool, shape (BINS,)
        Sectors of heading that any flight has flown.
    lasers : Corrections, optional
    """

    flights: Sequence[FlightResult]
    value: Array
    covariance: Array
    found: npt.NDArray[np.bool_]
    chi_square: float
    freedom: int
    compass: CompassCurve
    headings: npt.NDArray[np.bool_]
    lasers: Corrections | None = None

    @property
    def compass_found(self) -> bool:
        """Whether the compass curve is known better than before at the headings that were flown."""
        seen, _ = self.compass_sigma_deg()
        before = np.rad2deg(np.sqrt(COMPASS_PRIOR[0] ** 2 + COMPASS_PRIOR[1] ** 2 + COMPASS_PRIOR[3] ** 2))
        return seen < KNOWN * float(before)

    def compass_sigma_deg(self) -> tuple[float, float]:
        """Largest sigma of the compass curve where it was flown, and elsewhere; not-a-number where there is no such heading."""
        middle = (np.arange(BINS) + 0.5) * 2.0 * np.pi / BINS
        sigma = np.rad2deg(self.compass.sigma_rad(middle))
        seen, unseen = (
            float(sigma[part].max()) if part.any() else float("nan") for part in (self.headings, ~self.headings)
        )
        return seen, unseen

    @property
    def agree(self) -> bool:
        """Whether the flights agree within their sigmas."""
        return self.freedom == 0 or bool(chi2.sf(self.chi_square, self.freedom) > DOUBTFUL)

    def mount(self, nominal: Mount) -> Mount:
        """The nominal mount with what was found; what was not found stays."""
        value = np.where(self.found, self.value, 0.0)
        mat = nominal.mat_ins_lidar() @ turned(-value[:3])
        heading, pitch, roll = (float(np.rad2deg(a[0])) for a in frames.attitude_of(mat[None]))
        place = -mat @ (-nominal.mat_ins_lidar().T @ nominal.lidar_position_m() + value[3:])
        if not self.found[3:].any():
            place = nominal.lidar_position_m()
        x, y, z = (round(float(v), 5) for v in place)
        return nominal.with_lidar(
            yaw_deg=round((180.0 - heading) % 360.0 - 180.0, 5),
            pitch_deg=round(pitch, 5),
            roll_deg=round(roll, 5),
            position_m=(x, y, z),
        )

    def report(self, nominal: Mount) -> dict[str, Any]:
        """All of it, for calibration.json."""
        sigma = np.sqrt(np.diag(self.covariance))
        with_axes = np.hypot(sigma, np.repeat([MISALIGNMENT_RAD, LEVER_FLOOR_M], 3))
        scale = np.array([np.rad2deg(1.0)] * 3 + [1.0] * 3)
        mount = self.mount(nominal)
        return {
            "parameters": ["turn_x_deg", "turn_y_deg", "turn_z_deg", "lever_x_m", "lever_y_m", "lever_z_m"],
            "frame": "the sensor's: x right, y forward, z up; a turn from the autopilot's gyro axes to the lidar's",
            "value": (self.value * scale).tolist(),
            "sigma": (sigma * scale).tolist(),
            "sigma_with_axes": (with_axes * scale).tolist(),
            "correlation": (self.covariance / np.outer(sigma, sigma)).round(4).tolist(),
            "found": self.found.tolist(),
            "significant": (self.found & (np.abs(self.value) > SIGNIFICANT * with_axes)).tolist(),
            "chi_square": self.chi_square,
            "degrees_of_freedom": self.freedom,
            "agree": self.agree,
            "mount": {
                "yaw_deg": mount.lidar.yaw_deg,
                "pitch_deg": mount.lidar.pitch_deg,
                "roll_deg": mount.lidar.roll_deg,
                "position_m": list(mount.lidar.position_m),
            },
            "compass": {
                "found": self.compass_found,
                "coefficients_deg": list(self.compass.coefficients_deg),
                "covariance_deg2": [list(row) for row in self.compass.covariance_deg2],
                "scatter_deg": self.compass.scatter_deg,
                "headings_seen_deg": (np.flatnonzero(self.headings) * 360.0 / BINS).tolist(),
                "sector_deg": 360.0 / BINS,
                "largest_sigma_deg": dict(zip(("seen", "elsewhere"), self.compass_sigma_deg(), strict=True)),
            },
            **({} if self.lasers is None else {"lasers": self.lasers.report()}),
            "flights": [
                {
                    "log": flight.name,
                    "seconds": flight.seconds,
                    "value": (flight.value * scale).tolist(),
                    "sigma": (np.sqrt(np.diag(flight.covariance)) * scale).tolist(),
                    "delay_ms": flight.delay_s * 1e3,
                    "sigma_delay_ms": flight.sigma_delay_s * 1e3,
                    "offset_s": flight.offset_s,
                    "compass_deg": np.rad2deg(flight.compass_rad).tolist(),
                    "sigma_compass_deg": np.rad2deg(np.sqrt(np.diag(flight.compass_covariance))).tolist(),
                    "headings_seen": float(flight.headings.mean()),
                    "warning": flight.warning,
                }
                for flight in self.flights
            ],
        }


def flight_result(
    path: Path, windows: Sequence[Window], nominal: Mount, offset_s: float, warning: str
) -> FlightResult | None:
    """What the windows of one flight say; None where it has no inertial unit of the autopilot's to find a mount for."""
    exact = [window for window in windows if window.covariance is not None]
    if not exact:
        return None
    to_ins = -nominal.mat_ins_lidar().T @ nominal.lidar_position_m()
    values = [_shared(window.values, to_ins) for window in exact]
    covariances = [window.covariance for window in exact if window.covariance is not None]
    curves = [window.values["compass"][0] for window in exact]
    size = len(PRIOR)
    value, covariance = joined(values, [square[:size, :size] for square in covariances], PRIOR)
    curve, curve_covariance = joined(curves, [square[size:, size:] for square in covariances], COMPASS_PRIOR)
    if len(exact) > 1:  # later windows have the first one's north, error and all
        curve_covariance[0, 0] += covariances[0][size, size]
    delays = [window.values["ins.delay"] for window in exact]
    best = min(delays, key=lambda pair: float(pair[1][0]))
    return FlightResult(
        path.name, value, covariance, float(best[0][0]), float(best[1][0]), offset_s, curve, curve_covariance,
        headings_of(windows, nominal, curve), corrections_over(windows), sum(window.own for window in windows) * 0.1, warning,
    )  # fmt: skip


def _shared(values: Mapping[str, tuple[Array, Array]], to_ins: Array) -> Array:
    return np.concatenate([values["ins.turn"][0], values["ins.lever"][0] - to_ins])


def headings_of(windows: Sequence[Window], nominal: Mount, curve: Array) -> npt.NDArray[np.bool_]:
    """Sectors of the heading as the autopilot stated it that were flown, shape (BINS,)."""
    quat = np.concatenate([window.path.quat[: window.own * STEPS : STEPS] for window in windows])
    true = frames.attitude_of(frames.mat_from_quat(quat) @ nominal.mat_ins_lidar().T)[0]
    terms = compass_terms(true)
    return np.bincount(sector_of(true + terms @ curve), minlength=BINS) >= FEWEST


PRIOR: Final = np.repeat([PRIORS[name] for name in SHARED], 3)


def calibrate(flights: Sequence[FlightResult]) -> MountCalibration:
    """Join flights."""
    value, covariance = joined([f.value for f in flights], [f.covariance for f in flights], PRIOR)
    chi_square = sum(float((f.value - value) @ np.linalg.solve(f.covariance, f.value - value)) for f in flights)
    found = np.sqrt(np.diag(covariance)) < KNOWN * PRIOR
    curve, curve_covariance = joined(
        [f.compass_rad for f in flights], [f.compass_covariance for f in flights], COMPASS_PRIOR
    )
    headings = np.any([f.headings for f in flights], axis=0)
    compass = curve_of_errors(curve, curve_covariance, _scatter_deg(flights, curve), len(flights), headings)
    made = MountCalibration(
        flights, value, covariance, found, chi_square, len(PRIOR) * (len(flights) - 1), compass, headings
    )
    told = [f.lasers for f in flights if f.lasers is not None]
    if not told:
        return made
    return replace(
        made, lasers=Corrections(*joined([o for o, _ in told], [square for _, square in told], lasers.PRIOR))
    )


def _scatter_deg(flights: Sequence[FlightResult], curve: Array) -> float:
    """How far the flights' own compass curves lie from the common one, RMS over the headings that each has flown."""
    middle = (np.arange(BINS) + 0.5) * 2.0 * np.pi / BINS
    terms = compass_terms(middle)
    off = [(terms @ (f.compass_rad - curve))[f.headings] for f in flights]
    squares = np.concatenate([np.zeros(0), *off]) ** 2
    return float(np.rad2deg(np.sqrt(squares.mean()))) if len(squares) and len(flights) > 1 else 0.0
