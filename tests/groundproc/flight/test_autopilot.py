"""Messages sorted into boots, against pymavlink on recordings and against messages made one by one."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog.errors import LogError
from flightlog.mavlink import Frame, FrameParser
from groundproc.flight import autopilot

TlogFrames = Callable[[str], list[Frame]]
FramesOf = Callable[..., list[Frame]]
HOST_NS = 1_700_000_000_000_000_000
MS = 1_000_000
HALF = 500_000
"""A count of whole milliseconds is half of one behind on average: it is cut, not rounded."""


def heartbeat(autopilot_type: int = 3) -> Any:
    return dialect.MAVLink_heartbeat_message(2, autopilot_type, 0, 0, 4, 3)


def attitude(boot_ms: int, roll: float = 0.0) -> Any:
    return dialect.MAVLink_attitude_message(boot_ms, roll, 0.0, 0.0, 0.1, 0.2, 0.3)


def raw_imu(usec: int, gyro: tuple[int, int, int] = (1, 2, 3)) -> Any:
    return dialect.MAVLink_raw_imu_message(usec, 0, 0, -1000, *gyro, 0, 0, 0)


def case_frames(folder: Path) -> list[Frame]:
    """Frames kept as length and bytes, a second apart."""
    data, found, parser = (folder / "frames.bin").read_bytes(), [], FrameParser()
    offset = 0
    while offset < len(data):
        size = int.from_bytes(data[offset : offset + 2], "little")
        found += parser.feed(HOST_NS + len(found) * 1_000 * MS, data[offset + 2 : offset + 2 + size])
        offset += 2 + size
    return found


def of_pymavlink(recordings: Path, name: str, kind: str) -> list[Any]:
    log = mavutil.mavlink_connection(str(recordings / "mavlink" / f"{name}.tlog"), dialect="ardupilotmega")
    found = []
    while (message := log.recv_match(type=kind)) is not None:
        found.append(message)
    log.close()
    return found


def test_a_flight_with_two_boots_in_one_file_gives_both(recordings: Path, tlog_frames: TlogFrames) -> None:
    first, second = autopilot.boots(tlog_frames("copter_flight_2015"))
    theirs = of_pymavlink(recordings, "copter_flight_2015", "ATTITUDE")
    stamps = np.array([m.time_boot_ms for m in theirs])
    (cut,) = np.flatnonzero(np.diff(stamps) < -5000) + 1
    for boot, part in ((first, theirs[:cut]), (second, theirs[cut:])):
        # what comes late or twice over the radio is left out
        new = [m for i, m in enumerate(part) if i == 0 or m.time_boot_ms > max(n.time_boot_ms for n in part[:i])]
        table = boot.tables["ATTITUDE"]
        assert boot.stamps_ns["ATTITUDE"].tolist() == [m.time_boot_ms * MS + HALF for m in new]
        assert table["roll"].tolist() == [np.float32(m.roll) for m in new]
        assert table["yawspeed"].tolist() == [np.float32(m.yawspeed) for m in new]
        for name, stamps_ns in boot.stamps_ns.items():
            assert (np.diff(stamps_ns) > 0).all(), name
    # the same clock for all messages of a boot: none is further from the next attitude than a radio's hole
    for boot in (first, second):
        low, high = boot.stamps_ns["ATTITUDE"][[0, -1]]
        for name in ("RAW_IMU", "GLOBAL_POSITION_INT", "GPS_RAW_INT", "SYSTEM_TIME"):
            assert boot.stamps_ns[name].min() > low - 10_000 * MS
            assert boot.stamps_ns[name].max() < high + 10_000 * MS


def test_a_companion_is_not_the_autopilot(recordings: Path, tlog_frames: TlogFrames) -> None:
    (boot,) = autopilot.boots(tlog_frames("ardusub_2023"))
    assert (boot.system, boot.component) == (1, 1)
    theirs = of_pymavlink(recordings, "ardusub_2023", "ATTITUDE")
    assert len(boot.tables["ATTITUDE"]) == len({m.time_boot_ms for m in theirs})
    assert len(boot.tables["HEARTBEAT"]) <= sum(
        m.get_srcComponent() == 1 for m in of_pymavlink(recordings, "ardusub_2023", "HEARTBEAT")
    )
    assert boot.gyros()[0].name == "ATTITUDE"


def test_raw_imu_of_the_3_1_era_wraps_every_71_minutes_and_is_carried_on(frames_of: FramesOf) -> None:
    start_ms = 2**32 // 1000 * 3 - 500  # half a second before the third wrap
    messages = [(HOST_NS, heartbeat())]
    for i in range(100):
        boot_us = start_ms * 1000 + i * 20_000
        messages += [(HOST_NS + i, attitude(boot_us // 1000)), (HOST_NS + i, raw_imu((boot_us + 1_234) % 2**32))]
    (boot,) = autopilot.boots(frames_of(messages))
    assert boot.stamps_ns["RAW_IMU"].tolist() == [start_ms * MS + i * 20 * MS + 1_234_000 for i in range(100)]


def test_stamps_of_64_bits_and_of_unix_time_are_told_apart(frames_of: FramesOf) -> None:
    late_ms = 3 * 2**32 // 1000  # a boot time that 32 bits of microseconds do not hold
    for usec, expected_us in (
        (late_ms * 1000 + 250, late_ms * 1000 + 250),
        (1_779_272_223_000_000, late_ms * 1000 + 500),
    ):
        messages = [(HOST_NS, heartbeat()), (HOST_NS, attitude(late_ms)), (HOST_NS, raw_imu(usec))]
        (boot,) = autopilot.boots(frames_of(messages))
        assert boot.stamps_ns["RAW_IMU"].tolist() == [expected_us * 1000]


def test_a_reboot_is_told_from_messages_out_of_order(frames_of: FramesOf) -> None:
    stamps = [100_000, 100_040, 99_000, 100_080, 100_080, 96_000, 100_120, 2_500, 2_540, 2_580]
    messages = [(HOST_NS, heartbeat())] + [(HOST_NS + i, attitude(ms)) for i, ms in enumerate(stamps)]
    first, second = autopilot.boots(frames_of(messages))
    assert (first.stamps_ns["ATTITUDE"] // MS).tolist() == [100_000, 100_040, 100_080, 100_120]
    assert (second.stamps_ns["ATTITUDE"] // MS).tolist() == [2_500, 2_540, 2_580]
    assert (first.number, second.number) == (0, 1)
    assert second.span_ns() == (2_500 * MS + HALF, 2_580 * MS + HALF)


def test_a_reboot_heard_of_late_is_told_by_the_time_that_passed(frames_of: FramesOf) -> None:
    # rebooted at 20 s, heard again when its new clock stands at 30 s: 40 s have passed, 10 s were counted
    messages = [(HOST_NS, heartbeat()), (HOST_NS, attitude(19_960)), (HOST_NS + 40 * MS, attitude(20_000))]
    messages += [(HOST_NS + 40_040 * MS, attitude(30_000)), (HOST_NS + 40_080 * MS, attitude(30_040))]
    first, second = autopilot.boots(frames_of(messages))
    assert (first.stamps_ns["ATTITUDE"] // MS).tolist() == [19_960, 20_000]
    assert (second.stamps_ns["ATTITUDE"] // MS).tolist() == [30_000, 30_040]


def test_a_radio_silent_for_a_minute_is_no_reboot(frames_of: FramesOf) -> None:
    messages = [(HOST_NS, heartbeat()), (HOST_NS, attitude(20_000)), (HOST_NS + 62_000 * MS, attitude(80_000))]
    assert len(autopilot.boots(frames_of(messages))) == 1


def test_what_comes_before_the_first_stamp_has_that_stamp(frames_of: FramesOf) -> None:
    (boot,) = autopilot.boots(frames_of([(HOST_NS, heartbeat()), (HOST_NS, raw_imu(5)), (HOST_NS, attitude(70_000))]))
    assert boot.stamps_ns["HEARTBEAT"].tolist() == [70_000 * MS + HALF]
    assert boot.stamps_ns["RAW_IMU"].tolist() == [70_000 * MS + HALF]


def test_of_two_autopilots_the_one_heard_first_is_taken_as_aboard(frames_of: FramesOf) -> None:
    quiet = frames_of([(HOST_NS, heartbeat()), (HOST_NS + 5, attitude(1_000, 9.0))], system=1)
    other = frames_of([(HOST_NS, heartbeat())] + [(HOST_NS + i, attitude(50_000 + i)) for i in range(9)], system=2)
    ground = frames_of([(HOST_NS, heartbeat(8))] * 50, system=255)
    received = sorted([*quiet, *ground, *other], key=lambda frame: frame.time_ns)
    first, second = autopilot.vehicles(received)
    assert (first.addresses, second.addresses) == (((1, 1),), ((2, 1),))
    assert len(second.boots[0].tables["ATTITUDE"]) == 9
    (boot,) = autopilot.boots([*quiet, *other])
    assert boot.system == 1


def test_a_ground_station_that_says_generic_is_no_autopilot(cases: Path) -> None:
    (vehicle,) = autopilot.vehicles(case_frames(cases / "gcs_generic"))
    assert vehicle.addresses == ((1, 1),)


def test_a_system_id_changed_in_flight_is_followed(cases: Path, frames_of: FramesOf) -> None:
    (vehicle,) = autopilot.vehicles(case_frames(cases / "sysid_changed"))
    assert vehicle.addresses == ((1, 1), (3, 1))
    # the boot clock goes on: one boot under two addresses, with nothing lost
    before = frames_of([(HOST_NS + i * 40 * MS, attitude(1_000 + 40 * i)) for i in range(50)], system=1)
    after = frames_of([(HOST_NS + i * 40 * MS, attitude(1_000 + 40 * i)) for i in range(50, 100)], system=3)
    (vehicle,) = autopilot.vehicles([*before, *after])
    (boot,) = vehicle.boots
    assert vehicle.name == "1/1, then 3/1"
    assert len(boot.tables["ATTITUDE"]) == 100


def test_without_an_autopilot_there_is_nothing_to_go_by(frames_of: FramesOf) -> None:
    with pytest.raises(LogError, match="no heartbeat of an autopilot"):
        autopilot.boots(frames_of([(HOST_NS, heartbeat(8)), (HOST_NS, attitude(1_000))], system=255))
    with pytest.raises(LogError, match="no heartbeat"):
        autopilot.boots([])


def test_gyros_are_in_the_ins_frame_and_in_radians(frames_of: FramesOf) -> None:
    """Roll is about forward, which is y; pitch about right, x; yaw about down, minus z. RAW_IMU counts thousandths of a rad/s."""
    messages = [(HOST_NS, heartbeat())]
    for i in range(40):
        turning = dialect.MAVLink_attitude_message(1_000 + 40 * i, 0, 0, 0, 0.1 * (i % 3), 0.2 * (i % 3), 0.3 * (i % 3))
        messages += [
            (HOST_NS + i, turning),
            (HOST_NS + i, raw_imu((1_000 + 40 * i) * 1000, (100 * (i % 2), 200, -300))),
        ]
    (boot,) = autopilot.boots(frames_of(messages))
    by_name = {track.name: track for track in boot.gyros()}
    np.testing.assert_allclose(by_name["ATTITUDE"].rate_rad_s[2], [0.4, 0.2, -0.6], rtol=1e-6)
    np.testing.assert_allclose(by_name["RAW_IMU"].rate_rad_s[1], [0.2, 0.1, 0.3], rtol=1e-6)
    assert by_name["ATTITUDE"].rate_hz == pytest.approx(25.0)


def test_a_gyro_that_never_changes_is_none(frames_of: FramesOf) -> None:
    messages = [(HOST_NS, heartbeat())] + [(HOST_NS + i, raw_imu(i * 1000)) for i in range(40)]
    (boot,) = autopilot.boots(frames_of([*messages, (HOST_NS + 50, attitude(60))]))
    assert boot.gyros() == []


def test_receive_times_are_of_messages_with_a_stamp_of_their_own(frames_of: FramesOf) -> None:
    messages = [
        (HOST_NS, heartbeat()),
        (HOST_NS + 10, attitude(100)),
        (HOST_NS + 20, raw_imu(101_000)),
        (HOST_NS + 30, attitude(140)),
    ]
    (boot,) = autopilot.boots(frames_of(messages))
    boot_ns, host_ns = boot.host_pairs()
    assert boot_ns.tolist() == [100 * MS + HALF, 140 * MS + HALF]
    assert host_ns.tolist() == [HOST_NS + 10, HOST_NS + 30]
