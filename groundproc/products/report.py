"""report.html: the flight in words, pictures and tables, with its cloud to look around in; one file that needs no network."""

from dataclasses import dataclass
from typing import Final

from flightlog.config import option
from groundproc.products.product import Context
from groundproc.reporting import usesfound
from groundproc.reporting.flightreport import Subject, compose
from groundproc.vectors.tracks import pieces

FILE: Final = "report.html"


@dataclass(frozen=True, slots=True)
class Options:
    """Of the report.

    Attributes
    ----------
    points : int
    most_mb : float
    """

    points: int = option(1_000_000, "points of the cloud that it shows", minimum=1000)
    most_mb: float = option(
        12.0, "size of the file at most [MB]; fewer points are shown where they do not fit", minimum=1.0
    )


def write(context: Context, options: Options) -> None:
    """Write it, of what lies in the folder."""
    trajectory = context.estimate.trajectory
    paths = [context.projection.exact(trajectory.position_m[some]) for some in pieces(trajectory)]
    found = usesfound.read(context.finished)
    subject = Subject(context.finished, context.quality, context.estimate, paths, context.digests, found)
    text = compose(subject, options.points, int(options.most_mb * 1e6), context.foreseen)
    context.aside(FILE).write_text(text, encoding="utf-8")
