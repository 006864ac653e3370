"""Trajectories of all methods and of their peers on one simulated flight, against its truth.

A named flight is simulated with its truth. Every method of `swath process`, and KISS-ICP and small_gicp as peers, then makes a
trajectory of the same log, one after the other, each in a process of its own. `groundproc.accuracy` judges them all in the same way,
after one rigid alignment. The folder of results gets trajectory.json (everything), trajectory.md (the table) and pictures. The last
line is one JSON object: for each method and peer under its name

ate_m                 RMS error of the lidar's positions
rotation_rms_deg      RMS error of the lidar's attitude, the boresight that the method left included
cloud_floor_ratio     RMS distance of the points from their true echoes, over that of the cloud made with the true trajectory and mount
facade_floor_ratio    thickness of facades over all passes, over that of the same cloud
heading_settle_s      seconds until the heading error, less its median over the second half, stays within 1 deg; null: never
real_time_factor      seconds of flight in a second of making the trajectory: reading the log and all that a method needs included,
                      writing the cloud not
error                 why there are no figures, where a method failed
meadow                the same figures, of a flight over a meadow with trees that the same run makes after the first; none with --log or
                      --no-meadow
"""

import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from machine import busy_s

from flightlog.errors import SwathError
from flightlog.logfile import LogReader
from flightlog.mount import Mount
from groundproc.accuracy.cloud import choose_section
from groundproc.accuracy.cloudfigures import Section
from groundproc.accuracy.judge import judge
from groundproc.accuracy.truth import Clock, Truth, on_lidar_clock, read_truth
from groundproc.estimation import methods
from groundproc.estimation.method import gather
from groundproc.flight.flight import read_flight
from groundproc.flight.mounting import find_mount
from groundproc.flight.pairing import legs
from groundproc.flight.sync.result import Sync
from groundproc.sensors.shots import LaserTable
from groundproc.survey import Survey
from groundproc.trajectory.trajectory import Trajectory

ROOT: Final = Path(__file__).resolve().parents[1]
RESULTS: Final = ROOT / "build" / "bench-trajectory"
FIGURES: Final = (
    "ate_m", "rotation_rms_deg", "cloud_floor_ratio", "facade_floor_ratio", "heading_settle_s", "real_time_factor",
)  # fmt: skip
TABLE: Final = (
    ("ate_m", "trajectory [m]", ".3f"),
    ("rotation_rms_deg", "rotation [deg]", ".3f"),
    ("rotation_rms_free_deg", "less its mean", ".3f"),
    ("rpe_m", "in 1 s [m]", ".3f"),
    ("point_rms_m", "points [m]", ".3f"),
    ("cloud_floor_ratio", "/ floor", ".2f"),
    ("surface_median_m", "off surface, median [m]", ".3f"),
    ("facade_m", "facade [m]", ".4f"),
    ("facade_floor_ratio", "/ floor", ".2f"),
    ("ground_revolution_floor_ratio", "ground of revolutions / floor", ".2f"),
    ("ground_strip_floor_ratio", "ground of strips / floor", ".2f"),
    ("time_error_ms", "time [ms]", ".2f"),
    ("heading_rms_deg", "heading [deg]", ".3f"),
    ("heading_settle_s", "settles [s]", ".1f"),
    ("real_time_factor", "x real time", ".2f"),
    ("cpu_s_per_flight_s", "CPU s per s", ".2f"),
    ("other_load", "others' cores", ".2f"),
    ("peak_memory_mb", "memory [MB]", ".0f"),
)
MEADOW: Final = "meadow"
"""The named flight that follows the first, and the key of its figures."""
TRUTH: Final = "truth"
"""The name under which the true trajectory itself goes through the same mill: the floor."""
LONGEST_S: Final = 3600.0
"""After so long a method is given up."""
WARM_S: Final = 12.0


@dataclass(frozen=True, slots=True)
class Made:
    """A trajectory on the lidar's clock, what comes with it, and what it cost."""

    trajectory: Trajectory
    mount: Mount
    lasers: LaserTable | None
    absolute: bool
    wall_s: float
    cpu_s: float
    other_load: float
    """Cores that other programs took meanwhile."""
    warning: str = ""
    report: dict[str, Any] = field(default_factory=dict)
    tie: dict[str, float] = field(default_factory=dict)


def own_methods() -> list[str]:
    """What `swath process --method` offers, and the causal mode of the last where there is one."""
    (choice,) = (each for each in fields(Survey) if each.name == "method")
    names = list(choice.metadata["choices"])
    return [*names, "adjusted_causal"] if "causal" in {each.name for each in fields(Survey)} else names


def peers() -> list[str]:
    """The peers that are installed."""
    from importlib.util import find_spec

    from peers.odometries import PEERS

    here = [name for name in PEERS if find_spec(name if name == "kiss_icp" else "small_gicp")]
    if len(here) < len(PEERS):
        print(f"left out, not installed (pip install '.[bench]'): {', '.join(sorted(set(PEERS) - set(here)))}")
    return here


def cpu_s() -> float:
    """CPU time of this process and those that it waited for [s]."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


class Cost:
    """Measures time from its making on."""

    def __init__(self) -> None:
        self._start, self._cpu, self._busy = time.perf_counter(), cpu_s(), busy_s()

    def so_far(self) -> tuple[float, float, float]:
        """Wall time [s], CPU time [s], and the cores that other programs took."""
        wall, cpu = time.perf_counter() - self._start, cpu_s() - self._cpu
        return wall, cpu, max(0.0, busy_s() - self._busy - cpu) / wall


def peak_mb() -> float:
    """Highest resident memory of this program [MB]; getrusage would hold that of the one that started it too."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return float(next(line for line in lines if line.startswith("VmHWM")).split()[1]) * 1024 / 1e6


def make(name: str, truth: Truth, reader: LogReader) -> Made:
    """Make the trajectory of a method or peer, timed from the closed log on."""
    if name == TRUTH:
        return Made(truth.trajectory, truth.mount, None, True, 0.0, 0.0, 0.0)
    return _odometry(name, truth, reader) if name in peers() else _method(name, truth, reader)


def _method(name: str, truth: Truth, reader: LogReader) -> Made:
    survey = Survey(method=name.removesuffix("_causal"))
    if name.endswith("_causal"):
        survey = replace(survey, causal=True)
    cost = Cost()
    mount, _ = find_mount(None, [reader])
    flight = read_flight([reader], "ins")
    timeline = legs(flight.runs, flight.boots, mount.mat_ins_lidar(), survey.sync)
    estimate = methods.estimate(gather([reader], flight, timeline, mount, survey), lambda stage, size: None)
    spent = cost.so_far()
    if len({leg.run for leg in timeline}) > 1:
        raise SystemExit(f"{reader.path}: the lidar's clock was set in flight, expected one run of it")
    placed = on_lidar_clock(estimate.trajectory, timeline[0].lidar_line, truth)
    tie = tie_errors(timeline[0].sync, truth)
    lasers = estimate.corrections.table(flight.lidar.lasers)
    return Made(placed, estimate.mount, lasers, True, *spent, estimate.warning, estimate.report, tie)


def tie_errors(sync: Sync, truth: Truth) -> dict[str, float]:
    """Errors of the tie between the clocks of autopilot and lidar, with the sigmas that it states.

    The true offset is that at which the autopilot's rates say what the lidar's do: delays of its filters are part of it.
    """
    boot = Clock(**truth.content["clocks"]["boot"])
    at_ns = truth.from_device_ns(np.array([sync.reference_ns]))
    late_ns = truth.content["ins_gyro_delay_s"] * 1e9
    true_ns = boot.shows_ns(truth.lidar.elapsed_s(at_ns)) + late_ns - sync.reference_ns
    drift_ppm = ((1.0 + boot.drift_ppm * 1e-6) / (1.0 + truth.lidar.drift_ppm * 1e-6) - 1.0) * 1e6
    return {
        "offset_error_ms": float(sync.offset_ns - true_ns[0]) * 1e-6,
        "sigma_offset_ms": sync.sigma_offset_ns * 1e-6,
        "drift_error_ppm": sync.drift_ppm - drift_ppm,
        "sigma_drift_ppm": sync.sigma_drift_ppm,
    }


def _odometry(name: str, truth: Truth, reader: LogReader) -> Made:
    from peers.motion import dense, gyros
    from peers.odometries import NEEDS_GYROS, PEERS
    from peers.scans import scans

    cost = Cost()
    mount, motion = truth.nominal_mount, None
    if name in NEEDS_GYROS:
        flight = read_flight([reader], "ins")
        timeline = legs(flight.runs, flight.boots, mount.mat_ins_lidar(), "auto")
        motion = gyros(timeline[0], flight.runs[timeline[0].run], mount)
    poses = PEERS[name](scans([reader]), motion)
    spent = cost.so_far()
    found = dense(poses, motion, mount, truth.frame)
    found = replace(found, time_ns=truth.from_device_ns(found.time_ns))
    return Made(found, mount, None, False, *spent)


def one(name: str, folder: Path, results: Path, section: Section | None) -> None:
    """Make and judge one trajectory, and write its figures and courses."""
    truth = read_truth(folder)
    with ExitStack() as stack:
        reader = stack.enter_context(LogReader(truth.log))
        made = make(name, truth, reader)
        memory_mb = peak_mb()
        readers = [reader] if truth.has_hits else []
        found = judge(readers, truth, made.trajectory, made.mount, made.lasers, section, made.absolute)
    figures: dict[str, Any] = {"real_time_factor": None}
    if made.wall_s > 0:
        figures = {
            "real_time_factor": truth.duration_s / made.wall_s,
            "cpu_s_per_flight_s": made.cpu_s / truth.duration_s,
            "peak_memory_mb": memory_mb,
            "other_load": made.other_load,
        }
    figures |= {"warning": made.warning} if made.warning else {}
    figures |= {"report": made.report} if made.report else {}
    figures |= {"tie": made.tie} if made.tie else {}
    (results / f"{name}.json").write_text(json.dumps(found.figures | figures, indent=1, default=float) + "\n")
    np.savez_compressed(results / f"{name}.npz", **found.courses)


def run(name: str, folder: Path, results: Path) -> dict[str, Any]:
    """Have one trajectory made and judged in a process of its own; its figures, or the error that stopped it."""
    command = [sys.executable, __file__, "--one", name, "--log", str(folder), "--out", str(results)]
    (results / f"{name}.json").unlink(missing_ok=True)
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LONGEST_S, check=False)
    except subprocess.TimeoutExpired:
        return {"error": f"not done after {LONGEST_S:.0f} s"}
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"ended with {done.returncode}"]
        (results / f"{name}.log").write_text(done.stderr)
        return {"error": lines[-1]}
    figures: dict[str, Any] = json.loads((results / f"{name}.json").read_text())
    return figures


def simulate(folder: Path, flight: str, seconds: float | None, seed: int, points: bool, *more: str) -> None:
    """Simulate a named flight into a folder; `more` are further words of `swath simulate`."""
    words = ["simulate", "--flight", flight, "--seed", str(seed), "-o", str(folder)]
    words += ["--duration", str(seconds)] if seconds else []
    words += ["--truth-points"] if points else []
    words += more
    subprocess.run([Path(sys.executable).with_name("swath"), *words], check=True, stdout=subprocess.DEVNULL)


def markdown(results: dict[str, dict[str, Any]]) -> str:
    """The table of all methods and peers."""
    shown = [column for column in TABLE if any(figures.get(column[0]) is not None for figures in results.values())]
    lines = ["| | " + " | ".join(title for _, title, _ in shown) + " |", "|---" * (len(shown) + 1) + "|"]
    for name, figures in results.items():
        if "error" in figures:
            lines.append(f"| {name} | {figures['error']} |" + " |" * (len(shown) - 1))
            continue
        cells = []
        for key, _, form in shown:
            value = figures.get(key)
            cells.append("never" if value is None and key == "heading_settle_s" else _cell(value, form))
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _cell(value: Any, form: str) -> str:
    return "" if value is None else format(value, form)


def measure(arguments: argparse.Namespace, folder: Path) -> dict[str, dict[str, Any]]:
    """Simulate, make, judge, and draw."""
    from drawing import draw

    results: Path = arguments.out
    results.mkdir(parents=True, exist_ok=True)
    flight = arguments.log or folder / "flight"
    if not arguments.log:
        progress(f"simulating {arguments.flight}, seed {arguments.seed}")
        simulate(flight, arguments.flight, arguments.seconds, arguments.seed, points=True)
    own, others = own_methods(), peers()
    chosen = arguments.methods.split(",") if arguments.methods else [*own, *others]
    unknown = sorted(set(chosen) - set(own) - set(others))
    if unknown:
        raise SystemExit(f"--methods: {unknown[0]!r} found, expected some of {', '.join([*own, *others])}")
    truth = read_truth(flight)
    section = choose_section(truth) if truth.has_hits else None
    _write_section(results, section)
    found = {TRUTH: run(TRUTH, flight, results)}
    if not arguments.cold:
        warm(folder, arguments, [name for name in chosen if name in own])
    for name in chosen:
        progress(f"{name} ...")
        found[name] = run(name, flight, results)
        told = {key: found[name].get(key) for key in FIGURES}
        progress(f"{name}: {found[name].get('error') or found[name].get('warning') or ''} {told}")
    flown = arguments.log.name if arguments.log else arguments.flight
    title = f"{flown}, seed {truth.content['seed']}, {truth.duration_s:g} s"
    content = {"flight": title, "results": found}
    (results / "trajectory.json").write_text(json.dumps(content, indent=1) + "\n")
    (results / "trajectory.md").write_text(f"{title}\n\n{markdown(found)}")
    draw(results, [name for name, figures in found.items() if "error" not in figures], title, truth.duration_s)
    print(markdown(found))
    return {name: figures for name, figures in found.items() if name != TRUTH}


def warm(folder: Path, arguments: argparse.Namespace, names: list[str]) -> None:
    """Let each method compile what it compiles, on a short flight, so that nobody's time holds that of a compiler."""
    short, scratch = folder / "warm", folder / "warm-results"
    scratch.mkdir()
    simulate(short, arguments.flight, WARM_S, arguments.seed, points=True)
    for name in names:
        progress(f"{name}: compiling")
        run(name, short, scratch)


def _write_section(results: Path, section: Section | None) -> None:
    place = results / "section.json"
    place.unlink(missing_ok=True)
    if section is not None:
        place.write_text(json.dumps({"centre_m": section.centre_m.tolist(), "normal": section.normal.tolist()}))


def _read_section(results: Path) -> Section | None:
    place = results / "section.json"
    if not place.is_file():
        return None
    content = json.loads(place.read_text())
    return Section(np.array(content["centre_m"]), np.array(content["normal"]))


def progress(text: str) -> None:
    """Tell how far it is, before the JSON of the last line."""
    print(f"{time.strftime('%H:%M:%S')} {text}", flush=True)


def main(words: list[str] | None = None) -> int:
    """Run, print the table and the JSON object; 1 where a method of ours failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--flight", default="survey_fast_gyro", help="named flight (survey_fast_gyro)")
    parser.add_argument("--seconds", type=float, help="how long; default: as the flight says")
    parser.add_argument("--seed", type=int, default=1, help="placement and noise (1)")
    parser.add_argument("--methods", help="some of the methods and peers, by comma")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    parser.add_argument("--log", type=Path, help="folder of a flight simulated before, with --truth-points")
    parser.add_argument("--cold", action="store_true", help="do not run each method on a short flight first")
    parser.add_argument("--no-meadow", action="store_true", help="leave out the flight over a meadow that follows")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    arguments = parser.parse_args(words)
    if arguments.one:
        try:
            one(arguments.one, arguments.log, arguments.out, _read_section(arguments.out))
        except SwathError as error:
            sys.exit(str(error))
        return 0
    line = _figures(_measured(arguments))
    if not (arguments.log or arguments.no_meadow or arguments.flight == MEADOW):
        arguments.flight, arguments.out = MEADOW, arguments.out / MEADOW
        for name, figures in _figures(_measured(arguments)).items():
            line[name][MEADOW] = figures
    print(json.dumps(line))
    told = [each for name in own_methods() if name in line for each in (line[name], line[name].get(MEADOW, {}))]
    return 1 if any("error" in each for each in told) else 0


def _measured(arguments: argparse.Namespace) -> dict[str, dict[str, Any]]:
    folder = Path(tempfile.mkdtemp(prefix="swath-trajectory-"))
    try:
        return measure(arguments, folder)
    finally:
        shutil.rmtree(folder)


def _figures(found: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """What the last line says of each method."""
    keys = (*FIGURES, "error")
    return {name: {k: figures.get(k) for k in keys if k in figures or k in FIGURES} for name, figures in found.items()}


if __name__ == "__main__":
    sys.exit(main())
