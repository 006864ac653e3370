"""`swath export`: a cloud or a trajectory in another format."""

import argparse
import contextlib
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Final

HELP = "write a cloud (COPC, LAZ, LAS, PLY, E57, CSV) or a trajectory (TUM, KITTI, SBET, RTKLIB .pos) in another format"
_TRAJECTORY_KINDS: Final = ("poses", "solution")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force
    from groundproc.commands.selecting import add_selection

    parser.add_argument(
        "source", type=Path, metavar="FILE",
        help="a cloud (LAS, LAZ or COPC), or a trajectory (trajectory.csv, TUM, KITTI or SBET)",
    )  # fmt: skip
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE",
        help="a name that ends in .copc.laz, .laz, .las, .ply, .e57 or .csv; of a trajectory in .tum, .kitti, .sbet, .out, .pos or .csv",
    )  # fmt: skip
    parser.add_argument(
        "--height", choices=("msl", "ellipsoid", "relative"),
        help="what heights of a trajectory are above, where neither it nor the quality.json beside says that",
    )  # fmt: skip
    parser.add_argument(
        "--geoid", metavar="M|GRID",
        help="height of the geoid above the ellipsoid [m], or a grid file: heights above sea level become those above the ellipsoid",
    )  # fmt: skip
    parser.add_argument(
        "--week",
        type=int,
        metavar="N",
        help="GPS week of an SBET that is read, or of a cloud whose times are seconds of the week",
    )
    add_selection(parser)
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Write it; what the input is decides which endings there are."""
    from flightlog.errors import UsageError
    from groundproc.cloud.exports import FORMATS as CLOUDS
    from groundproc.flight.kinds import kind_of
    from groundproc.trajectory.exports import FORMATS as TRAJECTORIES

    output, suffix = arguments.output, arguments.output.suffix.lower()
    clouds = [ending for ending in CLOUDS if output.name.lower().endswith(ending)]
    if not clouds and suffix not in TRAJECTORIES:
        raise UsageError(
            f"-o {output}: expected a name that ends in {', '.join(CLOUDS)} for a cloud, or in {', '.join(TRAJECTORIES)} for a "
            "trajectory"
        )
    kind = kind_of(arguments.source) if arguments.source.is_file() else None
    poses = kind is not None and kind.name in _TRAJECTORY_KINDS
    if suffix in TRAJECTORIES and (poses or not clouds):
        return _trajectory(arguments)
    given = {"--height": arguments.height, "--geoid": arguments.geoid}
    if arguments.times is None:
        given["--week"] = arguments.week
    for word, value in given.items():
        if value is not None and not poses:
            raise UsageError(f"{word}: is for a trajectory, and {arguments.source} is to be written as a cloud")
    return _cloud(arguments)


def _cloud(arguments: argparse.Namespace) -> int:
    """Write a cloud or part of it, with a progress bar on a terminal."""
    from dataclasses import replace

    from tqdm import tqdm

    from groundproc.cloud import exports, reader
    from groundproc.cloud.gpstime import Clock
    from groundproc.cloud.part import write_part
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_file
    from groundproc.commands.selecting import asked, choices_of
    from groundproc.files import removed, written_aside

    output = arguments.output
    expect([arguments.source], CLOUD, CLOUD_WORDS)
    endings = [*dict.fromkeys(f".{ending.rpartition('.')[2]}" for ending in exports.FORMATS), ".copc.laz"]
    claim_file(output, endings, arguments.force, [arguments.source])
    cloud = reader.look(arguments.source)
    left_out: Mapping[str, int] = {}
    bar = tqdm(unit="points", unit_scale=True, leave=False, disable=not sys.stderr.isatty())
    with contextlib.ExitStack() as stack:
        aside = stack.enter_context(written_aside(output))
        stack.enter_context(bar)
        if asked(arguments):
            clock = Clock(week=arguments.week)
            cloud = replace(cloud, choices=tuple(choices_of(arguments, cloud, clock, bar.update)))
            part = stack.enter_context(removed(aside.with_name(f"{aside.name}.laz")))
            left_out = write_part(cloud, part, clock if arguments.times is not None else None, bar.update)
            cloud = reader.look(part)
        exports.write(cloud, output, aside, bar.update)
    told = ", ".join(f"{count:,} by {name}" for name, count in left_out.items())
    print(f"{cloud.points:,} points in {output}" + (f"; left out: {told}" if told else ""))
    return 0


def _trajectory(arguments: argparse.Namespace) -> int:
    """Write a trajectory; the file that was named appears last."""
    from flightlog.errors import UsageError
    from groundproc.commands.inputs import expect
    from groundproc.commands.outputs import claim_file
    from groundproc.commands.selecting import asked
    from groundproc.files import written_aside
    from groundproc.trajectory import exports
    from groundproc.trajectory.exports.source import read_source

    words = "a trajectory (trajectory.csv, TUM, KITTI or SBET)"
    expect([arguments.source], (*_TRAJECTORY_KINDS, "gzip"), words)
    if arguments.geoid is not None and exports.FORMATS[arguments.output.suffix.lower()] not in ("sbet", "pos"):
        raise UsageError(
            f"--geoid {arguments.geoid}: is for .sbet, .out and .pos; {arguments.output.suffix} keeps the heights as they are"
        )
    if asked(arguments):
        raise UsageError("--times, --area, --lines and --without-classes: are for a cloud, expected no trajectory")
    writers = exports.writers(arguments.output)
    for path in writers:
        suffixes = tuple(exports.FORMATS) if path == arguments.output else (path.suffix.lower(),)
        claim_file(path, suffixes, arguments.force, [arguments.source])
    source = read_source(arguments.source, height=arguments.height, geoid=arguments.geoid, week=arguments.week)
    with contextlib.ExitStack() as stack:
        asides = {path: stack.enter_context(written_aside(path)) for path in writers}
        for path, write in writers.items():
            write(source, asides[path])
    print(f"{len(source.trajectory):,} poses in {' and '.join(map(str, writers))}")
    return 0
