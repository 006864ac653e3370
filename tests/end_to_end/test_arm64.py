"""The packages of both architectures record the same flight: each in its own interpreter, that of arm64 in a Debian 12 root under qemu.

Where the kernel will not register the format of arm64 the interpreter is called by hand; so it is here everywhere, and Debian's
packages are unpacked without their scripts.
"""

import json
import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect
from recording import free_port

from flightlog import hdl32e, records
from flightlog.logfile import LogReader

ROOT = Path(__file__).resolve().parents[2]
NEEDED = (
    "python3",
    "python3-lz4",
    "python3-numpy",
    "python3-serial",
    "python3-systemd",
    "python3-yaml",
    "python3-zstandard",
)
TOOLS = ("mmdebstrap", "qemu-aarch64-static", "chroot", "unshare", "dpkg-deb", "aarch64-linux-gnu-strip")
missing = [name for name in TOOLS if shutil.which(name) is None]
# a whole system of another machine, emulated; in the quick suite: the package of arm64 is of arm64 (test_package)
pytestmark = [
    pytest.mark.soak,
    pytest.mark.root,
    pytest.mark.skipif(os.geteuid() != 0, reason="a root of another architecture needs root"),
    pytest.mark.skipif(bool(missing), reason=f"not installed: {', '.join(missing)}"),
]
PACKETS, PACKETS_S = 2400, 400
LIBRARIES = "/usr/lib/aarch64-linux-gnu/blas:/usr/lib/aarch64-linux-gnu/lapack"
"""What the packages' own scripts would have linked."""

SHIM = """
import errno, runpy, socket, sys
class Socket(socket.socket):
    # qemu knows neither the kernel's receive times nor its count of losses: swathd does without, as on any kernel that gives none
    def setsockopt(self, *words):
        try:
            return super().setsockopt(*words)
        except OSError as error:
            if error.errno != errno.ENOPROTOOPT:
                raise
    def getsockopt(self, *words):
        try:
            return super().getsockopt(*words)
        except OSError as error:
            if error.errno not in (errno.ENOPROTOOPT, errno.EOPNOTSUPP):
                raise
            return b""
socket.socket = Socket
sys.argv[0] = "/usr/bin/swathd"
runpy.run_path("/usr/bin/swathd", run_name="__main__")
"""


def lidar_packets() -> list[bytes]:
    """Two turns and a bit of a sensor with noise in every return, so that the edges of the field of view cut packets in two."""
    rng = np.random.default_rng(7)
    found = []
    for number in range(PACKETS):
        packet = np.zeros(1, hdl32e.DATA_DTYPE)
        plain = packet.view(np.uint8)
        plain[:] = rng.integers(0, 256, plain.shape, np.uint8)
        packet["blocks"]["flag"] = hdl32e.BLOCK_FLAG
        packet["blocks"]["azimuth"] = (np.arange(12) * 17 + number * 200) % 36_000
        packet["stamp_us"] = number * 553
        packet["return_mode"], packet["product"] = hdl32e.ReturnMode.STRONGEST, hdl32e.PRODUCT_ID
        found.append(packet.tobytes())
    return found


def play(data_port: int, position_port: int, mavlink_port: int) -> None:
    """The same bytes in the same datagrams, slowly enough for an interpreter in an interpreter."""
    link = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    words = struct.pack("<12H", *(tag << 12 | 5 for tag in (0, 1, 2, 3) * 3))
    begin = time.monotonic()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        for number, packet in enumerate(lidar_packets()):
            time.sleep(max(0.0, begin + number / PACKETS_S - time.monotonic()))
            sock.sendto(packet, ("127.0.0.1", data_port))
            if number % 10 == 0:
                position = (bytes(14) + words + bytes(160) + struct.pack("<IB", number * 553, 2)).ljust(512, b"\0")
                sock.sendto(position, ("127.0.0.1", position_port))
            if number % 16 == 0:
                message = dialect.MAVLink_attitude_message(number, 0.1, 0.2, number * 1e-3, 0, 0, 0)
                data = message.pack(link) + dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(link)
                sock.sendto(bytes(data), ("127.0.0.1", mavlink_port))
                link.seq = (link.seq + 1) % 256


def payloads(folder: Path) -> tuple[dict[str, bytes], dict[str, int]]:
    """Every payload of the logs by topic, receive times apart; and what became of the packets."""
    found: dict[str, list[bytes]] = {records.LIDAR.topic: [], records.POSITION.topic: [], "/mavlink/ins": []}
    counts = dict.fromkeys(("received", "kept", "masked_packets", "masked_blocks", "kernel_drops", "queue_drops"), 0)
    for path in sorted(folder.glob("*.mcap")):
        with LogReader(path) as log:
            for message in log.messages():
                if message.topic == records.LIDAR.topic:
                    found[message.topic] += [each["data"].tobytes() for each in records.decode_scan(message.data)]
                elif message.topic == records.LIDAR_ACCOUNT.topic:
                    account = records.decode_account(message.data)
                    counts = {name: count + getattr(account, name) for name, count in counts.items()}
                elif message.topic in found:
                    found[message.topic] += [data for _, data in records.decode_raw(message.data)]
            assert not log.damage
    return {topic: b"".join(pieces) for topic, pieces in found.items()}, counts


def resident_mb(pid: int) -> float:
    """Memory of a program [MB]; under qemu without what is qemu's own: its code, its heap, and the code that it makes."""
    text = Path(f"/proc/{pid}/smaps").read_text()
    qemu = "qemu-aarch64" in text
    total_kb, counts = 0, True
    for line in text.splitlines():
        words = line.split()
        if not words[0].endswith(":"):  # a mapping: addresses, permissions, offset, device, inode, name
            name = words[5] if len(words) > 5 else ""
            counts = "qemu-aarch64" not in name and words[1][:3] != "rwx" and not (qemu and name == "[heap]")
        elif words[0] == "Rss:" and counts:
            total_kb += int(words[1])
    return total_kb / 1024


def record(command: list[str], base: Path, inside: str) -> float:
    """Run a daemon with a folder that it knows as `inside`, play, stop; gives its memory at the end [MB]."""
    ports = [free_port() for _ in range(3)]
    settings = {
        "lidar": {"address": "127.0.0.1", "data_port": ports[0], "position_port": ports[1]},
        "ins": {"device": f"udp:127.0.0.1:{ports[2]}"},
        "recorder": {"directory": f"{inside}/logs", "min_free_mb": 8},
        "status_file": f"{inside}/status.json",
    }
    (base / "swathd.yaml").write_text(json.dumps(settings))
    status = base / "status.json"
    with (base / "said").open("wb") as said, subprocess.Popen(
        [*command, "run", "--config", f"{inside}/swathd.yaml"], stdout=said, stderr=said, start_new_session=True
    ) as process:  # fmt: skip
        try:
            end = time.monotonic() + 300
            while not status.exists() or not json.loads(status.read_text())["links"]["ins"]["connected"]:
                assert process.poll() is None, (base / "said").read_text()
                assert time.monotonic() < end
                time.sleep(0.2)
            play(*ports)
            while json.loads(status.read_text())["lidar"]["received"] < PACKETS:
                assert time.monotonic() < end
                time.sleep(0.2)
            pid = json.loads(status.read_text())["pid"]
            memory_mb = resident_mb(pid)
            os.kill(pid, signal.SIGTERM)
            process.wait(120)
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
    return memory_mb


@pytest.fixture(scope="module")
def debs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("debs")
    command = [sys.executable, ROOT / "package" / "deb.py", "--output", folder]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"the packages cannot be built: {done.stderr[-200:]}")
    return folder


def unpack(package: Path, root: Path) -> None:
    """The files of a package, compiled as its own script would have it: what Python compiles is the same on every processor."""
    subprocess.run(["dpkg-deb", "-x", package, root], check=True)
    subprocess.run(["/usr/bin/python3.11", "-m", "compileall", "-q", root / "usr/lib/swathd"], check=True)


def test_both_packages_record_the_same_bytes(debs: Path, tmp_path: Path) -> None:
    root = tmp_path / "root"
    done = subprocess.run(
        ["mmdebstrap", "--arch=arm64", "--variant=extract", f"--include={','.join(NEEDED)}", "bookworm", root],
        capture_output=True, text=True, check=False,
    )  # fmt: skip  # mmdebstrap knows where Debian's archive is
    if done.returncode:
        pytest.skip(f"Debian's archive cannot be reached: {done.stderr[-200:]}")
    unpack(next(debs.glob("*_arm64.deb")), root)
    qemu = shutil.which("qemu-aarch64-static")
    assert qemu is not None
    shutil.copy(qemu, root / "usr/bin/qemu-aarch64-static")
    for name in ("proc", "dev", "sys", "tmp", "srv"):
        (root / name).mkdir(exist_ok=True)
    mounts = "".join(f"mount --bind /{name} {root}/{name}; " for name in ("proc", "dev", "sys"))
    run = f'{mounts} exec chroot {root} /usr/bin/qemu-aarch64-static -E LD_LIBRARY_PATH={LIBRARIES} /usr/bin/python3.11 -I "$@"'
    arm_mb = record(["unshare", "-m", "bash", "-c", run, "bash", "-c", SHIM], root / "srv", "/srv")

    native = tmp_path / "native"
    unpack(next(debs.glob("*_amd64.deb")), native)
    (native / "srv").mkdir()
    amd_mb = record([str(native / "usr/bin/swathd")], native / "srv", str(native / "srv"))

    theirs, their_counts = payloads(root / "srv/logs")
    ours, our_counts = payloads(native / "srv/logs")
    assert their_counts == our_counts
    assert our_counts["received"] == PACKETS
    assert our_counts["masked_packets"] > 0
    assert our_counts["masked_blocks"] > 0
    assert our_counts["kernel_drops"] == our_counts["queue_drops"] == 0
    for topic, data in ours.items():
        assert data, topic
        assert theirs[topic] == data, topic
    assert max(amd_mb, arm_mb) < 100
    if path := os.environ.get("SWATH_FIGURES"):
        with Path(path).open("a") as file:
            print(json.dumps({"deb_amd64_mb": round(amd_mb, 1), "deb_arm64_mb": round(arm_mb, 1)}), file=file)
