"""A real, booted systemd to try the service in."""

import contextlib
import json
import os
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]

missing = [name for name in ("systemd-nspawn", "nsenter", "unshare", "ip", "sshd") if shutil.which(name) is None]
needs = [
    pytest.mark.root,
    pytest.mark.skipif(os.geteuid() != 0, reason="booting a systemd needs root"),
    pytest.mark.skipif(bool(missing), reason=f"not installed: {', '.join(missing)}"),
]
"""Marks of tests that boot one."""

BOOT = """
set -eu
mkdir -p /run/systemd/nspawn  # in this namespace only: it may not lie on a disk
mount -t tmpfs tmpfs /run/systemd/nspawn
mount -t tmpfs tmpfs {work}
mkdir {work}/upper {work}/work {work}/root
mount -t overlay overlay -o lowerdir=/,upperdir={work}/upper,workdir={work}/work {work}/root
cd {work}/root
rm -rf etc/machine-id etc/systemd/system/*.wants etc/systemd/system/swathd* etc/swathd var/lib/swathd var/log/journal
{prepare}
exec env SYSTEMD_NSPAWN_UNIFIED_HIERARCHY=1 systemd-nspawn -q -D {work}/root -b \
  --register=no --keep-unit --private-network --machine=swath-test --link-journal=no \
  --system-call-filter=bpf --capability=CAP_BPF {options}
"""


class Guest:
    """A booted system: a container on a copy-on-write view of this very one.

    What is installed in it vanishes with it. It has a network of its own with a lidar's cable in it.
    """

    def __init__(self, folder: Path, prepare: str, options: str = "") -> None:
        """`prepare` is run in the guest's root folder before it boots; `options` go to systemd-nspawn."""
        self.folder = folder
        (folder / "work").mkdir()
        script = BOOT.format(work=folder / "work", prepare=prepare, options=options)
        self.console = folder / "console"
        with self.console.open("wb") as console:
            self.process = subprocess.Popen(
                ["unshare", "-m", "bash", "-c", script], stdin=subprocess.DEVNULL, stdout=console, stderr=console,
                cwd=ROOT, start_new_session=True,
            )  # fmt: skip

    def boot(self) -> None:
        self.wait_for(lambda: self.leader is not None)
        self.wait_for(lambda: self.systemctl("is-system-running").strip() in ("running", "degraded"))
        # the lidar on a cable of its own, and a stranger on another
        for words in (
            "link add name lidar0 type veth peer name plug0", "link set plug0 up", "link set lidar0 up",
            "addr add 192.168.1.201/32 dev lidar0",
            "link add name other type veth peer name plug1", "link set plug1 up", "link set other up",
            "addr add 10.99.0.1/24 dev other",
        ):  # fmt: skip
            self.enter("ip", *words.split(), net_only=True)

    @property
    def leader(self) -> int | None:
        """The guest's first process, once it runs."""
        with contextlib.suppress(OSError, ValueError, IndexError):
            children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
            for child in children:
                if Path(f"/proc/{child}/comm").read_text().strip() == "systemd":
                    return int(child)
        return None

    def wait_for(self, true: Callable[[], Any], limit_s: float = 120.0) -> Any:
        deadline = time.monotonic() + limit_s
        while not (found := true()):
            assert self.process.poll() is None, self.console.read_text(errors="replace")[-3000:]
            assert time.monotonic() < deadline, self.console.read_text(errors="replace")[-3000:] + self.journal_text()
            time.sleep(0.1)
        return found

    def enter(self, *words: str | Path, check: bool = True, net_only: bool = False) -> str:
        spaces = ["-n"] if net_only else ["-a", "-r", "-w"]
        line = ["nsenter", "-t", str(self.leader), *spaces, *words]
        return subprocess.run(line, capture_output=True, text=True, check=check, timeout=300).stdout

    def systemctl(self, *words: str) -> str:
        return self.enter("systemctl", *words, check=False)

    def show(self, name: str) -> str:
        return self.systemctl("show", "--value", f"--property={name}", "swathd.service").strip()

    def journal(self, *words: str) -> list[dict[str, Any]]:
        text = self.enter("journalctl", "-o", "json", "--no-pager", "-q", *words, check=False)
        return [json.loads(line) for line in text.splitlines()]

    def journal_text(self) -> str:
        return self.enter("journalctl", "-n", "60", "--no-pager", check=False) if self.leader else ""

    def path(self, inside: str) -> Path:
        """A file of the guest, as seen from here."""
        return Path(f"/proc/{self.leader}/root{inside}")

    @property
    def pid(self) -> int:
        """The daemon's, in the guest; there is one."""
        pid = int(self.show("MainPID"))
        assert pid > 1, self.journal_text()
        return pid

    def status(self) -> dict[str, Any]:
        tree: dict[str, Any] = json.loads(self.path("/run/swathd/status.json").read_text())
        return tree

    def send(self, source: str = "192.168.1.201", count: int = 200) -> None:
        """Packets of a lidar in the guest's network."""
        self.enter(sys.executable, "-c", _sender(source, count), net_only=True)

    @contextlib.contextmanager
    def sending(self) -> Iterator[None]:
        """A lidar that sends all the while."""
        line = ["nsenter", "-t", str(self.leader), "-n", sys.executable, "-c", _sender("192.168.1.201", 10**9)]
        with subprocess.Popen(line, stdin=subprocess.DEVNULL) as process:
            try:
                yield
            finally:
                process.kill()

    def stop(self) -> None:
        if self.leader is not None:
            os.kill(self.leader, signal.SIGRTMIN + 14)  # poweroff at once, as systemd(1) has it
        try:
            self.process.wait(120)
        except subprocess.TimeoutExpired:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait(60)


def _sender(source: str, count: int) -> str:
    """A program that sends packets of a lidar, a thousand a second at the most."""
    block = struct.pack("<HH", 0xEEFF, 0) + 32 * struct.pack("<HB", 2500, 40)
    packet = 12 * block + struct.pack("<IBB", 1000, 0x37, 0x21)
    return (
        "import socket, time\n"
        f"s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM); s.bind(({source!r}, 0))\n"
        f"for i in range({count}): s.sendto(bytes.fromhex({packet.hex()!r}), ('192.168.1.201', 2368)); time.sleep(0.001)\n"
    )
