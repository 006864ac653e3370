"""What a ground station is told; pymavlink reads it."""

from dataclasses import replace

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from onboard.announce import Announcer, numbers, states
from onboard.lidarstate import State
from onboard.status import LidarStatus, LinkStatus, RecorderStatus, Status
from onboard.voice import Voice

GOOD = Status(
    time_ns=1,
    boot_id="b",
    version="1",
    pid=1,
    uptime_s=10.0,
    clock_steps=0,
    lidar=LidarStatus(age_s=0.1, packets_s=1808.0),
    links={"ins": LinkStatus(connected=True, age_s=0.1)},
    recorder=RecorderStatus(minutes_left=42.5),
)
SILENT = replace(GOOD, lidar=LidarStatus(state=State.SILENT, age_s=5.0))


def told(seconds: list[Status]) -> list[tuple[int, str] | None]:
    announcer = Announcer()
    texts = [announcer.next(states(status)) for status in seconds]
    return [None if text is None else (text.severity, text.text) for text in texts]


def test_only_changes_are_told_with_their_severity() -> None:
    heard = told([GOOD] * 5 + [SILENT] * 5 + [GOOD] * 5)
    assert [text for text in heard if text] == [
        (6, "swath: lidar recording"), (2, "swath: lidar silent"), (6, "swath: lidar recording"),
    ]  # fmt: skip


def test_what_flickers_is_not_told() -> None:
    assert [text for text in told([GOOD, SILENT] * 20) if text] == []


def test_never_more_than_one_text_in_a_second_and_the_news_are_not_lost() -> None:
    bad = replace(
        SILENT,
        links={"ins": LinkStatus()},
        recorder=RecorderStatus(space="low", sync_age_s=9.0),
        failures=["recorder: broken"],
    )
    heard = told([GOOD] * 5 + [bad] * 10)  # one entry a second, each one text or none
    assert {text for text in heard[5:] if text} == {
        (2, "swath: lidar silent"), (4, "swath: link ins silent"), (2, "swath: disk low, lidar stopped"),
        (2, "swath: disk does not take the log"), (2, "swath: recorder: broken"),
    }  # fmt: skip


def test_a_growing_count_of_losses_is_one_change() -> None:
    lossy = [replace(GOOD, lidar=LidarStatus(age_s=0.1, kernel_drops=n)) for n in range(20)]
    assert [text for text in told(lossy) if text and "lost" in text[1]] == [(4, "swath: lidar packets lost")]


@pytest.mark.parametrize("version", [1, 2])
def test_every_message_is_one_that_others_read_and_no_longer_than_it_may_be(version: int) -> None:
    voice = Voice()
    text = Announcer()
    long = replace(GOOD, failures=["a worker died with a sentence that is longer than fifty characters, and ümläuts"])
    text.next(states(long))
    messages = [*numbers(GOOD), message] if (message := text.next(states(long))) else []
    frames = [voice.frame(message, 7, version) for message in messages]
    assert {frame[0] for frame in frames} == {0xFE if version == 1 else 0xFD}
    if version == 1:  # MAVLink 1 has no extension fields: 51 bytes
        assert frames[-1][1] == 51
    heard = dialect.MAVLink(None).parse_buffer(b"".join(frames))
    assert [(m.get_srcSystem(), m.get_srcComponent()) for m in heard] == [(7, 191)] * 5
    assert [m.get_seq() for m in heard] == [0, 1, 2, 3, 4]
    assert {m.name: m.value for m in heard[:4]} == {
        "lidar_hz": 1808.0, "lidar_lost": 0.0, "mav_lost_b": 0.0, "disk_min": 42.5,
    }  # fmt: skip
    assert len(heard[4].text) <= 50
