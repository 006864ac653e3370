"""What recording costs: swathd against tcpdump and against a reader of one packet at a time, in turn, on loopback.

Every recorder gets the same packets, evenly spaced as the sensor sends them, on the same core; a sender on another core is not
counted. CPU time is what the scheduler gave to the recorder's threads while packets came, starting and ending not included. The
last line is one JSON object:

cpu_ratio_to_tcpdump    CPU per packet, swathd's over that of `tcpdump -w` (null where tcpdump is missing or not allowed)
cpu_ratio_to_recvfrom   the same over a Python loop of recvfrom and one MCAP message for each packet
bare_ratio_to_tcpdump   the floor: CPU per packet of what swathd cannot do without, over that of tcpdump: recvmmsg with receive times
                        as often as swathd, SHA-256, CRC-32, write, fdatasync twice a second; nothing looked at, no MCAP
loss_at_1x, loss_at_20x share of the packets that swathd did not log, at the sensor's rate and at 20 times that
cpu_percent_dual_return of one core, dual return at the sensor's rate and 1,000 MAVLink messages/s
memory_mb               highest resident memory of swathd in all runs
"""

import argparse
import ctypes
import hashlib
import json
import os
import shutil
import signal
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from fastcrc import crc32

from flightlog import hdl32e, records
from flightlog.constants import NS_PER_S
from flightlog.logfile import LogReader
from flightlog.logwriter import LogWriter
from onboard.datagrams import Receiver, open_udp

SENSOR_RATE: Final = NS_PER_S / hdl32e.PACKET_NS
MAVLINK_RATE: Final = 1000
ADDRESS: Final = "127.0.0.1"
_SENDER_CORE, _RECORDER_CORE = 0, min(1, (os.cpu_count() or 1) - 1)


@dataclass(frozen=True, slots=True)
class Run:
    """One recorder under one load."""

    sent: int
    seconds: float
    cpu_s: float
    logged: int = 0
    memory_mb: float = 0.0

    @property
    def cpu_s_per_million(self) -> float:
        """CPU seconds for a million packets."""
        return self.cpu_s / self.sent * 1e6

    @property
    def loss(self) -> float:
        """Share of the packets sent that were not logged."""
        return 1.0 - self.logged / self.sent


# Sending --------------------------------------------------------------------------------------------------------------


def packets(dual: bool) -> npt.NDArray[np.void]:
    """Data packets to send again and again: recorded ones where there are any, else noise that turns at 600 rpm."""
    recordings = os.environ.get("SWATH_RECORDINGS", "")
    pcap = Path(recordings) / "lidar" / "hdl32e_monterey.pcap"
    if recordings and pcap.exists():
        out = np.frombuffer(b"".join(pcap_payloads(pcap.read_bytes(), hdl32e.DATA_BYTES)), hdl32e.DATA_DTYPE).copy()
    else:
        count = 1808
        out = np.zeros(count, hdl32e.DATA_DTYPE)
        rng = np.random.default_rng(1)
        out["blocks"]["flag"] = hdl32e.BLOCK_FLAG
        out["blocks"]["azimuth"] = (np.arange(count * 12) * 16.59 % 36000).astype(np.uint16).reshape(count, 12)
        out["blocks"]["returns"]["range"] = (5000 + rng.normal(0, 8, (count, 12, 32)).cumsum(axis=1)).clip(0, 65535)
        out["blocks"]["returns"]["intensity"] = rng.integers(0, 100, (count, 12, 32))
        out["return_mode"], out["product"] = hdl32e.ReturnMode.STRONGEST, hdl32e.PRODUCT_ID
    if dual:
        out["blocks"][:, 1::2] = out["blocks"][:, ::2]
        out["return_mode"] = hdl32e.ReturnMode.DUAL
    return out


def pcap_payloads(raw: bytes, size: int) -> Iterator[bytes]:
    """UDP payloads of one size in an Ethernet pcap."""
    offset = 24
    while offset + 16 <= len(raw):
        length = struct.unpack_from("<I", raw, offset + 8)[0]
        if length == 42 + size:
            yield raw[offset + 16 + 42 : offset + 16 + length]
        offset += 16 + length


class Sender:
    """Sends with sendmmsg(2), some datagrams in one call."""

    def __init__(self, datagrams: npt.NDArray[np.void], port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect((ADDRESS, port))
        self._datagrams = datagrams
        index = np.arange(len(datagrams), dtype=np.uint64)
        self._iov = np.zeros((len(datagrams), 2), np.uint64)
        self._iov[:, 0] = datagrams.ctypes.data + index * np.uint64(datagrams.dtype.itemsize)
        self._iov[:, 1] = datagrams.dtype.itemsize
        self._messages = np.zeros((len(datagrams), 8), np.uint64)
        self._messages[:, 2] = self._iov.ctypes.data + index * np.uint64(16)
        self._messages[:, 3] = 1
        self._next = 0
        self._send = ctypes.CDLL(None, use_errno=True).sendmmsg
        self._send.argtypes = [ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int]

    def send(self, count: int) -> int:
        """Send the next datagrams; gives how many went out."""
        count = min(count, len(self._datagrams) - self._next)
        address = self._messages.ctypes.data + self._next * 64
        sent = int(self._send(self._socket.fileno(), address, count, 0))
        if sent < 0:
            raise OSError(ctypes.get_errno(), "sendmmsg")
        self._next = (self._next + sent) % len(self._datagrams)
        return sent


def send_main(options: argparse.Namespace) -> None:
    """Send at a rate for a time; print what was sent and how long it took."""
    os.sched_setaffinity(0, {_SENDER_CORE})
    sender = Sender(packets(options.dual), options.port)
    mavlink = mavlink_sender(options.mavlink_port) if options.mavlink_port else None
    if options.wait:  # until whoever measures says so: a sender that is starting sends nothing
        print("ready", flush=True)
        sys.stdin.readline()
    begin = time.monotonic()
    sent, told = 0, 0
    while (passed := time.monotonic() - begin) < options.seconds:
        due = int(passed * options.rate) - sent
        while due > 0:
            done = sender.send(min(due, 64))
            sent, due = sent + done, due - done
        if mavlink is not None:
            while told < passed * MAVLINK_RATE:
                mavlink()
                told += 1
        time.sleep(max(0.0, (sent + 1) / options.rate - (time.monotonic() - begin)))
    print(json.dumps({"sent": sent, "seconds": time.monotonic() - begin}))


def mavlink_sender(port: int) -> Callable[[], None]:
    """A function that sends an ATTITUDE, each hundredth time a heartbeat, of an autopilot."""
    from pymavlink.dialects.v20 import ardupilotmega as dialect

    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    mavlink = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    attitude = mavlink.attitude_encode(1, 0.1, 0.2, 0.3, 0, 0, 0).pack(mavlink, force_mavlink1=True)
    heartbeat = mavlink.heartbeat_encode(2, 3, 0, 0, 4).pack(mavlink, force_mavlink1=True)
    count = 0

    def send() -> None:
        nonlocal count
        count += 1
        sock.sendto(attitude if count % 100 else heartbeat, (ADDRESS, port))

    return send


@contextmanager
def sender(
    rate: float, seconds: float, port: int, *, dual: bool = False, mavlink_port: int = 0
) -> Iterator[Callable[[], tuple[int, float]]]:
    """A process that is ready to send, and a function that lets it; that gives datagrams sent and seconds taken."""
    command = [sys.executable, __file__, "--send", "--wait", f"--rate={rate}", f"--seconds={seconds}", f"--port={port}"]
    command += [f"--mavlink-port={mavlink_port}"] + ["--dual"] * dual
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        if process.stdout.readline() != "ready\n":
            raise SystemExit("the sender did not start")

        def go() -> tuple[int, float]:
            answer = json.loads(process.communicate("go\n")[0])
            return answer["sent"], answer["seconds"]

        yield go


# Recorders ------------------------------------------------------------------------------------------------------------


def free_port() -> int:
    """Find a UDP port that nobody has."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind((ADDRESS, 0))
        return int(sock.getsockname()[1])


def cpu_s(pid: int) -> float:
    """CPU time of all threads of a process so far, from the scheduler's own count of nanoseconds."""
    total = 0
    for task in Path(f"/proc/{pid}/task").iterdir():
        total += int((task / "schedstat").read_text().split()[0])
    return total / NS_PER_S


def peak_memory_mb(pid: int) -> float:
    """Highest resident memory of a process so far."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))


@contextmanager
def recorder(command: list[str], settle_s: float = 1.5) -> Iterator[subprocess.Popen[bytes]]:
    """A recorder on its core, up and running; told to stop at the end."""
    with subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        preexec_fn=lambda: os.sched_setaffinity(0, {_RECORDER_CORE}),
    ) as process:
        time.sleep(settle_s)
        if process.poll() is not None:
            assert process.stderr is not None
            raise SystemExit(f"{command[0]}: {process.stderr.read().decode().strip()}")
        try:
            yield process
        finally:
            process.send_signal(signal.SIGTERM)
            process.communicate(timeout=30)


def measure(
    process: subprocess.Popen[bytes],
    rate: float,
    seconds: float,
    port: int,
    *,
    dual: bool = False,
    mavlink_port: int = 0,
) -> Run:
    """Send to a recorder that runs, and see what it costs."""
    with sender(rate, seconds, port, dual=dual, mavlink_port=mavlink_port) as go:
        before = cpu_s(process.pid)
        sent, took = go()
        time.sleep(0.8)  # what is still in buffers is part of the work
        return Run(sent, took, cpu_s(process.pid) - before, memory_mb=peak_memory_mb(process.pid))


def run_swathd(
    folder: Path, rate: float, seconds: float, *, fov: bool, dual: bool = False, mavlink: bool = False
) -> Run:
    """One run of the daemon."""
    port, mavlink_port = free_port(), free_port()
    logs = folder / "swathd"
    shutil.rmtree(logs, ignore_errors=True)
    settings: dict[str, Any] = {
        "lidar": {"address": ADDRESS, "data_port": port, "position_port": free_port()},
        "ins": {"device": f"udp:{ADDRESS}:{mavlink_port}" if mavlink else None},
        "recorder": {"directory": str(logs)},
    }
    if not fov:
        settings["lidar"]["fov"] = {"start_deg": 0, "end_deg": 0}
    config = folder / "swathd.yaml"
    config.write_text(json.dumps(settings))
    with recorder([sys.executable, "-m", "onboard.cli", "run", "--config", str(config)]) as process:
        run = measure(process, rate, seconds, port, dual=dual, mavlink_port=mavlink_port if mavlink else 0)
    logged = 0
    kernel_drops = queue_drops = 0
    with LogReader(next(logs.glob("*.mcap"))) as log:
        for message in log.messages((records.LIDAR_ACCOUNT.topic,)):
            account = records.decode_account(message.data)
            logged += account.kept + account.masked_packets
            kernel_drops += account.kernel_drops
            queue_drops += account.queue_drops
    if kernel_drops or queue_drops:
        print(
            f"swathd counted {kernel_drops} packets dropped by the kernel and {queue_drops} that the disk did not take"
        )
    return Run(run.sent, run.seconds, run.cpu_s, logged, run.memory_mb)


def run_tcpdump(folder: Path, rate: float, seconds: float) -> Run | None:
    """One run of tcpdump with a buffer as large as ours, None where it cannot capture."""
    program = shutil.which("tcpdump") or shutil.which("tcpdump", path="/usr/sbin:/usr/bin")
    if program is None:
        print("tcpdump is not installed; no ratio to it")
        return None
    port = free_port()
    pcap = folder / "tcpdump.pcap"
    command = [program, "-i", "lo", "-B", "9216", "-w", str(pcap), "udp", "and", "dst", "port", str(port)]
    if os.geteuid() == 0:
        command[1:1] = ["-Z", "root"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sink:
        sink.bind((ADDRESS, port))  # or the kernel answers each packet with an ICMP error
        try:
            with recorder(command) as process:
                run = measure(process, rate, seconds, port)
        except SystemExit as error:
            print(f"tcpdump cannot capture here ({error}); no ratio to it")
            return None
    logged = sum(1 for _ in pcap_payloads(pcap.read_bytes(), hdl32e.DATA_BYTES))
    return Run(run.sent, run.seconds, run.cpu_s, logged)


def run_recvfrom(folder: Path, rate: float, seconds: float) -> Run:
    """One run of the loop below."""
    port = free_port()
    log = folder / "recvfrom.mcap"
    with recorder([sys.executable, __file__, "--recvfrom", str(log), f"--port={port}"]) as process:
        run = measure(process, rate, seconds, port)
    with LogReader(log) as reader:
        logged = sum(1 for _ in reader.messages())
    return Run(run.sent, run.seconds, run.cpu_s, logged)


def run_bare(folder: Path, rate: float, seconds: float) -> Run:
    """One run of the loop below."""
    port = free_port()
    raw = folder / "bare.raw"
    with recorder([sys.executable, __file__, "--bare", str(raw), f"--port={port}"]) as process:
        run = measure(process, rate, seconds, port)
    return Run(run.sent, run.seconds, run.cpu_s, raw.stat().st_size // records.SCAN_PACKET_DTYPE.itemsize)


def bare_main(options: argparse.Namespace) -> None:
    """Do what costs in proportion to the bytes, and as little else as Python can."""
    from onboard.config import LidarConfig

    pause_s, running = LidarConfig().poll_ms / 1e3, True

    def stop(number: int, frame: object) -> None:
        nonlocal running
        running = False

    signal.signal(signal.SIGTERM, stop)
    sock = open_udp(ADDRESS, options.port, 9 << 20)
    slots = np.zeros(1024, records.SCAN_PACKET_DTYPE)
    receiver = Receiver(sock, slots, 8, hdl32e.DATA_BYTES)
    content, size = slots.view(np.uint8).data, slots.dtype.itemsize
    digest, checksum, polls = hashlib.sha256(), 0, 0
    with options.bare.open("wb", buffering=0) as file:
        while running:
            time.sleep(pause_s)
            data = bytes(content[: receiver.receive() * size])
            file.write(data)
            digest.update(data)
            checksum = crc32.iso_hdlc(data, checksum)
            polls += 1
            if polls % 2 == 0:
                os.fdatasync(file.fileno())
    print(digest.hexdigest(), checksum)


def recvfrom_main(options: argparse.Namespace) -> None:
    """Be the recorder that one would write first: a call, a time and a message for each packet."""
    running = True

    def stop(number: int, frame: object) -> None:
        nonlocal running
        running = False

    signal.signal(signal.SIGTERM, stop)
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 9 << 20)
    sock.bind((ADDRESS, options.port))
    sock.settimeout(0.2)
    with options.recvfrom.open("wb") as file:
        writer = LogWriter(file, metadata={}, attachments={})
        while running:
            try:
                data, _ = sock.recvfrom(2048)
            except TimeoutError:
                continue
            time_ns = time.time_ns()
            writer.write(records.POSITION.topic, time_ns, records.encode_raw(time_ns, [(time_ns, data)], "velodyne"))
        writer.finish()


# The benchmark --------------------------------------------------------------------------------------------------------


def say(name: str, run: Run) -> None:
    """Print one run."""
    print(
        f"{name:34} {run.sent / run.seconds:7.0f} packets/s  {run.cpu_s_per_million:6.2f} CPU s per million  "
        f"{100 * run.cpu_s / run.seconds:5.2f} % of a core  lost {100 * run.loss:.3f} %",
        flush=True,
    )


def main() -> None:
    """Run the benchmark, or the part of it that a process of its own plays."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=10.0, help="of one run")
    parser.add_argument("--send", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--rate", type=float, help=argparse.SUPPRESS)
    parser.add_argument("--port", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--mavlink-port", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--dual", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--wait", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--recvfrom", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--bare", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.send:
        send_main(options)
    elif options.recvfrom:
        recvfrom_main(options)
    elif options.bare:
        bare_main(options)
    else:
        with tempfile.TemporaryDirectory(prefix="swath-capture-") as folder:
            print(json.dumps(benchmark(Path(folder), options.rounds, options.seconds)))


def benchmark(folder: Path, rounds: int, seconds: float) -> dict[str, float | None]:
    """Run all recorders in turn."""
    ours: list[Run] = []
    tcpdump: list[Run] = []
    bare: list[Run] = []
    recvfrom: list[Run] = []
    for _ in range(rounds):
        ours.append(run_swathd(folder, SENSOR_RATE, seconds, fov=False))
        say("swathd, full circle", ours[-1])
        if (run := run_tcpdump(folder, SENSOR_RATE, seconds)) is not None:
            tcpdump.append(run)
            say("tcpdump -w", run)
        bare.append(run_bare(folder, SENSOR_RATE, seconds))
        say("system calls and checksums alone", bare[-1])
        recvfrom.append(run_recvfrom(folder, SENSOR_RATE, seconds))
        say("recvfrom, a message each", recvfrom[-1])
    masked = run_swathd(folder, SENSOR_RATE, seconds, fov=True)
    say("swathd, +-105 deg", masked)
    fast = run_swathd(folder, 20 * SENSOR_RATE, seconds, fov=True)
    say("swathd, +-105 deg, 20x", fast)
    dual = run_swathd(folder, 2 * SENSOR_RATE, seconds, fov=True, dual=True, mavlink=True)
    say("swathd, dual return, 1,000 MAVLink/s", dual)

    cost = median_cost(ours)
    return {
        "cpu_ratio_to_tcpdump": round(cost / median_cost(tcpdump), 3) if tcpdump else None,
        "bare_ratio_to_tcpdump": round(median_cost(bare) / median_cost(tcpdump), 3) if tcpdump else None,
        "cpu_ratio_to_recvfrom": round(cost / median_cost(recvfrom), 3),
        "loss_at_1x": max(run.loss for run in ours),
        "loss_at_20x": fast.loss,
        "cpu_percent_dual_return": round(100 * dual.cpu_s / dual.seconds, 2),
        "memory_mb": round(max(run.memory_mb for run in (*ours, masked, fast, dual)), 1),
        "rate_at_20x": round(fast.sent / fast.seconds),
        "cpu_s_per_million": round(cost, 2),
        "cpu_s_per_million_tcpdump": round(median_cost(tcpdump), 2) if tcpdump else None,
        "cpu_s_per_million_masked": round(masked.cpu_s_per_million, 2),
    }


def median_cost(runs: list[Run]) -> float:
    """CPU seconds per million packets, the median of some runs."""
    return statistics.median(run.cpu_s_per_million for run in runs)


if __name__ == "__main__":
    main()
