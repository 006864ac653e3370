"""What `swath` offers from the ground: one module a command, with HELP, add_arguments(parser) and run(arguments).

A command is imported for one line of `swath --help`, so it imports what it needs to work inside `run`.
"""

from collections.abc import Iterable
from typing import Final

CHAPTERS: Final = {
    "before the flight": ("plan", "simulate"),
    "recordings": ("pull", "info", "import", "recover", "replay", "bag"),
    "from flight to cloud": ("init", "process", "batch", "live", "report", "view", "decode"),
    "trajectory and calibration": ("calibrate", "compass", "ppk", "adjust", "verify-sensor"),
    "after the cloud": ("export", "assess", "raster", "contours", "profile", "tin", "volume", "section", "smooth", "fuse", "merge",
        "tile", "transform"),
    "what people fly for": (
        "ground", "trees", "wires", "pipes", "windows", "detect", "moving", "soil", "change", "displacement", "banks",
        "viewshed", "passability", "reflectance", "orthophoto",
    ),
    "images": ("images", "colour", "ortho", "ndvi", "wide", "mesh", "drape"),
    "this computer": ("warmup", "completion"),
}  # fmt: skip
"""How `swath --help` and docs/commands.md group them; a command of another package is listed at the end."""


def grouped(names: Iterable[str]) -> dict[str, list[str]]:
    """Names of commands by chapter, in the order of the chapters; what no chapter has comes last."""
    left = set(names)
    found = {}
    for chapter, some in CHAPTERS.items():
        if there := [name for name in some if name in left]:
            found[chapter] = there
            left.difference_update(there)
    if left:
        found["others"] = sorted(left)
    return found
