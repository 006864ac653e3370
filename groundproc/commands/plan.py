"""`swath plan`: lines over an area, the density that they give, and a mission to load into the ground station."""

import argparse
import sys
from pathlib import Path

HELP = "plan a flight: lines over an area for a density or an overlap, as a mission file and a picture"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument("area", type=Path, metavar="AREA", help="one polygon with a CRS: GeoPackage or GeoJSON")
    parser.add_argument("--height", type=float, required=True, metavar="M", help="above the ground [m]")
    parser.add_argument("--speed", type=float, required=True, metavar="M/S", help="over the ground [m/s]")
    lines = parser.add_mutually_exclusive_group()
    lines.add_argument("--density", type=float, metavar="N", help="least number of points a square metre, anywhere")
    lines.add_argument("--spacing", type=float, metavar="M", help="distance of the lines [m]")
    lines.add_argument("--overlap", type=float, metavar="SHARE", help="of neighbouring strips, 0 to 0.95; default: 0.5")
    parser.add_argument("--heading", type=float, metavar="DEG", help="of the lines; default: along the longer side")
    parser.add_argument(
        "--margin", type=float, default=10.0, metavar="M", help="of each line beyond the area; default: 10"
    )
    parser.add_argument("--battery", type=float, metavar="MIN", help="flying time of one battery [min]")
    parser.add_argument(
        "--calibrate", action="store_true", help="begin with a cross that mount and compass are estimated from"
    )
    parser.add_argument(
        "--mount", type=Path, metavar="FILE", help="how the lidar sits on the airframe; default: 20 deg forward"
    )
    parser.add_argument(
        "--pitch", type=float, metavar="DEG", help="of the aircraft on a line, nose up; default: -1.5 for each m/s"
    )
    parser.add_argument("--fov-deg", default="255-105", metavar="A-B", help="azimuths that are kept; default: 255-105")
    parser.add_argument("--max-range", type=float, default=70.0, metavar="M", help="farthest echo [m]; default: 70")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="the mission, .waypoints; FILE.png beside it"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Plan it, and say what it gives."""
    from flightlog.errors import UsageError
    from flightlog.mount import Mount, load_mount
    from groundproc.commands.outputs import claim_file, write_json
    from groundproc.commands.values import field_of_view
    from groundproc.planning.mission import write_mission
    from groundproc.planning.picture import draw
    from groundproc.planning.plan import Wish, plan
    from groundproc.sensors.shots import Gate

    for value, low, high, word in (
        (arguments.height, 1.0, 200.0, "--height"), (arguments.speed, 0.1, 30.0, "--speed"),
        (arguments.spacing, 0.5, 500.0, "--spacing"), (arguments.density, 0.1, 1e5, "--density"),
        (arguments.overlap, 0.0, 0.95, "--overlap"), (arguments.battery, 1.0, 600.0, "--battery"),
        (arguments.margin, 0.0, 500.0, "--margin"), (arguments.max_range, 1.0, 200.0, "--max-range"),
        (arguments.heading, -360.0, 360.0, "--heading"), (arguments.pitch, -60.0, 60.0, "--pitch"),
    ):  # fmt: skip
        if value is not None and not low <= value <= high:
            raise UsageError(f"{word} {value:g}: expected {low:g} to {high:g}")
    picture = arguments.output.with_suffix(".png")
    claim_file(arguments.output, (".waypoints", ".txt"), arguments.force, [arguments.area])
    claim_file(picture, (".png",), arguments.force)
    if arguments.json is not None:
        claim_file(arguments.json, (".json",), arguments.force)
    start, end = field_of_view(arguments.fov_deg)
    wish = Wish(
        arguments.area, arguments.height, arguments.speed, arguments.spacing, arguments.density, arguments.overlap,
        arguments.heading, None if arguments.battery is None else 60.0 * arguments.battery, arguments.calibrate,
        Mount() if arguments.mount is None else load_mount(arguments.mount),
        Gate(fov_start_deg=start, fov_end_deg=end, max_range_m=arguments.max_range), arguments.margin,
        arguments.pitch,
    )  # fmt: skip
    made = plan(wish)
    write_mission(arguments.output, *made.places_deg(), arguments.height, arguments.speed)
    draw(picture, made.area, made.route, made.coverage)
    told = made.figures()
    if arguments.json is not None:
        write_json(arguments.json, told)
    density = told["density"]
    batteries = (
        "" if arguments.battery is None else f", {made.batteries} {'battery' if made.batteries == 1 else 'batteries'}"
    )
    overlap = f"overlap {told['overlap']:.0%}" if told["overlap"] >= 0.005 else "no overlap"
    print(
        f"{told['lines']} lines {told['spacing_m']:.1f} m apart, {told['length_m'] / 1000.0:.2f} km, "
        f"{told['seconds'] / 60.0:.1f} min{batteries}\n"
        f"{density['mean']:.0f} points a square metre in the mean, at least {density['tenth']:.0f} on nine tenths of the area and "
        f"{density['least']:.0f} everywhere, on level ground; {overlap}\n{arguments.output}: written; look at {picture}"
    )
    if told["gaps"] > 0.0:
        print(
            f"swath: warning: {told['gaps']:.1%} of the area gets less than one point a square metre; set lines closer (--spacing), "
            "or begin them farther out (--margin)",
            file=sys.stderr,
        )
    return 0
