"""A simulation from start to end: pieces of about 0.1 s in order, rendered by several threads, written as they come.

What is written does not depend on the number of threads.
"""

import dataclasses
import shutil
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
import numpy.typing as npt

from flightlog import __version__, records
from flightlog.config import dump, to_mapping
from flightlog.constants import NS_PER_S, NS_PER_US
from flightlog.errors import SwathError
from flightlog.hdl32e import BLOCKS, DATA_PORT, FIRING_NS, POSITION_PORT
from flightlog.logfile import LogWriter
from flightlog.mount import Mount
from simulator.autopilot import Autopilot, Frame
from simulator.boardlog import BoardLog
from simulator.cameras import CameraOptions, built, noted
from simulator.capture import PcapWriter, tlog_record
from simulator.chance import generator
from simulator.clocks import Clocks, clocks
from simulator.config import Options
from simulator.faults import Outage, Reboot, arriving
from simulator.flight import Flight
from simulator.geodesy import Origin
from simulator.ins import Ins
from simulator.lidar import Lidar, Sweep
from simulator.moving import Traffic
from simulator.photographs import Studio
from simulator.rtk import solution
from simulator.scene import Scene, scene
from simulator.telemetry import Telemetry
from simulator.truth import COLUMNS, PointsWriter, write_json, write_poses

Array = npt.NDArray[np.float64]

LOG, CAPTURE, TLOG, BOARD, POSES, TRUTH, POINTS, RTK, IMAGES = (
    "flight.mcap",
    "capture.pcap",
    "telemetry.tlog",
    "board.bin",
    "truth.csv",
    "truth.json",
    "truth_points.npy",
    "rtk.pos",
    "images",
)
FILES: Final = (LOG, CAPTURE, TLOG, BOARD, POSES, TRUTH)
"""Of every flight."""
_FIRINGS_IN_A_CHUNK: Final = 181 * BLOCKS
_NETWORK_S: Final = 50e-6


@dataclass(frozen=True, slots=True)
class Job:
    """What to simulate and where to put it."""

    scene: str
    duration_s: float
    seed: int
    directory: Path
    options: Options
    workers: int = 2
    truth_points: bool = False
    cameras: Mapping[str, CameraOptions] = field(default_factory=dict)


def logged_mount(scenes: Mount, options: Options) -> Mount:
    """The nominal mount, as the log has it: the scene's where the options do not say otherwise, with the antenna of the options."""
    o = options.mount
    lidar = scenes.lidar
    if o.lidar_position_m is not None:
        lidar = dataclasses.replace(lidar, position_m=o.lidar_position_m)
    if o.lidar_deg is not None:
        yaw, pitch, roll = o.lidar_deg
        lidar = dataclasses.replace(lidar, yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll)
    return dataclasses.replace(scenes, lidar=lidar, gps_position_m=o.gps_position_m)


def true_mount(nominal: Mount, options: Options, seed: int) -> Mount:
    """The mount as it really is, the nominal one changed by the options and by chance."""
    o = options.mount
    by_chance = generator(seed, "mount").uniform(-1.0, 1.0, (2, 3))
    yaw, pitch, roll = np.add(o.boresight_deg, o.boresight_spread_deg * by_chance[0]).tolist()
    position = np.add(nominal.lidar.position_m, o.lever_m) + o.lever_spread_m * by_chance[1]
    antenna = nominal.gps_position_m
    if any(o.gps_error_m):
        antenna = _triple(np.add((0.0, 0.0, 0.0) if antenna is None else antenna, o.gps_error_m))
    turned = nominal.with_lidar(
        position_m=_triple(position),
        yaw_deg=nominal.lidar.yaw_deg + yaw,
        pitch_deg=nominal.lidar.pitch_deg + pitch,
        roll_deg=nominal.lidar.roll_deg + roll,
    )
    return dataclasses.replace(turned, gps_position_m=antenna)


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


class Simulation:
    """Scene, flight and instruments of one job."""

    def __init__(self, job: Job) -> None:
        self.job = job
        options, seed = job.options, job.seed
        self.scene: Scene = scene(job.scene, seed, options.flight.route)
        self.clocks: Clocks = clocks(options.clocks)
        self.origin = Origin()
        self.flight = Flight(self.scene.route, job.duration_s, options.flight, seed)
        self.nominal_mount = logged_mount(self.scene.mount, options)
        self.mount = true_mount(self.nominal_mount, options, seed)
        self.ins = Ins(self.flight, options.ins, seed, self.mount.gps_position_m, options.faults)
        self.traffic = Traffic(self.scene.tracks, options.moving, seed)
        self.lidar = Lidar(
            self.scene.world, self.flight, self.mount, self.clocks.lidar, options.lidar, seed, self.traffic
        )
        self.telemetry = Telemetry(self.flight, self.mount, self.clocks, options, self.origin, seed)
        self.studio = Studio(
            self.scene.world, self.lidar.surfaces, self.flight, tuple(built(*item, seed) for item in job.cameras.items()),
            self.clocks, self.origin, seed,
        )  # fmt: skip
        self.noted = noted(self.studio.cameras, self.studio.exposures, seed)
        self.autopilot = Autopilot(self.ins, self.clocks, options, self.origin, seed, self.noted)

    @property
    def chunk_packets(self) -> int:
        """Data packets in a piece."""
        return _FIRINGS_IN_A_CHUNK // (BLOCKS // 2 if self.job.options.lidar.returns == "dual" else BLOCKS)

    @property
    def chunks(self) -> int:
        """Pieces in the flight; the last reaches no further than its end."""
        return -(-self.lidar.packets_until(self.job.duration_s) // self.chunk_packets)

    def bounds_s(self, chunk: int) -> tuple[float, float]:
        """True time at which a piece starts and ends."""
        edges_s = np.array([chunk, chunk + 1]) * _FIRINGS_IN_A_CHUNK * FIRING_NS * 1e-9
        low, high = self.clocks.lidar.time_s(edges_s)
        return float(low), min(float(high), self.job.duration_s)

    def sweep(self, chunk: int, truth: bool = True) -> Sweep:
        """Render the data packets of a piece, and the truth about them; safe in any thread."""
        first = chunk * self.chunk_packets
        last = min(first + self.chunk_packets, self.lidar.packets_until(self.job.duration_s) - 1)
        return self.lidar.sweep(first, max(last - first, 0), truth)

    def truth(self) -> dict[str, Any]:
        """All that is true and not a pose or a point."""
        job, link = self.job, self.autopilot.rates_hz
        lidar, boot = self.clocks.lidar, self.clocks.boot
        reboot, outage = Reboot.of(job.options.faults), Outage.of(job.options.faults)
        later = reboot.clock(reboot.end_s, boot) if 0 < reboot.start_s < job.duration_s else None
        return {
            "about": "Time t is true seconds since start; a clock shows start_ns + t * 1e9 * (1 + drift_ppm * 1e-6).",
            "software": f"swath {__version__}",
            "scene": job.scene,
            "seed": job.seed,
            "duration_s": job.duration_s,
            "clocks": {
                name: dataclasses.asdict(getattr(self.clocks, name)) for name in ("utc", "host", "lidar", "boot")
            },
            "boot_clock_after_reboot": None if later is None else dataclasses.asdict(later),
            "reboot_s": None if later is None else [reboot.start_s, reboot.end_s],
            "lidar_minus_boot_ns": lidar.start_ns - boot.start_ns,
            "lidar_minus_boot_ppm": lidar.drift_ppm - boot.drift_ppm,
            "ins_gyro_delay_s": job.options.ins.gyro_delay_s,
            "ins_position_delay_s": job.options.ins.position_delay_s,
            "mount_nominal": to_mapping(self.nominal_mount),
            "mount_true": to_mapping(self.mount),
            "boresight_deg": self._boresight_deg(),
            "lever_m": np.subtract(self.mount.lidar.position_m, self.nominal_mount.lidar.position_m).tolist(),
            "gps_outage_s": [outage.start_s, outage.end_s] if outage.start_s > 0 else None,
            "laser_bias_m": self.lidar.laser_bias_m.tolist(),
            "laser_elevation_error_deg": self.lidar.elevation_error_deg.tolist(),
            "lidar_gyro_matrix": self.telemetry.gyros.matrix.tolist(),
            "lidar_gyro_offset_deg_s": self.telemetry.gyros.bias.tolist(),
            "lidar_gyro_walk_deg_s_every_10_s": self.telemetry.gyro_wander.listed(),
            "ins_gyro_walk_deg_s_every_10_s": np.degrees(self.ins.gyro_wander.listed()).tolist(),
            "ins_accel_walk_m_s2_every_10_s": self.ins.accel_wander.listed(),
            "ins_gyro_matrix": self.ins.gyros.matrix.tolist(),
            "ins_gyro_bias_deg_s": np.degrees(self.ins.gyros.bias).tolist(),
            "ins_accel_matrix": self.ins.accelerometers.matrix.tolist(),
            "ins_accel_bias_m_s2": self.ins.accelerometers.bias.tolist(),
            "compass_phase_rad": self.ins.compass_phase_rad.tolist(),
            "mavlink_hz": link,
            "local_origin": dataclasses.asdict(self.origin),
            "surfaces": [*self.scene.world.names, *self.traffic.names],
            "options": to_mapping(job.options),
        } | ({"cameras": self.studio.truth()} if job.cameras else {})

    def _boresight_deg(self) -> list[float]:
        """True minus nominal yaw, pitch and roll of the lidar."""
        true, nominal = self.mount.lidar, self.nominal_mount.lidar
        return [getattr(true, name) - getattr(nominal, name) for name in ("yaw_deg", "pitch_deg", "roll_deg")]


def in_order(simulation: Simulation, workers: int) -> Iterator[Sweep]:
    """Sweeps of all pieces in order, a few rendered ahead by other threads."""
    with ThreadPoolExecutor(workers) as pool:
        ahead: deque[Future[Sweep]] = deque()
        for chunk in range(simulation.chunks):
            ahead.append(pool.submit(simulation.sweep, chunk, simulation.job.truth_points))
            if len(ahead) > workers + 1:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()


def render(job: Job, progress: Callable[[float], object] | None = None) -> Simulation:
    """Simulate and write all files of a job; they get their names only when everything is there.

    Parameters
    ----------
    job : Job
    progress : callable, optional
        Called with the simulated seconds done since the last call.

    Raises
    ------
    SwathError
        The directory cannot be written.
    """
    names = [*FILES, *[POINTS] * job.truth_points, *[RTK] * (job.options.rtk.hz > 0), *[IMAGES] * bool(job.cameras)]
    parts = {name: job.directory / f"{name}.part" for name in names}
    simulation = Simulation(job)
    made = [folder for folder in (job.directory, *job.directory.parents) if not folder.exists()]
    try:
        job.directory.mkdir(parents=True, exist_ok=True)
        try:
            with Recording(simulation, parts) as recording:
                for chunk, sweep in enumerate(in_order(simulation, job.workers)):
                    recording.add(chunk, sweep)
                    if progress is not None:
                        start_s, end_s = simulation.bounds_s(chunk)
                        progress(end_s - start_s)
            _write_more(simulation, parts)
            write_json(parts[TRUTH], simulation.truth())
            if IMAGES in parts and (job.directory / IMAGES).exists():
                shutil.rmtree(job.directory / IMAGES)
            for name, part in parts.items():
                part.replace(job.directory / name)
            made = []
        finally:
            for part in parts.values():
                if part.is_dir():
                    shutil.rmtree(part)
                part.unlink(missing_ok=True)
            with suppress(OSError):  # folders that nothing came into go again
                for folder in made:
                    folder.rmdir()
    except OSError as error:
        raise SwathError(f"{error.filename or job.directory}: cannot be written ({error.strerror})") from None
    return simulation


def _write_more(simulation: Simulation, parts: dict[str, Path]) -> None:
    """What other instruments make: positions of a receiver with a base, photographs."""
    job = simulation.job
    if RTK in parts:
        text = solution(
            simulation.flight, job.options.rtk, simulation.clocks, simulation.origin, simulation.mount.gps_position_m,
            Outage.of(job.options.faults), job.seed,
        )  # fmt: skip
        parts[RTK].write_text(text, encoding="utf-8")
    if IMAGES in parts:
        if parts[IMAGES].exists():
            shutil.rmtree(parts[IMAGES])
        simulation.studio.write_all(parts[IMAGES], job.workers)


class Recording:
    """All files of a simulation while they are written."""

    def __init__(self, simulation: Simulation, parts: dict[str, Path]) -> None:
        self._simulation, self._options = simulation, simulation.job.options
        self._pending: deque[Frame] = deque()
        self._next_clock_s = 0.0
        self._files = ExitStack()
        log = self._open(parts[LOG])
        self._log = LogWriter(
            log, metadata=self._metadata(), attachments=self._attachments(), library=f"swath simulate {__version__}"
        )
        self._pcap = PcapWriter(self._open(parts[CAPTURE]), self._options.capture_resolution)
        self._tlog = self._open(parts[TLOG])
        job = simulation.job
        self._board = BoardLog(
            self._open(parts[BOARD]), simulation.ins, simulation.clocks, job.options, simulation.origin, job.seed,
            simulation.noted,
        )  # fmt: skip
        self._poses = self._files.enter_context(parts[POSES].open("w", encoding="utf-8"))
        self._poses.write(COLUMNS + "\n")
        self._points = self._files.enter_context(PointsWriter(self._open(parts[POINTS]))) if POINTS in parts else None

    def __enter__(self) -> "Recording":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        with self._files:
            if kind is None:
                self._finish()

    def _open(self, path: Path) -> BinaryIO:
        return self._files.enter_context(path.open("wb"))

    def _metadata(self) -> dict[str, dict[str, str]]:
        job = self._simulation.job
        session = {"origin": "simulate", "software": f"swath {__version__}", "scene": job.scene, "seed": str(job.seed)}
        return {"swath.session": session}

    def _attachments(self) -> dict[str, bytes]:
        mount = self._simulation.nominal_mount.yaml()
        return {"mount.yaml": mount.encode(), "simulation.yaml": dump(self._options).encode()}

    def add(self, chunk: int, sweep: Sweep) -> None:
        """Write one piece: what the sensors sent in it and the truth about it."""
        start_s, end_s = self._simulation.bounds_s(chunk)
        self._add_lidar(chunk, start_s, end_s, sweep)
        self._pending.extend(self._simulation.autopilot.between(start_s, end_s, chunk))
        self._add_mavlink(end_s)
        if self._points is not None:
            self._points.write(sweep.truth)
        rate_hz = self._options.truth_hz
        grid = np.arange(np.ceil(start_s * rate_hz - 1e-9), np.ceil(end_s * rate_hz - 1e-9)) / rate_hz
        simulation = self._simulation
        self._board.add(start_s, end_s, chunk)
        write_poses(self._poses, simulation.flight, simulation.clocks, simulation.origin, grid)

    def _arrival_ns(self, sent_s: Array, rng: np.random.Generator) -> npt.NDArray[np.int64]:
        """Host times of arrival, to the microsecond as a capture keeps them, shape as given."""
        late_s = _NETWORK_S + np.abs(rng.standard_normal(len(sent_s))) * self._options.clocks.arrival_jitter_us * 1e-6
        time_ns = self._simulation.clocks.host.shows_ns(sent_s + late_s)
        if self._options.capture_resolution == "us":
            time_ns = time_ns // NS_PER_US * NS_PER_US
        return time_ns

    def _add_lidar(self, chunk: int, start_s: float, end_s: float, sweep: Sweep) -> None:
        rng = generator(self._simulation.job.seed, "arrival", chunk)
        lost = generator(self._simulation.job.seed, "lost packets", chunk)
        kept = arriving(sweep.sent_s, self._options.faults, lost)
        packets = np.zeros(int(kept.sum()), records.SCAN_PACKET_DTYPE)
        packets["data"] = sweep.packets[kept]
        data_ns = np.maximum.accumulate(self._arrival_ns(sweep.sent_s, rng))[kept]
        records.set_receive_time_ns(packets, data_ns)
        positions, sent_s = self._simulation.telemetry.between(start_s, end_s, chunk)
        kept = arriving(sent_s, self._options.faults, lost)
        position_ns = self._arrival_ns(sent_s, rng)
        # one by one: indexing with a mask would not copy the bytes between the fields, which are zero on the wire
        chunks = [(int(position_ns[i]), positions[i].tobytes()) for i in np.flatnonzero(kept)]
        wire = [(int(t), DATA_PORT, p.tobytes()) for t, p in zip(data_ns, packets["data"], strict=True)]
        wire += [(t, POSITION_PORT, payload) for t, payload in chunks]
        self._pcap.write(sorted(wire, key=lambda packet: packet[0]))
        self._host_clock(start_s)
        if len(packets):
            stamp_ns = int(data_ns[-1])
            account = records.LidarAccount(received=len(packets), kept=len(packets))
            self._log.write(records.LIDAR.topic, stamp_ns, records.encode_scan(stamp_ns, packets))
            self._log.write(records.LIDAR_ACCOUNT.topic, stamp_ns, records.encode_account(stamp_ns, account))
        if chunks:
            stamp_ns = chunks[-1][0]
            self._log.write(records.POSITION.topic, stamp_ns, records.encode_raw(stamp_ns, chunks, "velodyne"))

    def _host_clock(self, time_s: float) -> None:
        if time_s < self._next_clock_s:
            return
        self._next_clock_s += 1.0
        now_ns = int(self._simulation.clocks.host.shows_ns(time_s))
        up_ns = round((time_s + 100.0) * NS_PER_S)
        clock = records.HostClock(now_ns, now_ns, up_ns, up_ns)
        self._log.write(records.HOST_CLOCK.topic, now_ns, records.encode_host_clock(clock))

    def _add_mavlink(self, until_s: float) -> None:
        """Write the frames received until a true time."""
        chunks = []
        while self._pending and self._pending[0].received_s < until_s:
            frame = self._pending.popleft()
            time_ns = int(self._simulation.clocks.host.shows_ns(frame.received_s))
            chunks.append((time_ns, frame.noise + frame.data))
            self._tlog.write(frame.noise + tlog_record(time_ns, frame.data))
        if chunks:
            topic = records.MAVLINK.topic + "ins"
            self._log.write(topic, chunks[-1][0], records.encode_raw(chunks[-1][0], chunks, "ins"))

    def _finish(self) -> None:
        self._add_mavlink(np.inf)
        self._log.finish()
