"""All files of a simulation but its photographs, while they are written."""

from collections import deque
from contextlib import ExitStack
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np
import numpy.typing as npt

from flightlog import __version__, records
from flightlog.config import dump
from flightlog.constants import NS_PER_S, NS_PER_US
from flightlog.hdl32e import DATA_PORT, POSITION_PORT
from flightlog.logwriter import LogWriter
from simulator.autopilot import Frame
from simulator.boardlog import BoardLog
from simulator.capture import PcapWriter, tlog_record
from simulator.chance import generator
from simulator.faults import arriving
from simulator.lidar import Sweep
from simulator.simulation import Simulation
from simulator.truth import COLUMNS, PointsWriter, write_poses

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
_NETWORK_S: Final = 50e-6


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
        self._board = None
        if BOARD in parts:
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
        if self._board is not None:
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
