"""Recordings, and simulated flights that several tests process: made once for a test run, whatever the number of its workers."""

import json
import os
import pickle
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

# Workers fill the cores already. Threads of OpenBLAS and OpenMP that wait for their next small piece would keep them busy:
# five times the work for a block of images. To be said before numpy is loaded; programs that tests start hear it too.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, settings

# no test judges by a clock, and so no example does
settings.register_profile("swath", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("swath")

# a shell starts background jobs deaf to Ctrl-C, and so would be every program that a test interrupts
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

LONGEST = (
    "end_to_end/test_adjusted.py",
    "groundproc/steps/test_images.py",
    "end_to_end/test_process.py",
    "end_to_end/test_live.py",
    "groundproc/estimation/test_filtered.py",
    "groundproc/strips/test_adjust_command.py",
    "groundproc/imagery/test_on_trajectory.py",
    "groundproc/steps/test_steps.py",
    "groundproc/campaign/test_batch.py",
    "end_to_end/test_estimate_folder.py",
    "end_to_end/test_dynamic.py",
    "end_to_end/test_adjusted_anchored.py",
    "groundproc/analysis/test_smooth_command.py",
    "groundproc/imagery/test_hamlet.py",
    "end_to_end/test_pull.py",
    "end_to_end/test_package.py",
    "end_to_end/test_bare_install.py",
    "groundproc/assessment/test_targets.py",
    "groundproc/analysis/test_section_and_fuse.py",
)
"""Files that take half a minute and more, the longest first; files of one flight apart, or the second waits for the first to make it."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files begin: one that came last would keep one worker while the other is idle."""
    rank = {Path(__file__).parent / name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path, len(rank)))


@dataclass(frozen=True)
class Simulated:
    """Files of a simulated flight."""

    folder: Path

    @property
    def log(self) -> Path:
        return self.folder / "flight.mcap"

    @property
    def capture(self) -> Path:
        return self.folder / "capture.pcap"

    @property
    def telemetry(self) -> Path:
        return self.folder / "telemetry.tlog"

    @property
    def board(self) -> Path:
        return self.folder / "board.bin"

    @property
    def poses_file(self) -> Path:
        return self.folder / "truth.csv"

    @cached_property
    def truth(self) -> dict[str, Any]:
        content: dict[str, Any] = json.loads((self.folder / "truth.json").read_text())
        return content

    @cached_property
    def poses(self) -> npt.NDArray[np.void]:
        return np.asarray(np.genfromtxt(self.poses_file, delimiter=",", names=True, dtype=None))

    def offset_s(self, lidar_s: float) -> float:
        """True boot time minus lidar time when the lidar's clock, as it sends it, shows `lidar_s`."""
        lidar, boot = self.truth["clocks"]["lidar"], self.truth["clocks"]["boot"]
        elapsed_s = (lidar_s - lidar["start_ns"] * 1e-9) / (1 + lidar["drift_ppm"] * 1e-6)
        return float(boot["start_ns"] * 1e-9 + elapsed_s * (1 + boot["drift_ppm"] * 1e-6) - lidar_s)


def _render(folder: Path, scene: str, seconds: float, seed: int, options: Any, every: int, *more: str) -> None:
    """All files of a simulation, with the lidar's data packets of one 0.1 s in `every` only: rays are what costs."""
    from simulator.recording import CAPTURE, LOG, POINTS, POSES, TLOG, TRUTH, Recording
    from simulator.simulation import Job, Simulation
    from simulator.truth import write_json

    simulation = Simulation(Job(scene, seconds, seed, folder, options))
    with Recording(simulation, {name: folder / name for name in (LOG, CAPTURE, TLOG, POSES, *more)}) as recording:
        for chunk in range(simulation.chunks):
            sweep = simulation.lidar.sweep(0, 0) if chunk % every else simulation.sweep(chunk, POINTS in more)
            recording.add(chunk, sweep)
    write_json(folder / TRUTH, simulation.truth())


def _once(folder: Path, make: Callable[[], None]) -> None:
    """Have a folder filled by the first worker that asks; the others wait for it."""
    done = folder.with_name(f"{folder.name}.done")
    try:
        folder.mkdir()
    except FileExistsError:  # made already, or another worker is at it
        deadline = time.monotonic() + 900.0
        while not done.exists():
            assert time.monotonic() < deadline, f"{folder.name}: the worker that makes it has not finished in 900 s"
            time.sleep(0.1)
        return
    make()
    done.touch()


@pytest.fixture(scope="session")
def common(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that all workers of a test run share."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "simulated"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def simulated(common: Path) -> Callable[..., Simulated]:
    """A function that simulates: simulated(name, scene, seconds, options, seed=..., every=...); the name is its folder.

    What takes long and is asked for rarely is made on demand: points=True the true echoes, board=True the board's own log.
    """
    from simulator.recording import BOARD, POINTS

    def get(
        name: str,
        scene: str,
        seconds: float,
        options: Any,
        *,
        seed: int = 5,
        every: int = 1,
        points: bool = False,
        board: bool = False,
    ) -> Simulated:
        more = [POINTS] * points + [BOARD] * board
        _once(common / name, lambda: _render(common / name, scene, seconds, seed, options, every, *more))
        return Simulated(common / name)

    return get


@pytest.fixture(scope="session")
def adjustment(common: Path) -> Callable[[Simulated], Any]:
    """A function that gives the best estimate of a simulated flight, begun from its nominal mount: a whole adjustment, solved once."""
    from flightlog.logfile import LogReader
    from groundproc.accuracy.truth import read_truth
    from groundproc.estimation import methods
    from groundproc.estimation.method import gather
    from groundproc.flight.flight import read_flight
    from groundproc.flight.pairing import legs
    from groundproc.survey import Survey

    def get(flight: Simulated) -> Any:
        folder = common / f"{flight.folder.name}_adjustment"

        def make() -> None:
            truth = read_truth(flight.folder)
            with LogReader(truth.log) as reader:
                read = read_flight([reader], "ins")
                timeline = legs(read.runs, read.boots, truth.nominal_mount.mat_ins_lidar(), "auto")
                given = gather([reader], read, timeline, truth.nominal_mount, Survey())
                made = methods.estimate(given, lambda stage, size: None)
            (folder / "estimate.pickle").write_bytes(pickle.dumps(made))

        _once(folder, make)
        return pickle.loads((folder / "estimate.pickle").read_bytes())

    return get


@pytest.fixture(scope="session")
def house_flight(simulated: Callable[..., Simulated]) -> Simulated:
    """A third of the flight by which methods are judged: along buildings at 5 m/s, gyros at 100 Hz, boresight, delay and scales off."""
    from simulator.plans import plan

    return simulated("house_flight", "village", 20.0, plan("survey_fast_gyro").options, seed=11, points=True)


@pytest.fixture(scope="session")
def meadow_flight(simulated: Callable[..., Simulated]) -> Simulated:
    """Three seconds of hover, the take-off and two thirds of a line over rough ground with tufts, trees and two cars."""
    from simulator.plans import plan

    return simulated("meadow_flight", "meadow", 16.0, plan("meadow").options, seed=31)


@pytest.fixture(scope="session")
def live_flight(simulated: Callable[..., Simulated]) -> Simulated:
    """18 s round the village with all errors, every firing of them; beams without width, which are quicker to cast."""
    from simulator.config import Options

    options = Options()
    options = replace(options, lidar=replace(options.lidar, footprint_mrad=0.0))
    return simulated("live_flight", "village", 18.0, options)


@pytest.fixture(scope="session")
def gps_flight(simulated: Callable[..., Simulated]) -> Simulated:
    """16 s over level ground and along a wall, with all errors; the lidar's clock is steered by its own GPS.

    One revolution in ten: what is asked of its cloud, any of them tells.
    """
    from simulator.config import Options

    options = Options()
    options = replace(options, clocks=replace(options.clocks, lidar_gps=True))
    return simulated("gps_flight", "field", 16.0, options, every=10)


@pytest.fixture(scope="session")
def plain_flight(simulated: Callable[..., Simulated]) -> Simulated:
    """25 s round the village, with all errors and no GPS on the lidar: its clock counts from power-on."""
    from simulator.config import Options

    return simulated("plain_flight", "village", 25.0, Options(), every=20, board=True)


@pytest.fixture(scope="session")
def dual_flight(simulated: Callable[..., Simulated]) -> Simulated:
    """3 s in the village in dual return mode: too short to synchronise by gyros."""
    from simulator.config import Options

    options = Options()
    options = replace(options, lidar=replace(options.lidar, returns="dual"))
    return simulated("dual_flight", "village", 3.0, options, every=3)


@pytest.fixture(scope="session")
def still_flight(simulated: Callable[..., Simulated]) -> Simulated:
    """12 s on a tripod: nothing to correlate."""
    from simulator.config import Options

    return simulated("still_flight", "panels", 12.0, Options(), every=20)


@pytest.fixture(scope="session")
def rebooted_flight(simulated: Callable[..., Simulated]) -> Simulated:
    """45 s with a reboot of the autopilot from 20 to 24 s, over MAVLink 2."""
    from simulator.config import Options

    options = Options()
    options = replace(
        options,
        faults=replace(options.faults, reboot_at_s=20.0, reboot_silence_s=4.0),
        link=replace(options.link, version=2),
    )
    return simulated("rebooted_flight", "village", 45.0, options, every=20)


@pytest.fixture(scope="session")
def judged_flight(simulated: Callable[..., Simulated]) -> Simulated:
    """20 s round the village with all errors and a boresight that is off; the true echoes are there."""
    from simulator.config import MountOptions, Options

    options = replace(Options(), mount=MountOptions(boresight_deg=(0.6, -0.5, 0.8), lever_m=(0.01, -0.02, 0.01)))
    return simulated("judged_flight", "village", 20.0, options, every=10, points=True)


@pytest.fixture(scope="session")
def perfect_flight(simulated: Callable[..., Simulated]) -> Simulated:
    """15 s round the village with perfect instruments; clocks still differ and drift."""
    from simulator.config import Options, perfect

    return simulated("perfect_flight", "village", 15.0, perfect(Options()), every=50)


@pytest.fixture(scope="session")
def recordings() -> Path:
    folder = os.environ.get("SWATH_RECORDINGS")
    if not folder:
        pytest.skip("SWATH_RECORDINGS is not set: no recordings to test with")
    return Path(folder)


@pytest.fixture(scope="session")
def cases(recordings: Path) -> Path:
    """Folder of the small inputs that failed once, beside the recordings."""
    folder = recordings.parent / "cases"
    if not folder.is_dir():
        pytest.skip("no folder `cases` beside the recordings")
    return folder


@pytest.fixture(scope="session")
def monterey_log(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recorded HDL-32E and the copter's telemetry log, imported."""
    from groundproc.cli import main

    path = tmp_path_factory.mktemp("monterey") / "monterey.mcap"
    words = ["import", "--pcap", str(recordings / "lidar/hdl32e_monterey.pcap"), "-o", str(path)]
    assert main([*words, "--mavlink", str(recordings / "mavlink/copter_flight_2015.tlog")]) == 0
    return path
