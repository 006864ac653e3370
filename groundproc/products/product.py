"""What a product is, what it is told, and how chosen ones are made: written aside, with their name in an error."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import pyproj

from flightlog import __version__
from flightlog.errors import SourceError, SwathError
from groundproc.cloud.packer import round_origin_m
from groundproc.cloud.points import Points
from groundproc.cloud.setaside import SetAside
from groundproc.files import written_aside
from groundproc.geodesy import Projection, with_sea_level
from groundproc.products import Chosen
from groundproc.raster.layers import Layers
from groundproc.survey import Survey
from groundproc.trajectory.estimate import Estimate

if TYPE_CHECKING:
    from groundproc.reporting.cloudpart import Foreseen


@dataclass(frozen=True, slots=True)
class Context:
    """What a product may know of the flight.

    Attributes
    ----------
    folder : Path
        To write into.
    finished : Path
        Where what was made before lies.
    survey : Survey
    estimate : Estimate
        Trajectory, mount, lasers; `figures` and `report` of the method.
    projection : Projection
        From the trajectory's local frame to coordinates of the points.
    quality : dict
        What quality.json holds: inputs, versions, settings, figures. Empty while points are placed.
    digests : mapping of str to str
        SHA-256 of the logs and of what the steps before have made, by name. Empty while points are placed.
    inputs : tuple of str
        Names of the logs.
    software : str
        What makes it.
    layers : Layers
        Rasters made in the same pass.
    foreseen : Foreseen, optional
        What the report will ask of the cloud, read while others were finished.
    set_aside : SetAside, optional
        Keeps points of cloud.laz for the report as they are written.
    kept : contextlib.ExitStack
        Of this product alone: what is entered here is left when the product is finished, or has failed.
    """

    folder: Path
    finished: Path
    survey: Survey
    estimate: Estimate
    projection: Projection
    quality: dict[str, Any] = field(default_factory=dict)
    digests: Mapping[str, str] = field(default_factory=dict)
    inputs: tuple[str, ...] = ()
    software: str = f"swath {__version__}"
    layers: Layers = field(default_factory=Layers)
    foreseen: "Foreseen | None" = None
    set_aside: SetAside | None = None
    kept: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)

    @property
    def crs(self) -> pyproj.CRS:
        """The CRS that files state: with EGM 96 as the height reference where heights are above sea level."""
        crs = self.projection.crs
        return with_sea_level(crs) if self.survey.height == "msl" else crs

    @property
    def origin_m(self) -> tuple[float, float, float]:
        """A round place near where the flight began, shape (3,), for numbers that are to be small."""
        return round_origin_m(self.projection.exact(self.estimate.trajectory.position_m[:1])[0])

    def aside(self, name: str) -> Path:
        """A path to write a file of the folder to; it gets its name when the product is finished, and is removed if that fails."""
        return self.kept.enter_context(written_aside(self.folder / name))


class Product(Protocol):
    """Is made while the points are placed, in one pass."""

    def begin(self, context: Context) -> None:
        """Get ready."""

    def add(self, points: Points) -> None:
        """Take some projected points; their arrays are not to be changed."""

    def finish(self) -> None:
        """All points were given."""


class Making:
    """A product being made: what the placing stage hands points to.

    Parameters
    ----------
    name : str
    product : Product
    context : Context
    """

    def __init__(self, name: str, product: Product, context: Context) -> None:
        self._name, self._product, self._context = name, product, context

    def begin(self) -> None:
        """Begin it."""
        with named(self._name):
            self._product.begin(self._context)

    def add(self, points: Points) -> None:
        """Hand it points."""
        with named(self._name):
            self._product.add(points)

    def finish(self) -> None:
        """Finish it, and give its files their names."""
        with named(self._name):
            self._product.finish()
            self._context.kept.close()


@contextlib.contextmanager
def streamed(chosen: Sequence[Chosen], context: Context) -> Iterator[list[Making]]:
    """Those of the chosen products that take points; what is not finished when this is left leaves nothing behind."""
    with contextlib.ExitStack() as stack:
        making = []
        for each in chosen:
            if each.takes_points:
                own = replace(context, kept=stack.enter_context(contextlib.ExitStack()))
                making.append(Making(each.name, each.maker(*each.options), own))
        yield making


def draw(chosen: Sequence[Chosen], context: Context) -> None:
    """Make those of the chosen products that are functions of a finished flight."""
    for each in chosen:
        if not each.takes_points:
            with named(each.name), contextlib.ExitStack() as kept:
                each.maker(replace(context, kept=kept), *each.options)


@contextlib.contextmanager
def named(name: str) -> Iterator[None]:
    """Say which product an error is of."""
    try:
        yield
    except SwathError as error:
        raise type(error)(f"{name}: {error}") from error
    except OSError as error:
        raise SourceError(f"{name}: cannot be made ({error.strerror or error})") from error
    except Exception as error:  # a mistake of ours: it stays what it is
        error.add_note(f"while the product {name} was made")
        raise
