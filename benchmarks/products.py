"""What it costs to make all products of a flight: `make bench-products`, or benchmarks/products.py [OPTIONS] [FIGURE ...].

A survey at the full rate of the sensor is simulated, and processed by the real command with the default method. Peers are measured in turn
with ours, on the same points. The last line is one JSON object:

real_time_factor_all        seconds of flight in a second of `swath process`, all products of the default; the best round
laz_write_ratio_to_laspy    speed of our writing of LAZ over that of laspy with one thread of lazrs, by the clock; median of the rounds
copc_ratio_to_copclib_numpy speed of our writing of COPC over copclib's with an octree of numpy, by CPU time; median of the rounds
grid_mpts_per_cpu_s         million points in a CPU-second into cells of 0.25 m: lowest, highest, mean, deviation, count; the best round
two_worker_speedup          two flights by two Dask workers of one thread each, over the same by one worker
peak_gb_60min               highest resident memory of the longest flight
time_per_minute_spread      by how much CPU time for a minute of flight differs between the shortest and the longest flight
report_seconds              until a million points of a report are seen: see report.py

The long flights are over a town, with beams as lines so that their rendering ends. An hour (`--minutes 5 60`) takes half an hour to render,
more than an hour to process, and 60 GB of disk; the default is shorter. `--long LOG ...` takes flights that are there. Each
FIGURE is measured by itself where it is named: on a busy machine those of CPU time and memory (copc, grid, peak, spread) still hold, those
by the clock (real_time, laz, workers, report) do not. `workers --seconds 10` is short. Lines that begin with `note:` say what the figures
are of; docs/benchmarks.md keeps them.
"""

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, NamedTuple

import laspy
import numpy as np
import numpy.typing as npt
from machine import busy_s
from peers import clouds
from process import CORES, compress, resident_peak_kb

from groundproc.cloud import copc, packer, reader, writer
from groundproc.cloud.points import Points
from groundproc.products import REGISTRY
from groundproc.raster.cells import STATISTICS, Cells

ROOT: Final = Path(__file__).resolve().parents[1]
FLIGHT: Final = "survey_fast_gyro"
LONG_FLIGHT: Final = "long"
LONG_OPTIONS: Final = "lidar: {footprint_mrad: 0}\n"
"""Beams without width: several times quicker to render, and as many points."""
CELL_M: Final = 0.25
PIECE: Final = 200_000
"""Points handed on at once, as they are placed."""
LIMIT_AT_GOAL: Final = 24.0
"""Real time factor of two threads of lazrs on the machine that the goals are for."""
GOOD: Final = (0, 3)
"""Exit codes of a flight whose products are there, good or doubtful."""
Figures = dict[str, float | None]


class Bench:
    """What the figures are measured on.

    Parameters
    ----------
    folder : Path
        For everything that is made.
    log : Path
    seconds : float
        Of flight in it.
    minutes : list of float
        Lengths of the flights that memory and time are compared for.
    long_logs : list of Path
        Such flights where they are there already; else they are rendered.
    rounds : int
    """

    def __init__(
        self, folder: Path, log: Path, seconds: float, minutes: list[float], long_logs: list[Path], rounds: int
    ) -> None:
        self.folder, self.log, self.seconds, self.rounds = folder, log, seconds, rounds
        self._records: tuple[laspy.LasHeader, npt.NDArray[np.void], list[Points]] | None = None
        self._sources: list[float | Path] = [*long_logs] or [*minutes]
        self._long: list[Long] = []

    def cloud(self) -> tuple[laspy.LasHeader, npt.NDArray[np.void], list[Points]]:
        """Header, records and points of the flight's cloud, with all attributes."""
        if self._records is None:
            path = self.folder / "all" / "cloud.laz"
            if not path.exists():
                process(self.log, path.parent)
            with laspy.open(path) as file:
                records = np.asarray(file.read_points(-1).array)
                header = file.header
            cloud = reader.look(path)
            pieces = [chunk.points for chunk in reader.chunks(cloud)]
            self._records = header, records, [each for piece in pieces for each in cut(piece)]
        return self._records

    def long(self) -> list["Long"]:
        """The long flights, processed, the shortest first."""
        if not self._long:
            self._long = sorted(self._processed(each) for each in self._sources)
        return self._long

    def _processed(self, source: float | Path) -> "Long":
        """A flight of so many minutes, or that of a log."""
        log, out = self.folder / "rendered" / "flight.mcap", self.folder / "long"
        if isinstance(source, Path):
            log = source
        else:
            simulate(LONG_FLIGHT, 60.0 * source, log.parent, LONG_OPTIONS)
        wall_s, cpu_s, peak_gb = process(log, out)
        quality = json.loads((out / "quality.json").read_text())
        minutes = quality["trajectory"]["covered_s"] / 60.0
        shutil.rmtree(out)
        if log is not source:
            shutil.rmtree(log.parent)
        found = Long(minutes, cpu_s / minutes, peak_gb, minutes * 60.0 / wall_s, quality["points"]["written"] / 1e6)
        print(found.told, flush=True)
        return found


class Long(NamedTuple):
    """What a long flight took: minutes, CPU time [s] a minute, highest resident memory [GB], times real time, million points."""

    minutes: float
    cpu_s_a_minute: float
    peak_gb: float
    real_time: float
    mpoints: float

    @property
    def told(self) -> str:
        """In words."""
        return (
            f"{self.minutes:.1f} min, {self.mpoints:.0f} M points: {self.cpu_s_a_minute:.1f} CPU-s a minute, "
            f"{self.peak_gb:.2f} GB, {self.real_time:.2f} x real time"
        )


def simulate(flight: str, seconds: float, folder: Path, options: str = "") -> None:
    """Render a named flight into a folder."""
    folder.mkdir()
    words = ["simulate", "--flight", flight, "--duration", str(seconds), "--seed", "11", "-o", folder]
    if options:
        file = folder / "options.yaml"
        file.write_text(options)
        words += ["--config", file]
    program = "import sys; from groundproc.cli import main; sys.exit(main())"
    subprocess.run([sys.executable, "-c", program, *words], check=True, stdout=subprocess.DEVNULL, env=as_installed())


def cut(points: Points) -> list[Points]:
    """Pieces as they come from placing."""
    return [points.masked(slice(start, start + PIECE)) for start in range(0, len(points), PIECE)]


def note(text: str) -> None:
    """Say what a figure is of."""
    print(f"note: {text}", flush=True)


def as_installed() -> dict[str, str]:
    """The environment of the command: modules have their byte code, which the first run leaves beside the sources."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    return environment


def process(log: Path, folder: Path, *words: str) -> tuple[float, float, float]:
    """`swath process` into an empty folder: seconds by the clock, CPU time [s], highest resident memory [GB]."""
    shutil.rmtree(folder, ignore_errors=True)
    program = "import sys; from groundproc.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "process", log, "-o", folder, *words]
    peak_kb, began = 0, time.perf_counter()
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, env=as_installed()) as child:
        while not (ended := os.wait4(child.pid, os.WNOHANG))[0]:
            peak_kb = max(peak_kb, resident_peak_kb(child.pid))
            time.sleep(0.05)
        child.returncode = os.waitstatus_to_exitcode(ended[1])
    if child.returncode not in GOOD:
        raise SystemExit(f"swath process {log}: exit code {child.returncode}")
    wall_s, usage = time.perf_counter() - began, ended[2]
    return wall_s, usage.ru_utime + usage.ru_stime, peak_kb * 1024 / 1e9


def cost(work: Callable[[], object]) -> tuple[float, float]:
    """Seconds by the clock and CPU time [s] of a work."""
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - cpu


def in_turn(rounds: int, ours: Callable[[], object], peer: Callable[[], object]) -> tuple[float, float]:
    """How many times faster ours is: by the clock and by CPU time, medians of the rounds."""
    ours()  # what is compiled at first use is so now
    both = [(cost(ours), cost(peer)) for _ in range(rounds)]
    wall, cpu = (statistics.median(theirs[k] / own[k] for own, theirs in both) for k in (0, 1))
    return wall, cpu


def real_time(bench: Bench) -> Figures:
    """All products of the default, and the same without COPC; and what lazrs alone would take."""
    plain = ",".join(name for name, entry in REGISTRY.items() if entry.by_default and name != "cloud.copc.laz")
    process(bench.log, bench.folder / "all")
    every, without, limit = [], [], []
    busy, began = busy_s(), time.perf_counter()
    records = bench.cloud()[1]
    for _ in range(bench.rounds):
        every.append(process(bench.log, bench.folder / "all"))
        without.append(process(bench.log, bench.folder / "plain", "--products", plain))
        limit.append(cost(lambda: compress(records, bench.folder / "limit.laz")))
    own_s = sum(run[1] for run in (*every, *without)) + sum(cpu_s for _, cpu_s in limit)
    other = (busy_s() - busy - own_s) / (time.perf_counter() - began)
    factor, factor_plain = (bench.seconds / min(run[0] for run in runs) for runs in (every, without))
    of_limit = bench.seconds / min(wall_s for wall_s, _ in limit)
    note(
        f"real_time_factor_all on {bench.seconds:.0f} s of flight with {len(records) / 1e6:.1f} M points and {CORES} cores; "
        f"{min(run[1] for run in every):.1f} CPU-s, {max(run[2] for run in every):.2f} GB; without COPC {factor_plain:.2f}, "
        f"{min(run[1] for run in without):.1f} CPU-s; {CORES} threads of lazrs alone {of_limit:.1f}, so that goals of 1.5 and 3.0 (for "
        f"{LIMIT_AT_GOAL:.0f}) are {1.5 * of_limit / LIMIT_AT_GOAL:.2f} and {3.0 * of_limit / LIMIT_AT_GOAL:.2f} here; "
        f"other programs took {other:.2f} cores"
    )
    return {"real_time_factor_all": factor}


def laz(bench: Bench) -> Figures:
    """LAZ of points that are in memory; the peer is given records that are packed already."""
    header, records, pieces = bench.cloud()

    def ours() -> None:
        with writer.CloudWriter(
            bench.folder / "ours.laz", pieces[0].columns, offset_m=header.offsets.tolist(), gps=False
        ) as out:
            for each in pieces:
                out.write(each)

    wall, cpu = in_turn(
        bench.rounds, ours, lambda: clouds.write_laz(bench.folder / "peer.laz", header, records, writer.BUFFER_POINTS)
    )
    sizes = [(bench.folder / f"{name}.laz").stat().st_size / 1e6 for name in ("ours", "peer")]
    note(f"laz_write_ratio_to_laspy by CPU time {cpu:.2f}; {sizes[0]:.1f} and {sizes[1]:.1f} MB")
    return {"laz_write_ratio_to_laspy": wall}


def copc_(bench: Bench) -> Figures:
    """COPC of points that are in memory; the peer is given records that are packed already."""
    header, records, pieces = bench.cloud()
    path = bench.folder / "ours.copc.laz"

    def ours() -> None:
        packing = packer.Packer(path, pieces[0].columns, offset_m=header.offsets.tolist(), gps=False)
        builder = copc.CopcBuilder(packing.header, bench.folder)
        for each in pieces:
            out = np.zeros(len(each), packing.dtype)
            packing.pack(each, out)
            builder.add(out)
        packing.state_totals(packing.header)
        builder.write(path)

    peer = bench.folder / "peer.copc.laz"
    wall, cpu = in_turn(bench.rounds, ours, lambda: clouds.write_copc(peer, header, records))
    note(
        f"copc_ratio_to_copclib_numpy by the clock {wall:.2f}; {path.stat().st_size / 1e6:.1f} MB, the peer's "
        f"{peer.stat().st_size / 1e6:.1f}"
    )
    return {"copc_ratio_to_copclib_numpy": cpu}


def grid(bench: Bench) -> Figures:
    """Heights by cell."""
    pieces = bench.cloud()[2]

    def gather() -> None:
        cells = Cells(CELL_M, STATISTICS)
        for each in pieces:
            cells.add(each.xyz_m, each.xyz_m[:, 2])

    gather()
    cpu_s = min(cost(gather)[1] for _ in range(bench.rounds))
    return {"grid_mpts_per_cpu_s": sum(map(len, pieces)) / 1e6 / cpu_s}


def workers(bench: Bench) -> Figures:
    """Two flights of a campaign on a Dask cluster of one worker, then of two."""
    took: list[float] = []
    for count in (1, 2):
        with Cluster(bench.folder, count) as address:
            file = bench.folder / f"flights{count}.yaml"
            shutil.rmtree(bench.folder / f"campaign{count}", ignore_errors=True)
            flights = [{"name": name, "logs": [str(bench.log)]} for name in "ab"]
            # JSON is YAML
            file.write_text(json.dumps({"output": str(bench.folder / f"campaign{count}"), "flights": flights}))
            program = "import sys; from groundproc.cli import main; sys.exit(main())"
            began = time.perf_counter()
            command = [sys.executable, "-c", program, "batch", file, "--scheduler", address]
            done = subprocess.run(command, stdout=subprocess.DEVNULL, env=as_installed(), check=False)
            took.append(time.perf_counter() - began)
            if done.returncode not in GOOD:
                raise SystemExit(f"swath batch: exit code {done.returncode}")
    note(f"two_worker_speedup of two flights of {bench.seconds:.0f} s: {took[0]:.1f} and {took[1]:.1f} s")
    return {"two_worker_speedup": took[0] / took[1]}


class Cluster:
    """A Dask scheduler and workers of one thread each on this computer, as a context manager: its address."""

    def __init__(self, folder: Path, workers: int) -> None:
        self._folder, self._workers = folder, workers
        self._running: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> str:
        told = self._folder / f"scheduler{self._workers}.json"
        told.unlink(missing_ok=True)
        self._start("dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", told)
        for _ in range(self._workers):
            words = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", self._folder]
            self._start("dask_worker", "--scheduler-file", told, *words)
        from dask.distributed import Client

        # Dask is not typed
        with Client(scheduler_file=str(told), timeout="60s", set_as_default=False) as client:  # type: ignore[no-untyped-call]
            client.wait_for_workers(self._workers, timeout=60.0)  # type: ignore[no-untyped-call]
            return str(client.scheduler.address)

    def __exit__(self, *_: object) -> None:
        for each in reversed(self._running):
            each.terminate()
            each.wait()

    def _start(self, name: str, *words: str | Path) -> None:
        command = [sys.executable, "-W", "ignore", "-m", f"distributed.cli.{name}", *words]
        self._running.append(
            subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=as_installed())
        )


def peak(bench: Bench) -> Figures:
    """Memory of the longest flight: other programs do not change it."""
    longest = bench.long()[-1]
    note(f"peak_gb_60min is of {longest.told}")
    return {"peak_gb_60min": longest.peak_gb}


def spread(bench: Bench) -> Figures:
    """CPU time for a minute of flights of several lengths."""
    note(f"time_per_minute_spread of {'; '.join(each.told for each in bench.long())}")
    costs = [each.cpu_s_a_minute for each in bench.long()]
    return {"time_per_minute_spread": max(costs) / min(costs) - 1.0}


def report(bench: Bench) -> Figures:
    """A million points of a report in Chromium."""
    del bench
    done = subprocess.run(
        [sys.executable, ROOT / "benchmarks" / "report.py"], stdout=subprocess.PIPE, text=True, check=False
    )
    if done.returncode:
        return {"report_seconds": None}
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    note(
        f"report_seconds of {found['report_points']:,} points, {found['report_mb']} MB, {found['console_errors']} console errors, "
        f"{found['requests']} requests; least {found['report_seconds_least']}; the machine was busy to {found['busy_share']:.0%}"
    )
    return {"report_seconds": found["report_seconds"]}


FIGURES: Final[dict[str, Callable[[Bench], Figures]]] = {
    "real_time": real_time,
    "laz": laz,
    "copc": copc_,
    "grid": grid,
    "workers": workers,
    "peak": peak,
    "spread": spread,
    "report": report,
}
"""What may be measured, by the words of the command line."""


def main() -> int:
    """Measure what was asked for, or all."""
    parser = argparse.ArgumentParser(description="What it costs to make all products of a flight.")
    parser.add_argument("figures", nargs="*", metavar="FIGURE", help=f"of {', '.join(FIGURES)}; default: all")
    parser.add_argument("--log", type=Path, metavar="MCAP", help=f"a flight; default: {FLIGHT} is simulated")
    parser.add_argument("--seconds", type=float, default=30.0, metavar="S", help="of flight, default 30")
    parser.add_argument(
        "--minutes", type=float, nargs="+", default=[1.0, 4.0], metavar="MIN", help="lengths to compare, default 1 4"
    )
    parser.add_argument("--long", type=Path, nargs="+", default=[], metavar="MCAP", help="flights to compare instead")
    parser.add_argument("--rounds", type=int, default=3, metavar="N", help="of what is compared, default 3")
    asked = parser.parse_args()
    if unknown := set(asked.figures) - set(FIGURES):
        parser.error(f"{', '.join(sorted(unknown))} found, expected some of {', '.join(FIGURES)}")
    with tempfile.TemporaryDirectory(prefix="bench-products-") as name:
        folder, log = Path(name), asked.log
        if log is None:
            log = folder / "flight" / "flight.mcap"
            simulate(FLIGHT, asked.seconds, log.parent)
        bench = Bench(folder, log, asked.seconds, asked.minutes, asked.long, asked.rounds)
        found = Figures()
        for each in asked.figures or FIGURES:
            found |= FIGURES[each](bench)
            print(f"{each}: {found}", file=sys.stderr, flush=True)
    print(json.dumps({key: value if value is None else round(value, 3) for key, value in found.items()}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
