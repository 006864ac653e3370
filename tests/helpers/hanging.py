"""Overhead lines of many kinds, scanned by beams: another world than the simulator's, for `swath wires` to be judged in.

Wires hang as z = low + a (cosh((s - s0) / a) - 1). Passes of a scanner of 32 lasers along the line meet them where a laser's cone crosses
the wire: the azimuth is of steps of 0.16 deg, an echo comes if the footprint reaches the wire, and it lies on the axis of its beam, beside
the wire by up to a footprint. Ranges err by a sigma, and each pass lies beside the others by another. x east, y north, z up, metres.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

LOWEST_RAD, LASER_STEP_RAD = np.deg2rad(-30.67), np.deg2rad(4.0 / 3.0)
LASERS = 32
AZIMUTH_STEP_RAD = np.deg2rad(0.16)
HALF_DIVERGENCE_RAD = 1.4e-3
FARTHEST_M = 70.0
LOW_M = 30.0
"""A flight that is lower follows the ground."""


@dataclass(frozen=True)
class Hung:
    """A conductor of one span between two attachments, shape (2, 3), of a radius and a catenary parameter."""

    ends_m: Array
    a_m: float
    radius_m: float = 0.01

    @property
    def length_m(self) -> float:
        return float(np.hypot(*(self.ends_m[1] - self.ends_m[0])[:2]))

    def places(self, share: Array) -> Array:
        """Places at shares of the length in plan."""
        (p, q), length = self.ends_m, self.length_m
        rise = float(q[2] - p[2])
        lowest = length / 2 - self.a_m * np.arcsinh(rise / (2 * self.a_m * np.sinh(length / (2 * self.a_m))))
        s = share * length
        z = p[2] + self.a_m * (np.cosh((s - lowest) / self.a_m) - np.cosh(lowest / self.a_m))
        return np.column_stack([p[:2] + share[:, None] * (q - p)[:2], z])

    @property
    def sag_m(self) -> float:
        share = np.linspace(0, 1, 2001)
        return float(
            (self.ends_m[0, 2] + share * (self.ends_m[1, 2] - self.ends_m[0, 2]) - self.places(share)[:, 2]).max()
        )


@dataclass(frozen=True)
class Crown:
    """An ellipsoid of leaves on a stem."""

    x: float
    y: float
    middle_m: float
    radius_m: float
    half_height_m: float


@dataclass
class Site:
    """What stands on a place, and how it is flown over: pole is x, y, height, radius; house is west, south, east, north, height.

    Passes are along the line, or turned against it by an angle; then there are as many as it takes to cover it.
    """

    ground: Callable[[Array], Array]
    wires: list[Hung] = field(default_factory=list)
    poles: list[tuple[float, float, float, float]] = field(default_factory=list)
    crowns: list[Crown] = field(default_factory=list)
    houses: list[tuple[float, float, float, float, float]] = field(default_factory=list)
    above_m: float = 35.0
    passes: int = 6
    speed_m_s: float = 5.0
    answers: float = 0.7
    turned_deg: float = 0.0
    walled: bool = False

    def strung(self, poles: list[Array], arms: list[tuple[float, float]], sag: float, radius_m: float = 0.01) -> None:
        """Wires from pole to pole: of each arm, so far to the left on a crossarm that halves the angle, at that height above its foot."""
        xy = np.array([each[:2] for each in poles])
        ways = np.diff(xy, axis=0)
        ways /= np.linalg.norm(ways, axis=1)[:, None]
        along = np.vstack([ways[:1], ways[:-1] + ways[1:], ways[-1:]])
        along /= np.linalg.norm(along, axis=1)[:, None]
        left = np.column_stack([-along[:, 1], along[:, 0]])
        for side, up in arms:
            at = np.column_stack([xy + side * left, self.ground(xy) + up])
            for a, b in pairwise(at):
                length = np.hypot(*(b - a)[:2])
                self.wires.append(Hung(np.array([a, b]), float(length**2 / (8 * sag * (length / 60.0) ** 2)), radius_m))


def scanned(
    site: Site, seed: int, sigma_m: float = 0.02, between_m: float = 0.02, beams: int = 40_000
) -> tuple[Array, Array]:
    """Points of all passes, and for each the number of its wire, -1 for all else."""
    rng = np.random.default_rng(seed)
    places = np.concatenate([each.ends_m for each in site.wires])[:, :2]
    middle = places.mean(axis=0)
    way = np.linalg.svd(places - middle)[2][0]
    turn = np.deg2rad(site.turned_deg)
    way = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ way
    reach = np.abs((places - middle) @ way).max() + 15.0
    across = np.array([-way[1], way[0]])
    passes = site.passes
    if site.turned_deg:
        passes = max(passes, int(np.ceil(np.abs((places - middle) @ across).max() / 4.0)))
        beams = beams * site.passes // passes
    parts, numbers = [], []
    for number in range(passes):
        lateral = (number - (passes - 1) / 2) * 8.0 + rng.normal(0, 1)
        line = middle + lateral * across
        top = max(float(site.ground(places).max()), 0.0) + site.above_m + rng.normal(0, 1)
        count = int(2 * reach / site.speed_m_s * 10)
        s = np.linspace(-reach, reach, count)
        height = np.full(count, top)
        if site.above_m < LOW_M:
            height = site.ground(line + s[:, None] * way) + site.above_m
        track = np.column_stack([line + s[:, None] * way, height])
        axis = np.append(way if number % 2 else -way, 0.0)
        seen, of = _on_wires(rng, site, track, axis, sigma_m)
        rest = _on_the_rest(rng, site, track, axis, beams, sigma_m)
        points = np.concatenate([seen, rest, _on_poles(rng, site, sigma_m), _on_walls(rng, site, sigma_m)])
        parts.append(points + rng.normal(0, between_m, 3))
        numbers.append(np.append(of, np.full(len(points) - len(of), -1)))
    return np.concatenate(parts), np.concatenate(numbers)


def _on_wires(rng: np.random.Generator, site: Site, track: Array, axis: Array, sigma_m: float) -> tuple[Array, Array]:
    """Echoes of wires: where the cone of a laser crosses one."""
    found, of = [np.empty((0, 3))], [np.empty(0, int)]
    for number, wire in enumerate(site.wires):
        line = wire.places(np.linspace(0, 1, max(int(wire.length_m / 0.1), 10)))
        for place in track:
            d = line - place
            far = np.linalg.norm(d, axis=1)
            at = (np.arcsin(d @ axis / far) - LOWEST_RAD) / LASER_STEP_RAD
            cell = np.floor(at).astype(int)
            crossed = np.flatnonzero((np.diff(cell) != 0) & (far[1:] < FARTHEST_M))
            laser = np.maximum(cell[crossed], cell[crossed + 1])
            crossed, laser = crossed[(laser >= 0) & (laser < LASERS)], laser[(laser >= 0) & (laser < LASERS)]
            if not len(crossed):
                continue
            t = ((laser - at[crossed]) / (at[crossed + 1] - at[crossed]))[:, None]
            met = line[crossed] + t * (line[crossed + 1] - line[crossed])
            d = met - place
            far = np.linalg.norm(d, axis=1)
            miss = rng.uniform(-0.5, 0.5, len(met)) * AZIMUTH_STEP_RAD
            hit = (np.abs(miss) * far < wire.radius_m + HALF_DIVERGENCE_RAD * far) & (
                rng.random(len(met)) < site.answers
            )
            beside = np.cross(axis, d / far[:, None])
            echo = met + (miss * far)[:, None] * beside + rng.normal(0, sigma_m, (len(met), 1)) * d / far[:, None]
            found.append(echo[hit])
            of.append(np.full(int(hit.sum()), number))
    return np.concatenate(found), np.concatenate(of)


def _on_the_rest(rng: np.random.Generator, site: Site, track: Array, axis: Array, beams: int, sigma_m: float) -> Array:
    """Echoes of ground, houses and crowns."""
    place = track[rng.integers(len(track), size=beams)]
    lean = LOWEST_RAD + LASER_STEP_RAD * rng.integers(LASERS, size=beams)
    turn = rng.uniform(-1.2, 1.2, beams)
    side = np.cross(axis, [0.0, 0.0, 1.0])
    beam = np.sin(lean)[:, None] * axis + np.cos(lean)[:, None] * (
        np.sin(turn)[:, None] * side - np.cos(turn)[:, None] * np.array([0.0, 0.0, 1.0])
    )
    far = np.full(beams, 40.0)
    for _ in range(25):
        at = place + far[:, None] * beam
        far = far + 0.7 * (site.ground(at[:, :2]) - at[:, 2]) / beam[:, 2]
    at = place + far[:, None] * beam
    far[np.abs(site.ground(at[:, :2]) - at[:, 2]) > 0.05] = np.inf
    for west, south, east, north, height in site.houses:
        foot = float(site.ground(np.array([[(west + east) / 2, (south + north) / 2]]))[0])
        t = (foot + height - place[:, 2]) / beam[:, 2]
        at = place + t[:, None] * beam
        on = (at[:, 0] > west) & (at[:, 0] < east) & (at[:, 1] > south) & (at[:, 1] < north)
        far = np.where(on, np.minimum(far, t), far)
    for each in site.crowns:
        scale = np.array([each.radius_m, each.radius_m, each.half_height_m])
        o, u = (place - (each.x, each.y, each.middle_m)) / scale, beam / scale
        a, b, c = np.sum(u * u, 1), np.sum(o * u, 1), np.sum(o * o, 1) - 1.0
        root = b * b - a * c
        enter = (-b - np.sqrt(np.maximum(root, 0.0))) / a
        leave = (-b + np.sqrt(np.maximum(root, 0.0))) / a
        t = enter + rng.exponential(0.5, beams)
        far = np.where((root > 0) & (t < leave) & (t < far), t, far)
    ok = far < FARTHEST_M
    return np.asarray(place[ok] + (far[ok] + rng.normal(0, sigma_m, int(ok.sum())))[:, None] * beam[ok])


def _on_poles(rng: np.random.Generator, site: Site, sigma_m: float) -> Array:
    """Echoes all over the poles, seven on a metre in a pass."""
    parts = [np.empty((0, 3))]
    for x, y, height, radius in site.poles:
        count = int(7 * height)
        turn = rng.uniform(0, 2 * np.pi, count)
        foot = float(site.ground(np.array([[x, y]]))[0])
        parts.append(np.column_stack([
            x + radius * np.cos(turn), y + radius * np.sin(turn), foot + rng.uniform(0, height, count),
        ]))  # fmt: skip
    points = np.concatenate(parts)
    return np.asarray(points + rng.normal(0, sigma_m, points.shape))


def _on_walls(rng: np.random.Generator, site: Site, sigma_m: float) -> Array:
    """Echoes all over the walls of houses, two on a square metre in a pass."""
    parts = [np.empty((0, 3))]
    for west, south, east, north, height in site.houses if site.walled else ():
        wide, deep = east - west, north - south
        u = rng.uniform(0, 2 * (wide + deep), int(4 * (wide + deep) * height))
        x = west + np.clip(u, 0, wide) - np.clip(u - wide - deep, 0, wide)
        y = south + np.clip(u - wide, 0, deep) - np.clip(u - 2 * wide - deep, 0, deep)
        foot = float(site.ground(np.array([[(west + east) / 2, (south + north) / 2]]))[0])
        parts.append(np.column_stack([x, y, foot + rng.uniform(0, height, len(u))]))
    points = np.concatenate(parts)
    return np.asarray(points + rng.normal(0, sigma_m, points.shape))


def poles_at(site: Site, places: list[tuple[float, float]], height: float, radius: float = 0.13) -> list[Array]:
    site.poles += [(x, y, height, radius) for x, y in places]
    return [np.array(each, float) for each in places]


def wavy(slope: float = 0.0) -> Callable[[Array], Array]:
    return lambda xy: 50.0 + slope * xy[:, 0] + 1.2 * np.sin(xy[:, 0] / 23.0) * np.cos(xy[:, 1] / 31.0)
