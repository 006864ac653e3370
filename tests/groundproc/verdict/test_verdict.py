"""The verdict: what makes a log or a flight doubtful or bad, and that nothing else does."""

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from groundproc import verdict
from groundproc.verdict import BAD, DOUBTFUL, GOOD, Reason, Verdict, warnings_in
from groundproc.verdict.flight import judge_flight
from groundproc.verdict.log import judge_log

Figures = dict[str, Any]
Change = Callable[[Figures], object]

LOG: Figures = {
    "file": "a.mcap",
    "end_utc": "2026-05-20T10:17:33.816Z",
    "truncated": False,
    "damage": {"bad_chunks": 0, "lost_bytes": 0, "places": []},
    "lidar": {"packets": 54_256, "lost_packets": 0, "account": {"received": 54_256, "kernel_drops": 0, "queue_drops": 0}},
    "mavlink": {
        "ins": {
            "frames": 6780,
            "lost_frames": 0,
            "shared_ids": [],
            "bad_bytes": 0,
            "gps_fix_type": 3,
            "gps_after_first_fix": {"reports": 90, "without": 0},
            "messages": [{"count": 6780}],
        }
    },
    "lidar_with_autopilot_s": 30.0,
    "gaps": [],
    "messages_damaged": 0,
}  # fmt: skip

SYNC: Figures = {"method": "gyro", "sigma_s": 0.0001, "note": ""}
FLIGHT: Figures = {
    "inputs": [{"file": "a.mcap", "end": "2026-05-20T10:17:33Z", "truncated": False, "bad_chunks": 0, "lost_bytes": 0}],
    "legs": [{"sync": SYNC, "utc": {"source": "system_time"}, "gps_after_first_fix": {"reports": 90, "without": 0}}],
    "autopilot": {"frames": 6780, "bad_bytes": 0},
    "trajectory": {
        "covered_s": 29.9,
        "gaps_s": 0.0,
        "median_sigma_m": [3.0, 3.0, 4.5],
        "largest_sigma_m": [3.0, 3.0, 4.5],
        "median_sigma_attitude_deg": [0.02, 0.02, 0.4],
        "turn_rate_deg_s": 40.0,
        "method": "adjusted",
        "warning": "",
    },
    "config": {"causal": False},
    "mount": {"source": "log"},
    "points": {
        "written": 10_000_000,
        "shots_dropped": {"no_pose": 70_000, "outside_fov": 8_000_000, "no_return": 1_000_000, "out_of_range": 0},
    },
    "lidar": {
        "packets": 54_256,
        "packets_outside_every_leg": 0,
        "lost_packets": 0,
        "aboard": {"kernel_drops": 0, "queue_drops": 0},
    },
}


def changed(figures: Figures, path: str, value: Any) -> Figures:
    """Figures with one value changed, by its keys with slashes between."""
    made: Any = copy.deepcopy(figures)
    *way, last = [int(key) if key.isdecimal() else key for key in path.split("/")]
    place = made
    for key in way:
        place = place[key]
    place[last] = value
    return dict(made)


def test_a_log_without_a_fault_is_good() -> None:
    assert judge_log(LOG).line() == "verdict: good"
    assert judge_log(LOG).exit_code == 0


def test_a_flight_without_a_fault_is_good() -> None:
    assert judge_flight(FLIGHT).line() == "verdict: good"


@pytest.mark.parametrize(
    ("path", "value", "grade", "about", "words"),
    [
        ("truncated", True, DOUBTFUL, "truncated", "swath recover a.mcap"),
        ("damage/bad_chunks", 2, DOUBTFUL, "damaged", "2 pieces"),
        ("messages_damaged", 7, DOUBTFUL, "messages", "7 messages cannot be read"),
        ("lidar", None, DOUBTFUL, "lidar", "no lidar packets"),
        ("lidar/lost_packets", 1000, DOUBTFUL, "lost_packets", "1.8%"),
        ("lidar/account/kernel_drops", 1000, DOUBTFUL, "lost_packets", "1,000 lidar packets"),
        ("mavlink", {}, DOUBTFUL, "autopilot", "swath decode"),
        ("mavlink/ins/lost_frames", 2000, DOUBTFUL, "lost_frames", "23%"),
        ("mavlink/ins/shared_ids", ["1/1"], DOUBTFUL, "shared_id", "share the MAVLink id 1/1"),
        ("mavlink/ins/bad_bytes", 100_000, DOUBTFUL, "bad_bytes", "29%"),
        ("mavlink/ins/gps_fix_type", 1, BAD, "gnss", "never had a fix"),
        ("mavlink/ins/gps_after_first_fix/without", 30, DOUBTFUL, "gnss", "33% of the time"),
        ("lidar_with_autopilot_s", 0.0, BAD, "together", "one flight?"),
        ("gaps", [{"topic": "/mavlink/ins", "from_utc": "T", "duration_s": 4.0}], DOUBTFUL, "gaps", "4.0 s in /mavlink/ins from T"),
    ],
)  # fmt: skip
def test_each_fault_of_a_log_is_a_reason(path: str, value: Any, grade: str, about: str, words: str) -> None:
    found = judge_log(changed(LOG, path, value))
    assert (found.grade, [reason.about for reason in found.reasons]) == (grade, [about])
    assert words in found.line()


def test_a_log_of_neither_lidar_nor_autopilot_is_bad() -> None:
    assert judge_log(changed(changed(LOG, "lidar", None), "mavlink", {})).grade == BAD


def test_the_autopilots_own_log_stands_for_its_messages() -> None:
    board = changed(changed(LOG, "mavlink", {}), "topics", {"/dataflash/ins": {"messages": 9}})
    assert judge_log(board).grade == GOOD


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("lidar/lost_packets", 20),
        ("mavlink/ins/lost_frames", 200),
        ("mavlink/ins/bad_bytes", 2_000),
        ("mavlink/ins/gps_after_first_fix/without", 1),
        ("mavlink/ins/gps_after_first_fix", None),
        ("mavlink/ins/gps_fix_type", None),
        ("lidar/account", None),
        ("gaps", [{"topic": "/mavlink/fc", "from_utc": "T", "duration_s": 4.0}]),
    ],
)
def test_small_losses_and_what_is_not_known_are_no_reason(path: str, value: Any) -> None:
    assert judge_log(changed(LOG, path, value)).grade == GOOD


@pytest.mark.parametrize(
    ("path", "value", "grade", "about", "words"),
    [
        ("inputs/0/truncated", True, DOUBTFUL, "truncated", "swath recover a.mcap"),
        ("inputs/0/lost_bytes", 1234, DOUBTFUL, "damaged", "1,234 bytes"),
        (
            "legs/0/sync/sigma_s",
            0.02,
            DOUBTFUL,
            "sync",
            "to 20 ms only, by which turns of 40 deg/s put the beam 14.0 mrad off",
        ),
        ("legs/0/sync/sigma_s", 168.0, BAD, "sync", "to 168,000 ms only"),
        ("legs/0/utc/source", "host", DOUBTFUL, "utc", "recording computer"),
        ("legs/0/gps_after_first_fix/without", 9, DOUBTFUL, "gnss", "10% of the time"),
        ("autopilot/bad_bytes", 100_000, DOUBTFUL, "bad_bytes", "29%"),
        ("trajectory/gaps_s", 4.0, DOUBTFUL, "gaps", "4.0 s of 33.9 s"),
        ("trajectory/median_sigma_m", [12.0, 3.0, 4.5], DOUBTFUL, "position", "12.0 m in plan"),
        ("trajectory/largest_sigma_m", [3.0, 3.0, 40.0], DOUBTFUL, "position", "at worst 3.0 m in plan and 40.0 m"),
        ("trajectory/median_sigma_m", [3.0, 300.0, 4.5], BAD, "position", "300.0 m in plan"),
        (
            "trajectory/median_sigma_attitude_deg",
            [2.5, 0.2, 0.4],
            DOUBTFUL,
            "attitude",
            "known in level to 2.5 deg and heading to 0.4",
        ),
        ("trajectory/median_sigma_attitude_deg", [0.1, 0.1, 11.0], DOUBTFUL, "attitude", "30 m away by up to 5.8 m"),
        (
            "trajectory/median_sigma_attitude_deg",
            [float("nan"), 0.1, 11.0],
            DOUBTFUL,
            "attitude",
            "heading to 11.0 deg only",
        ),
        (
            "trajectory/median_sigma_attitude_deg",
            [5.0, float("nan"), float("nan")],
            DOUBTFUL,
            "attitude",
            "in level to 5.0 deg only",
        ),
        ("trajectory/median_sigma_m", [float("nan"), 12.0, float("nan")], DOUBTFUL, "position", "12.0 m in plan"),
        ("trajectory/warning", "it has not settled", DOUBTFUL, "warning", "it has not settled"),
        ("mount/source", "firmware_config/mount.yaml", DOUBTFUL, "mount", "--mount FILE"),
        ("mount/source", "estimated by adjusted, begun from firmware_config/mount.yaml", DOUBTFUL, "mount", "--mount"),
        ("points/written", 0, BAD, "points", "not one point"),
        ("points/shots_dropped/no_pose", 3_000_000, DOUBTFUL, "no_pose", "14% of the lidar's shots"),
        ("lidar/packets_outside_every_leg", 10_000, DOUBTFUL, "no_pose", "19% of the lidar's shots"),
        ("lidar/lost_packets", 1000, DOUBTFUL, "lost_packets", "1,000 lidar packets"),
        ("lidar/aboard/queue_drops", 1000, DOUBTFUL, "lost_packets", "1,000 lidar packets"),
    ],
)
def test_each_fault_of_a_flight_is_a_reason(path: str, value: Any, grade: str, about: str, words: str) -> None:
    found = judge_flight(changed(FLIGHT, path, value))
    assert (found.grade, [reason.about for reason in found.reasons]) == (grade, [about])
    assert words in found.line()


def test_a_coarse_tie_is_enough_for_a_sensor_that_hardly_turns() -> None:
    """9 ms of receive times: 6.3 mrad at 40 deg/s, but 0.3 at 2, where the beam is 2.8 wide."""
    coarse = changed(FLIGHT, "legs/0/sync/sigma_s", 0.009)
    assert judge_flight(coarse).grade == DOUBTFUL
    assert judge_flight(changed(coarse, "trajectory/turn_rate_deg_s", 2.0)).grade == GOOD


def test_a_sigma_that_nobody_stated_is_no_reason() -> None:
    assert judge_flight(changed(FLIGHT, "trajectory/median_sigma_m", [float("nan")] * 3)).grade == GOOD
    assert judge_flight(changed(FLIGHT, "trajectory/median_sigma_attitude_deg", [float("nan")] * 3)).grade == GOOD


def test_an_attitude_that_was_not_measured_says_what_would_measure_it() -> None:
    stated = changed(FLIGHT, "trajectory/median_sigma_attitude_deg", [1.0, 1.0, 12.0])
    assert "--method adjusted" not in judge_flight(stated).line()
    for path, value in (("trajectory/method", "ins"), ("config/causal", True)):
        assert "--method adjusted" in judge_flight(changed(stated, path, value)).line()


def test_a_warning_anywhere_in_the_figures_is_a_reason_whoever_wrote_it() -> None:
    figures = FLIGHT | {"radiometry": {"bands": [{"warnings": ["band 3 is dark", "band 4 is dark"]}, {"warning": ""}]}}
    assert warnings_in(figures) == ["band 3 is dark", "band 4 is dark"]
    assert judge_flight(figures).line() == "verdict: doubtful: band 3 is dark; band 4 is dark"


def test_the_worst_reason_decides_and_comes_first() -> None:
    found = Verdict((Reason(DOUBTFUL, "a", "one thing"), Reason(BAD, "b", "another"), Reason(DOUBTFUL, "c", "a third")))
    assert found.line() == "verdict: bad: another; one thing; a third"


@pytest.mark.parametrize(("grade", "code"), [(GOOD, 0), (DOUBTFUL, 3), (BAD, 1)])
def test_exit_codes_are_those_of_the_conventions(grade: str, code: int) -> None:
    assert Verdict(() if grade == GOOD else (Reason(grade, "a", "b"),)).exit_code == code
    page = (Path(verdict.__file__).parents[2] / "docs/conventions.md").read_text(encoding="utf-8")
    assert f"| {code} |" in page


def test_a_verdict_goes_through_json_and_back() -> None:
    found = judge_flight(changed(FLIGHT, "trajectory/gaps_s", 4.0))
    assert Verdict.from_mapping(json.loads(json.dumps(found.to_mapping()))) == found
    assert found.to_mapping()["verdict"] == "doubtful"
