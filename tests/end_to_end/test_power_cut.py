"""The power goes: the real `swathd` writes to a real ext4, and what is on the disk at that instant is all that is left.

The daemon is stopped with SIGSTOP and the image of its file system copied: that holds what ext4 has handed to the card, and nothing of
what was still in memory. The copy is mounted, which replays its journal as the next boot would.

A card whose own cache is volatile is the image inside another file system. What ext4 hands to it waits in the page cache of the outer one
until the inner one asks for a flush, which the loop device carries out as an fsync; the image of the outer one is what is copied. All that
was written and not flushed is then gone.
"""

import json
import os
import random
import signal
import stat
import struct
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from recording import mounted, recording, run

from flightlog import records
from flightlog.errors import LogError
from flightlog.logfile import LogReader
from flightlog.logwriter import LogWriter
from flightlog.salvage import salvage
from onboard import logfolder

pytestmark = [
    pytest.mark.root,
    pytest.mark.skipif(os.geteuid() != 0, reason="needs root to mount an ext4 image"),
]

ALLOWED_LOSS_S = 1.0


CARD_MB = 224


class Card:
    """A card with an ext4 on it, and what a power cut would leave of it.

    Parameters
    ----------
    folder : Path
    volatile : bool
        It has a cache that loses all that was not flushed.
    """

    def __init__(self, folder: Path, *, volatile: bool) -> None:
        self._folder, self._volatile = folder, volatile
        self._image, self._copy = folder / "card.img", folder / "cut.img"

    @contextmanager
    def mounted(self) -> Iterator[Path]:
        """The folder where it is mounted."""
        with ExitStack() as stack:
            inner = self._image
            if self._volatile:
                self._format(self._image, CARD_MB + 64)
                inner = stack.enter_context(mounted(self._image, self._folder / "outer")) / "card.img"
                # written once from end to end: a flush then concerns data alone, never where they are
                run("dd", "if=/dev/zero", f"of={inner}", "bs=1M", f"count={CARD_MB}", "conv=fsync")
                run("mkfs.ext4", "-q", inner)
                run("sync", "-f", inner)
            else:
                self._format(inner, CARD_MB)
            yield stack.enter_context(mounted(inner, self._folder / "card"))

    @staticmethod
    def _format(image: Path, size_mb: int) -> None:
        run("truncate", "-s", f"{size_mb}M", image)
        run("mkfs.ext4", "-q", image)

    def cut(self, daemon: subprocess.Popen[bytes]) -> int:
        """Take what the power cut leaves; gives the time of it on the monotonic clock [ns]."""
        daemon.send_signal(signal.SIGSTOP)
        cut_ns = time.monotonic_ns()
        run("cp", "--sparse=always", self._image, self._copy)
        daemon.send_signal(signal.SIGCONT)
        return cut_ns

    @contextmanager
    def after(self) -> Iterator[Path]:
        """What was left, mounted."""
        with ExitStack() as stack:
            left = self._copy
            if self._volatile:
                left = stack.enter_context(mounted(left, self._folder / "outer_after")) / "card.img"
            yield stack.enter_context(mounted(left, self._folder / "after"))


@dataclass
class Left:
    """What a power cut left."""

    segments: int = 0
    packets: list[int] = field(default_factory=list)
    kernel_drops: int = 0
    mavlink: list[int] = field(default_factory=list)
    oldest_ns: int = 0
    """Of lidar packets [ns of the monotonic clock]."""
    newest_ns: int = 0
    """Of lidar packets where there are any, else of MAVLink [ns of the monotonic clock]."""

    def add(self, path: Path) -> None:
        times = [0]
        with LogReader(path) as log:
            anchor_ns = int(log.metadata["swath.session"]["log_minus_monotonic_ns"])
            for message in log.messages():
                if message.topic == records.LIDAR.topic:
                    scan = records.decode_scan(message.data)
                    self.packets += scan["data"]["stamp_us"].tolist()
                    received_ns = records.receive_time_ns(scan)
                    times.append(int(received_ns[-1]))
                    self.oldest_ns = self.oldest_ns or int(received_ns[0]) - anchor_ns
                elif message.topic == records.LIDAR_ACCOUNT.topic:
                    self.kernel_drops += records.decode_account(message.data).kernel_drops
                elif message.topic == "/mavlink/ins":
                    chunks = records.decode_raw(message.data)
                    self.mavlink += [struct.unpack("<I", data)[0] for _, data in chunks]
                    if not self.packets:
                        times.append(chunks[-1][0])
            assert not log.damage
        self.newest_ns = max(self.newest_ns, max(times) - anchor_ns if max(times) else 0)


def what_is_left(logs: Path) -> Left:
    """Read everything of a disk after the cut: finished segments must be as the manifest says, the rest is salvaged."""
    left = Left()
    manifest = logfolder.read_manifest(logs)
    for name, line in sorted(manifest.items()):
        assert line["how"] == "closed"
        assert line["sha256"] == logfolder.sha256(logs / name)
        assert stat.S_IMODE((logs / name).stat().st_mode) == 0o444
        left.add(logs / name)
        left.segments += 1
    for path in logfolder.leftovers(logs):
        mended = path.with_suffix(".salvaged")
        try:
            found = salvage(path, mended)
        except LogError:  # made, but nothing of it was synced yet
            assert path.stat().st_size < 10_000
            continue
        assert found.torn_tail_only
        left.add(mended)
        mended.unlink()
    return left


def check(left: Left, cut_ns: int, *, lidar: bool) -> float:
    """Nothing may be missing but the end; gives how much of it [s]."""
    assert left.mavlink == list(range(left.mavlink[0], left.mavlink[0] + len(left.mavlink)))
    if lidar:
        assert (np.diff(left.packets) > 0).all()
        missing = left.packets[-1] - left.packets[0] + 1 - len(left.packets)
        assert missing <= left.kernel_drops
    return (cut_ns - left.newest_ns) / 1e9


def trials(folder: Path, count: int, *, lidar: bool, seed: int, volatile: bool = False) -> list[float]:
    """Cut the power again and again while one daemon records, a new segment each second; gives what each lost [s]."""
    card, dice, losses = Card(folder, volatile=volatile), random.Random(seed), []
    with card.mounted() as place, recording(folder, place / "logs", lidar=lidar) as daemon:
        for _ in range(count):
            time.sleep(dice.uniform(2.0, 4.0))
            cut_ns = card.cut(daemon)
            with card.after() as after:
                left = what_is_left(after / "logs")
            assert left.segments > 0
            losses.append(check(left, cut_ns, lidar=lidar))
        assert daemon.poll() is None
    return losses


@pytest.mark.parametrize("lidar", [True, False], ids=["at full rate", "with the lidar silent"])
def test_a_power_cut_loses_less_than_a_second_and_no_earlier_segment(tmp_path: Path, lidar: bool) -> None:
    (loss_s,) = trials(tmp_path, 1, lidar=lidar, seed=1)
    assert loss_s <= ALLOWED_LOSS_S


@pytest.mark.parametrize("volatile", [False, True])
def test_what_a_volatile_cache_holds_unflushed_is_lost(tmp_path: Path, volatile: bool) -> None:
    """The model itself: bytes written past the page cache of the inner file system, with and without a flush behind them."""
    card = Card(tmp_path, volatile=volatile)
    with card.mounted() as place, subprocess.Popen(["sleep", "100"]) as anybody:
        run("dd", "if=/dev/zero", f"of={place / 'old'}", "bs=64k", "count=1", "conv=fsync")
        run("dd", "if=/dev/zero", f"of={place / 'new'}", "bs=64k", "count=1", "conv=fsync")
        ones = tmp_path / "ones"
        ones.write_bytes(b"\xff" * 65536)
        run("dd", f"if={ones}", f"of={place / 'old'}", "bs=64k", "oflag=direct", "conv=notrunc,fsync")
        run("dd", f"if={ones}", f"of={place / 'new'}", "bs=64k", "oflag=direct", "conv=notrunc")
        card.cut(anybody)
        anybody.kill()
        with card.after() as after:
            assert (after / "old").read_bytes() == ones.read_bytes()
            assert ((after / "new").read_bytes() == ones.read_bytes()) is not volatile


def test_a_card_with_a_volatile_cache_loses_less_than_a_second_too(tmp_path: Path) -> None:
    losses = trials(tmp_path, 2, lidar=True, seed=3, volatile=True)
    assert max(losses) <= ALLOWED_LOSS_S


# forty cuts; in the quick suite a few
@pytest.mark.soak
def test_twenty_power_cuts_at_full_rate_and_twenty_with_the_lidar_silent(tmp_path: Path) -> None:
    losses = []
    for lidar in (True, False):
        folder = tmp_path / str(lidar)
        folder.mkdir()
        losses += trials(folder, 20, lidar=lidar, seed=2)
    tell("power_cut", losses)
    assert max(losses) <= ALLOWED_LOSS_S


# thirty cuts; in the quick suite two
@pytest.mark.soak
def test_thirty_power_cuts_of_a_volatile_cache_around_rotations(tmp_path: Path) -> None:
    """A segment lives for a second and takes most of one to be closed: each cut is near a rotation."""
    losses = []
    for seed in range(3):
        folder = tmp_path / str(seed)
        folder.mkdir()
        losses += trials(folder, 10, lidar=True, seed=seed, volatile=True)
    tell("power_cut_volatile", losses)
    assert max(losses) <= ALLOWED_LOSS_S


def tell(name: str, losses: list[float]) -> None:
    """Into the figures of the soak."""
    if figures := os.environ.get("SWATH_FIGURES"):
        with Path(figures).open("a") as file:
            found = {
                f"{name}_worst_loss_s": round(max(losses), 3),
                f"{name}_median_loss_s": round(float(np.median(losses)), 3),
                f"{name}_trials": len(losses),
            }
            file.write(json.dumps(found) + "\n")


def test_kill_9_loses_less_than_a_second_and_the_next_start_mends_the_log(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    with recording(tmp_path, logs, lidar=True, segment_s=60) as daemon:
        time.sleep(2.3)
        killed_ns = time.monotonic_ns()
        daemon.kill()
        daemon.wait()
    with recording(tmp_path, logs, lidar=True, segment_s=60):
        end = time.monotonic() + 120
        while not (manifest := logfolder.read_manifest(logs)):
            assert time.monotonic() < end
            time.sleep(0.1)
    ((name, line),) = manifest.items()
    assert line["how"] == "salvaged"
    left = Left()
    left.add(logs / name)
    assert check(left, killed_ns, lidar=True) <= ALLOWED_LOSS_S


def write_leftover(path: Path, size_mb: int) -> int:
    """A log of numbered packets that nobody closed; gives the number of messages."""
    count = size_mb * (1 << 20) // 220_000
    piece = random.Random(1).randbytes(220_000)
    with path.open("wb") as stream:
        writer = LogWriter(stream, metadata={}, attachments={}, compression="none")
        for i in range(count):
            writer.write(records.LIDAR.topic, i, piece)
        writer.flush()
    return count


# a gigabyte to be mended; in the quick suite 60 MB
@pytest.mark.parametrize("size_mb", [60, pytest.param(1024, marks=pytest.mark.soak)])
def test_a_large_leftover_does_not_delay_the_first_packet(tmp_path: Path, size_mb: int) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    count = write_leftover(logs / "00001-000.mcap", size_mb)
    begin_ns = time.monotonic_ns()
    with recording(tmp_path, logs, lidar=True, segment_s=3600) as daemon:
        end = time.monotonic() + 120 + size_mb
        while not (manifest := logfolder.read_manifest(logs)):
            assert time.monotonic() < end
            time.sleep(0.1)
        mended_ns = time.monotonic_ns()
        daemon.send_signal(signal.SIGTERM)
        daemon.wait(120)
    assert manifest["00001-000.mcap"]["messages"] == {records.LIDAR.topic: count}
    left = Left()
    left.add(logs / "00002-000.mcap")
    assert left.packets[-1] - left.packets[0] + 1 - len(left.packets) <= left.kernel_drops
    first_s = (left.oldest_ns - begin_ns) / 1e9
    assert left.oldest_ns < mended_ns  # it was received while the leftover was still being mended
    if figures := os.environ.get("SWATH_FIGURES"):
        with Path(figures).open("a") as file:
            file.write(json.dumps({"start_to_first_packet_s": round(first_s, 3)}) + "\n")
