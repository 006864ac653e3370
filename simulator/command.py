"""`swath simulate`: a flight in a world with known truth, as files, and played live on request."""

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from simulator.plans import Plan

HELP = "simulate a flight in a known world: flight log, pcap, tlog and the truth"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.add_argument(
        "--flight",
        metavar="NAME",
        help="scene, duration and options of a named flight, or of a file; --flights lists them",
    )
    parser.add_argument("--flights", action="store_true", help="list the named flights and end")
    parser.add_argument(
        "--scene",
        metavar="NAME",
        help="village, field, facade, panels, town, lake, wood, meadow, barefield, crops, slope, facades or bank (village)",
    )
    parser.add_argument("--duration", type=float, metavar="S", help="seconds of flight (20)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="same seed, same bytes (1)")
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="folder for what is written")
    parser.add_argument("--force", action="store_true", help="overwrite existing files")
    parser.add_argument(
        "--config", type=Path, metavar="YAML", help="options, also of a flight; --sample-config shows all"
    )
    parser.add_argument("--sample-config", action="store_true", help="print a commented file of all options and end")
    parser.add_argument(
        "--perfect", nargs="?", const="all", choices=("lidar", "ins", "all"),
        help="take every error out of the lidar, of the INS, or (no word) of both",
    )  # fmt: skip
    parser.add_argument("--returns", choices=("strongest", "last", "dual"), help="return mode of the lidar")
    parser.add_argument("--dark", action="store_true", help="cast no rays: quick, for tests of clocks and rates")
    parser.add_argument("--truth-points", action="store_true", help="write every true echo too (59 bytes each)")
    parser.add_argument(
        "--cameras",
        metavar="RIG",
        help="photographs too, of a named rig or a file of cameras; none: without, where a flight has some",
    )
    parser.add_argument("--workers", type=int, default=2, metavar="N", help="threads that cast rays (2)")
    live = parser.add_argument_group("live", "render first, then play in real time to UDP and a pseudo terminal")
    live.add_argument("--live", action="store_true", help="play what was rendered")
    live.add_argument("--host", default="127.0.0.1", help="address to send the lidar's packets to (127.0.0.1)")
    live.add_argument("--lidar-port", type=int, default=2368, metavar="N", help="UDP port of the data packets (2368)")
    live.add_argument(
        "--position-port", type=int, default=8308, metavar="N", help="UDP port of the position packets (8308)"
    )
    live.add_argument("--pty-link", type=Path, metavar="PATH", help="symbolic link to make to the pseudo terminal")
    live.add_argument(
        "--wait", type=float, default=0.0, metavar="S", help="seconds between opening the terminal and playing"
    )


def run(arguments: argparse.Namespace) -> int:
    """Simulate, write, and play."""
    from tqdm import tqdm

    from flightlog import config
    from flightlog.errors import UsageError
    from simulator import cameras, plans
    from simulator.config import Options
    from simulator.play import Target, play
    from simulator.recording import CAPTURE, TLOG
    from simulator.render import render
    from simulator.simulation import Job

    if arguments.sample_config:
        print(config.sample(Options), end="")
        return 0
    if arguments.flights:
        for name in plans.names():
            print(f"{name:20} {plans.plan(name).about}")
        return 0
    if arguments.output is None:
        raise UsageError("no folder to write to; say -o DIR")
    plan = _plan(arguments)
    _claim(arguments, plan)
    job = Job(
        plan.scene,
        plan.duration_s,
        arguments.seed,
        arguments.output,
        plan.options,
        arguments.workers,
        arguments.truth_points,
        cameras.rig(plan.cameras) if plan.cameras else {},
    )
    quiet = not sys.stderr.isatty()
    with tqdm(total=job.duration_s, unit="s", desc="simulate", disable=quiet, bar_format=_BAR) as bar:
        simulation = render(job, bar.update)
    print(f"{job.directory}: {job.duration_s:g} s of {job.scene}, seed {job.seed}, {simulation.chunks} batches")
    if arguments.live:
        target = Target(
            arguments.host, arguments.lidar_port, arguments.position_port, arguments.pty_link, arguments.wait
        )
        with tqdm(total=job.duration_s, unit="s", desc="play", disable=quiet, bar_format=_BAR) as bar:
            played = play(
                job.directory / CAPTURE, job.directory / TLOG, target, announce=_announce, progress=bar.update
            )
        print(
            f"played {played.packets} packets and {played.frames} MAVLink frames, {played.unread_bytes} bytes unread, "
            f"at most {played.worst_late_s * 1e3:.1f} ms late"
        )
    return 0


def _claim(arguments: argparse.Namespace, plan: "Plan") -> None:
    """Refuse to write over a flight that is there, and options that would not be used."""
    from flightlog.errors import UsageError
    from simulator.recording import FILES, IMAGES, POINTS, RTK

    more = {POINTS: arguments.truth_points, IMAGES: bool(plan.cameras), RTK: plan.options.rtk.hz > 0}
    for name in (*FILES, *(name for name, made in more.items() if made)):
        path = arguments.output / name
        if path.exists() and not arguments.force:
            raise UsageError(f"{path}: exists already; give another name, or --force to write over it")
    if arguments.pty_link is not None and not arguments.live:
        raise UsageError("--pty-link given, but nothing uses it without --live")


_BAR = "{desc}: {percentage:3.0f}%|{bar}| {n:.1f}/{total:.1f} s [{elapsed}<{remaining}]"


def _announce(path: str) -> None:
    print(f"MAVLink on {path}", flush=True)


def _plan(arguments: argparse.Namespace) -> "Plan":
    """What the command line asks for: a flight, changed by what else is said; UsageError for values that cannot be."""
    from flightlog.errors import UsageError
    from simulator import plans
    from simulator.config import perfect

    plan = plans.Plan(duration_s=20.0) if arguments.flight is None else plans.plan(arguments.flight)
    duration_s = plan.duration_s if arguments.duration is None else arguments.duration
    for value, least, name in (
        (duration_s, 1.0, "--duration"),
        (arguments.seed, 0, "--seed"),
        (arguments.workers, 1, "--workers"),
    ):
        if not value >= least:
            raise UsageError(f"{name}: {value} found, expected at least {least:g}")
    options = plan.options if arguments.config is None else plans.changed(plan.options, arguments.config)
    if arguments.returns is not None:
        options = dataclasses.replace(options, lidar=dataclasses.replace(options.lidar, returns=arguments.returns))
    if arguments.dark:
        options = dataclasses.replace(options, lidar=dataclasses.replace(options.lidar, dark=True))
    if arguments.perfect:
        options = perfect(options, arguments.perfect)
    rig = plan.cameras if arguments.cameras is None else "" if arguments.cameras == "none" else arguments.cameras
    scene = arguments.scene or plan.scene
    return dataclasses.replace(plan, scene=scene, duration_s=duration_s, options=options, cameras=rig)
