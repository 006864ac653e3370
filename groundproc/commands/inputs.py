"""Files that a command is given: that they are there and of the kind that it takes, before the work begins."""

import argparse
import difflib
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Final

LOG: Final = ("log",)
YAML: Final = ("yaml", "survey", "mount", "json", "text", "empty")
"""Any text: what is wrong within it, its reader says better."""
SOLUTIONS: Final = ("solution", "poses")
SOLUTION_WORDS: Final = "an RTKLIB .pos, an SBET, NMEA or a trajectory.csv"
LOG_WORDS: Final = "a flight log (.mcap)"
CLOUD: Final = ("cloud",)
CLOUD_WORDS: Final = "a cloud (LAS, LAZ or COPC)"
RASTER: Final = ("picture",)
RASTER_WORDS: Final = "a raster of heights (GeoTIFF)"
AREA: Final = ("features", "json", "text")
AREA_WORDS: Final = "polygons (GeoPackage or GeoJSON)"
_NAMES: Final = 2000
"""Names of a folder that are looked through for one like that which was typed."""


def expect(paths: Iterable[Path | str | None], kinds: Iterable[str], expected: str) -> None:
    """Refuse files that are not there, or are known to be of another kind; what is of no known kind is left to its reader.

    Parameters
    ----------
    paths : iterable of Path, str or None
        None is passed over.
    kinds : iterable of str
        Names of `groundproc.flight.kinds`.
    expected : str
        The kinds in words.

    Raises
    ------
    CaptureError
    """
    from flightlog.errors import CaptureError
    from groundproc.flight.kinds import kind_of

    allowed = frozenset(kinds)
    for path in (Path(each) for each in paths if each is not None):
        if not path.exists():
            raise CaptureError(f"{path}: no such file{like(path)}; expected {expected}")
        kind = kind_of(path)
        if kind is not None and kind.name not in allowed:
            raise CaptureError(f"{path}: {kind.sentence(path)}{inside(path)}; expected {expected}")


def cloud_in(path: Path) -> Path:
    """A cloud, or that of a folder of products.

    Raises
    ------
    CaptureError
        The folder holds none.
    """
    from flightlog.errors import CaptureError

    if not path.is_dir():
        return path
    for name in ("cloud.laz", "cloud.copc.laz"):
        if (path / name).is_file():
            return path / name
    raise CaptureError(
        f"{path}: a folder without cloud.laz or cloud.copc.laz{inside(path)}; expected {CLOUD_WORDS} or a folder of products"
    )


def expect_text(path: Path | str | None, expected: str) -> None:
    """Refuse what is known to be no text of keys and values; one that is not there, its reader names.

    Raises
    ------
    ConfigError
    """
    from flightlog.errors import CaptureError, ConfigError

    if path is None or not Path(path).exists():
        return
    try:
        expect([path], YAML, expected)
    except CaptureError as error:
        raise ConfigError(str(error)) from None


def told_damage(logs: Iterable[Path]) -> bool:
    """Say on the terminal which logs are cut off or damaged, and what mends them; whether any is."""
    from flightlog.clock import utc_text
    from flightlog.logfile import LogReader
    from groundproc.verdict.log import damage_of

    told = False
    for path in logs:
        with LogReader(path) as log:
            damage, end = log.damage, utc_text(log.end_ns) if log.end_ns else None
            for reason in damage_of(str(path), end, damage.truncated, damage.lost_bytes, damage.bad_chunks):
                print(f"swath: warning: {reason.text}", file=sys.stderr)
                told = True
    return told


def like(path: Path) -> str:
    """A name in the same folder that is nearly the one that was typed, in words."""
    try:
        names = [other.name for _, other in zip(range(_NAMES), path.parent.iterdir(), strict=False)]
    except OSError:
        return ""
    near = difflib.get_close_matches(path.name, names, 1, 0.8)
    return f"; there is {path.parent / near[0]}" if near else ""


def inside(folder: Path) -> str:
    """The logs of a folder, in words."""
    if not folder.is_dir():
        return ""
    logs = sorted(folder.glob("*.mcap"))
    if not logs:
        return ""
    return f"; it holds {logs[0]}" + (f" and {len(logs) - 1} more logs" if len(logs) > 1 else "")


def add_epochs(parser: argparse.ArgumentParser, earlier: str) -> None:
    """Declare a cloud, and the same place earlier; `earlier` says what that one is for."""
    parser.add_argument("cloud", type=Path, metavar="CLOUD", help="a LAS, LAZ or COPC file")
    parser.add_argument("--before", type=Path, metavar="CLOUD", help=f"the same place earlier: {earlier}")
    parser.add_argument("--registered", action="store_true", help="with --before: they lie on each other already")


def epochs(arguments: argparse.Namespace) -> list[Path]:
    """The one cloud or the two that `add_epochs` took, which are there and clouds.

    Raises
    ------
    CaptureError
    UsageError
        Registered, and nothing to be registered with.
    """
    from flightlog.errors import UsageError

    given = [arguments.cloud] + ([] if arguments.before is None else [arguments.before])
    expect(given, CLOUD, CLOUD_WORDS)
    if arguments.registered and arguments.before is None:
        raise UsageError("--registered given, but nothing uses it; expected with --before")
    return given
