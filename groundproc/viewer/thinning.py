"""A cloud of any size thinned to so many points, evenly: of an octree only what is needed is read."""

import contextlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.cloud import reader
from groundproc.cloud.georeference import extent
from groundproc.cloud.nodes import NodeReader, is_copc, octree_of
from groundproc.cloud.reader import Cloud
from groundproc.cloud.setaside import Parts, SetAside
from groundproc.machine.readahead import ahead
from groundproc.numerics.voxelhash import newcomers

Array = npt.NDArray[np.float64]

_READ: Final = (2, 4)
"""Times as many points are looked at as are kept: of an octree, whose levels are even already, and of a file in the order of time."""
_STRETCH: Final = 100_000
"""Points of a flight that are read on end: two of the pieces that LAZ packs by themselves, so that two cores unpack them."""
_CLOSE: Final = 0.97
"""Share of the wanted points that is enough."""
_TRIALS: Final = 12
_SURFACE: Final = 2.0
_POWERS: Final = (0.5, 3.0)
"""Cells on a surface: their number goes with the square of their size; where most have one point by then, with less. Two trials tell."""
_MORE: Final = 1_000
"""Room for what a share of many nodes comes to beyond the share of all."""
_TIME: Final = "time"
_GOLDEN: Final = 0.6180339887498949


@dataclass(frozen=True, slots=True)
class Thinned:
    """Some points of a cloud.

    Attributes
    ----------
    xyz_m : ndarray, shape (n, 3)
        In the cloud's CRS.
    columns : dict of str to ndarray, shape (n,)
        As in `Points`.
    time_s : ndarray or None, shape (n,)
        As stored.
    spacing_m : float
        Side of the voxels of which each gave one point; 0: all points are here.
    """

    xyz_m: Array
    columns: dict[str, npt.NDArray[Any]]
    time_s: Array | None
    spacing_m: float

    def __len__(self) -> int:
        return len(self.xyz_m)

    def part(self, chosen: npt.NDArray[Any], spacing_m: float) -> "Thinned":
        """Those of a mask, or of places in the arrays."""
        columns = {name: values[chosen] for name, values in self.columns.items()}
        return Thinned(self.xyz_m[chosen], columns, None if self.time_s is None else self.time_s[chosen], spacing_m)


def thin(
    cloud: Cloud,
    most: int,
    columns: Collection[str] | None = None,
    in_time: bool = False,
    aside: SetAside | None = None,
) -> Thinned:
    """At most so many points, spread as evenly as voxels of one size can; the same ones every time.

    Parameters
    ----------
    cloud : Cloud
    most : int
    columns : collection of str, optional
        Default: all.
    in_time : bool
        The points are known to be those of one flight in the order of time. Then stretches of it are read whole, and others not at all:
        a sensor that turns sees each place for seconds, of which stretches of 0.3 s are a fair sample, and unpacking costs the most.
    aside : SetAside, optional
        Where it kept `stretches` as the file was written, nothing is unpacked.

    Raises
    ------
    CaptureError
        The cloud is damaged.
    """
    octree = is_copc(cloud.path)
    room = min(_READ[0 if octree else 1] * most, cloud.points)
    held: dict[str, npt.NDArray[Any]] = {}
    used = 0
    # filled piece by piece: pieces and their sum together would be twice the memory
    if in_time and not octree:
        source = _of_flight(cloud, stretches(cloud.points, most), columns, aside)
    else:
        source = (_of_octree if octree else _of_file)(cloud, room, columns)
    with contextlib.closing(ahead(source)) as parts:
        for part in parts:
            arrays = {"": part.xyz_m, **part.columns} | ({} if part.time_s is None else {_TIME: part.time_s})
            count = min(len(part), room + _MORE - used)
            for name, values in arrays.items():
                if name not in held:
                    held[name] = np.empty((room + _MORE, *values.shape[1:]), values.dtype)
                held[name][used : used + count] = values[:count]
            used += count
    whole = {name: values[:used] for name, values in held.items()}
    time_s = whole.pop(_TIME, None)
    return thinner(Thinned(whole.pop(""), whole, time_s, 0.0), most)


def thinner(points: Thinned, most: int) -> Thinned:
    """At most so many of some points."""
    if len(points) <= most:
        return points
    corner, far = extent(points.xyz_m)
    low, high = 0.0, float((far - corner).max()) + 0.001
    voxel_m = max(high / np.sqrt(most), points.spacing_m)
    best: tuple[npt.NDArray[Any], float] | None = None
    last, power = None, _SURFACE
    for _ in range(_TRIALS):
        first, found = newcomers(points.xyz_m, corner, voxel_m)
        if found > most:
            low = voxel_m
        else:
            high = voxel_m
            best = np.flatnonzero(first), voxel_m
            if found >= _CLOSE * most:
                break
        if last is not None and found != last[1]:
            power = float(np.clip(np.log(found / last[1]) / np.log(last[0] / voxel_m), *_POWERS))
        last = voxel_m, found
        guess = voxel_m * (found / (0.985 * most)) ** (1.0 / power)
        voxel_m = guess if low < guess < high else (low + high) / 2.0
    if best is None:
        best = np.flatnonzero(_share(len(points), most / len(points))), high
    return points.part(best[0][:most], best[1])


def _share(count: int, share: float, begin: int = 0) -> npt.NDArray[np.bool_]:
    """A mask of about such a share, spread without any period that a scanner could have (the golden section's multiples)."""
    return np.asarray((np.arange(begin, begin + count) * _GOLDEN) % 1.0 < share)


def _of_octree(cloud: Cloud, most: int, columns: Collection[str] | None) -> Iterator[Thinned]:
    """Levels from the root down, until there are enough points."""
    octree = octree_of(cloud.path)
    levels: dict[int, list[Any]] = {}
    for key in sorted(octree.nodes):
        levels.setdefault(key[0], []).append(octree.nodes[key])
    left = most
    with NodeReader(cloud, octree) as nodes:
        for level in sorted(levels):
            total = sum(node.points for node in levels[level])
            share = min(left / total, 1.0)
            for node in levels[level]:
                points, time_s = nodes.read(node, columns)
                some = Thinned(points.xyz_m, dict(points.columns), time_s if cloud.timed else None, 0.0)
                yield some if share == 1.0 else some.part(_share(len(some), share), 0.0)
            left -= total
            if left <= 0:
                return


def _of_file(cloud: Cloud, most: int, columns: Collection[str] | None) -> Iterator[Thinned]:
    """All points in their order, or an even share of them."""
    share = min(most / cloud.points, 1.0)
    picked = (lambda begin, count: _share(count, share, begin)) if share < 1.0 else None
    for chunk in reader.chunks(cloud, columns=columns, picked=picked):
        yield _whole(cloud, chunk)


def stretches(points: int, most: int) -> Parts:
    """Of a flight of so many points, what is looked at for at most so many of them: stretches evenly over its time."""
    begins = range(0, points, _STRETCH)
    count = min(max(min(_READ[1] * most, points) // _STRETCH, 1), len(begins))
    chosen = [begins[i * len(begins) // count] for i in range(count)]
    return [(begin, min(_STRETCH, points - begin)) for begin in chosen]


def _of_flight(
    cloud: Cloud, parts: Parts, columns: Collection[str] | None, aside: SetAside | None
) -> Iterator[Thinned]:
    """Stretches of a flight."""
    for chunk in reader.chunks(cloud, columns=columns, parts=parts, aside=aside):
        yield _whole(cloud, chunk)


def _whole(cloud: Cloud, chunk: reader.Chunk) -> Thinned:
    time_s = np.asarray(chunk.record.gps_time, np.float64) if cloud.timed else None
    return Thinned(chunk.points.xyz_m, dict(chunk.points.columns), time_s, 0.0)
