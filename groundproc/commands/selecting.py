"""Options by which a command takes part of a cloud: by time, area, flight line and class."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from groundproc.cloud.gpstime import Clock
    from groundproc.cloud.reader import Cloud
    from groundproc.cloud.selection import Choice

_LAST_CLASS, _LAST_LINE = 255, 65535
WORDS: Final = ("times", "area", "area_keeps", "lines", "without_classes")


def add_selection(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--times", metavar="SPANS",
        help="spans of time kept, START/END between commas: seconds from the first point (60/480), or UTC (2026-05-01T10:02:00Z/)",
    )  # fmt: skip
    parser.add_argument(
        "--area", type=Path, metavar="FILE", help="polygons (GeoPackage or GeoJSON, in any CRS that they state)"
    )
    parser.add_argument(
        "--area-keeps",
        choices=("inside", "outside"),
        help="what is kept where there is an area; default: inside",
    )
    parser.add_argument("--lines", metavar="NUMBERS", help="flight lines kept (point_source_id): 1,3-5")
    parser.add_argument(
        "--without-classes", metavar="NUMBERS", help="classes left out: 7,18,69 are noise and what moved"
    )


def add_all_classes(
    parser: argparse.ArgumentParser, words: str = "noise and what moves (classes 7, 18 and 69) count too"
) -> None:
    """Declare the one option by which surfaces are made of noise and of what moves too."""
    parser.add_argument("--all-classes", action="store_true", help=words)


def asked(arguments: argparse.Namespace) -> bool:
    """Whether part of the cloud is wanted only."""
    return any(getattr(arguments, name) is not None for name in WORDS)


def choices_of(
    arguments: argparse.Namespace, cloud: Cloud, clock: Clock, progress: Callable[[int], object]
) -> list[Choice]:
    """What the command line wants of a cloud.

    Raises
    ------
    UsageError, CaptureError, GeodesyError
        A value or a file is not as it should be, or the cloud does not have what is asked about.
    """
    from flightlog.errors import UsageError
    from groundproc.cloud.part import times_of
    from groundproc.cloud.selection import Classes, Lines
    from groundproc.commands.inputs import AREA, AREA_WORDS, expect
    from groundproc.vectors.area import read_area

    found: list[Choice] = []
    if arguments.times is not None:
        found.append(times_of(cloud, tuple(arguments.times.split(",")), clock, progress))
    if arguments.area is not None:
        expect([arguments.area], AREA, AREA_WORDS)
        found.append(read_area(arguments.area, cloud.horizontal, arguments.area_keeps == "outside"))
    elif arguments.area_keeps is not None:
        raise UsageError(f"--area-keeps {arguments.area_keeps}: expected with --area FILE")
    if arguments.lines is not None:
        found.append(Lines(_numbers(arguments.lines, "--lines", _LAST_LINE)))
    if arguments.without_classes is not None:
        found.append(Classes(_numbers(arguments.without_classes, "--without-classes", _LAST_CLASS)))
    return found


def _numbers(text: str, word: str, last: int) -> frozenset[int]:
    """Whole numbers and ranges between commas."""
    from flightlog.errors import UsageError

    found: set[int] = set()
    for part in text.split(","):
        low, _, high = part.strip().partition("-")
        high = high or low
        if not (low.isdecimal() and high.isdecimal() and int(low) <= int(high) <= last):
            raise UsageError(
                f"{word} {text!r}: expected whole numbers of 0 to {last} and ranges of them between commas, such as 1,3-5"
            )
        found |= set(range(int(low), int(high) + 1))
    return frozenset(found)
