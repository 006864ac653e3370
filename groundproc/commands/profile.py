"""`swath profile`: heights along lines, of rasters and clouds."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pyproj

    from groundproc.analysis.profile import Line, Profile

HELP = "heights along a line, of rasters and clouds side by side: a table, a drawing, a picture"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument(
        "sources", type=Path, nargs="+", metavar="FILE", help="GeoTIFFs of heights, and clouds (LAS, LAZ, COPC)"
    )
    lines = parser.add_mutually_exclusive_group(required=True)
    lines.add_argument("--line", metavar="E,N,E,N[,...]", help="corners of one line, in the CRS of the first file")
    lines.add_argument(
        "--lines", type=Path, metavar="FILE", help="lines of a GeoPackage or GeoJSON, by their id or name"
    )
    parser.add_argument("--step", type=float, default=0.5, metavar="M", help="between stations [m]; default: 0.5")
    parser.add_argument(
        "--width", type=float, default=0.5, metavar="W", help="of the band of points of a cloud [m]; default: 0.5"
    )
    parser.add_argument(
        "--classes", metavar="N[,N]", help="only points of these classes, such as 2 for ground; default: all but noise"
    )
    parser.add_argument(
        "--exaggeration", type=float, default=1.0, metavar="X", help="of heights in a drawing; default: 1"
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="a name that ends in .csv, .dxf or .png"
    )
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw it too, .png")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Take the heights, and write them."""
    from flightlog.errors import UsageError
    from groundproc.analysis.profilefiles import write_csv, write_drawing
    from groundproc.analysis.profileplot import draw
    from groundproc.commands.inputs import CLOUD, RASTER, expect
    from groundproc.commands.outputs import claim_file
    from groundproc.files import written_aside

    output: Path = arguments.output
    expect(arguments.sources, (*CLOUD, *RASTER), "a raster of heights (GeoTIFF) or a cloud (LAS, LAZ or COPC)")
    claim_file(output, (".csv", ".dxf", ".png"), arguments.force, arguments.sources)
    if arguments.picture is not None:
        claim_file(arguments.picture, (".png",), arguments.force, arguments.sources)
    if not arguments.exaggeration > 0.0:
        raise UsageError(f"--exaggeration {arguments.exaggeration:g}: expected more than 0")
    profiles = _profiles(arguments)
    suffix = output.suffix.lower()
    if suffix == ".png":
        draw(output, profiles)
    else:
        with written_aside(output) as aside:
            if suffix == ".csv":
                write_csv(aside, profiles)
            else:
                write_drawing(aside, profiles, arguments.exaggeration)
    if arguments.picture is not None:
        draw(arguments.picture, profiles)
    _say(profiles)
    print(f"{len(profiles)} profile{'s' if len(profiles) > 1 else ''} in {output}")
    return 0


def _profiles(arguments: argparse.Namespace) -> "list[Profile]":
    """Of all sources, by line; all have to be in one CRS, as far as they state one."""
    from tqdm import tqdm

    from flightlog.errors import CoverageError
    from groundproc.analysis import profile
    from groundproc.cloud.metres import flat
    from groundproc.commands.values import classes

    chosen = None if arguments.classes is None else classes(arguments.classes, "--classes")
    crs = _crs(arguments.sources)
    flat(arguments.sources[0], crs)
    lines = _lines(arguments, crs)
    found: list[Profile] = []
    with tqdm(unit="points", unit_scale=True, leave=False, disable=not sys.stderr.isatty()) as bar:
        for path in arguments.sources:
            if _is_raster(path):
                found += profile.of_raster(path, lines)
            else:
                found += profile.of_cloud(path, lines, arguments.width, chosen, bar.update)
    import numpy as np

    if not any(np.isfinite(each.height_m).any() for each in found):
        raise CoverageError(
            f"{arguments.sources[0]}: no height is known along {'the line' if arguments.line else arguments.lines}"
        )
    return sorted(found, key=lambda each: lines.index(each.line))


def _is_raster(path: Path) -> bool:
    from groundproc.commands.inputs import RASTER
    from groundproc.flight.kinds import kind_of

    kind = kind_of(path)
    return kind is not None and kind.name in RASTER


def _crs(sources: list[Path]) -> "pyproj.CRS | None":
    """The horizontal CRS of the sources; a warning says which states none.

    Raises
    ------
    GeodesyError
        Two are in different ones.
    """
    from flightlog.errors import GeodesyError
    from groundproc.cloud import reader
    from groundproc.raster import geotiff

    first: tuple[Path, pyproj.CRS] | None = None
    for path in sources:
        if _is_raster(path):
            with geotiff.opened(path) as raster:
                crs = raster.crs
        else:
            crs = reader.look(path).crs
        crs = crs.sub_crs_list[0] if crs is not None and crs.is_compound else crs
        if crs is None:
            print(f"swath: warning: {path} states no CRS, and is taken to be in that of the line", file=sys.stderr)
        elif first is None:
            first = path, crs
        elif not crs.equals(first[1], ignore_axis_order=True):
            raise GeodesyError(f"{path} is in {crs.name}, {first[0]} in {first[1].name}; expected files in one CRS")
    return None if first is None else first[1]


def _lines(arguments: argparse.Namespace, crs: "pyproj.CRS | None") -> "list[Line]":
    import numpy as np
    import shapely

    from flightlog.errors import UsageError
    from groundproc.analysis.profile import line_of
    from groundproc.cloud.metres import metres_in
    from groundproc.commands.values import numbers
    from groundproc.vectors.features import names_of, read_features

    unit = metres_in(crs)
    if arguments.line is not None:
        values = numbers(arguments.line, "--line", None, "E,N,E,N")
        if len(values) < 4 or len(values) % 2:
            raise UsageError(
                f"--line {arguments.line}: {len(values)} numbers found, expected E,N of two corners and more"
            )
        return [line_of("line", np.array(values).reshape(-1, 2), arguments.step, unit)]
    features = read_features(arguments.lines, "LineString")
    if crs is not None and features.crs is not None:
        features = features.into(crs)
    names = names_of(features)
    found = []
    for name, shape in zip(names, features.geometry, strict=True):
        parts = shapely.get_parts(shape)
        for number, part in enumerate(parts, 1):
            called = name if len(parts) == 1 else f"{name}.{number}"
            found.append(line_of(called, shapely.get_coordinates(part), arguments.step, unit))
    return found


def _say(profiles: "list[Profile]") -> None:
    import numpy as np

    for each in profiles:
        height = each.height_m[np.isfinite(each.height_m)]
        extent = f"{height.min():.2f} to {height.max():.2f} m" if len(height) else "not known anywhere"
        share = len(height) / len(each.height_m)
        print(f"{each.line.name}: {each.source}: {each.line.along_m[-1]:.2f} m long, {extent}, {share:.0%} of it known")
