"""`swath reflectance`: the diffuse reflectance of every echo."""

import argparse
import sys
from pathlib import Path
from typing import Any

HELP = "calibrate intensities: the diffuse reflectance of every echo, from targets of known reflectance"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force
    from groundproc.commands.selecting import add_all_classes

    parser.add_argument("clouds", nargs="+", type=Path, metavar="CLOUD", help="LAS, LAZ or COPC files of one flight")
    parser.add_argument(
        "-t", "--trajectory", type=Path, metavar="FILE",
        help="trajectory.csv, SBET, RTKLIB .pos or NMEA of the flight; default: recovered from shots with several echoes",
    )  # fmt: skip
    parser.add_argument(
        "--targets", type=Path, metavar="FILE",
        help="GeoPackage or GeoJSON with polygons of known reflectance: column reflectance (0 to 1), or reflectance_0, "
        "reflectance_15, ... by degrees of incidence",
    )  # fmt: skip
    parser.add_argument("--visibility-km", type=float, metavar="V", help="visibility; default: the air takes nothing")
    parser.add_argument("--wavelength-nm", type=float, default=905.0, metavar="NM", help="of the laser; default: 905")
    parser.add_argument(
        "--intensity", metavar="KIND",
        help="compensated (for the range, by the sensor), amplitude, amplitude-db or decibel (reflectance in dB); "
        "default: recognised, and reported",
    )  # fmt: skip
    parser.add_argument(
        "--lever", type=float, nargs=3, default=(0.0, 0.0, 0.0), metavar=("RIGHT", "FORWARD", "UP"),
        help="sensor in the body frame of the trajectory [m]; default: 0 0 0",
    )  # fmt: skip
    add_place(parser)
    add_all_classes(parser)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder of the results")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    add_force(parser)


def add_place(parser: argparse.ArgumentParser) -> None:
    """Options by which a trajectory is laid over a cloud."""
    parser.add_argument("--crs", metavar="EPSG", help="projected CRS of the clouds; default: as they state")
    parser.add_argument("--week", type=int, metavar="N", help="GPS week, where the files have only seconds of it")
    parser.add_argument(
        "--geoid", type=float, default=0.0, metavar="N",
        help="taken off the trajectory's heights, where those of the cloud are above the geoid [m]",
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Calibrate, and say what came of it."""
    from tqdm import tqdm

    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, SOLUTION_WORDS, SOLUTIONS, expect
    from groundproc.commands.outputs import claim_file, claim_folder, write_json
    from groundproc.geodesy import projected_crs

    expect(arguments.clouds, CLOUD, CLOUD_WORDS)
    expect([arguments.trajectory], SOLUTIONS, SOLUTION_WORDS)

    from groundproc.radiometry import work
    from groundproc.radiometry.site import Task

    names = [path.with_suffix(".laz").name for path in arguments.clouds]
    if all(path.resolve() != (arguments.output / path.with_suffix(".laz").name).resolve() for path in arguments.clouds):
        claim_folder(arguments.output, (*names, work.REPORT), arguments.force)
    if arguments.json is not None:
        claim_file(arguments.json, (".json",), arguments.force)
    task = Task(
        arguments.clouds, arguments.output, arguments.trajectory, arguments.targets, arguments.intensity,
        arguments.visibility_km, arguments.wavelength_nm, None if arguments.crs is None else projected_crs(arguments.crs),
        arguments.week, arguments.geoid, tuple(arguments.lever), arguments.all_classes,
    )  # fmt: skip
    with tqdm(unit="points", unit_scale=True, leave=False, disable=not sys.stderr.isatty()) as bar:

        def advance(stage: str, count: int) -> None:
            bar.set_description(stage, refresh=False)
            bar.update(count)

        told = work.run(task, advance)
    if arguments.json is not None:
        write_json(arguments.json, told)
    for line in told["warnings"]:
        print(f"swath: warning: {line}", file=sys.stderr)
    print(_text(told, arguments.output))
    return 0


def _text(told: dict[str, Any], folder: Path) -> str:
    sigma = "" if told["c_cal_sigma"] is None else f", sigma {told['c_cal_sigma']:.3g}"
    lines = [
        f"intensities are {told['intensity']} ({told['recognised_by']}); sensor: {told['sensor_path']}",
        f"c_cal {told['c_cal']:.6g}{sigma}"
        + (" (relative)" if told["relative"] else f" from {len(told['targets'])} targets"),
    ]
    for each in told["strips"]:
        if each["raw_percent"] is not None and each["reflectance_percent"] is not None:
            lines.append(
                f"strip {each['strip']}: {each['raw_percent']:+.1f} % against the others before, "
                f"{each['reflectance_percent']:+.1f} % after ({each['patches']} patches of 1 m)"
            )
            if each["surface_percent"] is not None:
                lines.append(
                    f"    on surfaces {each['surface_percent']:+.1f} %; single patches are {each['surface_cells_percent']:.1f} % off, "
                    f"where their echoes' own scatter is {each['surface_expected_percent']:.1f} %"
                )
    power, sigma = told["leaves"]["exponent"], told["leaves"]["sigma"]
    if power:
        lines.append(f"leaves: by the cosine from the vertical to the power of {power:.2f} (sigma {sigma:.2f})")
    points = told["points"]
    lines.append(
        f"{points['all']:,} points in {folder}, {points['on_surface'] / points['all']:.0%} of them on a surface"
    )
    return "\n".join(lines)
