"""What `swath live` costs and how far behind it is: a simulated flight played to it by `swath replay`, several times.

The last line is one JSON object:

cpu_s_per_flight_s     CPU time of the command for a second of flight, its start and its files included; the least of the rounds
real_time_factor       how many times faster than the flight one core would do that
lag_median_s, lag_95_s
                       age of a result when it was made, by the lidar's clock; the round with the smallest median
drops                  packets that found no room, and slices that were thinned or left out because it fell behind, all rounds
other_load             cores that other programs took, mean over the rounds; above 0.1 the lags say little
flight_s, rounds       of the measurement
"""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from machine import busy_s

ROUNDS: Final = 3
FLIGHT_S: Final = 30
START_ROWS: Final = 20
"""Rows of the first two seconds, while it catches up with its start."""
SWATH: Final = Path(sys.executable).with_name("swath")


@dataclass(frozen=True, slots=True)
class Run:
    """One flight followed."""

    cpu_s: float
    lags_s: tuple[float, float]
    drops: int
    other_load: float


def free_port(kind: int) -> int:
    """A port that nobody has."""
    with socket.socket(socket.AF_INET, kind) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


def status(page: int) -> dict[str, Any]:
    """What it says of itself."""
    with urllib.request.urlopen(f"http://127.0.0.1:{page}/status", timeout=60) as answer:
        return dict(json.load(answer))


def follow(log: Path, out: Path) -> Run:
    """Start it, play the flight, wait until nothing comes any more, end it."""
    lidar, position, mavlink = (free_port(socket.SOCK_DGRAM) for _ in range(3))
    page = free_port(socket.SOCK_STREAM)
    ports = ["--lidar-port", str(lidar), "--position-port", str(position), "--mavlink", f"udp:127.0.0.1:{mavlink}"]
    words = ["--address", "127.0.0.1", *ports, "--port", str(page), "--json", "-o", str(out)]
    with subprocess.Popen(
        [SWATH, "live", *words], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as live:
        assert live.stderr is not None
        while not live.stderr.readline().startswith("listening"):
            if live.poll() is not None:
                raise SystemExit(f"swath live: exit code {live.returncode}")
        busy, start_s = busy_s(), time.monotonic()
        subprocess.run([SWATH, "replay", str(log), *ports], check=True, stdout=subprocess.DEVNULL)
        wall_s, busy = time.monotonic() - start_s, busy_s() - busy
        seconds = -1.0
        while (now := status(page)["seconds"]) != seconds:
            seconds = now
            time.sleep(2.0)
        found = status(page)
        live.send_signal(signal.SIGTERM)
        _, code, usage = os.wait4(live.pid, 0)
        live.returncode = os.waitstatus_to_exitcode(code)
    if live.returncode:
        raise SystemExit(f"swath live: exit code {live.returncode}")
    cpu_s = usage.ru_utime + usage.ru_stime
    lags = np.genfromtxt(out / "trajectory_live.csv", delimiter=",", names=True)["lag_s"][START_ROWS:]
    counts = found["counts"]
    drops = found["drops"]["kernel"] + found["drops"]["queue"] + counts["thinned_slices"] + counts["skipped_slices"]
    median, late = np.percentile(lags, [50, 95])
    return Run(cpu_s, (float(median), float(late)), drops, max(0.0, busy - cpu_s) / wall_s)


def measure(folder: Path) -> dict[str, Any]:
    """All figures."""
    simulate = ["simulate", "--scene", "village", "--duration", str(FLIGHT_S), "--seed", "1", "-o", folder / "flight"]
    subprocess.run([SWATH, *simulate], check=True, stdout=subprocess.DEVNULL)
    runs = []
    for number in range(1, ROUNDS + 1):
        runs.append(follow(folder / "flight" / "flight.mcap", folder / f"live{number}"))
        print(f"round {number}: CPU {runs[-1].cpu_s:.2f} s, behind by {runs[-1].lags_s[0]:.3f} s", flush=True)
    cpu_s = min(run.cpu_s for run in runs)
    median, late = min(run.lags_s for run in runs)
    return {
        "cpu_s_per_flight_s": cpu_s / FLIGHT_S,
        "real_time_factor": FLIGHT_S / cpu_s,
        "lag_median_s": median,
        "lag_95_s": late,
        "drops": sum(run.drops for run in runs),
        "other_load": float(np.mean([run.other_load for run in runs])),
        "flight_s": FLIGHT_S,
        "rounds": ROUNDS,
    }


def main() -> int:
    """Run and print the figures."""
    folder = Path(tempfile.mkdtemp(prefix="swath-live-"))
    try:
        figures = measure(folder)
    finally:
        shutil.rmtree(folder)
    print(json.dumps({name: round(value, 4) for name, value in figures.items()}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
