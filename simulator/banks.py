"""A river bank of two epochs whose edges, water line and retreat are known: surfaces that are functions of the place.

x east, y north, z up, metres. The river runs north; land lies in the west. Random numbers come from the seed alone.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Bank:
    """What a bank is like.

    Attributes
    ----------
    seed : int
    length_m : float
    height_m, width_m : float
        Of the face; a width below 0 is none, the face is upright then.
    land_m : float
        From the western end to the bank.
    beach : float
        Slope of what lies below.
    fall : float
        Of the river, along it.
    level_m : float
        Of the water at its southern end; the lower edge lies at 0 there.
    rough_m : float
        Height of waves on all of it.
    """

    seed: int
    length_m: float = 60.0
    height_m: float = 2.0
    width_m: float = 1.0
    land_m: float = 14.0
    beach: float = 0.12
    fall: float = 0.002
    level_m: float = -0.5
    rough_m: float = 0.02

    def upper_x(self, y: Array) -> Array:
        """Upper edge."""
        phase = np.random.default_rng(self.seed).uniform(0, 2 * np.pi, 3)
        return np.asarray(
            self.land_m + 1.5 * np.sin(2 * np.pi * y / 45.0 + phase[0]) + 0.3 * np.sin(2 * np.pi * y / 13.0 + phase[1])
        )

    def lower_x(self, y: Array) -> Array:
        """Lower edge."""
        return self.upper_x(y) + self.width_m

    def land_x(self, y: Array) -> Array:
        """From where on the land above rises."""
        return self.upper_x(y)

    def beach_x(self, y: Array) -> Array:
        """Where the beach begins to fall: at the lower edge."""
        return self.lower_x(y)

    def lower_z(self, y: Array) -> Array:
        """Its height."""
        return np.asarray(self.fall * y)

    def water_x(self, y: Array) -> Array:
        """Where the beach goes under water, the first time from the bank."""
        way = np.arange(0.0, 12.0, 0.01)
        at = self.lower_x(y)[:, None] + way
        z = self.height(np.stack([at, np.broadcast_to(y[:, None], at.shape)], axis=-1).reshape(-1, 2)).reshape(at.shape)
        under = z < (self.level_m + self.fall * y)[:, None]
        return np.asarray(self.lower_x(y) + way[np.argmax(under, axis=1)])

    def height(self, xy: Array) -> Array:
        """Height of the land at places, shape (n, 2) -> (n,), under water too."""
        x, y = xy.T
        upper = self.upper_x(y)
        share = np.clip((x - upper) / self.width_m, 0.0, 1.0)
        top = self.height_m + 0.03 * (self.land_x(y) - upper)
        z = self.lower_z(y) + top * (1.0 - share) + np.where(x < upper, 0.03 * (upper - x), 0.0)
        return np.asarray(z - self.beach * np.maximum(x - self.beach_x(y), 0.0) + self._waves(xy))

    def _waves(self, xy: Array) -> Array:
        rng = np.random.default_rng(self.seed + 7)
        z = np.zeros(len(xy))
        for length in (4.0, 2.0, 1.1):
            for turn, phase in rng.uniform(0, 2 * np.pi, (2, 2)):
                z += 0.5 * self.rough_m * np.sin(2 * np.pi / length * xy @ (np.cos(turn), np.sin(turn)) + phase)
        return z

    def points(self, rng: np.random.Generator, per_m2: float, noise_m: float, water_per_m2: float = 0.0) -> Array:
        """Points of the land, as many on a square metre of its surface, and echoes of the water's surface."""
        east = self.land_m + self.width_m + 12.0 - self.level_m / self.beach
        steep = float(np.hypot(1.0, self.height_m / self.width_m))
        xy = rng.uniform((0.0, 0.0), (east, self.length_m), (int(east * self.length_m * per_m2), 2))
        on_face = (xy[:, 0] > self.upper_x(xy[:, 1])) & (xy[:, 0] < self.lower_x(xy[:, 1]))
        y = rng.uniform(0.0, self.length_m, int(self.length_m * self.width_m * steep * per_m2))
        face = np.column_stack([rng.uniform(self.upper_x(y), self.lower_x(y)), y])
        xy = np.concatenate([xy[~on_face], face])
        z, level = self.height(xy), self.level_m + self.fall * xy[:, 1]
        dry = z > level
        wet = np.flatnonzero(~dry)
        wet = wet[rng.random(len(wet)) < water_per_m2 / per_m2]
        xyz = np.concatenate([np.column_stack([xy[dry], z[dry]]), np.column_stack([xy[wet], level[wet]])])
        return np.asarray(xyz + noise_m * rng.standard_normal(xyz.shape))


@dataclass(frozen=True, slots=True)
class Eroded(Bank):
    """The same bank later.

    Attributes
    ----------
    retreat_m : float
        Of both edges in the middle third of its length; nothing in the southern one.
    """

    retreat_m: float = 0.8

    def moved(self, y: Array) -> Array:
        """Retreat along x."""
        return np.asarray(self.retreat_m * np.clip(3.0 * y / self.length_m - 1.0, 0.0, 1.0))

    def upper_x(self, y: Array) -> Array:
        """Upper edge."""
        return np.asarray(Bank.upper_x(self, y) - self.moved(y))

    def land_x(self, y: Array) -> Array:
        """As before."""
        return Bank.upper_x(self, y)

    def beach_x(self, y: Array) -> Array:
        """Where it began before; up to there the ground is level now."""
        return np.asarray(self.lower_x(y) + self.moved(y))


def later(bank: Bank, retreat_m: float = 0.8) -> Eroded:
    """The bank after some of it is gone: the beach stays where it was, at its height."""
    fields = {name: getattr(bank, name) for name in Bank.__dataclass_fields__}
    return replace(Eroded(**fields), retreat_m=retreat_m)
