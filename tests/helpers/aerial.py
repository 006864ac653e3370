"""A scanner over a small town of planes, made with numpy, scipy, laspy and pyproj alone: clouds with true or wrong poses."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
import pyproj
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]

EPSG = 32633
PLACE = np.array([545_000.0, 6_470_000.0, 80.0])
START_NS = 1_779_272_223_000_000_000
GPS_MINUS_UNIX_S = 18 - 315_964_800
STEP_S = 0.01


def town(seed: int = 1) -> Array:
    """Parallelograms, shape (n, 3, 3): corner and two edges. A slope, an embankment, houses with gables."""
    rng = np.random.default_rng(seed)
    faces = [([-400, -400, -8], [800, 0, 16], [0, 800, 4])]
    faces += [([-400, 45, 4], [800, 0, 16], [0, 12, 5]), ([-400, -70, 4], [800, 0, 16], [0, 10, -4])]
    for _ in range(14):
        x, y = rng.uniform(-65, 65), rng.uniform(-38, 38)
        a, b, high, rise = rng.uniform(8, 14), rng.uniform(6, 9), rng.uniform(3, 5), rng.uniform(2, 4)
        turn = rng.uniform(0, np.pi)
        u, v = a * np.array([np.cos(turn), np.sin(turn), 0]), b * np.array([-np.sin(turn), np.cos(turn), 0])
        o, up, ridge = np.array([x, y, -4.0]), np.array([0, 0, high + 8.0]), np.array([0, 0, rise])
        eaves = o + up
        faces += [(o, u, up), (o, v, up), (o + u, v, up), (o + v, u, up)]
        faces += [(eaves, u, v / 2 + ridge), (eaves + v, u, -v / 2 + ridge)]
    return np.array([[np.asarray(part, float) for part in face] for face in faces])


def seen(faces: Array, eye: Array, ray: Array) -> Array:
    """Range of the nearest face along rays, shape (n,); infinite where there is none."""
    best = np.full(len(ray), np.inf)
    eye = np.broadcast_to(eye, ray.shape)
    for corner, u, v in faces:
        normal = np.cross(u, v)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = ((corner - eye) @ normal) / (ray @ normal)
        near = np.flatnonzero((t > 1) & (t < best))
        hit = eye[near] + t[near, None] * ray[near] - corner
        across = np.linalg.solve(np.stack([u, v, normal], axis=1), hit.T)
        good = near[(across[:2] >= 0).all(axis=0) & (across[:2] <= 1).all(axis=0)]
        best[good] = t[good]
    return best


@dataclass
class Flight:
    """Poses every 10 ms: map coordinates, and attitudes map from body (right, forward, up)."""

    time_s: Array
    place_m: Array
    attitude: Rotation

    def at(self, time_s: Array) -> tuple[Array, Rotation]:
        i = np.clip(np.rint(time_s / STEP_S).astype(int), 0, len(self.time_s) - 1)
        return self.place_m[i], self.attitude[i]


LINES = [(-75, -28), (75, -28), (75, 0), (-75, 0), (-75, 28), (75, 28), (75, 45), (0, 45), (0, -60)]


def flown(
    corners: list[tuple[float, float]] = LINES, speed: float = 9.0, high: float = 48.0, sway: float = 1.0
) -> Flight:
    """A flight along corners, leaning and swaying a little."""
    points = np.array([(x, y, high) for x, y in corners], float)
    legs = np.linalg.norm(np.diff(points, axis=0), axis=1)
    time = np.arange(0, legs.sum() / speed, STEP_S)
    rough = np.stack([np.interp(time * speed, np.append(0, np.cumsum(legs)), points[:, k]) for k in range(3)], axis=1)
    place = gaussian_filter1d(rough, 100, axis=0, mode="nearest")
    course = np.diff(rough[:, :2], axis=0, append=rough[-1:, :2])
    course[-1] = course[-2]
    yaw = gaussian_filter1d(np.unwrap(np.arctan2(-course[:, 0], course[:, 1])), 80, mode="nearest")
    pitch = sway * np.deg2rad(2.5) * np.sin(2 * np.pi * time / 3.1)
    roll = sway * np.deg2rad(3.0) * np.sin(2 * np.pi * time / 4.3 + 1)
    place[:, 0] += 0.3 * np.sin(2 * np.pi * time / 7)
    return Flight(time, place + PLACE, Rotation.from_euler("ZXY", np.stack([yaw, pitch, roll], axis=1)))


@dataclass
class Errors:
    """Slow errors of a trajectory, and constants of the mount."""

    position_m: float = 0.0
    attitude_deg: float = 0.0
    boresight_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lever_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seed: int = 5
    period_s: float = 25.0
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def slow(self, time_s: Array, sigma: float, stream: int) -> Array:
        """Three sums of sines of random phase, shape (n, 3)."""
        rng = np.random.default_rng((self.seed, stream))
        periods = self.period_s * np.array([1.0, 1.7, 3.1])
        phase = rng.uniform(0, 2 * np.pi, (3, 3))
        waves = np.sin(2 * np.pi * time_s[:, None, None] / periods + phase)
        return np.asarray(sigma * np.sqrt(2 / 3) * waves.sum(axis=2))

    def applied(self, flight: Flight) -> Flight:
        turn = Rotation.from_rotvec(np.deg2rad(self.slow(flight.time_s, self.attitude_deg, 1)))
        place = flight.place_m + self.slow(flight.time_s, self.position_m, 2) + np.array(self.shift_m)
        return Flight(flight.time_s, place, turn * flight.attitude)


@dataclass
class Scan:
    """Points of a flight.

    `seen_m` is where they were, `placed_m` where wrong poses put them.
    """

    flight: Flight
    wrong: Flight
    time_s: Array
    seen_m: Array
    placed_m: Array
    faces: Array = field(repr=False)


def scanned(
    flight: Flight,
    errors: Errors,
    *,
    faces: Array | None = None,
    rate_hz: float = 2000.0,
    noise_m: float = 0.015,
    seed: int = 2,
) -> Scan:
    """A scanner that sweeps 40 deg to both sides with its mirror also nodding, ranges with noise."""
    rng = np.random.default_rng(seed)
    faces = town() if faces is None else faces
    time = np.arange(0, flight.time_s[-1], 1 / rate_hz)
    across = np.deg2rad(40) * (2 * ((time * 41.7) % 1) - 1)
    along = np.deg2rad(18) * np.sin(2 * np.pi * time * 3.3)
    ray = np.stack([np.sin(across), np.sin(along), -np.cos(across) * np.cos(along)], axis=1)
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    eye, attitude = flight.at(time)
    # the mount that the placing believes in is the body itself
    mount = Rotation.from_rotvec(np.deg2rad(errors.boresight_deg))
    eye = eye + attitude.apply(np.array(errors.lever_m))
    pointed = (attitude * mount).apply(ray)
    reach = seen(faces, eye - PLACE, pointed)
    hit = np.isfinite(reach)
    time, ray, reach = time[hit], ray[hit], reach[hit] + noise_m * rng.standard_normal(hit.sum())
    wrong = errors.applied(flight)
    believed, turned = wrong.at(time)
    placed = believed + turned.apply(ray * reach[:, None])
    return Scan(flight, wrong, time, eye[hit] + pointed[hit] * reach[:, None], placed, faces)


def write_las(path: Path, scan: Scan, places: Array, *, chosen: Any = slice(None), **named: Any) -> None:
    """A LAS 1.4 file of format 7 with extra bytes; `named`: gps_s, point_format, crs, source, week_time."""
    time, places = scan.time_s[chosen], places[chosen]
    header = laspy.LasHeader(version="1.4", point_format=named.get("point_format", 7))
    header.scales, header.offsets = np.array([0.001, 0.001, 0.001]), np.floor(PLACE)
    header.add_extra_dim(laspy.ExtraBytesParams("pulse", np.uint32, "number of the pulse"))
    standard = not named.get("week_time", False)
    header.global_encoding.gps_time_type = (
        laspy.header.GpsTimeType.STANDARD if standard else laspy.header.GpsTimeType.WEEK_TIME
    )
    if named.get("crs", True):
        header.add_crs(pyproj.CRS.from_epsg(EPSG))
    header.vlrs.append(laspy.VLR("somebody", 77, "a record of their own", b"kept"))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = places.T
    if "gps_time" in header.point_format.dimension_names:
        gps = START_NS * 1e-9 + GPS_MINUS_UNIX_S + time
        cloud.gps_time = np.broadcast_to(named.get("gps_s", gps - 1e9 if standard else gps % 604_800), len(time))
    cloud.intensity = (np.arange(len(time)) % 65_536).astype(np.uint16)
    cloud.classification = (np.arange(len(time)) % 7).astype(np.uint8)
    cloud["pulse"] = np.arange(len(time), dtype=np.uint32)
    cloud.point_source_id = np.asarray(named.get("source", np.full(len(time), 3)), np.uint16)
    cloud.write(path)


def geodetic(place_m: Array) -> tuple[Array, Array, Array]:
    """Latitude, longitude [deg] and convergence [deg]: grid bearing = true bearing - convergence."""
    crs = pyproj.CRS.from_epsg(EPSG)
    lon, lat = pyproj.Transformer.from_crs(crs, 4326, always_xy=True).transform(place_m[:, 0], place_m[:, 1])
    return np.asarray(lat), np.asarray(lon), np.asarray(pyproj.Proj(crs).get_factors(lon, lat).meridian_convergence)


def write_csv(path: Path, flight: Flight) -> None:
    """The columns of trajectory.csv that a pose needs."""
    lat, lon, convergence = geodetic(flight.place_m)
    yaw, pitch, roll = np.rad2deg(flight.attitude.as_euler("ZXY")).T
    heading = (-yaw + convergence) % 360
    stamps = START_NS + np.rint(flight.time_s * 1e9).astype(np.int64)
    with path.open("w", encoding="ascii") as file:
        file.write("utc_ns,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg\n")
        for row in zip(stamps, lat, lon, flight.place_m[:, 2], roll, pitch, heading, strict=True):
            stamp, *rest = row
            file.write(f"{stamp}," + ",".join(f"{value:.10f}" for value in rest) + "\n")


def read_csv(path: Path) -> Flight:
    """A trajectory.csv back in map coordinates."""
    table = np.genfromtxt(path, delimiter=",", names=True)
    stamps = np.loadtxt(path, delimiter=",", skiprows=1, usecols=0, dtype=np.int64)
    east, north = pyproj.Transformer.from_crs(4326, EPSG, always_xy=True).transform(
        table["longitude_deg"], table["latitude_deg"]
    )
    place = np.stack([east, north, table["height_m"]], axis=1)
    *_, convergence = geodetic(place)
    angles = np.stack([-(table["heading_deg"] - convergence), table["pitch_deg"], table["roll_deg"]], axis=1)
    return Flight((stamps - START_NS) * 1e-9, place, Rotation.from_euler("ZXY", np.deg2rad(angles)))


def aligned(value: Array, truth: Array) -> Array:
    """What is left of distances to the truth, shape (n, 3), after one small turn and one shift."""
    centre = truth.mean(axis=0)
    off, arm = value - truth, truth - centre
    zero = np.zeros(len(arm))
    x, y, z = arm.T
    turn = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3)
    base = np.concatenate([turn, np.tile(np.eye(3), (len(arm), 1))], axis=1)
    solution, *_ = np.linalg.lstsq(base, off.ravel(), rcond=None)
    return np.asarray((off.ravel() - base @ solution).reshape(-1, 3))
