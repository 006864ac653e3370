"""A card that stalls: nobody waits for it, memory stays bounded, and what it does not take is counted."""

import threading
import time
from pathlib import Path

import pytest

from flightlog import records
from flightlog.logfile import LogReader
from flightlog.records import HostClock
from onboard.config import RecorderConfig
from onboard.recorder import Recorder
from onboard.segment import Segment

PIECE = bytes(220_000)


class Stall:
    """Makes every sync of a segment wait while it is `closed`."""

    def __init__(self, segment: Segment) -> None:
        self._gate = threading.Event()
        self._gate.set()
        sync = segment._file.sync

        def slow() -> None:
            self._gate.wait()
            sync()

        segment._file.sync = slow  # type: ignore[method-assign]

    def close(self) -> None:
        self._gate.clear()

    def open(self) -> None:
        self._gate.set()


@pytest.fixture
def stalled(tmp_path: Path) -> tuple[Recorder, Stall]:
    first = (records.HOST_CLOCK.topic, 5, records.encode_host_clock(HostClock(5, 6, 7, 8)))
    segment = Segment(tmp_path / "00001-000.mcap", {}, {}, ["/mavlink/ins"], first)
    config = RecorderConfig(str(tmp_path), sync_ms=50, backlog_mb=4)
    return Recorder(config, lambda _: segment), Stall(segment)


def lidar(log: Path) -> list[int]:
    with LogReader(log) as reader:
        assert not reader.damage
        return [message.log_time_ns for message in reader.messages((records.LIDAR.topic,))]


def test_a_stall_that_the_backlog_bridges_loses_nothing(stalled: tuple[Recorder, Stall], tmp_path: Path) -> None:
    recorder, stall = stalled
    recorder.start()
    stall.close()
    for number in range(15):  # 3.3 MB
        assert recorder.put(records.LIDAR.topic, number, PIECE, False)
        time.sleep(0.02)
    stall.open()
    recorder.stop()
    assert lidar(tmp_path / "00001-000.mcap") == list(range(15))


def test_in_a_long_stall_nobody_waits_memory_is_bounded_and_every_drop_is_counted(
    stalled: tuple[Recorder, Stall], tmp_path: Path
) -> None:
    recorder, stall = stalled
    recorder.start()
    recorder.put(records.LIDAR.topic, 0, PIECE, False)
    stall.close()
    taken = [0]
    for number in range(1, 100):  # 22 MB into 4; who waited for the disk here would wait for ever
        if recorder.put(records.LIDAR.topic, number, PIECE, False):
            taken.append(number)
        assert recorder.put("/mavlink/ins", number, b"small", True)
        assert recorder.backlog.size_bytes <= (4 << 20) + 100 * 5
        time.sleep(0.005)
    assert recorder.backlog.refused == 100 - len(taken) > 50
    stall.open()
    recorder.stop()
    assert recorder.failure is None
    assert lidar(tmp_path / "00001-000.mcap") == taken
    with LogReader(tmp_path / "00001-000.mcap") as log:
        assert sum(1 for _ in log.messages(("/mavlink/",))) == 99
