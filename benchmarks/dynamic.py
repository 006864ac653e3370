"""The dynamic calibration under the conditions of its source, and under harsher ones: what it finds, and how fast.

A car drives along facades at 30 m with a compass that is off by 5 deg (the named flight `drive`), and a multirotor flies round a house with
an INS that is worse in everything (`harsh`). Each is processed as it is (`ins`), to the letter of the source (`source`) and with what makes
the method robust (`robust`). The folder of results gets dynamic_drive.png and dynamic_harsh.png: yaw trim and truth over time, and a
slice through a facade before and after. The last line is one JSON object: for each flight and trajectory under its name

heading_settle_s    seconds until the heading is right within 1 deg for 3 s on end; null: never
heading_within      share of the time from `SETTLED_S` on in which it is
heading_rms_deg     RMS of its error over that time, and
heading_mean_deg    its mean
ate_m               RMS error of positions over that time, after one rigid alignment
facade_m            thickness of all facades, each about a plane of its own, over the same time
real_time_factor    seconds of flight in a CPU-second of the search, one core
"""

import argparse
import dataclasses
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
import numpy.typing as npt

from flightlog.frames import mat_from_quat
from flightlog.hdl32e import FIRING_NS, LASERS
from flightlog.logfile import LogReader
from flightlog.mount import Mount
from groundproc.accuracy.alignment import align
from groundproc.accuracy.truth import Truth, on_lidar_clock, read_truth
from groundproc.cloud.georeference import georeference
from groundproc.estimation import direct
from groundproc.estimation.dynamic.revolutions import revolutions
from groundproc.estimation.dynamic.search import Found, Search
from groundproc.estimation.dynamic.trims import applied, interpolated
from groundproc.estimation.method import Given, gather
from groundproc.flight.flight import read_flight
from groundproc.flight.mounting import find_mount
from groundproc.flight.pairing import legs
from groundproc.flight.shots import shots
from groundproc.flight.timeline import Leg
from groundproc.sensors.shots import Gate
from groundproc.survey import Survey
from groundproc.survey.dynamic import ROBUST, SOURCE, DynamicOptions
from groundproc.trajectory.trajectory import Trajectory

mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.lines import Line2D

Array = npt.NDArray[np.float64]

ROOT: Final = Path(__file__).resolve().parents[1]
RESULTS: Final = ROOT / "build" / "bench-dynamic"
FLIGHTS: Final = {"drive": 30.0, "harsh": 30.0}
SETTLED_S: Final = 8.0
"""From here on a trajectory is judged: the flights stand for 3 s, and trims may take 5 s."""
GATE: Final = Gate(255.0, 105.0, 1.0, 60.0)
EVERY: Final = 12
"""One point in so many is judged."""
WARM: Final = 5
"""Revolutions before the clock runs."""
LEAST_POINTS: Final = 3000
PLANE_M: Final = 0.03
"""Points within this of an upright plane of the true cloud are of a facade."""


@dataclass(frozen=True, slots=True)
class Made:
    """A trajectory on the lidar's clock in the truth's frame, with its yaw trims where it has some."""

    trajectory: Trajectory
    trim_ns: npt.NDArray[np.int64]
    yaw_deg: Array
    real_time_factor: float | None


def trimmed(given: Given, start: Trajectory) -> dict[str, Made]:
    """The trajectory with the trims of both modes: each revolution is read once and forgotten."""
    options = {mode: DynamicOptions(mode=mode) for mode in (SOURCE, ROBUST)}
    searches = {mode: Search(chosen) for mode, chosen in options.items()}
    found: dict[str, list[Found]] = {mode: [] for mode in options}
    busy_s = dict.fromkeys(options, 0.0)
    for turn in revolutions(given.readers, given.timeline, start, given.mount, GATE, lambda _: None):
        for mode, search in searches.items():
            before = time.process_time()
            found[mode].append(search.step(turn))
            # the kernels are compiled in the first revolutions
            busy_s[mode] += time.process_time() - before if len(found[mode]) > WARM else 0.0
    made = {}
    for mode, each in found.items():
        stamps, values = np.array([f.time_ns for f in each]), np.array([f.trims for f in each])
        trajectory = applied(start, interpolated(stamps, values, start.time_ns, options[mode].spline_hz))
        factor = (stamps[-1] - stamps[WARM]) * 1e-9 / busy_s[mode]
        made[mode] = Made(trajectory, stamps, np.rad2deg(values[:, 0]), float(factor))
    return made


def cloud(
    given: Given, trajectory: Trajectory, mount: Mount
) -> tuple[Array, npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Some points placed with a trajectory, their times, and a number for each that is the same in all clouds."""
    places, times, lasers = [], [], []
    for seen in shots(given.readers, given.timeline, GATE):
        points = georeference(seen, trajectory, mount)
        kept = points.time_ns // FIRING_NS % EVERY == 0
        places.append(points.xyz_m[kept])
        times.append(points.time_ns[kept])
        lasers.append(points["laser"][kept])
    time_ns = np.concatenate(times)
    keys = (time_ns - given.readers[0].start_ns) * LASERS + np.concatenate(lasers)
    return np.concatenate(places), time_ns, keys


def facades(true_m: Array) -> list[tuple[npt.NDArray[np.intp], int]]:
    """Points of each facade in a true cloud, and the axis across it: plane, upright, along east or north."""
    found = []
    over = true_m[:, 2] - np.quantile(true_m[:, 2], 0.2)
    for across in (0, 1):
        level = np.round(true_m[:, across] / PLANE_M).astype(np.int64)
        values, counts = np.unique(level[over > 1.0], return_counts=True)
        for value in values[counts > LEAST_POINTS // 4]:
            chosen = np.flatnonzero((np.abs(true_m[:, across] - value * PLANE_M) < PLANE_M) & (over > 1.0))
            if len(chosen) > LEAST_POINTS and np.ptp(true_m[chosen, 1 - across]) > 10.0:
                found.append((chosen, across))
    return found


def thickness(points: Array, across: int) -> float:
    """RMS distance of points from the plane that fits them best, across an axis [m]."""
    design = np.column_stack([points[:, 1 - across], points[:, 2], np.ones(len(points))])
    left, *_ = np.linalg.lstsq(design, points[:, across], rcond=None)
    return float(np.sqrt(np.square(points[:, across] - design @ left).mean()))


def judged(truth: Truth, made: Made) -> tuple[dict[str, Any], Array, Array]:
    """Figures of poses; seconds and heading errors [deg] for the plot."""
    trajectory = made.trajectory
    poses, known = truth.trajectory.where_covered(trajectory.time_ns)
    known &= trajectory.covered
    seconds = truth.lidar.elapsed_s(trajectory.time_ns[known])
    mats = [mat_from_quat(q[known]) for q in (trajectory.quat_local_ins_wxyz, poses.quat_local_ins_wxyz)]
    ours, theirs = (np.arctan2(m[:, 0, 1], m[:, 1, 1]) for m in mats)
    error = np.rad2deg((ours - theirs + np.pi) % (2 * np.pi) - np.pi)
    late = seconds >= SETTLED_S
    position, true_position = trajectory.position_m[known], poses.position_m[known]
    motion = align(position[late], mats[0][late], true_position[late], mats[1][late])
    away = motion.points(position[late]) - true_position[late]
    outside_s = np.concatenate([seconds[:1], seconds[np.abs(error) > 1.0], seconds[-1:]])
    quiet = np.flatnonzero(np.diff(outside_s) >= 3.0)
    return (
        {
            "heading_settle_s": float(outside_s[quiet[0]]) if len(quiet) else None,
            "heading_within": float((np.abs(error[late]) <= 1.0).mean()),
            "heading_rms_deg": float(np.sqrt(np.square(error[late]).mean())),
            "heading_mean_deg": float(error[late].mean()),
            "ate_m": float(np.sqrt(np.square(away).sum(axis=1).mean())),
            "real_time_factor": made.real_time_factor,
        },
        seconds,
        error,
    )


def experiment(name: str, folder: Path, results: Path) -> dict[str, Any]:
    """Judge the three trajectories of a simulated flight and draw them."""
    truth = read_truth(folder)
    with LogReader(folder / "flight.mcap") as reader:
        survey = Survey()
        mount, _ = find_mount(None, [reader])
        flight = read_flight([reader], "ins")
        timeline: list[Leg] = legs(flight.runs, flight.boots, mount.mat_ins_lidar(), survey.sync)
        given = gather([reader], flight, timeline, mount, survey)
        start = direct.ins_estimate(given, lambda *_: None).trajectory
        none = np.empty(0, np.int64)
        made = {
            "ins": Made(start, none, np.empty(0), None),
            **trimmed(given, start),
        }
        lines = timeline[0].lidar_line
        true_utc = start.time_ns
        figures: dict[str, Any] = {}
        courses, points = {}, {}
        for mode, each in made.items():
            moved = dataclasses.replace(each, trajectory=on_lidar_clock(each.trajectory, lines, truth))
            figures[mode], seconds, error = judged(truth, moved)
            courses[mode] = seconds, error
            points[mode], time_ns, keys = cloud(given, each.trajectory, given.mount)
            if mode == "ins":
                elapsed_s = np.interp(time_ns, true_utc, truth.lidar.elapsed_s(moved.trajectory.time_ns))
        true_points = _true_cloud(given, truth, start, lines)
    late = elapsed_s >= SETTLED_S
    shared = facades(true_points[0])
    section = None
    for mode, cloud_m in points.items():
        errors = []
        for chosen, across in shared:
            mine = _matching(keys, true_points[1][chosen])
            mine = mine[late[mine]]
            if len(mine) > 1000:
                errors.append((len(mine), thickness(cloud_m[mine], across)))
                section = section or (chosen, across)
        if errors:
            weights, values = np.array(errors).T
            figures[mode]["facade_m"] = float(np.sqrt(np.average(values**2, weights=weights)))
    _draw(results / f"dynamic_{name}.png", name, courses, made, points, keys, true_points[1], section, late, elapsed_s)
    return figures


def _true_cloud(given: Given, truth: Truth, start: Trajectory, lines: Any) -> tuple[Array, npt.NDArray[np.int64]]:
    """Points placed with the true poses and the true mount; the poses are put on UTC by the same line as the packets."""
    device_ns = start.time_ns
    for line in reversed(lines):
        device_ns = line.inverse()(device_ns)
    utc_ns = truth.trajectory.time_ns + (device_ns - truth.from_device_ns(device_ns))[0]
    for line in lines:
        utc_ns = line(utc_ns)
    placed, _, keys = cloud(given, dataclasses.replace(truth.trajectory, time_ns=utc_ns), truth.mount)
    return placed, keys


def _matching(keys: npt.NDArray[np.int64], wanted: npt.NDArray[np.int64]) -> npt.NDArray[np.intp]:
    """Where the wanted keys stand among the keys, those that do."""
    return np.intersect1d(keys, wanted, return_indices=True)[1]


def _draw(
    path: Path,
    name: str,
    courses: dict[str, Any],
    made: dict[str, Made],
    points: dict[str, Array],
    keys: npt.NDArray[np.int64],
    true_keys: npt.NDArray[np.int64],
    section: Any,
    late: npt.NDArray[np.bool_],
    elapsed_s: Array,
) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    colours = {"ins": "0.5", SOURCE: "tab:red", ROBUST: "tab:blue"}
    seconds, raw = courses["ins"]
    left.plot(seconds, -raw, color="black", lw=2, label="true: what the heading lacks")
    for mode in (SOURCE, ROBUST):
        at_s = np.interp(made[mode].trim_ns, made["ins"].trajectory.time_ns, courses_time(courses, made))
        left.plot(at_s, made[mode].yaw_deg, color=colours[mode], lw=1.2, label=f"yaw trim, {mode}")
    left.set(xlabel="time [s]", ylabel="[deg]", title=f"{name}: yaw trim")
    left.legend(fontsize=8)
    left.grid(alpha=0.3)
    if section is not None:
        chosen, across = section
        mine = _matching(keys, true_keys[chosen])
        mine = mine[late[mine]]
        for mode, cloud_m in points.items():
            part = cloud_m[mine]
            along, deep = part[:, 1 - across], part[:, across]
            right.plot(along, deep - np.median(deep), ",", color=colours[mode], label=mode)
        right.set(
            xlabel="along the facade [m]", ylabel="across [m]", title=f"a facade from above, from {SETTLED_S:.0f} s on"
        )
        handles = [Line2D([], [], color=colours[m], marker="s", ls="") for m in points]
        right.legend(handles, list(points), fontsize=8)
        right.grid(alpha=0.3)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def courses_time(courses: dict[str, Any], made: dict[str, Made]) -> Array:
    """Seconds of the flight at the knots of the start's trajectory."""
    knots = made["ins"].trajectory.time_ns
    first = courses["ins"][0][0]
    return np.asarray(first + (knots - knots[0]) * 1e-9)


def main(words: list[str] | None = None) -> int:
    """Simulate where needed, judge, print the JSON object."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    parser.add_argument(
        "--log",
        type=Path,
        action="append",
        default=[],
        help="folder of a flight simulated before; its name is its title",
    )
    arguments = parser.parse_args(words)
    arguments.out.mkdir(parents=True, exist_ok=True)
    found = {}
    with tempfile.TemporaryDirectory(prefix="swath-dynamic-") as scratch:
        folders = arguments.log or [Path(scratch) / name for name in FLIGHTS]
        for folder in folders:
            if not arguments.log:
                command = [Path(sys.executable).with_name("swath"), "simulate", "--flight", folder.name, "--seed", "1"]
                subprocess.run([*command, "--duration", str(FLIGHTS[folder.name]), "-o", folder], check=True)
            found[folder.name] = experiment(folder.name, folder, arguments.out)
            for mode, figures in found[folder.name].items():
                print(folder.name, mode, {k: None if v is None else round(v, 3) for k, v in figures.items()})
    print(json.dumps(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
