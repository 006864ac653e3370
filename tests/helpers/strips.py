"""Clouds of strips whose every echo is known: surfaces, a lidar above them on straight lines, and its trajectory."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
import pyproj

Array = npt.NDArray[np.float64]

ORIGIN = np.array([533_000.0, 6_472_000.0, 0.0])
START_NS = 1_779_272_223_000_000_000
GPS_S = START_NS * 1e-9 - 315_964_800 + 18 - 1e9
"""Adjusted standard GPS time of the start."""


@dataclass
class Strip:
    """A straight line flown at a constant speed.

    Attributes
    ----------
    start_m, velocity_m_s : of the origin of the scene
    begin_s, seconds : float
    """

    start_m: Sequence[float]
    velocity_m_s: Sequence[float]
    begin_s: float
    seconds: float

    def at(self, time_s: Array) -> Array:
        return np.asarray(self.start_m) + (time_s - self.begin_s)[:, None] * np.asarray(self.velocity_m_s)


@dataclass
class Surface:
    """A flat rectangle: centre, two half axes [m], reflectance at normal incidence and exponent of the cosine."""

    centre_m: Sequence[float]
    right_m: Sequence[float]
    up_m: Sequence[float]
    reflectance: float
    per_m2: float = 400.0
    texture: float = 0.0
    exponent: float = 1.0

    @property
    def normal(self) -> Array:
        n = np.cross(self.right_m, self.up_m)
        return np.asarray(n / np.linalg.norm(n))


@dataclass
class Scene:
    """Echoes of surfaces from strips."""

    surfaces: list[Surface]
    strips: list[Strip]
    noise_m: float = 0.01
    speckle: float = 0.1
    gains: Array = field(default_factory=lambda: np.ones(32))
    response: Callable[[Array, Array], Array] = lambda strength, range_m: 100.0 * strength
    """Of reflectance x cosine and range: what the sensor says."""

    def make(self, seed: int = 1) -> dict[str, Any]:
        rng = np.random.default_rng(seed)
        parts: list[dict[str, Any]] = []
        for number, strip in enumerate(self.strips):
            for which, surface in enumerate(self.surfaces):
                a, b = np.asarray(surface.right_m, float), np.asarray(surface.up_m, float)
                area = 4.0 * float(np.linalg.norm(np.cross(a, b)))
                count = int(area * surface.per_m2)
                uv = rng.uniform(-1, 1, (count, 2))
                place = np.asarray(surface.centre_m) + uv[:, :1] * a + uv[:, 1:] * b
                if which == 0:
                    place = place[~self._covered(place)]
                    count = len(place)
                time_s = strip.begin_s + rng.uniform(0, strip.seconds, count)
                sensor = strip.at(time_s)
                away = sensor - place
                range_m = np.linalg.norm(away, axis=1)
                cosine = np.abs(away @ surface.normal) / range_m
                laser = rng.integers(0, 32, count)
                rho = surface.reflectance * (1.0 + surface.texture * np.sin(place[:, 0]) * np.sin(place[:, 1]))
                strength = (
                    rho * cosine**surface.exponent * self.gains[laser] * (1 + self.speckle * rng.standard_normal(count))
                )
                noise = self.noise_m * rng.standard_normal(count)
                xyz = place + away / range_m[:, None] * noise[:, None]
                parts.append(
                    {
                        "xyz": xyz, "time_s": time_s, "laser": laser, "range": range_m, "cosine": cosine, "rho": rho,
                        "strip": np.full(count, number), "surface": np.full(count, which),
                        "intensity": np.clip(np.rint(self.response(np.maximum(strength, 0.0), range_m)), 0, 65535),
                    }
                )  # fmt: skip
        whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        order = np.argsort(whole["time_s"], kind="stable")
        return {name: values[order] for name, values in whole.items()}

    def _covered(self, place: Array) -> npt.NDArray[np.bool_]:
        """Places of the first surface, the ground, that lie under others."""
        found = np.zeros(len(place), bool)
        for other in self.surfaces[1:]:
            away = place[:, :2] - np.asarray(other.centre_m)[:2]
            half = np.abs(np.asarray(other.right_m)) + np.abs(np.asarray(other.up_m))
            found |= (np.abs(away[:, 0]) <= half[0]) & (np.abs(away[:, 1]) <= half[1])
        return found

    def write_trajectory(self, path: Path) -> Path:
        """A trajectory.csv, level and heading north."""
        to = pyproj.Transformer.from_crs(32633, 4326, always_xy=True)
        lines = ["utc_ns,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg"]
        for strip in self.strips:
            time_s = np.arange(strip.begin_s, strip.begin_s + strip.seconds + 0.05, 0.1)
            place = strip.at(time_s) + ORIGIN
            longitude, latitude = to.transform(place[:, 0], place[:, 1])
            lines += [
                f"{START_NS + round(t * 1e9)},{la:.10f},{lo:.10f},{h:.4f},0,0,0"
                for t, la, lo, h in zip(time_s, latitude, longitude, place[:, 2], strict=True)
            ]
        path.write_text("\n".join(lines) + "\n")
        return path


def write_cloud(
    path: Path, echoes: dict[str, Any], *, laser: bool = True, epsg: int | None = 32633, system: str = ""
) -> Path:
    """A LAS file of echoes."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, ORIGIN
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    if epsg is not None:
        header.add_crs(pyproj.CRS.from_epsg(epsg))
    if system:
        header.system_identifier = system
    if laser:
        header.add_extra_dim(laspy.ExtraBytesParams("laser", np.uint8, "laser in firing order"))
    las = laspy.LasData(header)
    las.xyz = echoes["xyz"] + ORIGIN
    las.gps_time = GPS_S + echoes["time_s"]
    las.intensity = echoes["intensity"].astype(np.uint16)
    las.return_number = las.number_of_returns = np.ones(len(echoes["xyz"]), np.uint8)
    las.point_source_id = echoes["strip"] + 1
    if laser:
        las["laser"] = echoes["laser"].astype(np.uint8)
    las.write(path)
    return path
