"""What a lidar sees from 3 to 6 m: tall grass with trampled squares, the edge of a wood, a road under grazing beams.

Beams are those of the HDL-32E along a straight and steady line, cast as in a simulated flight (`echoes`), without packets and telemetry:
what the sensor meets is the question here, not where it was. Source of the cases: FOI-R--4045--SE, figures 4, 25 and 26.
x east, y north, z up, metres; random numbers come from the seed alone.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.hdl32e import ELEVATION_DEG, FIRING_NS, LASER_NS, LASERS
from simulator.buildings import add_tree
from simulator.config import LidarOptions
from simulator.echoes import LAST, RANGE, RAYS, SECOND, STRENGTH, STRONGEST, TRIANGLE, aim, form
from simulator.lidar import intensity
from simulator.materials import FALLOFF, REFLECTANCE, TRANSMISSION
from simulator.meshes import quad
from simulator.parts import Parts, World
from simulator.rays import Surfaces
from simulator.terrain import Relief, add_plants, add_relief

Array = npt.NDArray[np.float64]

_TILT_RAD: Final = np.deg2rad(-20.0)
_DARK_PANEL: Final = 0.046
_AT_ONCE: Final = 2000
"""Firings."""
TRAMPLED_M: Final = 0.3


@dataclass(frozen=True, slots=True)
class Line:
    """A line that is flown at a steady speed, the lidar tilted forward by 20 deg.

    Attributes
    ----------
    start_m, velocity_m_s : tuple of 3 float
    seconds : float
    heading_deg : float
        Of the aircraft, from north eastwards.
    """

    start_m: tuple[float, float, float]
    velocity_m_s: tuple[float, float, float]
    seconds: float
    heading_deg: float = 0.0


@dataclass(frozen=True, slots=True)
class Seen:
    """Shots and their echoes.

    Attributes
    ----------
    origin_m, direction : ndarray, shape (n, 3)
        Of the middle of each beam; shots without an echo too.
    range_m : ndarray, shape (n, 3)
        Of the strongest, the second strongest and the last echo, with the sensor's noise; 0 for none.
    intensity : ndarray of uint8, shape (n, 3)
    surface : ndarray of int32, shape (n, 3)
        Index into the world's names; -1 for none.
    """

    origin_m: Array
    direction: Array
    range_m: Array
    intensity: npt.NDArray[np.uint8]
    surface: npt.NDArray[np.int32]

    def points(self, returns: str) -> tuple[Array, npt.NDArray[np.int32]]:
        """Places and surfaces of what a sensor sends in a mode: strongest, last, or dual."""
        which = {"strongest": [STRONGEST], "last": [LAST], "dual": [STRONGEST, LAST]}[returns]
        parts = []
        for number, each in enumerate(which):
            column = np.full(len(self.range_m), each)
            if number:  # one echo is not sent twice: the second strongest takes its place
                column[self.range_m[:, LAST] == self.range_m[:, STRONGEST]] = SECOND
            rows = np.arange(len(column))
            range_m, kind = self.range_m[rows, column], self.surface[rows, column]
            met = range_m > 0.0
            parts.append((self.origin_m[met] + range_m[met, None] * self.direction[met], kind[met]))
        return np.concatenate([xyz for xyz, _ in parts]), np.concatenate([kind for _, kind in parts])


def seen(
    world: World, lines: list[Line], seed: int, options: LidarOptions | None = None, fov_deg: float = 105.0
) -> Seen:
    """What the lidar sees of a world from some lines."""
    options = options or LidarOptions()
    surfaces, rng = Surfaces(world), np.random.default_rng(seed)
    parts = []
    for line in lines:
        firings = int(line.seconds * 1e9 / FIRING_NS)
        for first in range(0, firings, _AT_ONCE):
            number = np.arange(first, min(first + _AT_ONCE, firings) + 1)
            parts.append(_cast(world, surfaces, line, number, options, fov_deg, rng))
    return Seen(*(np.concatenate([getattr(part, name) for part in parts]) for name in Seen.__dataclass_fields__))


def _cast(
    world: World, surfaces: Surfaces, line: Line, number: npt.NDArray[np.int64], options: LidarOptions, fov_deg: float,
    rng: np.random.Generator,
) -> Seen:  # fmt: skip
    time_s = number * FIRING_NS * 1e-9
    position = np.asarray(line.start_m) + time_s[:, None] * np.asarray(line.velocity_m_s)
    turn_deg = 6.0 * options.rpm * time_s
    off = np.abs((turn_deg[:-1] + 180.0) % 360.0 - 180.0)
    open_shots = np.repeat((off < fov_deg)[:, None], LASERS, axis=1)
    origins, directions = aim(
        position, np.repeat(_attitude(line.heading_deg)[None], len(number), axis=0), np.radians(turn_deg), np.radians(ELEVATION_DEG),
        LASER_NS / FIRING_NS, options.footprint_mrad * 1e-3, int(number[0]) * LASERS, open_shots, RAYS,
    )  # fmt: skip
    shots = len(origins) // RAYS
    echoes = form(
        origins, directions, surfaces.opaque(origins, directions), surfaces.clear(origins, directions), surfaces.planes, world.material,
        np.stack([REFLECTANCE, FALLOFF, TRANSMISSION]), RAYS,
        np.clip(1.0 + options.intensity_noise * rng.standard_normal((shots, 2)), 0.05, None),
        _DARK_PANEL / options.blind_beyond_m**2, options.max_range_m, np.zeros((0, 4)), np.zeros(0, np.uint8),
    )  # fmt: skip
    met = echoes[..., RANGE] > 0.0
    noise = options.range_noise_m * rng.standard_normal(met.shape)
    noise[:, 1:][echoes[:, 1:, RANGE] == echoes[:, :1, RANGE]] = 0.0
    same = echoes[:, LAST, RANGE] == echoes[:, STRONGEST, RANGE]
    noise[same, LAST] = noise[same, STRONGEST]
    return Seen(
        origins[::RAYS].astype(np.float64),
        directions[::RAYS].astype(np.float64),
        np.where(met, echoes[..., RANGE] + noise, 0.0),
        intensity(echoes[..., STRENGTH]),
        np.where(met, world.surface[echoes[..., TRIANGLE].astype(np.int64)], -1).astype(np.int32),
    )


def _attitude(heading_deg: float) -> Array:
    """From the lidar's frame (right, forward, up) to the local one: tilted forward, then turned."""
    c, s = np.cos(_TILT_RAD), np.sin(_TILT_RAD)
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    turn = np.radians(heading_deg)
    c, s = np.cos(turn), np.sin(turn)
    return np.asarray(np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ tilt)


def tall_grass(
    seed: int, side_m: float = 6.0, grass_m: float = 0.7, trampled: int = 4, before: bool = False
) -> tuple[World, Array]:
    """Grass on rough ground, with squares of 30 x 30 cm trampled down to 12 cm; their middles, shape (n, 2), lie apart and inside.

    `before`: the same blades before anybody trod there.
    """
    rng = np.random.default_rng(seed)
    parts, half = Parts(), side_m / 2.0
    relief = Relief.drawn(rng, ((9.0, 0.05), (2.5, 0.02)))
    add_relief(parts, relief, half + 3.0, 0.25, 0.01, rng, "soil")
    middles: list[Array] = []
    while len(middles) < trampled:
        spot = rng.uniform(-half + 1.0, half - 1.0, 2)
        if all(np.hypot(*(spot - other)) > 1.8 for other in middles):
            middles.append(spot)
    places = np.array(middles).reshape(-1, 2)
    roots = rng.uniform(-half - 2.0, half + 2.0, (int((side_m + 4.0) ** 2 * 150), 2))
    down = np.zeros(len(roots), np.bool_)
    for spot in places:
        down |= (np.abs(roots - spot) < TRAMPLED_M / 2.0).all(axis=1)
    down &= not before
    height = np.where(down, 0.12, grass_m * rng.uniform(0.75, 1.1, len(roots)))
    size = np.column_stack([np.where(down, 0.1, 0.16), height])
    add_plants(parts, "grass", np.column_stack([roots, relief.height(*roots.T)]), size, 7, rng, 0.1)
    return parts.world(), places


def over_grass(side_m: float = 6.0, height_m: float = 4.0, apart_m: float = 2.0) -> list[Line]:
    """Lines over it, northwards at 3 m/s."""
    half = side_m / 2.0
    return [
        Line((float(x), -half - 4.0, height_m), (0.0, 3.0, 0.0), (side_m + 2.0) / 3.0)
        for x in np.arange(-half, half + 0.1, apart_m)
    ]


def wood_edge(seed: int, deep_m: float = 20.0, wide_m: float = 30.0) -> tuple[World, Relief]:
    """A wood that begins at y = 0: trees, bushes at its edge and within, a floor of 5 cm roughness; open grass in the south."""
    rng = np.random.default_rng(seed)
    parts = Parts()
    relief = Relief.drawn(rng, ((25.0, 0.3), (6.0, 0.06)))
    add_relief(parts, relief, 35.0, 0.5, 0.03, rng, "soil")
    planted: list[Array] = []
    while len(planted) < int(deep_m * wide_m * 0.06):
        spot = rng.uniform((-wide_m / 2.0, 0.5), (wide_m / 2.0, deep_m))
        if any(np.hypot(*(spot - other)) < 2.2 for other in planted):
            continue
        planted.append(spot)
        add_tree(
            parts,
            f"tree {len(planted)}",
            relief.at(float(spot[0]), float(spot[1]), -0.1),
            float(rng.uniform(7.0, 12.0)),
            rng,
            800,
        )
    roots = rng.uniform((-wide_m / 2.0, 0.0), (wide_m / 2.0, deep_m), (int(deep_m * wide_m * 2.0), 2))
    size = np.column_stack([rng.uniform(0.2, 0.6, len(roots)), rng.uniform(0.2, 1.0, len(roots))])
    add_plants(parts, "undergrowth", np.column_stack([roots, relief.height(*roots.T)]), size, 8, rng)
    return parts.world(), relief


def road(material: str) -> World:
    """A plane as far as the lidar reaches."""
    parts = Parts()
    parts.add(material, material, quad((-60.0, -60.0, 0.0), (120.0, 0.0, 0.0), (0.0, 120.0, 0.0)))
    return parts.world()
