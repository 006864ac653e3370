"""`swath merge`: clouds of several flights in one, their flight lines numbered through."""

import argparse
import sys
from pathlib import Path

HELP = "merge clouds of several flights that lie in one CRS: point_source_id numbers the flight lines of all"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument(
        "clouds",
        nargs="+",
        type=Path,
        metavar="CLOUD",
        help="LAS, LAZ or COPC, or folders of `swath process`; two or more",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="FILE",
        help="the cloud, a name that ends in .laz or .copc.laz",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write which line is of which file to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Merge, and say which lines are whose."""
    import contextlib

    from tqdm import tqdm

    from flightlog.errors import UsageError
    from groundproc.cloud import exports, reader
    from groundproc.cloud.flightlines import merge
    from groundproc.cloud.sameness import agreed_crs, agreed_times
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, cloud_in, expect
    from groundproc.commands.outputs import claim_file, write_json
    from groundproc.files import removed, written_aside

    paths = [cloud_in(each) for each in arguments.clouds]
    if len(paths) < 2:
        raise UsageError(f"one cloud given, {paths[0]}; expected two or more")
    again = [path for n, path in enumerate(paths) if path.resolve() in {each.resolve() for each in paths[:n]}]
    if again:
        raise UsageError(f"{again[0]}: given twice; expected each cloud once")
    expect(paths, CLOUD, CLOUD_WORDS)
    claim_file(arguments.output, (".laz", ".copc.laz"), arguments.force, paths)
    if arguments.json is not None:
        claim_file(arguments.json, (".json",), arguments.force)
    clouds = [reader.look(path) for path in paths]
    if agreed_crs(clouds) is None:
        print(
            f"swath: warning: {paths[0]} and the others state no CRS, and so the merged cloud states none",
            file=sys.stderr,
        )
    agreed_times(clouds)
    bar = tqdm(unit="points", unit_scale=True, leave=False, disable=not sys.stderr.isatty())
    with contextlib.ExitStack() as stack:
        stack.enter_context(bar)
        aside = stack.enter_context(written_aside(arguments.output))
        if exports.format_of(arguments.output) == "copc":
            plain = stack.enter_context(removed(aside.with_name(f"{aside.name}.laz")))
            lines = merge(clouds, plain, bar.update)
            exports.write(reader.look(plain), arguments.output, aside, bar.update)
        else:
            lines = merge(clouds, aside, bar.update)
    if arguments.json is not None:
        write_json(arguments.json, {"flight_lines": [line.tell() for line in lines]})
    for path in paths:
        own = [line for line in lines if line.file == str(path)]
        numbers = f"{own[0].number} to {own[-1].number}" if len(own) > 1 else f"{own[0].number}"
        print(f"{path}: {sum(line.points for line in own):,} points, flight lines {numbers}")
    print(f"{sum(line.points for line in lines):,} points in {arguments.output}")
    return 0
