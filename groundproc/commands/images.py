"""`swath images`: a block of images adjusted, with or without lidar, INS and control."""

import argparse
import contextlib
import json
import sys
from pathlib import Path
from typing import Any

TABLE = ("control", "table", "text", "gzip", "empty")
HELP = "adjust images: poses, cameras and points from tie points, trajectory, control and lidar"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument(
        "inputs", nargs="*", type=Path, metavar="[LOG] IMAGES", help="images, folders of them, a flight log"
    )
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", required=True, help="folder of the results")
    parser.add_argument(
        "-t",
        "--trajectory",
        type=Path,
        metavar="FILE",
        help="trajectory.csv, or the folder of an estimate, instead of a log",
    )
    parser.add_argument(
        "--rig",
        type=Path,
        metavar="FILE",
        help="rig.yaml (Kalibr), cameras.txt (COLMAP) or camera_models.json (OpenSfM)",
    )
    parser.add_argument("--cloud", type=Path, metavar="LAS", help="cloud of the place: its surface holds tie points")
    parser.add_argument("--control", type=Path, metavar="CSV", help="surveyed points: name,x,y,z,sigma[,sigma_z],use")
    parser.add_argument(
        "--image-points",
        type=Path,
        metavar="CSV",
        help="image,point,x_px,y_px[,sigma]: adjusted as they are, nothing matched",
    )
    parser.add_argument("--marks", type=Path, metavar="CSV", help="the same beside what is matched")
    parser.add_argument("--start", type=Path, metavar="CSV", help="first poses, columns of poses.csv; no observations")
    parser.add_argument(
        "--times",
        type=Path,
        metavar="FILE",
        help="which image when: .MRK, a CSV with image,utc_ns, or a log (.mcap, .tlog, .bin)",
    )
    parser.add_argument(
        "--positions", type=Path, metavar="FILE", help="with a log: better positions, as `swath process` takes them"
    )
    parser.add_argument(
        "--geoid", metavar="M|GRID", help="with --positions: height of the geoid, if their heights are another kind"
    )
    parser.add_argument("--crs", "--epsg", metavar="EPSG", help="projected CRS; default: the cloud's, or a UTM zone")
    parser.add_argument(
        "--hybrid", choices=("gained", "true"), default="gained",
        help="what hybrid/trajectory.csv holds for `swath process --poses`: what images add to the trajectory, or adjusted poses that "
        "are taken to be true; default: gained",
    )  # fmt: skip
    parser.add_argument(
        "--hybrid-every",
        type=float,
        default=0.0,
        metavar="S",
        help="at most one of these in so many seconds; default: 0, all",
    )
    parser.add_argument("--json", action="store_true", help="print what bundle.json holds")
    add_force(parser)


def run(arguments: argparse.Namespace) -> int:
    """Adjust, and say how good it is."""
    from tqdm import tqdm

    from flightlog.errors import UsageError
    from groundproc.commands.inputs import CLOUD, CLOUD_WORDS, expect
    from groundproc.commands.outputs import claim_folder
    from groundproc.imagery import results, work

    logs = [path for path in arguments.inputs if path.suffix.lower() == ".mcap"]
    images = tuple(path for path in arguments.inputs if path not in logs)
    if len(logs) > 1:
        raise UsageError(f"{logs[1]}: a second log; expected one")
    if logs and arguments.trajectory is not None:
        raise UsageError(f"--trajectory and {logs[0]}: one of the two")
    if arguments.positions is not None and not logs:
        raise UsageError("--positions: nothing uses it without a flight log")
    if not images and arguments.image_points is None:
        raise UsageError("IMAGES are missing; expected swath images [LOG] IMAGES... -o DIR, or --image-points")
    if arguments.image_points is not None and arguments.marks is not None:
        raise UsageError("--image-points and --marks: one of the two")
    expect([arguments.cloud], CLOUD, CLOUD_WORDS)
    expect([arguments.control, arguments.image_points, arguments.marks], TABLE, "a table (CSV)")
    expect([arguments.start], (*TABLE, "orientations"), "poses of images (CSV)")
    claim_folder(arguments.output, results.FILES, arguments.force)
    geoid: float | str | None = arguments.geoid
    with contextlib.suppress(ValueError, TypeError):
        geoid = float(arguments.geoid)
    task = work.Task(
        arguments.output, images, logs[0] if logs else None, arguments.trajectory, arguments.rig, arguments.cloud,
        arguments.control, arguments.image_points, arguments.marks, arguments.start, arguments.times, arguments.crs,
        arguments.positions, geoid, arguments.hybrid, arguments.hybrid_every,
    )  # fmt: skip
    with tqdm(unit="", leave=False, disable=not sys.stderr.isatty()) as bar:

        def advance(stage: str, count: float) -> None:
            bar.set_description(stage, refresh=False)
            bar.update(1)

        told = work.run(task, advance)
    for warning in told["warnings"]:
        print(f"swath: warning: {warning}", file=sys.stderr)
    for image, why in told["left_out"].items():
        print(f"swath: warning: {image} is left out: {why}", file=sys.stderr)
    print(json.dumps(told, indent=2) if arguments.json else text(told, arguments.output))
    return 3 if told["warnings"] or told["left_out"] else 0


def text(told: dict[str, Any], folder: Path) -> str:
    """A few lines for the terminal."""
    counts = told["counts"]
    sigma0 = "none" if told["sigma0"] is None else f"{told['sigma0']:.4f}"
    size = f"{told['observations']:,} observations, {told['unknowns']:,} unknowns"
    lines = [
        f"{counts['images']} images, {counts['points']:,} points, {counts['image_points']:,} image points; {size}",
        f"sigma0 {sigma0}, residuals {told['residual_rms_px']:.3f} px RMS; {told['datum']}",
    ]
    for camera in told["cameras"]:
        values = [f"{name} {camera['values'][name]:.6g} (sigma {sigma:.2g})" for name, sigma in camera["sigma"].items()]
        if values:
            lines.append(f"{camera['name']}: {', '.join(values)}")
    for kind in ("control", "check"):
        errors = told[kind]
        if errors:
            rms = [(sum(one[axis] ** 2 for one in errors) / len(errors)) ** 0.5 for axis in ("dx", "dy", "dz")]
            lines.append(f"{len(errors)} {kind} points: RMS {rms[0]:.3f} east, {rms[1]:.3f} north, {rms[2]:.3f} m up")
    lines.append(f"poses.csv, rig.yaml, points.csv, bundle.json and colmap/ in {folder}")
    return "\n".join(lines)
