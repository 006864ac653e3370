"""Method `adjusted` on many flights, seeds and error models against the figures that it promises, and against its own sigmas.

Each flight of FLIGHTS is simulated with its truth. The methods then go through the mill of benchmarks/trajectory.py, each in a process
of its own, and one line of the table says how far the promises hold. study.json and study.md are written anew after every flight, so a
run that is broken off leaves what it had; flights of an earlier run stay in them until they are flown again. What misses a promise
stands in bold type. The last line is one JSON object: for each flight the promises that method `adjusted` missed.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from trajectory import progress, run, simulate

from flightlog import config
from flightlog.hdl32e import SENSOR_FROM_GYROS
from flightlog.mount import Mount

ROOT: Final = Path(__file__).resolve().parents[1]
RESULTS: Final = ROOT / "build" / "bench-study"
METHODS: Final = ("ins", "adjusted", "adjusted_causal")
SQUARE: Final = "ins: {gyro_misalignment_deg: 0, accel_misalignment_deg: 0}\ngyros: {misalignment_deg: 0}"
"""Inertial units whose axes are those of their boards, so that the boresight is what their gyros show."""
AIR: Final = "flight: {buzz_deg_s: [0.5, 1.8, 1.8], gust_deg: 0.05}\ngyros: {rotor_line_deg_s: [1.0, 1.0, 0.3]}"
"""What the air and the motors do on the flights over natural scenes, for others."""
MULTIPATH: Final = "faults: {gnss_glitch_at_s: 6, gnss_glitch_s: 8, gnss_glitch_rise_s: 3, gnss_glitch_m: [20, 0, -8]}"
"""Positions that walk away and come back."""

GLITCH: Final = "faults: {gnss_glitch_at_s: 8, gnss_glitch_s: 4, gnss_glitch_m: [40, -30, 15]}"
HEIGHT: Final = "faults: {gnss_glitch_at_s: 9, gnss_glitch_s: 1000, gnss_glitch_m: [0, 0, 5]}"
OFFSET: Final = "faults: {gnss_glitch_at_s: 15, gnss_glitch_s: 30, gnss_glitch_rise_s: 6, gnss_glitch_m: [12, -9, 6]}"
FLOAT: Final = (
    "ins: {gnss_sigma_m: 0.01, height_bias_m: 0.01, position_noise_m: 0.01, baro_walk_m: 0.01}\n"
    "faults: {gnss_glitch_at_s: 9, gnss_glitch_s: 6, gnss_glitch_m: [0.4, -0.3, 0.5]}"
)
"""A receiver of centimetres whose ambiguities are wrong for some seconds, and that states the metres of its dilution of precision."""


@dataclass(frozen=True, slots=True)
class Trial:
    """One flight of the study.

    Attributes
    ----------
    name : str
    flight : str
        Named flight that it is made of.
    seed : int
    seconds : float
    changes : str
        Options as YAML that go before those of the flight.
    scene : str
        Another scene than the flight's, where that is named.
    """

    name: str
    flight: str
    seed: int
    seconds: float = 50.0
    changes: str = ""
    scene: str = ""


TRIALS: Final = (
    *(Trial(f"fast {seed}", "survey_fast_gyro", seed, 60.0) for seed in (21, 22, 23)),
    *(Trial(f"slow {seed}", "survey_slow_gyro", seed, 60.0) for seed in (24, 25)),
    *(Trial(f"fast {seed}, axes square", "survey_fast_gyro", seed, changes=SQUARE) for seed in (52, 53)),
    Trial("slow 54, axes square", "survey_slow_gyro", 54, changes=SQUARE),
    Trial("harsh", "harsh", 26, 60.0),
    Trial("busy", "busy", 27, 60.0),
    Trial("shore", "shore", 28, 60.0),
    Trial("drive", "drive", 29, 60.0),
    Trial("strips", "strips", 30, 60.0),
    Trial("calibration", "calibration", 31, 120.0),
    Trial("boresight off", "survey_fast_gyro", 32, changes="mount: {boresight_deg: [1, 1, 1], boresight_spread_deg: 0}"),
    Trial("noisy lidar IMU", "survey_slow_gyro", 33, changes="gyros: {noise_deg_s: 2.2, accel_noise_g: 0.03}"),
    Trial("noisy gyro", "survey_fast_gyro", 34, changes="ins: {gyro_noise_deg_s: 0.45}"),
    Trial("GNSS 3 m, lasting", "survey_fast_gyro", 35, changes="ins: {gnss_sigma_m: 3.0, gnss_tau_s: 200}"),
    Trial("GNSS 3 m, brief", "survey_fast_gyro", 36, changes="ins: {gnss_sigma_m: 3.0, gnss_tau_s: 10}"),
    Trial("low", "survey_fast_gyro", 37, changes="flight: {higher_m: -1.5}"),
    Trial("high", "survey_fast_gyro", 38, changes="flight: {higher_m: 7.0}"),
    Trial("swaying", "survey_fast_gyro", 39, changes="flight: {speed_m_s: 8.0, wander_deg: 4.0, vibration_deg: 0.06}"),
    Trial("dual returns, busy", "busy", 40, changes="lidar: {returns: dual}\nmoving: {cars: 8, people: 16}"),
    Trial("wood", "survey_fast_gyro", 41, scene="wood"),
    Trial("wood, slow gyro", "survey_slow_gyro", 42, scene="wood"),
    Trial("one wall", "survey_fast_gyro", 43, scene="field", changes="flight: {higher_m: -3.0}"),
    Trial("town", "survey_slow_gyro", 44, scene="town"),
    Trial("street, slow gyro", "survey_slow_gyro", 45, scene="facade"),
    Trial("level lidar ahead", "survey_fast_gyro", 46, changes="mount: {lidar_deg: [0, 0, 0], lidar_position_m: [0.1, 0.3, -0.1]}"),
    Trial("lidar upright", "survey_fast_gyro", 47, changes="mount: {lidar_deg: [0, -90, 0], lidar_position_m: [0, 0.2, -0.2]}"),
    Trial("lidar turned", "survey_slow_gyro", 48, changes="mount: {lidar_deg: [90, -30, 0], lever_spread_m: 0.05}"),
    Trial("lasers off", "survey_fast_gyro", 49, changes="lidar: {laser_bias_m: 0.01, elevation_error_deg: 0.05}"),
    Trial("gyros 3 % off", "survey_fast_gyro", 50, changes="ins: {gyro_scale: 0.03}\ngyros: {scale: 0.03}"),
    *(Trial(f"air, fast {seed}", "survey_fast_gyro", seed, changes=AIR) for seed in (61, 67)),
    Trial("air, slow 62", "survey_slow_gyro", 62, changes=AIR),
    Trial("air, 540 rpm", "survey_slow_gyro", 66, changes=AIR + "\nlidar: {rpm: 540}"),
    Trial("air, wood", "survey_fast_gyro", 63, scene="wood", changes=AIR),
    *(Trial(f"meadow {seed}", "meadow", seed, 40.0) for seed in (31, 64)),
    *(Trial(f"hover before lines {seed}", "hover_lines", seed, 40.0) for seed in (21, 22)),
    *(Trial(f"crops {seed}", "crops", seed, 40.0) for seed in (21, 22)),
    *(Trial(f"slope {seed}", "slope", seed, 40.0) for seed in (21, 22)),
    Trial("bare field", "barefield", 21, 40.0),
    *(Trial(f"facades {seed}", "facades", seed, 40.0) for seed in (21, 22)),
    Trial("facades, slowly", "facades", 31, 60.0, changes="flight: {speed_m_s: 3.3}"),
    *(Trial(f"avenue {seed}", "avenue", seed, 40.0) for seed in (41, 43)),
    Trial("drive, slowly", "drive_slowly", 43, 180.0),
    Trial("bank", "bank", 21, 40.0),
    Trial("quarry", "quarry", 21, 40.0),
    Trial("empty street", "emptystreet", 21, 40.0),
    Trial("lidar upside down", "survey_fast_gyro", 47, changes="mount: {lidar_deg: [0, -20, 180]}"),
    Trial("glitch of 50 m", "meadow", 31, 24.0, changes=GLITCH),
    Trial("air, 300 rpm", "survey_fast_gyro", 82, changes=AIR + "\nlidar: {rpm: 300}"),
    Trial("air, 1200 rpm", "survey_fast_gyro", 83, changes=AIR + "\nlidar: {rpm: 1200}"),
    Trial("540 rpm, packets lost", "survey_slow_gyro", 81, changes="lidar: {rpm: 540}\nfaults: {lidar_loss: 0.02}"),
    Trial("multipath", "survey_fast_gyro", 11, 24.0, changes=MULTIPATH),
    Trial("multipath, velocities too", "survey_fast_gyro", 11, 24.0, changes=MULTIPATH[:-1] + ", gnss_glitch_velocity: true}"),
    Trial("height jumps by 5 m", "survey_fast_gyro", 11, 24.0, changes=HEIGHT),
    Trial("fix after take-off", "survey_fast_gyro", 11, 24.0, changes="faults: {gnss_from_s: 8}"),
    Trial("RTK, floats for a while", "survey_fast_gyro", 11, 24.0, changes=FLOAT),
    Trial("offset for half a minute", "survey_fast_gyro", 11, 60.0, changes=OFFSET),
    Trial("lidar's gyros 3 ms late", "survey_fast_gyro", 91, 24.0, changes=AIR[:-1] + ", delay_s: 0.003}"),
    Trial("lidar's gyros 5 ms early", "survey_fast_gyro", 91, 24.0, changes=AIR[:-1] + ", delay_s: -0.005}"),
    Trial("autopilot 20 ms late", "survey_slow_gyro", 51, changes="ins: {gyro_delay_s: 0.02, position_delay_s: 0.2}"),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Promise:
    """A figure that is to be reached.

    Attributes
    ----------
    key : str
        Of `measured`.
    title : str
    form : str
        How the table writes it.
    most, most_slow : float
        Largest that holds the promise, with an autopilot's gyro of 50 Hz and with a slower one. Where two means of a flight are compared
        they may differ by 2 %: they are of different instants.
    """

    key: str
    title: str
    form: str
    most: float
    most_slow: float

    def broken(self, figures: Mapping[str, Any]) -> bool:
        """Whether a value is there and does not hold it."""
        value = figures.get(self.key)
        return value is not None and value > (self.most if figures["gyro_hz"] >= 50.0 else self.most_slow)


PROMISES: Final = (
    Promise("ate_mm", "trajectory [mm]", ".1f", 10.0, 20.0),
    Promise("rotation_rms_deg", "attitude [deg]", ".3f", 0.03, 0.06),
    Promise("cloud_floor_ratio", "cloud / floor", ".2f", 1.1, 1.25),
    Promise("facade_floor_ratio", "facade / floor", ".2f", 1.1, 1.1),
    Promise("ground_strip_floor_ratio", "strips / floor", ".2f", 1.1, 1.1),
    Promise("time_error_ms", "time [ms]", ".2f", 0.2, 0.2),
    Promise("boresight_error_deg", "boresight [deg]", ".3f", 0.1, 0.1),
    Promise("lever_error_mm", "lever [mm]", ".1f", 20.0, 20.0),
    Promise("boresight_z", "boresight / sigma", ".1f", 3.0, 3.0),
    Promise("lever_z", "lever / sigma", ".1f", 3.0, 3.0),
    Promise("delay_z", "delay / sigma", ".1f", 3.0, 3.0),
    Promise("drift_z", "drift / sigma", ".1f", 3.0, 3.0),
    Promise("scale_z", "scales / sigma", ".1f", 3.0, 3.0),
    Promise("position_beyond_2_sigma", "position beyond 2 sigma", ".2f", 0.05, 0.05),
    Promise("attitude_beyond_2_sigma", "attitude beyond 2 sigma", ".2f", 0.05, 0.05),
    Promise("mean_over_fixes", "mean error / that of the fixes", ".2f", 1.02, 1.02),
    Promise("ate_over_ins", "trajectory / ins", ".3f", 1.02, 1.02),
)


def measured(found: Mapping[str, Any], ins: Mapping[str, Any], truth: Mapping[str, Any]) -> dict[str, Any]:
    """The figures of a method that promises are made of, and what goes with them.

    Parameters
    ----------
    found, ins : mapping
        What the mill says of the method, and of method `ins`, whose mean error of position is that of an average of the fixes.
    truth : mapping
        truth.json.
    """
    figures: dict[str, Any] = {"gyro_hz": truth["mavlink_hz"].get("raw_imu", 0.0)}
    if "error" in found:
        return figures | {"error": found["error"]}
    kept = ("rotation_rms_deg", "cloud_floor_ratio", "facade_floor_ratio", "ground_strip_floor_ratio", "covered_time_share",
            "rotation_rms_free_deg", "rpe_m", "surface_median_m", "aligned_position_within_2_sigma", "aligned_attitude_within_2_sigma",
            "position_error_over_sigma", "attitude_error_over_sigma", "absolute_heading_mean_deg", "cpu_s_per_flight_s", "peak_memory_mb",
            "warning")  # fmt: skip
    figures |= {key: found.get(key) for key in kept}
    figures["ate_mm"] = found["ate_m"] * 1e3
    figures["time_error_ms"] = None if found["time_error_ms"] is None else abs(found["time_error_ms"])
    for kind in ("position", "attitude"):
        share = found[f"{kind}_within_2_sigma"]
        figures[f"{kind}_beyond_2_sigma"] = None if share is None else 1.0 - share
    if "ate_m" in ins and ins is not found:
        mean, theirs = (float(np.linalg.norm(each["absolute_mean_error_m"])) for each in (found, ins))
        figures |= {"mean_error_m": mean, "mean_of_fixes_m": theirs, "mean_over_fixes": mean / theirs}
        figures["ate_over_ins"] = found["ate_m"] / ins["ate_m"]
    report = found.get("report", {})
    figures["note"] = report.get("note", "")
    return figures | _estimates(found, report.get("estimated", {}), truth)


def _estimates(found: Mapping[str, Any], estimated: Mapping[str, Any], truth: Mapping[str, Any]) -> dict[str, Any]:
    """Errors and ratios of error to sigma of what was estimated besides the path; held components count in neither."""
    figures: dict[str, Any] = {}
    mat = config.from_mapping(truth["mount_nominal"], Mount, "truth.json: mount_nominal").mat_ins_lidar()
    tie = found.get("tie", {})
    if estimated and tie:
        figures["drift_z"] = abs(tie["drift_error_ppm"]) / max(tie["sigma_drift_ppm"], 1e-9)
    if "ins.turn_deg" in estimated:
        error = np.abs(found["boresight_error_deg"])
        figures["boresight_error_deg"] = float(error.max())
        figures["boresight_z"] = float((error / estimated["ins.turn_deg"]["sigma"]).max())
    if "ins.lever_m" in estimated:
        error, free = np.abs(mat.T @ found["lever_error_m"]), ~np.array(estimated["ins.lever_m"]["held"])
        if free.any():
            figures["lever_error_mm"] = float(error[free].max()) * 1e3
            figures["lever_z"] = float((error / estimated["ins.lever_m"]["sigma"])[free].max())
    if "ins.delay_s" in estimated and tie:
        delay = estimated["ins.delay_s"]
        error_ms = tie["offset_error_ms"] + delay["value"][0] * 1e3
        figures |= {"offset_error_ms": error_ms, "delay_z": abs(error_ms) / (delay["sigma"][0] * 1e3)}
    if "lidar.delay_s" in estimated:
        late = estimated["lidar.delay_s"]
        error_ms = (late["value"][0] - truth.get("lidar_imu_delay_s", 0.0)) * 1e3
        figures |= {"lidar_delay_error_ms": error_ms, "lidar_delay_z": abs(error_ms) / (late["sigma"][0] * 1e3)}
    ratios = []
    for unit, matrix, turn in (
        ("ins", truth["ins_gyro_matrix"], mat.T),
        ("lidar", truth["lidar_gyro_matrix"], np.asarray(SENSOR_FROM_GYROS, np.float64)),
    ):
        scale = estimated.get(f"{unit}.scale")
        if scale is not None:
            error = np.array(scale["value"]) - (np.diag(turn @ np.array(matrix) @ turn.T) - 1.0)
            figures[f"{unit}_scale_error"] = error.tolist()
            ratios += (np.abs(error) / scale["sigma"]).tolist()
    if ratios:
        figures["scale_z"] = max(ratios)
    return figures


def fly(
    trial: Trial, methods: Sequence[str], results: Path, scratch: Path, keep: Path | None, points: bool = True
) -> dict[str, Any]:
    """Simulate a trial, have each method judged, and measure; `points`: clouds too, not only poses."""
    name = trial.name.replace(" ", "_").replace(",", "").replace("%", "percent")
    folder, out = (keep or scratch) / name, results / name
    out.mkdir(parents=True, exist_ok=True)
    if not (folder / "truth.json").is_file():
        more = ["--scene", trial.scene] if trial.scene else []
        if trial.changes:
            changes = scratch / f"{name}.yaml"
            changes.write_text(trial.changes + "\n", encoding="utf-8")
            more += ["--config", str(changes)]
        simulate(folder, trial.flight, trial.seconds, trial.seed, points, *more)
    truth = json.loads((folder / "truth.json").read_text())
    found = {method: run(method, folder, out) for method in methods}
    if keep is None:
        shutil.rmtree(folder)
    ins = found.get("ins", {})
    return {
        "flight": trial.flight, "scene": truth["scene"], "seed": trial.seed, "seconds": truth["duration_s"], "changes": trial.changes,
        "methods": {method: measured(found[method], ins, truth) for method in methods},
    }  # fmt: skip


def missed(figures: Mapping[str, Any]) -> list[str]:
    """Titles of the promises that a method missed on a flight."""
    if "error" in figures:
        return ["no trajectory"]
    return [promise.title for promise in PROMISES if promise.broken(figures)]


def markdown(flights: Mapping[str, Any]) -> str:
    """A table for each method: a line for each flight, misses in bold type."""
    methods = list(
        dict.fromkeys(method for flight in flights.values() for method in flight["methods"] if method != "ins")
    )
    return "\n".join(_table(method, flights) for method in methods)


def _table(method: str, flights: Mapping[str, Any]) -> str:
    rows = {name: flight["methods"][method] for name, flight in flights.items() if method in flight["methods"]}
    shown = [p for p in PROMISES if any(figures.get(p.key) is not None for figures in rows.values())]
    lines = [
        f"### {method}",
        "",
        "| | " + " | ".join(p.title for p in shown) + " | said |",
        "|---" * (len(shown) + 2) + "|",
    ]
    for name, figures in rows.items():
        if "error" in figures:
            lines.append(f"| {name} | {figures['error']} |" + " |" * len(shown))
            continue
        cells = []
        for promise in shown:
            value = figures.get(promise.key)
            text = "" if value is None else format(value, promise.form)
            cells.append(f"**{text}**" if promise.broken(figures) else text)
        said = "warning" if figures.get("warning") else "note" if figures.get("note") else ""
        lines.append(f"| {name} | " + " | ".join(cells) + f" | {said} |")
    return "\n".join([*lines, ""])


def write(results: Path, flights: Mapping[str, Any]) -> None:
    """Write both tables whole or not at all."""
    for name, text in (("study.json", json.dumps(flights, indent=1)), ("study.md", markdown(flights))):
        part = results / f"{name}.part"
        part.write_text(text + "\n", encoding="utf-8")
        part.replace(results / name)


def main(words: list[str] | None = None) -> int:
    """Fly them all, print the table and the JSON object; 1 where a method gave no trajectory."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--only", help="some of the flights, by comma; a word that is in several names chooses all of them"
    )
    parser.add_argument("--list", action="store_true", help="list the flights and end")
    parser.add_argument("--seconds", type=float, help="how long each is flown; default: as it says")
    parser.add_argument("--poses", action="store_true", help="judge no clouds: half the time")
    parser.add_argument("--methods", default=",".join(METHODS), help=f"by comma ({','.join(METHODS)})")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    parser.add_argument(
        "--keep", type=Path, help="folder in which flights are kept, and taken from where they are there already"
    )
    arguments = parser.parse_args(words)
    chosen = [t for t in TRIALS if not arguments.only or any(w.strip() in t.name for w in arguments.only.split(","))]
    if arguments.list:
        for trial in chosen:
            print(
                f"{trial.name:24} {trial.flight}, seed {trial.seed}, {trial.seconds:g} s {trial.scene} {trial.changes!r}"
            )
        return 0
    if not chosen:
        raise SystemExit(f"--only: {arguments.only!r} is in none of the names; --list shows them")
    if arguments.seconds:
        chosen = [replace(trial, seconds=arguments.seconds) for trial in chosen]
    results: Path = arguments.out
    results.mkdir(parents=True, exist_ok=True)
    before = results / "study.json"
    flights: dict[str, Any] = json.loads(before.read_text()) if before.is_file() else {}
    scratch = Path(tempfile.mkdtemp(prefix="swath-study-"))
    try:
        for trial in chosen:
            progress(f"{trial.name} ...")
            methods = arguments.methods.split(",")
            flights[trial.name] = fly(trial, methods, results, scratch, arguments.keep, not arguments.poses)
            write(results, flights)
            for method, figures in flights[trial.name]["methods"].items():
                if method != "ins":
                    progress(f"{trial.name}: {method} misses {', '.join(missed(figures)) or 'nothing'}")
    except subprocess.CalledProcessError as error:
        raise SystemExit(f"{trial.name}: could not be simulated ({error})") from None
    finally:
        shutil.rmtree(scratch)
    print(markdown(flights))
    told = {trial.name: flights[trial.name]["methods"] for trial in chosen}
    print(json.dumps({name: missed(methods["adjusted"]) for name, methods in told.items() if "adjusted" in methods}))
    return 1 if any("error" in figures for methods in told.values() for figures in methods.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
