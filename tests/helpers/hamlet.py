"""A hamlet by triangles and balls, and what cameras see of it: rays, lenses and map coordinates by arithmetic of their own.

Nothing of the package's cameras, frames or poses is used, only the words of the documentation: an outside witness of colours and mosaics.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
import pyproj
import yaml
from numba import njit
from PIL import Image

Array = npt.NDArray[np.float64]

EPSG = 32633
LATITUDE, LONGITUDE, HEIGHT = 47.0, 17.6, 300.0
"""2.6 degrees off the central meridian of its zone: grid north is 1.9 degrees off."""
GROUND, ROOF, WALL, LEAVES = range(4)


@dataclass(frozen=True)
class Hamlet:
    """Triangles, shape (n, 3, 3), with what each is of, and balls, shape (m, 4): middle and radius. East, north, up [m]."""

    triangle: Array
    kind: npt.NDArray[np.int64]
    ball: Array

    def hit(self, origin: Array, ray: Array) -> tuple[Array, npt.NDArray[np.int64]]:
        """Distances along rays from places, shape (n, 3) each, in lengths of the ray, and what is hit; -1: nothing."""
        origin = np.ascontiguousarray(np.broadcast_to(origin, ray.shape))
        distance, which = np.empty(len(ray)), np.empty(len(ray), np.int64)
        _hit(origin, np.ascontiguousarray(ray), self.triangle, self.ball, distance, which)
        kinds = np.append(self.kind, [LEAVES] * len(self.ball) + [-1])
        return distance, kinds[which]

    def hidden(self, origin: Array, places: Array) -> npt.NDArray[np.bool_]:
        """Places on its surfaces that cannot be seen from others."""
        return self.hit(origin, places - origin)[0] < 1.0 - 1e-6

    def sampled(self, density: float, rng: np.random.Generator) -> tuple[Array, npt.NDArray[np.int64]]:
        """Places on all surfaces, so many a square metre, and what they are of."""
        a, b, c = np.moveaxis(self.triangle, 1, 0)
        count = rng.poisson(density * 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))
        of = np.repeat(np.arange(len(count)), count)
        u, v = rng.random((2, len(of), 1))
        flip = u + v > 1.0
        u, v = np.where(flip, 1.0 - u, u), np.where(flip, 1.0 - v, v)
        flat = a[of] + u * (b - a)[of] + v * (c - a)[of]
        balls = []
        for x, y, z, radius in self.ball:
            way = rng.normal(size=(rng.poisson(density * 4.0 * np.pi * radius**2), 3))
            balls.append(np.array([x, y, z]) + radius * way / np.linalg.norm(way, axis=1, keepdims=True))
        places = np.concatenate([flat, *balls])
        kinds = np.concatenate([self.kind[of], np.full(len(places) - len(flat), LEAVES)])
        order = rng.permutation(len(places))
        return places[order], kinds[order]


@njit(cache=False)
def _hit(origin: Any, ray: Any, triangle: Any, ball: Any, distance: Any, which: Any) -> None:
    for i in range(len(ray)):
        o, d = origin[i], ray[i]
        best, of = np.inf, -1
        for t in range(len(triangle)):
            a, b, c = triangle[t, 0], triangle[t, 1], triangle[t, 2]
            e0, e1, e2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
            f0, f1, f2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
            p0, p1, p2 = d[1] * f2 - d[2] * f1, d[2] * f0 - d[0] * f2, d[0] * f1 - d[1] * f0
            det = e0 * p0 + e1 * p1 + e2 * p2
            if abs(det) < 1e-14:
                continue
            s0, s1, s2 = o[0] - a[0], o[1] - a[1], o[2] - a[2]
            u = (s0 * p0 + s1 * p1 + s2 * p2) / det
            if u < 0.0 or u > 1.0:
                continue
            q0, q1, q2 = s1 * e2 - s2 * e1, s2 * e0 - s0 * e2, s0 * e1 - s1 * e0
            v = (d[0] * q0 + d[1] * q1 + d[2] * q2) / det
            if v < 0.0 or u + v > 1.0:
                continue
            far = (f0 * q0 + f1 * q1 + f2 * q2) / det
            if 1e-9 < far < best:
                best, of = far, t
        for t in range(len(ball)):
            x, y, z = o[0] - ball[t, 0], o[1] - ball[t, 1], o[2] - ball[t, 2]
            a2 = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
            half = d[0] * x + d[1] * y + d[2] * z
            rest = half * half - a2 * (x * x + y * y + z * z - ball[t, 3] * ball[t, 3])
            if rest > 0.0:
                far = (-half - np.sqrt(rest)) / a2
                if 1e-9 < far < best:
                    best, of = far, len(triangle) + t
        distance[i], which[i] = best, of


def quad(a: Sequence[float], b: Sequence[float], c: Sequence[float], d: Sequence[float]) -> Array:
    """Two triangles of four corners in turn."""
    return np.array([[a, b, c], [a, c, d]], float)


def house(x: float, y: float, wide: float, deep: float, eaves: float, ridge: float, over: float, ground: float) -> Any:
    """Four walls, and a roof with its ridge along x that stands out over them on all sides; triangles of each."""
    low, left, right, front, back = ground, x - wide / 2, x + wide / 2, y - deep / 2, y + deep / 2
    slope = (ridge - eaves) / (deep / 2)
    walls = [
        quad((left, s, low), (right, s, low), (right, s, ground + eaves), (left, s, ground + eaves))
        for s in (front, back)
    ]
    for s in (left, right):
        walls.append(quad((s, front, low), (s, back, low), (s, back, ground + eaves), (s, front, ground + eaves)))
        gable = [(s, front, ground + eaves), (s, back, ground + eaves), (s, y, ground + ridge)]
        walls.append(np.array([gable], float))
    drop = ground + eaves - slope * over
    roof = [
        quad((left - over, y, ground + ridge), (right + over, y, ground + ridge), (right + over, s, drop), (left - over, s, drop))
        for s in (front - over, back + over)
    ]  # fmt: skip
    return np.concatenate(walls), np.concatenate(roof)


def hamlet(half_m: float = 24.0, eaves_m: float = 0.5) -> Hamlet:
    """Rolling ground, two houses, a garden wall and three trees."""

    def relief(x: Any, y: Any) -> Any:
        return 0.06 * x + 0.8 * np.sin(x / 9.0) * np.cos(y / 11.0)

    edges = np.linspace(-half_m, half_m, 9)
    parts, kinds = [], []
    for x0, x1 in pairwise(edges):
        for y0, y1 in pairwise(edges):
            parts.append(quad(*[(x, y, float(relief(x, y))) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]))
            kinds += [GROUND] * 2
    for x, y, wide, deep, eaves, ridge in ((-9.0, 4.0, 9.0, 7.0, 4.0, 6.5), (9.0, -6.0, 8.0, 8.0, 5.5, 7.5)):
        walls, roof = house(x, y, wide, deep, eaves, ridge, eaves_m, float(relief(x, y)) - 1.0)
        parts += [walls, roof]
        kinds += [WALL] * len(walls) + [ROOF] * len(roof)
    box = [(-15.0, -12.0), (1.0, -12.0), (1.0, -11.7), (-15.0, -11.7)]
    for (x0, y0), (x1, y1) in zip(box, [*box[1:], box[0]], strict=True):
        parts.append(quad((x0, y0, -2.5), (x1, y1, -2.5), (x1, y1, 2.0), (x0, y0, 2.0)))
        kinds += [WALL] * 2
    parts.append(quad(*[(x, y, 2.0) for x, y in box]))
    kinds += [WALL] * 2
    balls = [
        (x, y, float(relief(x, y)) + z, r)
        for x, y, z, r in ((0.0, 12.0, 5.0, 2.2), (15.0, 9.0, 4.0, 1.8), (-17.0, -4.0, 5.5, 2.5))
    ]
    return Hamlet(np.concatenate(parts), np.array(kinds), np.array(balls))


def colours(places: Array, kind: npt.NDArray[np.int64]) -> Array:
    """Red, green, blue, 0 to 1, of places: waves of decimetres to metres, roofs reddish, walls blueish, leaves dark."""
    x, y, z = places.T
    wave = np.stack(
        [np.sin(1.3 * x + 0.4 * z) * np.cos(0.9 * y), np.sin(1.1 * y + 0.7 * z + 1.0), np.cos(1.2 * x - 0.8 * y + 1.1 * z)],
        axis=1,
    )  # fmt: skip
    base = np.array([[0.45, 0.5, 0.35], [0.65, 0.35, 0.3], [0.35, 0.4, 0.65], [0.25, 0.35, 0.2], [0.0, 0.0, 0.0]])
    return base[kind] + np.where(kind[:, None] >= 0, 0.14 * wave, 0.0)


@dataclass(frozen=True)
class Lens:
    """A camera as rig.yaml describes it.

    `mat_cam_ins` and `arm_m` are of T_cam_imu, rows as there. `fall` is vignetting: [a, b, c] of r2, r4, r6.
    """

    name: str
    width: int
    height: int
    focal: float
    model: str = "none"
    coefficients: tuple[float, ...] = ()
    centre: tuple[float, float] | None = None
    pixel_mm: float = 0.0
    fall: tuple[float, ...] = ()
    line_delay_s: float = 0.0
    bands: tuple[str, ...] = ()
    more: Mapping[str, Any] = field(default_factory=dict)

    @property
    def middle(self) -> tuple[float, float]:
        return self.centre or ((self.width - 1) / 2 + 3.3, (self.height - 1) / 2 - 2.1)

    def rays(self) -> Array:
        """Directions of all pixels, x right, y down, z forward, row by row; not a number where the lens does not look."""
        v, u = np.mgrid[: self.height, : self.width].reshape(2, -1).astype(float)
        x, y = (u - self.middle[0]) / self.focal, (v - self.middle[1]) / self.focal
        if self.model == "equidistant":
            bent = np.hypot(x, y)
            theta = bent.copy()
            for _ in range(60):
                theta += 0.7 * (bent - _polynomial(theta, self.coefficients))
            across = np.sin(theta) / np.maximum(bent, 1e-12)
            ray = np.stack([across * x, across * y, np.cos(theta)], axis=1)
            ray[theta > np.deg2rad(88.0)] = np.nan
            return ray
        if self.model == "radtan":
            bx, by = x.copy(), y.copy()
            for _ in range(60):
                px, py = _brown(bx, by, self.coefficients)
                bx, by = bx + 0.7 * (x - px), by + 0.7 * (y - py)
            x, y = bx, by
        elif self.model == "brown_photogrammetric":
            k1, k2, p1, p2, k3 = self.coefficients
            mx, my = (u - self.middle[0]) * self.pixel_mm, -(v - self.middle[1]) * self.pixel_mm
            r2 = mx * mx + my * my
            radial = k1 * r2 + k2 * r2**2 + k3 * r2**3
            cx = mx + mx * radial + p1 * (r2 + 2 * mx * mx) + 2 * p2 * mx * my
            cy = my + my * radial + p2 * (r2 + 2 * my * my) + 2 * p1 * mx * my
            x, y = cx / self.pixel_mm / self.focal, -cy / self.pixel_mm / self.focal
        ray = np.stack([x, y, np.ones_like(x)], axis=1)
        return ray / np.linalg.norm(ray, axis=1, keepdims=True)

    def pixels(self, places: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Pixels of places in the frame of the camera, and which are in the picture. Not of `brown_photogrammetric`."""
        x, y, z = places.T
        if self.model == "equidistant":
            across = np.hypot(x, y)
            theta = np.arctan2(across, z)
            bent = _polynomial(theta, self.coefficients)
            px, py = bent * x / np.maximum(across, 1e-12), bent * y / np.maximum(across, 1e-12)
            ok = theta < np.deg2rad(88.0)
        else:
            ok = z > 0.1
            px, py = _brown(
                x / np.where(ok, z, 1.0),
                y / np.where(ok, z, 1.0),
                self.coefficients if self.model == "radtan" else (0, 0, 0, 0),
            )
        found = np.stack([self.focal * px + self.middle[0], self.focal * py + self.middle[1]], axis=1)
        inside = (found >= -0.5).all(axis=1) & (found <= np.array([self.width, self.height]) - 0.5).all(axis=1)
        return found, ok & inside

    def falloff(self) -> Array:
        """Share of the light that reaches pixels, shape (height, width)."""
        v, u = np.mgrid[: self.height, : self.width]
        square = (u - self.middle[0]) ** 2 + (v - self.middle[1]) ** 2
        square = square / square.max()
        return np.asarray(1.0 + sum(term * square**power for power, term in enumerate(self.fall, 1)))

    def entry(self) -> dict[str, Any]:
        """Of rig.yaml."""
        found: dict[str, Any] = {
            "camera_model": "pinhole", "intrinsics": [self.focal, self.focal, *self.middle], "distortion_model": self.model,
            "distortion_coeffs": list(self.coefficients), "resolution": [self.width, self.height],
            "image_prefix": f"{self.name}/", "line_delay_s": self.line_delay_s,
        }  # fmt: skip
        if self.pixel_mm:
            found["pixel_mm"] = self.pixel_mm
        if self.fall:
            found["vignetting"] = list(self.fall)
        if self.bands:
            found["bands"] = list(self.bands)
        return found | dict(self.more)


def _polynomial(theta: Any, k: Sequence[float]) -> Any:
    return theta * (1.0 + sum(term * theta ** (2 * power) for power, term in enumerate(k, 1)))


def _brown(x: Any, y: Any, k: Sequence[float]) -> Any:
    k1, k2, p1, p2, k3 = (*k, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    r2 = x * x + y * y
    radial = 1.0 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


@dataclass(frozen=True)
class Shot:
    """A picture: its camera, where that was, how it looked (columns of `turn`: its axes in east, north, up), and how it moved."""

    lens: Lens
    place: Array
    turn: Array
    exposure: tuple[float, ...] = (1.0,)
    time_s: float = 0.0
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    exif: Mapping[int, Any] = field(default_factory=dict)

    def rows_at(self, row: Any) -> Array:
        """Where the camera was when rows were exposed, shape (n, 3)."""
        late = (row - (self.lens.height - 1) / 2) * self.lens.line_delay_s
        return self.place + late[:, None] * np.array(self.velocity)

    def sees(self, scene: Hamlet, places: Array) -> npt.NDArray[np.bool_]:
        """Which places on surfaces are in the picture and not hidden."""
        row = np.full(len(places), (self.lens.height - 1) / 2)
        for _ in range(4 if self.lens.line_delay_s else 1):
            eye = self.rows_at(row)
            pixel, inside = self.lens.pixels((places - eye) @ self.turn)
            row = np.clip(pixel[:, 1], -0.5, self.lens.height - 0.5)
        found = np.zeros(len(places), bool)
        some = np.flatnonzero(inside)
        found[some] = ~scene.hidden(eye[some], places[some])
        return found


def looking(right: float, ahead: float, heading: float) -> Array:
    """Axes of a camera that looks down, its upper edge to a heading, tilted to the right and ahead of it [deg]."""
    h, a, b = np.deg2rad([heading, ahead, right])
    forward, side, up = (
        np.array([np.sin(h), np.cos(h), 0.0]),
        np.array([np.cos(h), -np.sin(h), 0.0]),
        np.array([0.0, 0.0, 1.0]),
    )
    z = -up * np.cos(a) * np.cos(b) + forward * np.sin(a) * np.cos(b) + side * np.sin(b)
    x = side - (side @ z) * z
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


Paint = Callable[[Array, npt.NDArray[np.int64]], Array]


def picture(scene: Hamlet, shot: Shot, paint: Paint = colours) -> Array:
    """What it shows, shape (height, width, planes), 0 to 1 where nothing is too bright; mean of four rays a pixel is left to others."""
    lens = shot.lens
    rays = lens.rays()
    there = np.isfinite(rays[:, 0])
    row = np.repeat(np.arange(lens.height), lens.width)
    eye = shot.rows_at(row.astype(float))
    world = np.where(there[:, None], rays, 0.0) @ shot.turn.T
    distance, kind = scene.hit(eye, world + np.where(there, 0.0, 1e-9)[:, None])
    kind = np.where(there & np.isfinite(distance), kind, -1)
    places = eye + world * np.where(np.isfinite(distance), distance, 0.0)[:, None]
    values = paint(places, kind).reshape(lens.height, lens.width, -1)
    return np.asarray(values * lens.falloff()[..., None] * np.array(shot.exposure))


def to_map(places: Array) -> Array:
    """Easting, northing, height of places in the frame of the hamlet: by way of the earth's centre."""
    return np.stack(_pipeline().transform(*places.T), axis=1)


def _pipeline() -> pyproj.Transformer:
    return pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +lat_0={LATITUDE} +lon_0={LONGITUDE} +h_0={HEIGHT} +ellps=WGS84 "
        "+step +inv +proj=cart +ellps=WGS84 +step +proj=utm +zone=33 +ellps=WGS84"
    )


def angles(shot: Shot) -> tuple[float, float, float]:
    """Omega, phi, kappa [deg] against grid axes, the camera's x right, y up, z backwards."""
    factors = pyproj.Proj(EPSG).get_factors(LONGITUDE, LATITUDE)
    g = np.deg2rad(factors.meridian_convergence)
    grid_enu = np.array([[np.cos(g), -np.sin(g), 0.0], [np.sin(g), np.cos(g), 0.0], [0.0, 0.0, 1.0]])
    m = grid_enu @ shot.turn @ np.diag([1.0, -1.0, -1.0])
    # Rx(o) Ry(p) Rz(k) has sin p in its upper right corner
    omega, phi, kappa = np.arctan2(-m[1, 2], m[2, 2]), np.arcsin(m[0, 2]), np.arctan2(-m[0, 1], m[0, 0])
    return float(np.rad2deg(omega)), float(np.rad2deg(phi)), float(np.rad2deg(kappa))


def write_block(
    folder: Path, scene: Hamlet, shots: Sequence[Shot], paint: Paint = colours, scale: float = 255.0, black: float = 0.0,
    noise: float = 0.0, suffix: str = "png", seed: int = 0,
) -> list[str]:  # fmt: skip
    """Pictures of 8 bits (16 where the scale is above 255), poses.csv and rig.yaml; gives their names."""
    rng = np.random.default_rng(seed)
    lines, names = ["image,utc_ns,easting,northing,height,omega_deg,phi_deg,kappa_deg"], []
    for number, shot in enumerate(shots):
        name = f"{shot.lens.name}/{number:03d}.{suffix}"
        (folder / shot.lens.name).mkdir(parents=True, exist_ok=True)
        values = picture(scene, shot, paint) * scale
        values = values * rng.normal(1.0, noise, values.shape) + black if noise else values + black
        dtype = np.uint8 if scale <= 255.0 else np.uint16
        shown = np.clip(np.rint(values), 0, np.iinfo(dtype).max).astype(dtype)
        exif = Image.Exif()
        if shot.exif:
            exif._ifds[0x8769], exif[0x8769] = dict(shot.exif), 0
        Image.fromarray(shown[..., 0] if shown.shape[2] == 1 else shown).save(folder / name, exif=exif)
        e, n, h = to_map(shot.place[None])[0]
        stamp = 1_700_000_000_000_000_000 + round(shot.time_s * 1e9)
        lines.append(f"{name},{stamp},{e:.5f},{n:.5f},{h:.5f}," + ",".join(f"{a:.8f}" for a in angles(shot)))
        names.append(name)
    (folder / "poses.csv").write_text("\n".join(lines) + "\n")
    lenses = {shot.lens.name: shot.lens for shot in shots}
    (folder / "rig.yaml").write_text(yaml.safe_dump({name: lens.entry() for name, lens in lenses.items()}))
    return names


def write_cloud(path: Path, places: Array) -> None:
    """A LAZ file of places in the frame of the hamlet."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    on_map = to_map(places)
    header.scales, header.offsets = [0.001] * 3, np.floor(on_map.min(axis=0))
    header.add_crs(pyproj.CRS.from_epsg(EPSG))
    las = laspy.LasData(header)
    las.xyz = on_map
    las.intensity = np.arange(len(places)) % 65536
    las.gps_time = np.arange(len(places)) * 1e-5
    las.write(path)


def flown(
    lenses: Sequence[tuple[Lens, float, float]], height: float = 30.0, speed: float = 5.0, step: float = 8.0, half: float = 16.0
) -> list[Shot]:  # fmt: skip
    """Strips there and back along north, all cameras (tilted to the right and ahead) at each place."""
    found, time_s = [], 0.0
    for strip, east in enumerate(np.arange(-half, half + 1e-9, step)):
        heading = 0.0 if strip % 2 == 0 else 180.0
        norths = np.arange(-half, half + 1e-9, step)[:: 1 if strip % 2 == 0 else -1]
        for north in norths:
            for lens, right, ahead in lenses:
                way = np.array([np.sin(np.deg2rad(heading)), np.cos(np.deg2rad(heading)), 0.0])
                sway = 2.0 * np.sin(3.0 * time_s), 1.5 * np.cos(2.0 * time_s), 3.0 * np.sin(time_s)
                turn = looking(right + sway[0], ahead + sway[1], heading + sway[2])
                found.append(
                    Shot(
                        lens,
                        np.array([east, north, height + 0.5 * np.sin(time_s)]),
                        turn,
                        (1.0,),
                        time_s,
                        tuple(speed * way),
                    )
                )
            time_s += step / speed
        time_s += 10.0
    return found


def exposed(shots: Sequence[Shot], low: float, high: float, seed: int) -> list[Shot]:
    """The same with an exposure of its own each, and a white balance."""
    rng = np.random.default_rng(seed)
    return [replace(shot, exposure=tuple(rng.uniform(low, high) * rng.uniform(0.97, 1.03, 3))) for shot in shots]


def clear_cut(
    scene: Hamlet, shot: Shot, true: Array, spacing: float
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Points that are seen, and those that are hidden, wherever within a spacing across the view they may be."""
    angle = np.arange(8) * np.pi / 4.0
    ring = np.cos(angle)[:, None] * shot.turn[:, 0] + np.sin(angle)[:, None] * shot.turn[:, 1]
    # thin things lie between the point and a place a whole spacing aside
    ways = [np.zeros(3), *(share * spacing * way for share in (0.35, 0.7, 1.0) for way in ring)]
    _, inside = shot.lens.pixels((true - shot.place) @ shot.turn)
    some = np.flatnonzero(inside)
    hidden = []
    for way in ways:
        distance, _ = scene.hit(shot.place, true[some] + way - shot.place)
        # the surface itself leans away from a place beside the point
        leans = 2.0 * np.linalg.norm(way) / np.linalg.norm(true[some] - shot.place, axis=1)
        hidden.append(distance < 1.0 - np.maximum(leans, 1e-6))
    seen, behind = np.zeros(len(true), np.bool_), np.zeros(len(true), np.bool_)
    seen[some], behind[some] = ~np.any(hidden, axis=0), np.all(hidden, axis=0)
    return seen, behind


def grove(seed: int = 3, trees: int = 6, leaves: int = 250, half_m: float = 14.0) -> Hamlet:
    """Rolling ground under trees: a trunk each, branches 6 cm thick, and leaves, tufts of 10 to 28 cm with light between them."""
    rng = np.random.default_rng(seed)

    def relief(x: Any, y: Any) -> Any:
        return 0.05 * x + 0.5 * np.sin(x / 6.0) * np.cos(y / 7.0)

    edges = np.linspace(-half_m, half_m, 9)
    parts, kinds, balls = [], [], []
    for x0, x1 in pairwise(edges):
        for y0, y1 in pairwise(edges):
            parts.append(quad(*[(x, y, float(relief(x, y))) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]))
            kinds += [GROUND] * 2
    for number in range(trees):
        angle = 2.0 * np.pi * number / trees + rng.uniform(-0.3, 0.3)
        x, y = rng.uniform(4.0, 9.0) * np.array([np.cos(angle), np.sin(angle)])
        foot, top = float(relief(x, y)) - 0.2, float(relief(x, y)) + rng.uniform(4.5, 7.0)
        stems = [(np.array([x, y, foot]), np.array([x, y, top]), 0.3)]
        crown = 0.5 * (top - foot)
        for _ in range(10):
            start = np.array([x, y, rng.uniform(foot + crown, top)])
            way = np.append(rng.normal(size=2), 0.0)
            end = (
                start + rng.uniform(1.0, 2.5) * way / np.linalg.norm(way) + np.array([0.0, 0.0, rng.uniform(0.2, 0.8)])
            )
            stems.append((start, end, 0.06))
        for start, end, thick in stems:
            parts.append(stem(start, end, thick))
            kinds += [WALL] * len(parts[-1])
        which = rng.integers(1, len(stems), leaves)
        along = np.array([start + rng.uniform(0.2, 1.0) * (end - start) for start, end, _ in (stems[n] for n in which)])
        middles = along + rng.normal(0.0, 0.35, (leaves, 3))
        balls.append(np.column_stack([middles, rng.uniform(0.05, 0.14, leaves)]))
    return Hamlet(np.concatenate(parts), np.array(kinds), np.concatenate(balls))


def stem(start: Array, end: Array, thick: float, sides: int = 6) -> Array:
    """The sides of a prism from one place to another, triangles."""
    axis = (end - start) / np.linalg.norm(end - start)
    across = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    across *= 0.5 * thick / np.linalg.norm(across)
    other = np.cross(axis, across)
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    ring = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * other
    return np.concatenate([quad(start + a, start + b, end + b, end + a) for a, b in pairwise(ring)])
