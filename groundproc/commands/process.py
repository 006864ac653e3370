"""`swath process`: a flight log in, a georeferenced cloud out."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from groundproc.survey import Survey

HELP = "make a georeferenced cloud of a flight: cloud.laz, trajectory.csv, quality.json, pictures"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG", help="a flight log, or all parts of one flight")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder of the products")
    parser.add_argument("--config", type=Path, metavar="FILE", help="survey.yaml; options here go before it")
    parser.add_argument("--mount", type=Path, metavar="FILE", help="mount.yaml, in place of the one in the log")
    parser.add_argument(
        "--method",
        choices=("best", "adjusted", "filtered", "dynamic", "ins"),
        help="how the trajectory is made; default: best, which is adjusted, or filtered or ins where the log does not hold what that needs",
    )
    parser.add_argument(
        "--causal", action="store_true", default=None, help="adjusted: use nothing of the future, as in flight"
    )
    parser.add_argument(
        "--crs",
        "--epsg",
        metavar="EPSG",
        help="output CRS, such as 32633 or EPSG:32633; default: UTM zone of the first fix",
    )
    parser.add_argument(
        "--height", choices=("msl", "ellipsoid", "relative"), help="what heights refer to; default: msl"
    )
    parser.add_argument("--geoid", metavar="N", help="geoid above the ellipsoid: a number [m] or a PROJ grid file")
    parser.add_argument(
        "--pose-grid",
        metavar="MS",
        help="method ins: one pose for so long, such as 10ms; default: one for every firing",
    )
    parser.add_argument("--sync", choices=("auto", "gyro", "host"), help="how the clocks are tied; default: auto")
    parser.add_argument("--fov", metavar="A-B", help="azimuths kept, clockwise, in degrees, or all; default: 255-105")
    parser.add_argument(
        "--positions",
        type=Path,
        metavar="FILE",
        help="a better GNSS solution or poses (RTKLIB .pos, SBET, NMEA, trajectory.csv), for methods adjusted and filtered",
    )
    parser.add_argument(
        "--control",
        type=Path,
        metavar="CSV",
        help="control points and planes for method adjusted: columns x, y, z, sigma, and more",
    )
    parser.add_argument("--compass", type=Path, metavar="FILE", help="compass model that method dynamic begins with")
    parser.add_argument(
        "--lasers",
        metavar="FILE",
        help="corrections of the single lasers, as `swath calibrate --lasers` writes them; or estimate, to have method adjusted find them",
    )
    parser.add_argument(
        "--trajectory", type=Path, metavar="CSV", help="poses from elsewhere, in place of the autopilot's"
    )
    parser.add_argument("--json", action="store_true", help="print what quality.json holds")


def run(arguments: argparse.Namespace) -> int:
    """Process, with a progress bar on a terminal."""
    from groundproc.progress import stages
    from groundproc.steps.pipeline import process

    survey = _survey(arguments)
    with stages(
        arguments.logs, {"read": "clocks and autopilot", "adjust": "trajectory", "place": "points"}
    ) as progress:
        quality = process(arguments.logs, survey, arguments.output, progress, arguments.trajectory)
    if arguments.json:
        import json

        print(json.dumps(quality, indent=2))
    else:
        print(_report(quality, arguments.output))
    if quality["trajectory"]["warning"]:
        print(f"swath: {quality['trajectory']['warning']}", file=sys.stderr)
        return 1
    return 0


def _survey(arguments: argparse.Namespace) -> Survey:
    """The survey file with the command line's options laid over it."""
    from flightlog import config
    from groundproc.commands.values import field_of_view, milliseconds
    from groundproc.sensors.lasers import ESTIMATE
    from groundproc.survey import Survey

    tree = config.to_mapping(config.load(arguments.config, Survey) if arguments.config else Survey())
    if isinstance(tree["mount"], str):
        tree["mount"] = str(arguments.config.parent / tree["mount"])
    for name in ("compass", "positions", "control", "lasers"):
        if tree[name] not in (None, ESTIMATE):
            tree[name] = str(arguments.config.parent / tree[name])
    given = {
        "crs": arguments.crs,
        "method": arguments.method,
        "causal": arguments.causal,
        "height": arguments.height,
        "geoid": arguments.geoid,
        "sync": arguments.sync,
        "pose_grid_ms": arguments.pose_grid and milliseconds(arguments.pose_grid),
        "fov_deg": arguments.fov and list(field_of_view(arguments.fov)),
        "mount": arguments.mount and str(arguments.mount),
        "compass": arguments.compass and str(arguments.compass),
        "positions": arguments.positions and str(arguments.positions),
        "lasers": arguments.lasers,
        "control": arguments.control and str(arguments.control),
    }
    return config.from_mapping(tree | {k: v for k, v in given.items() if v is not None}, Survey, "command line")


def _report(quality: dict[str, Any], folder: Path) -> str:
    """A few lines for the terminal."""
    sync, points, track = quality["sync"], quality["points"], quality["trajectory"]
    crs, height = quality["crs"], quality["height"]
    east, north, up = track["median_sigma_m"]
    lines = [
        f"{points['written']:,} points in EPSG:{crs['epsg']} ({crs['name']}), heights {height['meaning']}",
        f"trajectory by {track['method']}: {track['covered_s']:.1f} s from {track['start']}, "
        f"sigma {east:.2f} / {north:.2f} / {up:.2f} m (east, north, up)"
        + (f"; {track['note']}" if track["note"] else ""),
        f"sync by {sync['method']}: autopilot = lidar {sync['offset_s']:+.6f} s, sigma {sync['sigma_s'] * 1e3:.2f} ms"
        + (f"; {sync['note']}" if sync["note"] else ""),
        *_control_lines(quality.get(track["method"], {}).get("control")),
        f"mount from {quality['mount']['source']}",
        *_where(folder),
    ]
    return "\n".join(lines)


def _where(folder: Path) -> list[str]:
    """What to look at first, of what was chosen."""
    shown = [folder / name for name in ("cloud_height.png", "cloud_intensity.png") if (folder / name).exists()]
    parts = [f"look at {' and '.join(map(str, shown))}"] if shown else []
    if (figures := folder / "quality.json").exists():
        parts.append(f"all figures are in {figures}")
    return ["; ".join(parts)] if parts else []


def _control_lines(control: dict[str, Any] | None) -> list[str]:
    """How the cloud meets its control points."""
    if not control:
        return []
    lines = []
    for use, name in (("used", "control points"), ("check", "check points, not used")):
        found = control[use]
        if found["count"]:
            lines.append(
                f"{found['count']} {name}: surface off by {found['before_rms_m']:.3f} m rms before, {found['after_rms_m']:.3f} m after "
                f"(expected {found['sigma_m']:.3f})"
            )
    return lines + ([f"control: {control['note']}"] if control["note"] else [])
