"""A place of boxes and shrubs, and every beam of a scanner followed into it: clouds whose truth nothing else in the project made.

Ground is waves in closed form, boxes are upright, a shrub is some hundred round leaves about a stem that leans with the wind, anew in
each pass. The first thing that a beam meets answers; a leaf that it only grazes lets a second echo through. Files hold what any lidar
writes, and no columns of ours.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import laspy
import numpy as np
import numpy.typing as npt
import pyproj

Array = npt.NDArray[np.float64]

ORIGIN = np.array([601_200.0, 5_303_400.0, 480.0])
EPSG = 32632
START_GPS_S = 1_400_000_000.0
"""Of the first pass."""
_UNIX_OF_GPS_S = 315_964_800 - 18


@dataclass
class Shrub:
    """Leaves about a stem: where it stands, how high and wide it is, and its leaves at rest."""

    x: float
    y: float
    height_m: float
    leaves_m: Array
    leaf_radius_m: float


@dataclass
class Place:
    """Ground of `side_m` squared with boxes (x, y, edge) on it, and shrubs."""

    side_m: float
    waves_m: float = 0.15
    boxes: Sequence[tuple[float, float, float]] = ()
    shrubs: list[Shrub] = field(default_factory=list)

    def ground(self, x: Array, y: Array) -> Array:
        return np.asarray(self.waves_m * (np.sin(x / 2.3 + 0.4) + np.cos(y / 1.7) * np.sin(x / 5.0)))


def shrubs(rng: np.random.Generator, places: Array, leaves: int = 250) -> list[Shrub]:
    made = []
    for x, y in places:
        height, radius = rng.uniform(0.6, 1.4), rng.uniform(0.3, 0.6)
        way = rng.standard_normal((leaves, 3))
        way *= rng.uniform(0.3, 1.0, (leaves, 1)) / np.linalg.norm(way, axis=1)[:, None]
        at = way * (radius, radius, height / 2) + (0.0, 0.0, height / 2)
        made.append(Shrub(float(x), float(y), float(height), at, 0.035))
    return made


@dataclass
class Pass:
    """A straight line above the place, from one point to another, in some seconds."""

    start_m: tuple[float, float, float]
    end_m: tuple[float, float, float]
    begin_s: float
    seconds: float = 8.0

    def at(self, time_s: Array) -> Array:
        share = ((time_s - self.begin_s) / self.seconds)[:, None]
        return np.asarray((1.0 - share) * np.array(self.start_m) + share * np.array(self.end_m))


@dataclass
class Echoes:
    """What came back, in the order of time."""

    xyz_m: Array
    time_s: Array
    rank: npt.NDArray[np.int64]
    of: npt.NDArray[np.int64]
    line: npt.NDArray[np.int64]
    thing: npt.NDArray[np.int64]
    """0: ground, 1 + n: box n, -1 - n: shrub n."""

    def of_lines(self, chosen: Sequence[int]) -> "Echoes":
        own = np.isin(self.line, chosen)
        return Echoes(*(getattr(self, name)[own] for name in ("xyz_m", "time_s", "rank", "of", "line", "thing")))


def passes(side_m: float, height_m: float = 25.0, count: int = 5) -> list[Pass]:
    """Lines there and across, from beyond one edge to beyond the other."""
    made = []
    for n in range(count):
        at, ends = side_m * (n + 0.5) / count, (-6.0, side_m + 6.0)
        start, end = ((ends[n // 2 % 2], at), (ends[1 - n // 2 % 2], at))
        if n % 2:
            start, end = start[::-1], end[::-1]
        made.append(Pass((*start, height_m + 2.0 * n), (*end, height_m + 2.0 * n), 40.0 * n))
    return made


def scan(
    place: Place, lines: Sequence[Pass], per_m2: float, seed: int, noise_m: float = 0.02, gust_m: float = 0.1
) -> Echoes:
    """All that beams to random points of the place bring back."""
    rng = np.random.default_rng(seed)
    parts = [_one_pass(place, n, line, per_m2 / len(lines), rng, (noise_m, gust_m)) for n, line in enumerate(lines)]
    whole = [np.concatenate([part[k] for part in parts]) for k in range(6)]
    order = np.lexsort((whole[2], whole[1]))
    return Echoes(*(each[order] for each in whole))


def _one_pass(
    place: Place, number: int, line: Pass, per_m2: float, rng: np.random.Generator, sizes: tuple[float, float]
) -> list[npt.NDArray[np.generic]]:
    noise_m, gust_m = sizes
    count = int(per_m2 * place.side_m**2)
    time_s = np.sort(rng.uniform(line.begin_s, line.begin_s + line.seconds, count))
    eye = line.at(time_s)
    aim = np.column_stack([rng.uniform(0, place.side_m, (count, 2)), np.zeros(count)])
    ahead = aim - eye
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    range_m = _to_ground(place, eye, ahead)
    thing = np.zeros(count, np.int64)
    for n, (x, y, edge) in enumerate(place.boxes):
        base = float(place.ground(np.array(x), np.array(y)))
        half = edge / 2
        low, high = np.array([x - half, y - half, base - 0.05]), np.array([x + half, y + half, base + edge])
        hit = _to_box(eye, ahead, low, high)
        nearer = hit < range_m
        range_m[nearer], thing[nearer] = hit[nearer], 1 + n
    first, graze = range_m.copy(), np.zeros(count, bool)
    leaf_of = np.zeros(count, np.int64)
    for n, shrub in enumerate(place.shrubs):
        hit, grazed = _to_leaves(place, shrub, eye, ahead, rng.normal(0, gust_m, 2), rng)
        nearer = hit < first
        first[nearer], graze[nearer], leaf_of[nearer] = hit[nearer], grazed[nearer], -1 - n
    both = np.flatnonzero(graze & (range_m - first > 0.4))
    several = np.ones(count, np.int64)
    several[both] = 2
    rows = np.concatenate([np.arange(count), both])
    far = np.concatenate([first, range_m[both]])
    far = far + noise_m * rng.standard_normal(len(far))
    xyz = eye[rows] + far[:, None] * ahead[rows] + 0.004 * rng.standard_normal((len(rows), 3))
    rank = np.concatenate([np.ones(count, np.int64), np.full(len(both), 2)])
    what = np.concatenate([np.where(leaf_of < 0, leaf_of, thing), thing[both]])
    return [xyz, time_s[rows], rank, several[rows], np.full(len(rows), number), what]


def _to_ground(place: Place, eye: Array, ahead: Array) -> Array:
    """Range to the waves, by secants: they are far flatter than any beam."""
    far = -eye[:, 2] / ahead[:, 2]
    for _ in range(12):
        at = eye + far[:, None] * ahead
        far += (at[:, 2] - place.ground(at[:, 0], at[:, 1])) / -ahead[:, 2]
    return far


def _to_box(eye: Array, ahead: Array, low: Array, high: Array) -> Array:
    with np.errstate(divide="ignore"):
        a, b = (low - eye) / ahead, (high - eye) / ahead
    into, out = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    return np.where((into <= out) & (into > 0), into, np.inf)


def _to_leaves(
    place: Place, shrub: Shrub, eye: Array, ahead: Array, lean: Array, rng: np.random.Generator
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Range to the nearest leaf of a shrub that leans, and whether it is only grazed."""
    base = np.array([shrub.x, shrub.y, float(place.ground(np.array(shrub.x), np.array(shrub.y)))])
    bent = shrub.leaves_m + rng.normal(0, 0.03, shrub.leaves_m.shape)
    bent[:, :2] += lean * (bent[:, 2:] / shrub.height_m) ** 2
    leaves = base + bent
    middle, reach = leaves.mean(axis=0), float(np.linalg.norm(leaves - leaves.mean(axis=0), axis=1).max()) + 0.1
    along = ((middle - eye) * ahead).sum(axis=1)
    near = np.flatnonzero(np.linalg.norm(eye + along[:, None] * ahead - middle, axis=1) < reach)
    hit, grazed = np.full(len(eye), np.inf), np.zeros(len(eye), bool)
    for leaf in leaves:
        to = ((leaf - eye[near]) * ahead[near]).sum(axis=1)
        off = np.linalg.norm(eye[near] + to[:, None] * ahead[near] - leaf, axis=1)
        met = (off < shrub.leaf_radius_m) & (to < hit[near])
        hit[near[met]], grazed[near[met]] = to[met], off[met] > 0.75 * shrub.leaf_radius_m
    return hit, grazed


def write_las(path: Path, echoes: Echoes, turned: tuple[Array, Array] | None = None) -> Path:
    """Format 6 with time, rank of echo and line; turned and shifted about the middle of the place, if asked for."""
    xyz = echoes.xyz_m
    if turned is not None:
        middle = xyz.mean(axis=0)
        xyz = (xyz - middle) @ turned[0].T + middle + turned[1]
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.0005] * 3, ORIGIN
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.add_crs(pyproj.CRS.from_epsg(EPSG))
    las = laspy.LasData(header)
    las.xyz = xyz + ORIGIN
    las.gps_time = START_GPS_S - 1e9 + echoes.time_s
    las.return_number, las.number_of_returns = echoes.rank, echoes.of
    las.point_source_id = 11 + echoes.line
    las.intensity = np.full(len(xyz), 900)
    las.write(path)
    return path


def write_track(path: Path, lines: Sequence[Pass]) -> Path:
    """The passes as a table of positions and attitudes."""
    to = pyproj.Transformer.from_crs(EPSG, 4326, always_xy=True)
    rows = ["utc_ns,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg"]
    for line in lines:
        time_s = np.arange(line.begin_s - 0.2, line.begin_s + line.seconds + 0.25, 0.05)
        at = line.at(time_s) + ORIGIN
        longitude, latitude = to.transform(at[:, 0], at[:, 1])
        rows += [
            f"{round((START_GPS_S + _UNIX_OF_GPS_S + t) * 1e9)},{la:.10f},{lo:.10f},{h:.4f},0,0,0"
            for t, la, lo, h in zip(time_s, latitude, longitude, at[:, 2], strict=True)
        ]
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return path
