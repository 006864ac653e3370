"""What is made of a flight: one file here for each product, and one line in `REGISTRY`.

A product that sees the points is a class with `begin(context)`, `add(points)` and `finish()`; one that is made of what a finished flight
left behind is a function of `Context`. One with options of its own has a frozen dataclass `Options` beside it, which the class or the
function is given. Modules are imported when a product is chosen, so that the command line stays fast; that is long before it is made, and
so they import matplotlib only when they draw: it would take 27 MB beside the estimation.
"""

import importlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from flightlog import config
from flightlog.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Entry:
    """Where a product is written, and what it is.

    Attributes
    ----------
    module, attribute : str
        Of its class or function.
    about : str
        A few words for people.
    by_default : bool
        Made where the survey chooses none.
    long : bool
        Takes the longest to finish: the others are finished beside it.
    """

    module: str
    attribute: str
    about: str
    by_default: bool = True
    long: bool = False


REGISTRY: Final[dict[str, Entry]] = {
    "cloud.laz": Entry("groundproc.products.cloud_laz", "CloudLaz", "all points, LAS 1.4 compressed"),
    "pictures": Entry(
        "groundproc.products.pictures",
        "Pictures",
        "cloud_height.png (as a lit surface), cloud_intensity.png: from above and from the south, to scale",
    ),
    "cloud.copc.laz": Entry("groundproc.products.cloud_copc", "CloudCopc", "the same points as an octree, for viewers", long=True),
    "tiles": Entry(
        "groundproc.products.tiles", "Tiles", "tiles/: the points in squares of 250 m, cloud.vpc opens them all", by_default=False
    ),
    "dsm.tif": Entry("groundproc.products.dsm", "Dsm", "surface model: the highest point of each cell, 0.25 m"),
    "intensity.tif": Entry("groundproc.products.intensity", "Intensity", "mean intensity by cell"),
    "density.tif": Entry("groundproc.products.density", "Density", "points per square metre by cell"),
    "hillshade.tif": Entry("groundproc.products.hillshade", "Hillshade", "surface model lit from the north-west"),
    "sigma.tif": Entry(
        "groundproc.products.sigma", "Sigma", "how well the points of each cell are known, one sigma in space", by_default=False
    ),
    "strip_difference.tif": Entry(
        "groundproc.products.strip_difference", "StripDifference", "by how much flight lines differ in height, cells of 0.5 m",
        by_default=False,
    ),
    "cloud_smooth.laz": Entry(
        "groundproc.products.cloud_smooth", "write", "a copy freed of the sensor's noise, marked as such; see `swath smooth`",
        by_default=False,
    ),
    "trajectory.gpkg": Entry("groundproc.products.trajectory_gpkg", "write", "the flown path as lines, for maps"),
    "trajectory.gpx": Entry(
        "groundproc.products.trajectory_maps", "write", "the flown path for phones and globes: trajectory.gpx and .kml", by_default=False
    ),
    "report.html": Entry(
        "groundproc.products.report", "write", "the flight on one page for the browser: verdict, cloud, maps, quality, losses, hashes",
        long=True,
    ),
    "adjustment.png": Entry(
        "groundproc.products.adjustment_plot", "draw", "method adjusted: what it left over, and how well it knows what it estimated"
    ),
    "lasers.png": Entry("groundproc.products.laser_plot", "draw", "lasers: estimate: corrections of the single lasers"),
    "trims.csv": Entry("groundproc.products.trim_table", "write", "method dynamic: the trims of each revolution"),
    "trims.png": Entry("groundproc.products.trim_plot", "draw", "method dynamic: the trims over time"),
}  # fmt: skip
"""All products by name, in the order in which they are made."""
ALWAYS: Final = ("trajectory.csv", "quality.json")
"""What the steps leave whatever is chosen; a survey may name them."""


@dataclass(frozen=True, slots=True)
class Chosen:
    """A product that is to be made.

    Attributes
    ----------
    name : str
    maker : type or callable
        A class of points, or a function of a finished flight.
    options : tuple
        Its `Options` where it has some; else empty.
    long : bool
        As in `Entry`.
    """

    name: str
    maker: Any
    options: tuple[Any, ...]
    long: bool = False

    @property
    def takes_points(self) -> bool:
        """Whether it is made while points are placed."""
        return isinstance(self.maker, type)


def chosen(
    wanted: Sequence[Any] | None, registry: Mapping[str, Entry] = REGISTRY, what: str = "products"
) -> list[Chosen]:
    """The products of a survey, in the order of the registry.

    Parameters
    ----------
    wanted : sequence of str or mapping, optional
        Names; or one name with its options, `{"dsm.tif": {"cell_m": 0.5}}`. Default: all that are made by default.
    registry : mapping of str to Entry
        Of products, or of other things that a survey chooses alike.
    what : str
        The key of the survey, for sentences.

    Raises
    ------
    ConfigError
        A name or an option that there is not, or a product named twice.
    """
    if wanted is None:
        wanted = [name for name, entry in registry.items() if entry.by_default]
    options: dict[str, Any] = {}
    always = ALWAYS if registry is REGISTRY else ()
    for item in wanted:
        if item in always:
            continue
        name = _name(item)
        if name is None or name not in registry:
            raise ConfigError(f"{what}: {item!r} found, expected some of {', '.join((*registry, *always))}")
        if name in options:
            raise ConfigError(f"{what}: {name!r} stands there twice, expected once")
        options[name] = item[name] if isinstance(item, Mapping) else {}
    return [_loaded(name, registry[name], options[name], what) for name in registry if name in options]


def longest_first(products: Iterable[Chosen]) -> list[Chosen]:
    """Products in the order in which they are finished: those that take longest, then the others."""
    return sorted(products, key=lambda each: not each.long)


def plain(products: Iterable[Chosen]) -> dict[str, Any]:
    """Chosen products and their options as plain values by name: what decides whether they are to be made again."""
    return {each.name: [config.to_mapping(options) for options in each.options] for each in products}


def _name(item: Any) -> str | None:
    """Name in one item of the survey's list; None where there is none."""
    if isinstance(item, Mapping) and len(item) == 1:
        (item,) = item
    return item if isinstance(item, str) else None


def _loaded(name: str, entry: Entry, given: Any, what: str) -> Chosen:
    module = importlib.import_module(entry.module)
    own = getattr(module, "Options", None)
    if own is None and given:
        raise ConfigError(f"{what}: {name}: {given!r} found, but it has no options")
    options = () if own is None else (config.from_mapping(given, own, f"{what}: {name}"),)
    return Chosen(name, getattr(module, entry.attribute), options, entry.long)
