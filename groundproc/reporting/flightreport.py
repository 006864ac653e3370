"""report.html: what a flight brought, on one page that opens from the disk and asks nothing of any network."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.machine.readahead import both
from groundproc.raster import geotiff
from groundproc.reporting import cloudpart, imagepart, maps, usesfound, words
from groundproc.reporting.charts import charts
from groundproc.reporting.cloudpart import CloudPart, Foreseen
from groundproc.reporting.markup import Html, joined, section, tag
from groundproc.reporting.plots import draw
from groundproc.trajectory.estimate import Estimate
from groundproc.viewer.page import VIEWER, page, script_of

Array = npt.NDArray[np.float64]

STYLES: Final = ("base.css", "viewer.css", "report.css")
_DENSITY: Final = "density.tif"
_ROOM_BYTES: Final = 64
"""For numbers of points that are longer than those of the page without them."""
_CELL_M: Final = 1.0
_MOST_CELLS: Final = 4000
"""Along a side; of larger areas, cells are larger."""


@dataclass(frozen=True, slots=True)
class Subject:
    """What a report is of.

    Attributes
    ----------
    folder : Path
        Of the finished products.
    quality : mapping
        quality.json.
    estimate : Estimate
    paths : sequence of ndarray, shape (k, 3)
        Covered pieces of the trajectory in the CRS of the points.
    digests : mapping of str to str
        SHA-256 of inputs and products by name.
    uses : sequence of mapping
        What the uses found (`usesfound.read`).
    """

    folder: Path
    quality: Mapping[str, Any]
    estimate: Estimate
    paths: Sequence[Array]
    digests: Mapping[str, str]
    uses: Sequence[Mapping[str, Any]] = ()


def compose(subject: Subject, most_points: int, most_bytes: int, foreseen: Foreseen | None = None) -> str:
    """The page, of at most so many bytes; its cloud may have been read before.

    Raises
    ------
    CaptureError
        A product that it shows is damaged.
    """
    part = cloudpart.read(subject.folder, most_points, foreseen)
    text, (before, after) = both(
        lambda: "" if part is None else cloudpart.text_of(part),
        lambda: (_before(subject, part), _after(subject, part)),
    )
    if part is not None:
        rest = len(_page(subject, [before, _cloud(subject, part, ""), after]).encode())
        text, part = cloudpart.fitted(part, text, most_bytes - rest - _ROOM_BYTES)
    return _page(subject, [before, _cloud(subject, part, text), after])


def _page(subject: Subject, parts: Sequence[Html]) -> str:
    title = f"Flight of {_day(subject.quality)}"
    return page(title, STYLES, tag("main", parts), script_of((*VIEWER, "report.js")))


def _before(subject: Subject, part: CloudPart | None) -> Html:
    """What stands above the cloud."""
    quality = subject.quality
    names = ", ".join(log["file"] for log in quality["inputs"])
    density, area_m2 = _covered(subject, part)
    return joined(
        [
            tag("header", tag("h1", f"Flight of {_day(quality)}"), tag("p", names)),
            words.verdict(quality),
            words.facts(quality, density, area_m2),
            words.story(quality),
        ]
    )


def _after(subject: Subject, part: CloudPart | None) -> Html:
    """What stands below it."""
    quality = subject.quality
    curves = tag("div", [draw(plot) for plot in charts(subject.estimate)], class_="plots")
    return joined(
        [
            usesfound.told(subject.uses),
            _maps(subject, part),
            imagepart.images(quality, subject.folder, list(subject.digests)),
            section("quality", "Quality over time", curves),
            words.clocks(quality),
            words.control(quality),
            words.losses(quality),
            words.settings(quality["config"]),
            words.provenance(quality, subject.digests),
            tag("footer", "All figures are in quality.json beside this page."),
        ]
    )


def _day(quality: Mapping[str, Any]) -> str:
    """Date and time of day, as a title."""
    start = str(quality["trajectory"]["start"])
    return f"{start[:10]}, {start[11:16]} UTC"


def _cloud(subject: Subject, part: CloudPart | None, text: str) -> Html:
    if part is None:
        missing = " or ".join(cloudpart.CLOUDS)
        return section(
            "cloud",
            "Cloud",
            tag("p", f"No cloud is shown, because none of the products holds points: choose {missing}."),
        )
    return section("cloud", "Cloud", cloudpart.element(part, text, subject.paths))


def _maps(subject: Subject, part: CloudPart | None) -> Html:
    layers, shade = maps.layers_of(subject.folder, [name for name in subject.digests if name not in imagepart.MOSAICS])
    if not layers and part is not None:
        layers = [maps.of_points(part.points.xyz_m)]
    if not layers:
        return Html("")
    buttons = [tag("button", each.title, type="button", data_layer=each.name, aria_pressed="false") for each in layers]
    chooser = tag("div", buttons if len(buttons) > 1 else [], class_="choose")
    about = "Red: the path of the flight. North is up."
    drawn = maps.figures(layers, shade, subject.paths)
    return section("map", "Map", tag("div", chooser, drawn, class_="layers"), tag("p", about, class_="aside"))


def _covered(subject: Subject, part: CloudPart | None) -> tuple[float | None, float | None]:
    """Median density [points/m2] and area [m2] of what has points."""
    if _DENSITY in subject.digests and (subject.folder / _DENSITY).is_file():
        with geotiff.opened(subject.folder / _DENSITY) as raster:
            side_m = max(raster.grid.columns, raster.grid.rows) * raster.grid.cell_m
            values, cell_m = geotiff.coarse(raster, min(int(np.ceil(side_m / _CELL_M)), _MOST_CELLS))
        seen = values[values > 0.0]
        return (float(np.median(seen)), float(len(seen) * cell_m**2)) if len(seen) else (None, None)
    if part is None:
        return None, None
    cells = np.unique(np.floor(part.points.xyz_m[:, :2]).astype(np.int64), axis=0, return_counts=True)[1]
    return float(np.median(cells)) * part.total / len(part.points), float(len(cells))
