"""What people fly for, as a part of processing a flight: one file here for each use, and one line in `REGISTRY`.

A use is a function `make(site, options)` of the flight's finished cloud, with its frozen dataclass `Options` beside it. It writes files
into a folder and gives what it found: figures, and a sentence for people. The commands of the same names do the same with any cloud.
"""

from collections.abc import Sequence
from typing import Any, Final

from groundproc.products import Chosen, Entry
from groundproc.products import chosen as of_registry

REGISTRY: Final[dict[str, Entry]] = {
    "ground": Entry(
        "groundproc.uses.ground", "make",
        "ground.laz with classes and heights above ground, dtm.tif, dtm_sigma.tif, chm.tif, buildings.geojson",
    ),
    "trees": Entry("groundproc.uses.trees", "make", "trees.geojson: place, height, crown, stem, dead ones"),
    "wires": Entry("groundproc.uses.wires", "make", "wires.geojson: wires, poles, masts, stays, fences; wires.laz with clearances"),
    "pipes": Entry("groundproc.uses.pipes", "make", "pipes.geojson: axes with diameter, cover and free spans"),
    "windows": Entry(
        "groundproc.uses.windows", "make", "windows.laz: what is behind panes in class 68; walls.geojson"
    ),
    "detect": Entry("groundproc.uses.detect", "make", "objects.geojson: hard targets; penetration.tif: where nothing can be claimed"),
    "moving": Entry("groundproc.uses.moving", "make", "moving.geojson, ways.geojson: what moved, with time, place and speed"),
    "soil": Entry("groundproc.uses.soil", "make", "soil.geojson: patches of ground that stand out by height and reflectance"),
    "banks": Entry("groundproc.uses.banks", "make", "banks.geojson: upper and lower edges of banks, lines of waters"),
    "passability": Entry(
        "groundproc.uses.passability", "make", "passability.tif, slope.tif, step.tif, obstacle.tif: where a vehicle can go"
    ),
    "reflectance": Entry(
        "groundproc.uses.reflectance", "make", "reflectance.laz, calibration.json, and reflectance.tif as an orthophoto"
    ),
}  # fmt: skip
"""All uses by name, in the order in which they are made."""


def chosen(wanted: Sequence[Any] | None) -> list[Chosen]:
    """The uses of a survey, in the order of the registry; none where it names none.

    Raises
    ------
    ConfigError
        A name or an option that there is not, or a use named twice.
    """
    return of_registry(wanted or (), REGISTRY, "uses")
