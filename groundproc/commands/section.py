"""`swath section`: a slice through a cloud."""

import argparse
import sys
import tempfile
from pathlib import Path

HELP = "cut a slice out of a cloud, along a line"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force
    from groundproc.commands.selecting import add_all_classes

    parser.add_argument("cloud", type=Path, metavar="CLOUD", help="a LAS, LAZ or COPC file")
    parser.add_argument("--line", required=True, metavar="E,N,E,N", help="both ends, in the CRS of the cloud")
    add_all_classes(parser)
    parser.add_argument("--width", type=float, default=0.5, metavar="W", help="of the slice [m]; default: 0.5")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="FILE",
        help="a cloud (.laz, .las), a table (.csv) or a drawing (.dxf)",
    )
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw it too, .png")
    parser.add_argument("--colour", default="z", metavar="NAME", help="attribute that colours it; default: z")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Cut, and say what is in it."""
    from dataclasses import asdict

    from tqdm import tqdm

    from groundproc.analysis.section import CLOUD_ENDINGS, ENDINGS, section
    from groundproc.analysis.sectionplot import check_colour
    from groundproc.cloud import reader
    from groundproc.cloud.metres import unstated
    from groundproc.commands.figures import warn
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_file, write_json
    from groundproc.commands.values import numbers

    line = numbers(arguments.line, "--line", 4, "E,N,E,N")
    expect([arguments.cloud], CLOUD, CLOUD_WORDS)
    claim_file(arguments.output, ENDINGS, arguments.force, [arguments.cloud])
    for path, suffix in ((arguments.json, ".json"), (arguments.picture, ".png")):
        if path is not None:
            claim_file(path, (suffix,), arguments.force)
    if arguments.picture is not None:
        check_colour(reader.look(arguments.cloud), arguments.colour)
    with tqdm(unit="points", unit_scale=True, leave=False, disable=not sys.stderr.isatty()) as bar:
        made = section(arguments.cloud, arguments.output, line, arguments.width, bar.update, arguments.all_classes)
        if arguments.picture is not None:
            from groundproc.analysis.sectionplot import draw

            with tempfile.TemporaryDirectory(dir=arguments.output.parent) as folder:
                drawn = arguments.output
                if drawn.suffix.lower() not in CLOUD_ENDINGS:  # a picture is drawn of the slice as a cloud
                    drawn = Path(folder) / "section.laz"
                    section(arguments.cloud, drawn, line, arguments.width, bar.update, arguments.all_classes)
                draw(drawn, arguments.picture, arguments.colour)
    if arguments.json is not None:
        write_json(arguments.json, asdict(made))
    warn(unstated(reader.look(arguments.cloud)), sys.stderr)
    print(
        f"{made.points:,} of {made.of:,} points, {made.length_m:.2f} m long, {made.lowest_m:.2f} to {made.highest_m:.2f} m high; "
        f"{arguments.output}"
    )
    if made.no_surface:
        print(f"{made.no_surface:,} points of noise and of what moves were left out; --all-classes takes them")
    return 0
