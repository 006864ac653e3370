"""How fast `swath process` makes everything of a flight, and in how much memory; the compression of the cloud alone is the peer.

A survey of a minute is simulated. The real command then processes it several times with the default method and with method ins, in
turn with lazrs compressing the same points from memory on all cores, which nothing that writes LAZ can beat. Before that, kernels are
compiled into an empty cache by `swath warmup`, so that the very first run shows what a newcomer waits for. The last line is one JSON
object:

real_time_factor           default method, all products: seconds of flight in a second of the whole command; the best round
real_time_factor_median    the same, the median of the rounds
real_time_factor_ins       method ins, all products; the best round
real_time_factor_ins_median
share_of_laz_limit         speed of the default method over that of the compression, the median of the rounds
share_of_laz_limit_ins     the same of method ins
first_run_extra_s          how much longer the first run after `swath warmup` takes than the next [s]
warmup_s                   what `swath warmup` takes with an empty cache [s]
peak_memory_mb             highest resident memory of the command, default method
peak_memory_ins_mb
cpu_s_per_flight_s, cpu_s_per_flight_s_ins
                           CPU time of the command for a second of flight, the least of the rounds
laz_limit_real_time_factor, laz_limit_cpu_s_per_flight_s
                           of the compression alone
other_load                 cores that other programs took, mean over the rounds; above 0.1 the wall times say little
"""

import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import laspy
import lazrs
import numpy as np
import numpy.typing as npt
from machine import busy_s

ROUNDS: Final = 3
FLIGHT: Final = "survey_fast_gyro"
FLIGHT_S: Final = 60
LOOK_S: Final = 0.05
CORES: Final = len(os.sched_getaffinity(0))


@dataclass(frozen=True, slots=True)
class Run:
    """What one run cost."""

    wall_s: float
    cpu_s: float
    other_load: float
    """Cores that other programs took meanwhile."""
    peak_mb: float = 0.0


def swath(*words: str | Path) -> tuple[float, float]:
    """Run a command of swath; its CPU time [s] and highest resident memory [MB].

    The memory is read while it runs: what wait4 tells holds that of this program too, from before the exec.
    """
    command = [Path(sys.executable).with_name("swath"), *words]
    peak_kb = 0
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        while not (ended := os.wait4(process.pid, os.WNOHANG))[0]:
            peak_kb = max(peak_kb, resident_peak_kb(process.pid))
            time.sleep(LOOK_S)
        _, status, usage = ended
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(map(str, command))}: exit code {process.returncode}")
    return usage.ru_utime + usage.ru_stime, peak_kb * 1024 / 1e6


def resident_peak_kb(pid: int) -> int:
    """Highest resident memory of a process so far [KiB]; 0 where it has just ended."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("VmHWM")), 0)


def compress(points: npt.NDArray[np.void], target: Path) -> tuple[float, float]:
    """The compression alone; CPU time [s]. No header: nobody reads the file."""
    extra_bytes = points.itemsize - laspy.PointFormat(6).size
    start = time.process_time()
    with target.open("wb") as stream:
        compressor = lazrs.ParLasZipCompressor(stream, lazrs.LazVlr.new_for_compression(6, extra_bytes))
        compressor.compress_many(points.view(np.uint8))
        compressor.done()
    return time.process_time() - start, 0.0


def timed(work: Callable[[], tuple[float, float]]) -> Run:
    """One run of a work that tells its CPU time and memory."""
    busy, start = busy_s(), time.perf_counter()
    cpu_s, peak_mb = work()
    wall_s = time.perf_counter() - start
    return Run(wall_s, cpu_s, max(0.0, busy_s() - busy - cpu_s) / wall_s, peak_mb)


def process(log: Path, folder: Path, *words: str) -> tuple[float, float]:
    """Process into a folder that is not there yet: nothing is taken over from an earlier run."""
    shutil.rmtree(folder, ignore_errors=True)
    return swath("process", log, *words, "-o", folder)


def first_runs(log: Path, folder: Path) -> dict[str, float]:
    """`swath warmup` with an empty cache of kernels, then the first and the second run."""
    os.environ["NUMBA_CACHE_DIR"] = str(folder / "kernels")
    warmup = timed(lambda: swath("warmup"))
    first, second = (timed(lambda: process(log, folder / "first")) for _ in range(2))
    print(f"warm-up {warmup.wall_s:.1f} s; first run {first.wall_s:.1f} s, second {second.wall_s:.1f} s", flush=True)
    return {"first_run_extra_s": first.wall_s - second.wall_s, "warmup_s": warmup.wall_s}


def cloud_points(path: Path) -> npt.NDArray[np.void]:
    """The points of a cloud as they are before compression."""
    with laspy.open(path) as cloud:
        return np.asarray(cloud.read_points(-1).array)


def measure(folder: Path) -> dict[str, Any]:
    """All figures."""
    log, products = folder / "flight" / "flight.mcap", folder / "products"
    swath("simulate", "--flight", FLIGHT, "--duration", str(FLIGHT_S), "--seed", "11", "-o", log.parent)
    figures: dict[str, Any] = first_runs(log, folder)
    process(log, products, "--method", "ins")
    points = cloud_points(products / "cloud.laz")
    works: dict[str, Callable[[], tuple[float, float]]] = {
        "swath process": lambda: process(log, products),
        "swath process --method ins": lambda: process(log, products, "--method", "ins"),
        "compression": lambda: compress(points, folder / "limit.laz"),
    }
    runs: dict[str, list[Run]] = {name: [] for name in works}
    for number in range(1, ROUNDS + 1):
        for name, work in works.items():
            run = timed(work)
            runs[name].append(run)
            print(
                f"round {number}, {name}: {run.wall_s:.2f} s, {FLIGHT_S / run.wall_s:.2f}x real time, CPU {run.cpu_s:.2f} s, "
                f"other programs took {run.other_load:.2f} of {CORES} cores",
                flush=True,
            )
    best, ins, limit = runs.values()
    for tail, each in (("", best), ("_ins", ins)):
        figures |= {
            f"real_time_factor{tail}": FLIGHT_S / min(run.wall_s for run in each),
            f"real_time_factor{tail}_median": FLIGHT_S / statistics.median(run.wall_s for run in each),
            f"share_of_laz_limit{tail}": statistics.median(
                b.wall_s / a.wall_s for a, b in zip(each, limit, strict=True)
            ),
            f"cpu_s_per_flight_s{tail}": min(run.cpu_s for run in each) / FLIGHT_S,
            f"peak_memory{tail}_mb": max(run.peak_mb for run in each),
        }
    return figures | {
        "laz_limit_real_time_factor": FLIGHT_S / min(run.wall_s for run in limit),
        "laz_limit_cpu_s_per_flight_s": min(run.cpu_s for run in limit) / FLIGHT_S,
        "other_load": statistics.mean(run.other_load for each in runs.values() for run in each),
        "cores": CORES,
        "flight_s": FLIGHT_S,
        "points_per_flight_s": len(points) / FLIGHT_S,
    }


def main() -> int:
    """Run and print the figures."""
    folder = Path(tempfile.mkdtemp(prefix="swath-process-"))
    try:
        figures = measure(folder)
    finally:
        shutil.rmtree(folder)
    print(json.dumps({name: round(value, 4) for name, value in figures.items()}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
