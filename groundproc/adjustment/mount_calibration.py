"""Mount, clock offset and compass from several flights together, with what each flight says of them and how well they agree.

Every flight is adjusted on its own; of the parameters that belong to the airframe its normal equations are joined, the nominal values
counted once. What the flights could not tell stays as it was.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2

from flightlog import frames
from flightlog.mount import Mount
from groundproc.adjustment.batch import PRIORS, turned
from groundproc.adjustment.windows import UNSEEN, Window

Array = npt.NDArray[np.float64]

SHARED: Final = ("ins.turn", "ins.lever")
"""What stays the same from flight to flight, in the order of the covariance: misalignment [rad] and lever arm [m], sensor frame."""
KNOWN: Final = 0.5
"""A parameter counts as found where its sigma is below this share of what was known before."""
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
    compass_rad, sigma_compass_rad : ndarray, shape (5,)
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
    sigma_compass_rad: Array
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
    """

    flights: Sequence[FlightResult]
    value: Array
    covariance: Array
    found: npt.NDArray[np.bool_]
    chi_square: float
    freedom: int

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
        with_axes = np.hypot(sigma, np.repeat([UNSEEN[name] for name in SHARED], 3))
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
            "chi_square": self.chi_square,
            "degrees_of_freedom": self.freedom,
            "agree": self.agree,
            "mount": {
                "yaw_deg": mount.lidar.yaw_deg,
                "pitch_deg": mount.lidar.pitch_deg,
                "roll_deg": mount.lidar.roll_deg,
                "position_m": list(mount.lidar.position_m),
            },
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
                    "sigma_compass_deg": np.rad2deg(flight.sigma_compass_rad).tolist(),
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
    value, covariance = joined(values, [window.covariance for window in exact if window.covariance is not None])
    delays = [window.values["ins.delay"] for window in exact]
    best = min(delays, key=lambda pair: float(pair[1][0]))
    compass = min((window.values["compass"] for window in exact), key=lambda pair: float(pair[1].sum()))
    return FlightResult(
        path.name, value, covariance, float(best[0][0]), float(best[1][0]), offset_s, compass[0], compass[1],
        sum(window.own for window in windows) * 0.1, warning,
    )  # fmt: skip


def _shared(values: Mapping[str, tuple[Array, Array]], to_ins: Array) -> Array:
    return np.concatenate([values["ins.turn"][0], values["ins.lever"][0] - to_ins])


def joined(values: Sequence[Array], covariances: Sequence[Array]) -> tuple[Array, Array]:
    """Weighted mean of estimates that all hold the same prior: it is counted once."""
    prior = np.diag(np.repeat([PRIORS[name] ** -2.0 for name in SHARED], 3))
    information = [np.linalg.inv(covariance) for covariance in covariances]
    total = sum(information[1:], information[0]) - (len(information) - 1) * prior
    right = sum((i @ v for i, v in zip(information, values, strict=True)), np.zeros(6))
    covariance = np.linalg.inv(total)
    return covariance @ right, covariance


def calibrate(flights: Sequence[FlightResult]) -> MountCalibration:
    """Join flights."""
    value, covariance = joined([f.value for f in flights], [f.covariance for f in flights])
    prior = np.repeat([PRIORS[name] for name in SHARED], 3)
    chi_square = sum(float((f.value - value) @ np.linalg.solve(f.covariance, f.value - value)) for f in flights)
    found = np.sqrt(np.diag(covariance)) < KNOWN * prior
    return MountCalibration(flights, value, covariance, found, chi_square, 6 * (len(flights) - 1))
