"""A slice through a cloud: the points near a line, as they were, with their way along it."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import CoverageError, UsageError
from groundproc.cloud import reader
from groundproc.cloud.metres import metres_of
from groundproc.cloud.rewriter import Rewriter
from groundproc.cloud.selection import CLASS, standing
from groundproc.files import written_aside

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

CLOUD_ENDINGS: Final = (".laz", ".las")
ENDINGS: Final = (*CLOUD_ENDINGS, ".csv", ".dxf")
_TABLE: Final = ("intensity", "classification")
_DRAWN_M: Final = 0.01
"""Drawing programs are slow with points, and none shows finer."""


@dataclass(frozen=True, slots=True)
class Made:
    """What a section holds."""

    points: int
    of: int
    length_m: float
    lowest_m: float
    highest_m: float
    no_surface: int = 0
    """Points of noise and of what moves that would lie in it."""


def section(
    path: Path,
    output: Path,
    line_m: Sequence[float],
    width_m: float,
    progress: Callable[[int], object],
    all_classes: bool = False,
) -> Made:
    """Write the points within half a width of a line, beyond its ends none.

    As a cloud every point comes out as it was, in its order, with `along`: metres from the line's beginning. As a table (.csv) it has
    `left_m` too, and a drawing (.dxf) shows it in the plane of the section.

    Parameters
    ----------
    path, output : Path
    line_m : sequence of 4 floats
        Easting and northing of the ends, in the unit of the cloud's CRS.
    width_m : float
    progress : callable
        Told of points done.
    all_classes : bool
        Noise and what moves are in it too.

    Raises
    ------
    UsageError
        The line has no length, or the slice no width.
    CoverageError
        No point is there.
    """
    cloud = reader.look(path)
    metres = metres_of(cloud)
    start, end = (metres.across * np.array(each, np.float64) for each in (line_m[:2], line_m[2:]))
    length = float(np.linalg.norm(end - start))
    if not (length > 0.0 and 0.0 < width_m < np.inf):
        raise UsageError(
            f"a line of {length:g} m and a width of {width_m:g} m: expected more than 0 of both, and finite"
        )
    ahead = (end - start) / length
    kept, left_out, low, high = 0, 0, np.inf, -np.inf
    bounds = [np.full(2, np.inf), np.full(2, -np.inf)]
    with written_aside(output) as aside:
        with _writer(cloud, aside, output.suffix.lower()) as new:
            for chunk in reader.chunks(cloud, columns=(*new.columns, CLASS)):
                xyz = metres.of(chunk.points.xyz_m)
                away = xyz[:, :2] - start
                along, across = away @ ahead, away @ np.array([-ahead[1], ahead[0]])
                inside = (along >= 0.0) & (along <= length) & (np.abs(across) <= width_m / 2.0)
                stands = standing(chunk.points, all_classes)
                left_out += int(np.count_nonzero(inside & ~stands))
                inside &= stands
                bounds = [np.minimum(bounds[0], xyz[:, :2].min(axis=0)), np.maximum(bounds[1], xyz[:, :2].max(axis=0))]
                if inside.any():
                    kept += int(inside.sum())
                    low, high = min(low, float(xyz[inside, 2].min())), max(high, float(xyz[inside, 2].max()))
                    new.add(chunk, inside, along[inside], across[inside])
                progress(len(inside))
        if not kept:
            bounds = [each / metres.across for each in bounds]
            raise CoverageError(
                f"{path}: no point lies within {width_m / 2:g} m of the line; its points span {bounds[0][0]:.2f} to {bounds[1][0]:.2f} E "
                f"and {bounds[0][1]:.2f} to {bounds[1][1]:.2f} N"
            )
    return Made(kept, cloud.points, length, low, high, left_out)


@contextlib.contextmanager
def _writer(cloud: reader.Cloud, aside: Path, suffix: str) -> Iterator["_Cloud | _Table | _Drawing"]:
    """What writes points of a section to a file of a name with that ending."""
    if suffix == ".csv":
        with aside.open("w", encoding="utf-8", newline="\n") as file:
            yield _Table(cloud, file)
    elif suffix == ".dxf":
        drawing = _Drawing(metres_of(cloud).up)
        yield drawing
        drawing.write(aside)
    else:
        with Rewriter(cloud, aside, suffix != ".las", ("along",)) as new:
            yield _Cloud(new)


class _Cloud:
    """The points as they were, with `along`."""

    columns: Final[tuple[str, ...]] = ()

    def __init__(self, new: Rewriter) -> None:
        self._new = new

    def add(self, chunk: reader.Chunk, inside: Mask, along: Array, across: Array) -> None:
        """Write those of a chunk; `across` is not kept."""
        del across
        self._new.write(chunk.record[inside], columns={"along": along})


class _Table:
    """A row a point: the way along the line, how far to the left of it, place, and what may be wanted of each."""

    def __init__(self, cloud: reader.Cloud, file: IO[str]) -> None:
        self.columns = tuple(name for name in _TABLE if name in cloud.columns)
        self._file = file
        file.write(",".join(("along_m", "left_m", "easting", "northing", "height", *self.columns)) + "\n")

    def add(self, chunk: reader.Chunk, inside: Mask, along: Array, across: Array) -> None:
        """Write those of a chunk."""
        xyz = chunk.points.xyz_m[inside]
        others = [chunk.points[name][inside].tolist() for name in self.columns]
        for place, *rest in zip(np.column_stack([along, across, xyz]).tolist(), *others, strict=True):
            self._file.write(",".join([*(f"{value:.4f}" for value in place), *map(str, rest)]) + "\n")


class _Drawing:
    """Points of a plane, way to the right and height upwards, on a layer each class; of those that coincide at 1 cm one."""

    columns: Final[tuple[str, ...]] = ("classification",)

    def __init__(self, up: float) -> None:
        self._up = up
        self._parts: list[npt.NDArray[np.int64]] = []

    def add(self, chunk: reader.Chunk, inside: Mask, along: Array, across: Array) -> None:
        """Keep those of a chunk; `across` is what a section leaves out."""
        del across
        known = "classification" in chunk.points.columns
        kind = chunk.points["classification"][inside] if known else np.zeros(len(along))
        some = np.column_stack([along / _DRAWN_M, self._up * chunk.points.xyz_m[inside, 2] / _DRAWN_M, kind])
        self._parts.append(np.unique(np.rint(some).astype(np.int64), axis=0))

    def write(self, path: Path) -> None:
        """Write them."""
        from groundproc.vectors.dxf import write_places

        if not self._parts:
            return
        found = np.unique(np.concatenate(self._parts), axis=0)
        places = np.column_stack([found[:, :2] * _DRAWN_M, np.zeros(len(found))])
        write_places(path, places, [f"CLASS_{kind}" for kind in found[:, 2].tolist()])
