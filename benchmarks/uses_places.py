"""Ground of made-up places of the kinds that ground filters find hard, drawn without our simulator: a part of `uses.py`.

places_total_error_percent, places_kappa_percent
                     mean of twelve places with one automatic setting; each is printed
"""

import sys
from collections.abc import Callable
from typing import Any, Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Height = Callable[[Array, Array], Array]

_NOISE_M: Final = 0.06


class Place:
    """Points over a square, one in each cell of a grid and off its middle; what stands there is put on them."""

    def __init__(self, seed: int, side_m: float, per_m2: float, ground: Height) -> None:
        self.rng, self.ground, self._side_m = np.random.default_rng(seed), ground, side_m
        cells = int(side_m * np.sqrt(per_m2))
        middle = (np.arange(cells) + 0.5) * side_m / cells
        x, y = np.meshgrid(middle, middle)
        self.x, self.y = (v.ravel() + self.rng.uniform(-0.7, 0.7, v.size) * side_m / cells for v in (x, y))
        self.z = ground(self.x, self.y)
        self.is_ground = np.ones(len(self.x), np.bool_)

    def put(self, there: Mask, z: Array | float) -> None:
        """Something that is no ground, at this height."""
        self.z = np.where(there, z, self.z)
        self.is_ground &= ~there

    def house(
        self, at: Array, size: tuple[float, float], eaves_m: float, rise_m: float = 0.0, turn: float = 0.0
    ) -> None:
        """A roof with a gable, or a flat one."""
        u, v = self._along(at, turn)
        base = float(self.ground(np.array([at[0]]), np.array([at[1]]))[0])
        there = (np.abs(u) < size[0] / 2) & (np.abs(v) < size[1] / 2)
        self.put(there, base + eaves_m + rise_m * (1 - 2 * np.abs(v) / size[1]))

    def houses(self, count: int, apart_m: float, eaves_m: tuple[float, float]) -> None:
        """Houses with gables, turned at random."""
        for at in self.spread(count, apart_m):
            size = (self.rng.uniform(8, 15), self.rng.uniform(7, 11))
            self.house(at, size, self.rng.uniform(*eaves_m), self.rng.uniform(0, 3), self.rng.uniform(0, 3))

    def trees(self, count: int, apart_m: float, share: float = 0.75) -> None:
        """Crowns that this share of the points ends in."""
        for at in self.spread(count, apart_m):
            radius, height = self.rng.uniform(1.5, 5), self.rng.uniform(3, 13)
            off = np.hypot(self.x - at[0], self.y - at[1])
            there = (off < radius) & (self.rng.random(len(off)) < share) & self.is_ground
            dome = np.sqrt(np.maximum(1 - (off / radius) ** 2, 0))
            self.put(there, self.ground(self.x, self.y) + 0.3 + height * dome * self.rng.uniform(0.3, 1, len(off)))

    def low(self, there: Mask, share: float, up_to_m: float) -> None:
        """Low vegetation from half a metre."""
        there = there & (self.rng.random(len(there)) < share) & self.is_ground
        self.put(there, self.ground(self.x, self.y) + self.rng.uniform(0.5, up_to_m, len(there)))

    def spread(self, count: int, apart_m: float) -> list[Array]:
        """Places at least so far from each other."""
        found: list[Array] = []
        for _ in range(4000):
            at = self.rng.uniform(8, self._side_m - 8, 2)
            if len(found) < count and all(np.hypot(*(at - other)) > apart_m for other in found):
                found.append(at)
        return found

    def points(self) -> Array:
        """With noise, shape (n, 3)."""
        return np.column_stack([self.x, self.y, self.z + _NOISE_M * self.rng.standard_normal(len(self.z))])

    def _along(self, at: Array, turn: float) -> tuple[Array, Array]:
        x, y, c, s = self.x - at[0], self.y - at[1], np.cos(turn), np.sin(turn)
        return c * x + s * y, c * y - s * x


def relief(seed: int, length_m: float, height_m: float) -> Height:
    """Waves of all directions."""
    rng = np.random.default_rng(seed)
    wave, phase = rng.normal(0, 1 / length_m, (24, 2)), rng.uniform(0, 2 * np.pi, 24)
    return lambda x, y: np.asarray(
        height_m / np.sqrt(12) * sum(np.sin(a * x + b * y + p) for (a, b), p in zip(wave, phase, strict=True))
    )


def town(seed: int) -> dict[str, Place]:
    """Places of 0.7 points/m2."""
    waves = relief(seed, 25.0, 0.8)
    made = {}
    made["hillside village"] = one = Place(seed, 180, 0.7, lambda x, y: 0.18 * x + 0.05 * y + waves(x, y))
    one.houses(45, 20, (2.5, 6))
    one.trees(60, 7)
    made["steep hillside"] = one = Place(seed, 180, 0.7, lambda x, y: 0.45 * x + 2 * waves(x, y))
    one.houses(25, 22, (3, 6))
    one.trees(90, 6, 0.8)
    made["bridge and gangway"] = one = Place(
        seed, 180, 0.7, lambda x, y: 6 * np.clip((np.abs(x - 90) - 12) / 7, 0, 1) + 0.3 * waves(x, y)
    )
    for north, width in ((50, 12), (120, 5)):
        one.put((np.abs(one.x - 90) < 20) & (np.abs(one.y - north) < width / 2) & (one.z < 5.6), 6.0)
    one.trees(40, 8)
    made["halls with a court"] = one = Place(seed, 180, 0.7, lambda x, y: 0.01 * x + 0.2 * waves(x, y))
    court = (np.abs(one.x - 50) < 13) & (np.abs(one.y - 50) < 8)
    for at, size, height in (((50, 50), (70, 50), 12), ((45, 130), (60, 18), 9), ((120, 130), (66, 46), 15)):
        one.house(np.array(at), size, height)
    one.z, one.is_ground = np.where(court, one.ground(one.x, one.y), one.z), one.is_ground | court
    made["station"] = one = Place(seed, 200, 0.7, lambda x, y: 0.005 * x + 0.2 * waves(x, y))
    one.house(np.array([60, 50]), (100, 44), 14, 2)
    one.house(np.array([140, 50]), (30, 60), 11)
    for n in range(5):
        one.house(np.array([110, 110 + 9 * n]), (100, 3), 4)
    made["ramp between walls"] = one = Place(
        seed, 180, 0.7, lambda x, y: np.where(np.abs(y - 90) < 6, np.clip((x - 40) / 12, 0, 5), 0.0) + 0.2 * waves(x, y)
    )
    one.trees(20, 15)
    return made


def country(seed: int) -> dict[str, Place]:
    """Places of one point in four square metres."""
    waves = relief(seed + 100, 40.0, 3.0)
    made = {}
    made["river bank"] = one = Place(
        seed, 300, 0.25, lambda x, y: 9 / (1 + np.exp((150 - x - 10 * np.sin(y / 40)) / 2.5)) + 0.4 * waves(x, y)
    )
    one.low(one.x > 130, 0.25, 2.0)
    one.trees(60, 10, 0.8)
    made["sparse village"] = one = Place(seed, 300, 0.25, lambda x, y: 0.08 * y + 0.4 * waves(x, y))
    one.houses(60, 24, (3, 5))
    one.trees(60, 10, 0.8)
    made["embankment"] = one = Place(
        seed, 300, 0.25,
        lambda x, y: np.where(np.abs(y - 150) < 5, 0, 6 * np.clip((14 - np.abs(x - 150)) / 8, 0, 1)) + 0.2 * waves(x, y),
    )  # fmt: skip
    one.put((np.abs(one.y - 150) < 5) & (np.abs(one.x - 150) < 7), 6 + 0.2 * waves(one.x, one.y))
    one.low(one.x < 60, 0.2, 1.5)
    made["quarry"] = one = Place(
        seed, 300, 0.25, lambda x, y: 7 * np.floor(np.clip((x + 20 * np.sin(y / 50)) / 50, 0, 6)) + 0.5 * waves(x, y)
    )
    one.low(one.x > 0, 0.06, 2.5)
    made["ridge"] = one = Place(
        seed, 300, 0.25, lambda x, y: 5 * np.clip((9 - np.abs(x - 150)) / 7, 0, 1) + 0.3 * waves(x, y)
    )
    one.low(one.x > 200, 0.12, 1.5)
    made["overgrown slope"] = one = Place(seed, 250, 0.25, lambda x, y: 0.5 * x + waves(x, y))
    one.trees(110, 8)
    one.low(one.y > 120, 0.25, 1.5)
    return made


def places() -> dict[str, Any]:
    """All of them."""
    from uses_clouds import is_ground

    from groundproc.analysis.terrain.settings import Settings

    figures = []
    for name, place in (town(1) | country(1)).items():
        found, truth = is_ground(place.points(), Settings()), place.is_ground
        error = float(np.mean(found != truth))
        chance = found.mean() * truth.mean() + (1 - found.mean()) * (1 - truth.mean())
        figures.append((100 * error, 100 * (1 - error - chance) / (1 - chance)))
        print(f"{name}: total error {figures[-1][0]:.2f} %, kappa {figures[-1][1]:.1f} %", file=sys.stderr, flush=True)
    total, kappa = np.mean(figures, axis=0)
    return {"places_total_error_percent": round(float(total), 2), "places_kappa_percent": round(float(kappa), 1)}


FIGURES: Final[dict[str, Callable[[], dict[str, Any]]]] = {"places": places}
