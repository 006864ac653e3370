from dataclasses import replace

import pytest

from flightlog.errors import SwathError
from onboard import health, healthreport
from onboard.health import Level
from onboard.lidarstate import State
from onboard.status import ClockStatus, LidarStatus, LinkStatus, RecorderStatus, Status, from_json, to_json

S = 1_000_000_000
GOOD = Status(
    time_ns=100 * S,
    boot_id="b",
    version="1",
    pid=1,
    uptime_s=10.0,
    clock_steps=0,
    lidar=LidarStatus(age_s=0.1, packets_s=1808.0, received=18080, kept=10500),
    links={"ins": LinkStatus(connected=True, age_s=0.1, frames_s=60.0, autopilot="1/1", version=1)},
    recorder=RecorderStatus(segment="00001-000.mcap", sync_age_s=0.4),
    clocks={"ins": ClockStatus("TIMESYNC", 1.5, 2.0, 60, 0, "SYSTEM_TIME", -3600.5)},
)


def judged(status: Status, now_ns: int = 101 * S) -> tuple[Level, list[str]]:
    verdict = health.judge(status, now_ns, "b")
    return verdict.level, verdict.findings


def test_all_well_is_good() -> None:
    assert judged(GOOD) == (Level.GOOD, [])


@pytest.mark.parametrize(
    ("lidar", "level", "finding"),
    [
        (LidarStatus(state=State.NO_LINK), 2,
         "lidar: no link; is the cable plugged in and the lidar powered?"),
        (LidarStatus(state=State.NO_PACKETS), 2,
         "lidar: no packets; none yet, but a network link is up; check its destination address and the ports"),
        (LidarStatus(state=State.SILENT, age_s=3.0), 2,
         "lidar: silent for 3 s; the network link is not down; check its power and its laser switch"),
        (LidarStatus(state=State.RATE_LOW, age_s=0.1, packets_s=900.0, expected_packets_s=1808.0), 1,
         "lidar: rate low, 900 packets/s, expected 1808; check cable, network load and receive buffer"),
        (LidarStatus(age_s=0.1, kernel_drops=5), 1, "lidar: 5 packets lost in the receive buffer"),
        (LidarStatus(age_s=0.1, queue_drops=5), 1, "lidar: 5 packets lost because the disk was too slow or full"),
        (LidarStatus(age_s=0.1, rejected={"data packet of another sensor: VLP-16": 2}), 1,
         "lidar: 2 x data packet of another sensor: VLP-16"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_the_lidar_is_told_apart_by_name(lidar: LidarStatus, level: int, finding: str) -> None:
    assert judged(replace(GOOD, lidar=lidar))[0] == level
    assert finding in judged(replace(GOOD, lidar=lidar))[1]


@pytest.mark.parametrize(
    ("link", "finding"),
    [
        (LinkStatus(trouble="serial device x cannot be opened"), "link ins: serial device x cannot be opened"),
        (LinkStatus(connected=True), "link ins: open, but no autopilot heard"),
        (LinkStatus(connected=True, age_s=9.0), "link ins: autopilot silent for 9 s"),
    ],
)
def test_what_is_wrong_with_a_link_is_told_apart_by_name(link: LinkStatus, finding: str) -> None:
    assert judged(replace(GOOD, links={"ins": link})) == (Level.WARNING, [finding])


def test_an_old_status_says_stale_whatever_it_says() -> None:
    assert judged(GOOD, 107 * S) == (Level.CRITICAL, ["stale: the status is 7 s old; swathd does not run or hangs"])
    other_boot = health.judge(GOOD, 101 * S, "another")
    assert (other_boot.level, other_boot.findings) == (2, ["stale: the status is from before the last boot"])


def test_a_recorder_that_does_not_reach_the_disk_is_critical() -> None:
    slow = replace(GOOD, recorder=RecorderStatus(sync_age_s=8.0))
    assert judged(slow) == (Level.CRITICAL, ["recorder: nothing reached the disk for 8 s"])


@pytest.mark.parametrize(
    ("recorder", "level", "finding"),
    [
        (RecorderStatus(space="low"), 2, "recorder: space is low, so the lidar is not recorded"),
        (RecorderStatus(space="full", sync_age_s=60.0), 2, "recorder: the disk is full and nothing is recorded"),
        (RecorderStatus(lost_on_disk=7), 1, "recorder: 7 messages lost on a full disk"),
        (RecorderStatus(leftovers_left=2), 1, "recorder: 2 earlier logs cut off and not mended"),
    ],
)
def test_trouble_with_the_disk_is_told(recorder: RecorderStatus, level: int, finding: str) -> None:
    found = judged(replace(GOOD, recorder=recorder))
    assert found[0] == level
    assert found[1][0].startswith(finding)


def test_a_status_survives_its_file() -> None:
    assert from_json(to_json(GOOD), "here") == GOOD


@pytest.mark.parametrize("text", ["", "[]", "{}", "null", '{"lidar": 3}', to_json(GOOD).replace("pid", "pit")])
def test_another_file_is_no_status(text: str) -> None:
    with pytest.raises(SwathError, match=r"^s\.json: is no status file of this version of swathd$"):
        from_json(text, "s.json")


def test_a_worker_is_stalled_when_it_has_made_no_progress_for_too_long() -> None:
    progress = {"lidar": 99 * S, "recorder": 90 * S}
    assert health.stalled(progress, 100 * S) == ["recorder has made no progress for 10.0 s"]
    assert health.stalled(progress, 100 * S, 20 * S) == []


def test_the_report_has_the_verdict_first() -> None:
    lines = healthreport.report(GOOD, health.judge(GOOD, 101 * S, "b"))
    assert lines[0].startswith("GOOD: 00001-000.mcap: lidar 1808/s")
    assert [line.split()[0] for line in lines[1:]] == [
        "lidar", "10500", "position", "ins", "clock", "host", "recorder",
    ]  # fmt: skip


def test_armed_is_known_only_of_an_autopilot_that_is_heard_now() -> None:
    def of(*links: LinkStatus, age_s: float = 0.0, boot: str = "b") -> bool | None:
        named = {str(i): link for i, link in enumerate(links)}
        status = Status(0, "b", "", 1, 1.0, 0, LidarStatus(), named, RecorderStatus())
        return health.armed(status, int(age_s * 1e9), boot)

    yes, no, unsaid = (LinkStatus(connected=True, age_s=0.5, armed=one) for one in (True, False, None))
    assert of(no) is False
    assert of(no, no) is False
    assert of(no, yes) is True
    assert of(unsaid, yes) is True
    assert of(no, unsaid) is None
    assert of() is None
    assert of(replace(no, age_s=10.0)) is None
    assert of(replace(yes, connected=False)) is None
    assert of(no, age_s=10.0) is None
    assert of(no, boot="another") is None
