"""How fast `swath process` makes a cloud of a flight, and in how much memory; the compression of the cloud alone is the peer.

A flight of 30 s round the village is simulated and repeated to 120 s; the real command then processes it several times, in turn
with lazrs compressing the same points from memory on all cores, which nothing that writes LAZ can beat. The last line is one JSON
object:

real_time_factor           seconds of flight in a second of the whole command, from its start to its end; the best round
real_time_factor_median    the same, the median of the rounds
peak_memory_mb             highest resident memory of the command
cpu_s_per_flight_s         CPU time of the command for a second of flight, the least of the rounds
cpu_real_time_factor       what so much CPU time allows on all cores of this machine if nothing else runs
laz_limit_real_time_factor, laz_limit_cpu_s_per_flight_s
                           of the compression alone
share_of_laz_limit         speed of the command over that of the compression, the median of the rounds
other_load                 cores that other programs took, mean over the command's rounds; above 0.1 the wall times say little
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
from long_log import write_long_log
from machine import busy_s

ROUNDS: Final = 5
FLIGHT_S: Final = 30
TIMES: Final = 4
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
    """Run a command of swath; its CPU time [s] and highest resident memory [MB]."""
    command = [Path(sys.executable).with_name("swath"), *words]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(map(str, command))}: exit code {process.returncode}")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024 / 1e6


def compress(points: npt.NDArray[np.void], target: Path) -> tuple[float, float]:
    """The compression alone, as often as the flight is repeated; CPU time [s]. No header: nobody reads the file."""
    content = points.view(np.uint8)
    extra_bytes = points.itemsize - laspy.PointFormat(6).size
    start = time.process_time()
    with target.open("wb") as stream:
        compressor = lazrs.ParLasZipCompressor(stream, lazrs.LazVlr.new_for_compression(6, extra_bytes))
        for _ in range(TIMES):
            compressor.compress_many(content)
        compressor.done()
    return time.process_time() - start, 0.0


def timed(work: Callable[[], tuple[float, float]]) -> Run:
    """One run of a work that tells its CPU time and memory."""
    busy, start = busy_s(), time.perf_counter()
    cpu_s, peak_mb = work()
    wall_s = time.perf_counter() - start
    return Run(wall_s, cpu_s, max(0.0, busy_s() - busy - cpu_s) / wall_s, peak_mb)


def cloud_points(path: Path) -> npt.NDArray[np.void]:
    """The points of a cloud as they are before compression."""
    with laspy.open(path) as cloud:
        return np.asarray(cloud.read_points(-1).array)


def measure(folder: Path) -> dict[str, Any]:
    """All figures."""
    flight, long_log, products = folder / "flight", folder / "long.mcap", folder / "products"
    swath("simulate", "--scene", "village", "--duration", str(FLIGHT_S), "--seed", "1", "-o", flight)
    seconds = write_long_log(flight / "flight.mcap", long_log, TIMES)
    swath("process", flight / "flight.mcap", "--method", "ins", "-o", products)  # compiled kernels are kept for later
    points = cloud_points(products / "cloud.laz")
    runs: list[Run] = []
    limits: list[Run] = []
    for number in range(1, ROUNDS + 1):
        runs.append(timed(lambda: swath("process", long_log, "--method", "ins", "--force", "-o", products)))
        limits.append(timed(lambda: compress(points, folder / "limit.laz")))
        for name, run in (("swath process", runs[-1]), ("compression", limits[-1])):
            print(
                f"round {number}, {name}: {run.wall_s:.2f} s, {seconds / run.wall_s:.2f}x real time, CPU {run.cpu_s:.2f} s, "
                f"other programs took {run.other_load:.2f} of {CORES} cores",
                flush=True,
            )
    cpu_s, limit_cpu_s = (min(run.cpu_s for run in each) for each in (runs, limits))
    return {
        "real_time_factor": seconds / min(run.wall_s for run in runs),
        "real_time_factor_median": seconds / statistics.median(run.wall_s for run in runs),
        "peak_memory_mb": max(run.peak_mb for run in runs),
        "cpu_s_per_flight_s": cpu_s / seconds,
        "cpu_real_time_factor": CORES * seconds / cpu_s,
        "laz_limit_real_time_factor": seconds / min(run.wall_s for run in limits),
        "laz_limit_cpu_s_per_flight_s": limit_cpu_s / seconds,
        "share_of_laz_limit": statistics.median(b.wall_s / a.wall_s for a, b in zip(runs, limits, strict=True)),
        "other_load": statistics.mean(run.other_load for run in runs),
        "cores": CORES,
        "flight_s": seconds,
        "points_per_flight_s": TIMES * len(points) / seconds,
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
