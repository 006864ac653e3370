"""A power line with what stands along it, as a cloud with known truth: wires, poles, stays, a fence, trees.

x east, y north, z up, metres. Random numbers come from the seed alone.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simulator.outdoors import GROUND, TREE, Array, Tree, rolling, tree_points


@dataclass(frozen=True, slots=True)
class Wire:
    """A conductor between two attachments: a catenary of parameter `a_m` through `low_m` at `middle_m` along the straight line in plan."""

    ends_m: Array
    a_m: float
    middle_m: float
    low_m: float

    def places(self, s_m: Array) -> Array:
        """Places so far from the first end, in plan."""
        d = self.ends_m[1, :2] - self.ends_m[0, :2]
        xy = self.ends_m[0, :2] + s_m[:, None] * d / np.linalg.norm(d)
        return np.column_stack([xy, self.low_m + self.a_m * (np.cosh((s_m - self.middle_m) / self.a_m) - 1.0)])

    @property
    def length_m(self) -> float:
        """In plan."""
        return float(np.linalg.norm(self.ends_m[1, :2] - self.ends_m[0, :2]))

    @property
    def sag_m(self) -> float:
        """Greatest vertical distance below the chord."""
        s = np.linspace(0, self.length_m, 2001)
        z = self.places(s)[:, 2]
        return float((self.ends_m[0, 2] + (self.ends_m[1, 2] - self.ends_m[0, 2]) * s / self.length_m - z).max())


@dataclass(frozen=True, slots=True)
class Line:
    """A power line with what stands along it."""

    xyz: Array
    kind: npt.NDArray[np.uint8]
    wires: list[Wire]
    poles_m: Array
    """Feet and heights, shape (n, 4)."""
    stays_m: Array
    """Upper and lower ends, shape (n, 2, 3)."""
    fence_m: Array
    """Ends in plan, shape (2, 2)."""


WIRE, POLE, STAY, FENCE = 14, 65, 67, 66


def power_line(seed: int = 0, spans: int = 3, span_m: float = 62.0, per_m2: float = 15.0, passes: int = 5) -> Line:
    """A bent line of poles with three conductors and a lower one, trees and shrubs beside it, stays at its bend, a fence along it.

    Each pass of the scanner hits a wire about every 0.8 m.
    """
    rng = np.random.default_rng(seed)
    turn = np.deg2rad(rng.uniform(-40, 40))
    feet = [np.array([30.0, 45.0])]
    for n in range(spans):
        way = turn + (np.deg2rad(14.0) if n >= spans // 2 else 0.0)
        feet.append(feet[-1] + span_m * rng.uniform(0.85, 1.15) * np.array([np.cos(way), np.sin(way)]))
    xy = np.array(feet)
    xy += 20.0 - xy.min(axis=0)
    ground = rolling(xy)
    poles = np.column_stack([xy, ground, np.full(len(xy), 10.5)])
    wires = _conductors(rng, xy, ground)
    parts: list[Array] = []
    kinds: list[int] = []

    def add(points: Array, kind: int) -> None:
        parts.append(points)
        kinds.append(kind)

    high = xy.max(axis=0) + 20.0
    flat = rng.uniform((0, 0), high, (int(high.prod() * per_m2), 2))
    add(np.column_stack([flat, rolling(flat)]), GROUND)
    for wire in wires:
        for _ in range(passes):
            s = np.arange(rng.uniform(0, 0.8), wire.length_m, 0.8)
            s = s[rng.random(len(s)) < 0.8] + rng.uniform(-0.2, 0.2)
            add(wire.places(np.clip(s, 0, wire.length_m)), WIRE)
    for x, y, z, height in poles:
        tall = rng.uniform(0, height, 160)
        a = rng.uniform(0, 2 * np.pi, 160)
        add(np.stack([x + 0.13 * np.cos(a), y + 0.13 * np.sin(a), z + tall], axis=1), POLE)
    bend = spans // 2
    outward = -(xy[bend + 1] + xy[bend - 1] - 2 * xy[bend]) if bend else np.array([0.0, 1.0])
    outward /= np.linalg.norm(outward)
    stays = []
    for n, way in ((bend, outward), (0, (xy[0] - xy[1]) / np.linalg.norm(xy[0] - xy[1]))):
        foot = xy[n] + 5.0 * way
        ends = np.array([[*xy[n], ground[n] + 9.0], [*foot, rolling(foot[None])[0]]])
        stays.append(ends)
        add(ends[0] + rng.random((50, 1)) * (ends[1] - ends[0]), STAY)
    d = (xy[1] - xy[0]) / np.linalg.norm(xy[1] - xy[0])
    fence = np.array([xy[0] + 4 * d, xy[0] + 34 * d]) + 9.0 * np.array([d[1], -d[0]])
    run = fence[0] + rng.random((900, 1)) * (fence[1] - fence[0])
    add(np.column_stack([run, rolling(run) + rng.uniform(0.05, 1.4, 900)]), FENCE)
    for _ in range(60):
        x, y = rng.uniform((3, 3), high - 3)
        if (
            min(_off(np.array([x, y]), xy[n], xy[n + 1]) for n in range(spans)) > 7.0
            and _off(np.array([x, y]), *fence) > 4.0
        ):
            tree = Tree(float(x), float(y), float(rng.uniform(5, 14)), float(rng.uniform(1.2, 2.6)))
            add(tree_points(rng, tree, float(rolling(np.array([[x, y]]))[0]), 2 * per_m2), TREE)
    xyz = np.concatenate(parts)
    xyz += rng.normal(0, 0.03, xyz.shape)
    return Line(
        xyz, np.repeat(np.array(kinds, np.uint8), [len(p) for p in parts]), wires, poles, np.array(stays), fence
    )


def _off(place: Array, a: Array, b: Array) -> float:
    """Distance from a stretch in plan."""
    t = np.clip((place - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    return float(np.linalg.norm(place - a - t * (b - a)))


def _hung(a: Array, b: Array, parameter_m: float) -> Wire:
    """The catenary of a parameter through two places."""
    length, rise = float(np.linalg.norm(b[:2] - a[:2])), float(b[2] - a[2])
    middle = length / 2 - parameter_m * np.arcsinh(rise / (2 * parameter_m * np.sinh(length / (2 * parameter_m))))
    low = a[2] - parameter_m * (np.cosh(middle / parameter_m) - 1.0)
    return Wire(np.stack([a, b]), parameter_m, float(middle), float(low))


def _conductors(rng: np.random.Generator, xy: Array, ground: Array) -> list[Wire]:
    """Three conductors and a lower one on each span between poles."""
    wires = []
    for n in range(len(xy) - 1):
        across = np.array([-(xy[n + 1] - xy[n])[1], (xy[n + 1] - xy[n])[0]]) / np.linalg.norm(xy[n + 1] - xy[n])
        for offset, height in ((-1.2, 10.0), (0.0, 10.4), (1.2, 10.0), (0.15, 7.6)):
            first = np.append(xy[n] + offset * across, ground[n] + height)
            second = np.append(xy[n + 1] + offset * across, ground[n + 1] + height)
            wires.append(_hung(first, second, float(rng.uniform(180, 420))))
    return wires
