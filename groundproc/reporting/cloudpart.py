"""The cloud of a report: as many points as fit, with every attribute that tells something."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.cloud import reader
from groundproc.cloud.georeference import extent
from groundproc.cloud.setaside import SetAside
from groundproc.reporting.markup import Html, tag
from groundproc.viewer.packing import pack
from groundproc.viewer.page import held
from groundproc.viewer.scene import origin_of, scene
from groundproc.viewer.shades import TIME, Shade, shades_of
from groundproc.viewer.thinning import Thinned, thin, thinner

Array = npt.NDArray[np.float64]

CLOUDS: Final = ("cloud.copc.laz", "cloud.laz")
"""Products that hold the points; the first can be read in part."""
_CLOSE: Final = 0.985
"""Of the room that is left, so that a second trial is the last."""
_LEAST_POINTS: Final = 1_000


@dataclass(frozen=True, slots=True)
class CloudPart:
    """Points for the page.

    Attributes
    ----------
    points : Thinned
    shades : list of Shade
    total : int
        Points of the cloud.
    crs : Any
        Of the cloud.
    """

    points: Thinned
    shades: list[Shade]
    total: int
    crs: Any


@dataclass(frozen=True, slots=True)
class Foreseen:
    """What was read of a cloud before a page asks for it.

    Attributes
    ----------
    part : CloudPart
    most : int
        How many points were asked for.
    mark : tuple of int
        Inode, size and time [ns] of the file: they stay when it gets its name, and change with what is in it.
    """

    part: CloudPart
    most: int
    mark: tuple[int, int, int]


def foreseen(path: Path, most: int, aside: SetAside | None = None) -> Foreseen:
    """Some points of a cloud that will be asked for, of those that were set aside where these are the ones.

    Raises
    ------
    CaptureError
        The cloud is damaged.
    """
    mark = _mark(path)
    return Foreseen(_of(path, most, aside), most, mark)


def read(folder: Path, most: int, before: Foreseen | None = None) -> CloudPart | None:
    """Some points of the folder's cloud, those of `before` where they are the same; None where no product holds them.

    Raises
    ------
    CaptureError
        The cloud is damaged.
    """
    path = next((folder / name for name in CLOUDS if (folder / name).is_file()), None)
    if path is None:
        return None
    if before is not None and (before.most, before.mark) == (most, _mark(path)):
        return before.part
    return _of(path, most)


def _of(path: Path, most: int, aside: SetAside | None = None) -> CloudPart:
    cloud = reader.look(path)
    points = thin(cloud, most, in_time=True, aside=aside)
    return CloudPart(points, shades_of(points.columns, _since(points)), cloud.points, cloud.crs)


def _mark(path: Path) -> tuple[int, int, int]:
    found = path.stat()
    return found.st_ino, found.st_size, found.st_mtime_ns


def text_of(part: CloudPart) -> str:
    """All points packed as text."""
    return base64.b64encode(_packed(part.points, part.shades)).decode()


def fitted(part: CloudPart, text: str, room_bytes: int) -> tuple[str, CloudPart]:
    """Points, packed as a text, as one of at most so many bytes: fewer points where that is needed."""
    while len(text) > room_bytes and len(part.points) > _LEAST_POINTS:
        most = max(int(len(part.points) * _CLOSE * room_bytes / len(text)), _LEAST_POINTS)
        part = replace(part, points=thinner(part.points, most))
        text = text_of(part)
    return text, part


def _packed(points: Thinned, shades: Sequence[Shade]) -> bytes:
    since = _since(points)
    columns = [
        shade.encode(since if shade.name == TIME and since is not None else points.columns[shade.name])
        for shade in shades
    ]
    return pack(points.xyz_m - origin(points), columns)


def origin(points: Thinned) -> Array:
    """Of the page's coordinates."""
    return origin_of(*extent(points.xyz_m))


def element(part: CloudPart, text: str, paths: Sequence[Array]) -> Html:
    """The viewer, and what it shows."""
    points = part.points
    limits = extent(points.xyz_m)
    spacing_m = points.spacing_m or float(np.sqrt(np.prod((limits[1] - limits[0])[:2]) / max(len(points), 1)))
    told = scene(origin(points), limits, points.xyz_m, part.shades, paths, spacing_m, part.crs)
    shown = f"{len(points):,} of {part.total:,} points" if len(points) < part.total else f"All {part.total:,} points"
    about = (
        f"{shown}. Drag to turn, right button or Shift to move, wheel to zoom (click into the picture first), two fingers on a phone; "
        "a click on a point tells what is known of it. Places are exact to the millimetre."
    )
    return Html(
        tag("div", id="viewer", class_="viewer")
        + held("scene", told)
        + f'<script type="application/octet-stream" id="cloud-data">{text}</script>'
        + tag("p", about, class_="aside")
    )


def _since(points: Thinned) -> Array | None:
    """Seconds from the first point on."""
    return None if points.time_s is None else points.time_s - points.time_s.min()
