"""The log on the autopilot's card against the same flight over MAVLink, the truth of the simulator, and logs made message by message."""

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from flightlog import dataflash, frames
from flightlog.errors import LogError
from flightlog.logfile import LogReader
from groundproc.cli import main
from groundproc.estimation import ins, ownsolution
from groundproc.flight import boardlog, merging
from groundproc.flight.autopilot import Boot
from groundproc.flight.flight import Flight, read_flight
from groundproc.flight.mounting import find_mount
from groundproc.flight.pairing import legs
from groundproc.flight.timeline import Leg
from groundproc.geodesy import LocalFrame
from groundproc.steps.clocks import describe_leg, describe_sync
from simulator.boardlog import Kind

Array = npt.NDArray[np.float64]
HOUR_NS = 3_600_000_000_000
WAYS = ("tlog", "bin", "both")


def log_of(*kinds: Kind, rows: bytes) -> dataflash.Dataflash:
    """A log of some kinds of messages, without UNIT and FMTU, as older firmware writes them."""
    fmt = Kind(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns", "", "")
    declared = [
        fmt.rows(1, Type=k.number, Length=k.dtype.itemsize, Name=k.name.encode(), Format=k.letters.encode(), Columns=k.labels.encode())
        for k in (fmt, *kinds)
    ]  # fmt: skip
    return dataflash.parse(b"".join(each.tobytes() for each in declared) + rows, "a.bin", boardlog.WANTED)


def boot(log: dataflash.Dataflash) -> Boot:
    made, _ = boardlog.boot_of(log)
    assert made is not None
    return made


@dataclass(frozen=True)
class Read:
    """A flight read one way."""

    flight: Flight
    leg: Leg
    mount: Any


@pytest.fixture(scope="module")
def read(plain_flight: Any, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Read]:
    """The same flight by its telemetry log, by the board's own, and by both."""
    folder, found = tmp_path_factory.mktemp("ways"), {}
    with LogReader(plain_flight.log) as reader:
        mount, _ = find_mount(None, [reader])
    for way in WAYS:
        given = {"tlog": [plain_flight.telemetry], "bin": [plain_flight.board]}
        files = given.get(way, [plain_flight.telemetry, plain_flight.board])
        log = folder / f"{way}.mcap"
        words = ["import", "--pcap", str(plain_flight.capture), "--mavlink", *map(str, files), "-o", str(log)]
        assert main(words) == 0
        with LogReader(log) as reader:
            flight = read_flight([reader], "ins")
        (leg,) = legs(flight.runs, flight.boots, mount.mat_ins_lidar(), "gyro")
        found[way] = Read(flight, leg, mount)
    return found


def sync_error_s(truth: Any, leg: Leg) -> float:
    told = describe_sync(leg)
    return float(told["offset_s"] - truth.offset_s(told["at_lidar_s"]))


def errors(truth: Any, each: Read) -> tuple[Array, Array]:
    """Errors of position [m] and attitude [rad] of method ins, shape (n, 3), by the boot clock."""
    origin, clock, poses = truth.truth["local_origin"], truth.truth["clocks"]["boot"], truth.poses
    frame = LocalFrame(origin["latitude_deg"], origin["longitude_deg"], origin["height_msl_m"])
    fixes = ownsolution.position_fixes(each.leg.boot, "msl")
    made = ins.ins_trajectory(each.leg.boot, fixes, frame, lambda t: t, each.mount)
    at_s = (made.time_ns - clock["start_ns"]) * 1e-9 / (1 + clock["drift_ppm"] * 1e-6)
    truth_s = (poses["utc_ns"] - poses["utc_ns"][0]) * 1e-9
    place = np.stack([np.interp(at_s, truth_s, poses[f"{name}_m"]) for name in ("east", "north", "up")], axis=1)
    angles = [np.interp(at_s, truth_s, np.unwrap(np.deg2rad(poses[f"{n}_deg"]))) for n in ("heading", "pitch", "roll")]
    quat = frames.quat_from_mat(frames.mat_local_ins(*angles))
    return made.position_m - place, frames.quat_log(
        frames.quat_multiply(frames.quat_inverse(quat), made.quat_local_ins_wxyz)
    )


def rms(values: Array) -> float:
    return float(np.sqrt(np.square(values).sum(axis=1).mean()))


def test_the_boards_gyros_tie_the_clocks_better_than_the_links(read: dict[str, Read], plain_flight: Any) -> None:
    for way in ("bin", "both"):
        leg = read[way].leg
        assert leg.sync.samples > 1.8 * read["tlog"].leg.sync.samples  # 50 Hz against 25
        assert abs(sync_error_s(plain_flight, leg)) < 0.5e-3
        assert leg.sync.sigma_offset_ns < read["tlog"].leg.sync.sigma_offset_ns
        assert abs(sync_error_s(plain_flight, leg)) < 4e-9 * leg.sync.sigma_offset_ns + 0.1e-3


def test_the_trajectory_is_the_links_or_better(read: dict[str, Read], plain_flight: Any) -> None:
    place, attitude = errors(plain_flight, read["tlog"])
    for way in ("bin", "both"):
        by_board = errors(plain_flight, read[way])
        # the autopilot's own errors are in both; what the link adds is jitter and rounding
        assert rms(by_board[0]) <= 1.02 * rms(place)
        assert rms(by_board[1]) <= 1.02 * rms(attitude)
        assert rms(np.diff(by_board[1], axis=0)) <= 1.02 * rms(np.diff(attitude, axis=0))


def test_what_is_used_for_what_is_said(read: dict[str, Read]) -> None:
    assert read["tlog"].flight.choice.notes == ()
    (alone,) = read["bin"].flight.choice.notes
    assert "inertial samples (IMU at 50 Hz), attitudes (ATT at 25 Hz), positions (POS, XKF1 at 10 Hz)" in alone
    (both,) = read["both"].flight.choice.notes
    assert both.endswith("of the link: receive times, and what the log lacks")
    assert describe_leg(read["both"].leg)["from_board_log"]["ATTITUDE"] == "dataflash ATT"
    assert read["both"].flight.board_bad_bytes == 0
    assert read["both"].leg.boot.system == read["tlog"].leg.boot.system


def test_utc_is_right_to_what_it_claims(read: dict[str, Read], plain_flight: Any) -> None:
    clocks = plain_flight.truth["clocks"]
    true_ns = clocks["utc"]["start_ns"] - clocks["boot"]["start_ns"]
    for way in WAYS:
        tie = read[way].leg.utc
        assert abs(tie.offset_ns - true_ns) < 3.0 * tie.sigma_ns


def test_accuracy_and_pressure_come_along(read: dict[str, Read]) -> None:
    by_board, by_link = read["bin"].leg.boot, read["tlog"].leg.boot
    assert (by_board.tables["GPS_RAW_INT"]["h_acc"] == 1800.0).all()
    assert ownsolution.position_fixes(by_board, "msl").sigma_m[0].tolist() == pytest.approx([1.8, 1.8, 2.7])
    pressures = by_board.tables["SCALED_PRESSURE"]["press_abs"]
    assert np.median(pressures) == pytest.approx(np.median(by_link.tables["SCALED_PRESSURE"]["press_abs"]), abs=0.1)
    assert {"MODE", "EV", "PARM", "MSG", "MAG"} <= set(by_board.tables)


def test_process_makes_a_cloud_of_a_board_log_alone(
    plain_flight: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, out = tmp_path / "bin.mcap", tmp_path / "out"
    assert (
        main(["import", "--pcap", str(plain_flight.capture), "--mavlink", str(plain_flight.board), "-o", str(log)]) == 0
    )
    assert main(["process", str(log), "--method", "ins", "-o", str(out), "--products", "cloud.laz"]) == 3  # no mount
    assert (out / "cloud.laz").stat().st_size > 10_000
    assert "used of the board's own log" in capsys.readouterr().err


def test_two_board_logs_are_kept_apart(plain_flight: Any, tmp_path: Path) -> None:
    """The first is cut within a message: its rest must not swallow the beginning of the second."""
    other = tmp_path / "first.bin"
    whole = plain_flight.board.read_bytes()
    other.write_bytes(whole[: len(whole) // 2 - 5])
    log = tmp_path / "log.mcap"
    words = ["import", "--pcap", str(plain_flight.capture), "--mavlink", str(other), str(plain_flight.board)]
    assert main([*words, "-o", str(log)]) == 0
    with LogReader(log) as reader:
        logs = boardlog.BoardLogs()
        for message in reader.messages(("/dataflash/ins",)):
            logs.feed(message)
    first, second = logs.boots()
    assert len(second.tables["HIGHRES_IMU"]) == pytest.approx(2 * len(first.tables["HIGHRES_IMU"]), rel=0.05)
    assert (np.diff(second.stamps_ns["HIGHRES_IMU"]) > 0).all()
    assert 0 < logs.bad_bytes < 100


def test_a_log_of_another_boot_is_no_part_of_the_link(read: dict[str, Read]) -> None:
    heard, log = read["tlog"].leg.boot, read["bin"].leg.boot
    assert merging.is_same(heard, log)
    turned = {name: table.copy() for name, table in log.tables.items()}
    turned["ATTITUDE"]["roll"] += np.deg2rad(4.0)
    assert not merging.is_same(heard, Boot(0, 1, 1, turned, log.stamps_ns, log.heard, "gps", log.origins))
    later = {name: stamps + 3 * HOUR_NS for name, stamps in log.stamps_ns.items()}
    assert not merging.is_same(heard, Boot(0, 1, 1, log.tables, later, log.heard, "gps", log.origins))


def test_a_log_from_arming_on_keeps_what_the_link_heard_before(read: dict[str, Read]) -> None:
    heard, log = read["tlog"].leg.boot, read["bin"].leg.boot
    middle_ns = int(np.mean(log.span_ns()))
    late = {name: stamps >= middle_ns for name, stamps in log.stamps_ns.items()}
    armed = Boot(
        0, 1, 1, {name: table[late[name]] for name, table in log.tables.items()},
        {name: stamps[late[name]] for name, stamps in log.stamps_ns.items()}, log.heard, "gps", log.origins,
    )  # fmt: skip
    from groundproc.flight.autopilot import Vehicle

    merged = merging.merge([Vehicle(((1, 1),), [heard])], [armed])
    ((made,),) = (vehicle.boots for vehicle in merged.vehicles)
    stamps = made.stamps_ns["ATTITUDE"]
    assert stamps[0] == heard.stamps_ns["ATTITUDE"][0]
    assert (np.diff(stamps) > 0).all()
    assert (stamps < middle_ns).sum() == pytest.approx((heard.stamps_ns["ATTITUDE"] < middle_ns).sum(), abs=2)
    assert made.host_pairs()[1].tolist() == heard.host_pairs()[1].tolist()


def test_a_capture_without_a_clock_is_tied_by_gyros_alone(read: dict[str, Read], plain_flight: Any) -> None:
    from dataclasses import replace

    each = read["bin"]
    shift_ns = -50 * 365 * 24 * HOUR_NS
    runs = [
        replace(
            run, first_receive_ns=run.first_receive_ns + shift_ns, last_receive_ns=run.last_receive_ns + shift_ns,
            line=replace(run.line, offset_ns=run.line.offset_ns + shift_ns),
        )
        for run in each.flight.runs
    ]  # fmt: skip
    (leg,) = legs(runs, each.flight.boots, each.mount.mat_ins_lidar(), "auto")
    assert leg.sync.method == "gyro"
    assert abs(sync_error_s(plain_flight, leg)) < 0.5e-3


# Logs of other firmware ------------------------------------------------------------------------------------------------

OLD_GPS = Kind(1, "GPS", "BIHBcLLeeEefI", "Status,TimeMS,Week,NSats,HDop,Lat,Lng,RelAlt,Alt,Spd,GCrs,VZ,T", "", "")
OLD_ATT = Kind(2, "ATT", "IccccCC", "TimeMS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw", "", "")
OLD_IMU = Kind(3, "IMU", "Iffffff", "TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ", "", "")


def test_logs_of_2014_count_milliseconds_and_gps_calls_them_t(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("simulator.boardlog._SCALES", {"c": 100.0, "C": 100.0, "e": 100.0, "E": 100.0, "L": 1e7})
    monkeypatch.setitem(__import__("simulator.boardlog", fromlist=["x"])._STORED, "E", "<u4")
    ms = 60_000 + 20 * np.arange(200)
    angle = np.linspace(-20.0, 20.0, 200)
    rows = OLD_IMU.rows(200, TimeMS=ms, GyrX=np.sin(angle), AccZ=-9.8).tobytes()
    rows += OLD_ATT.rows(200, TimeMS=ms, Roll=angle, Pitch=1.0, Yaw=359.5).tobytes()
    fix = {"Status": 3, "Week": 1718, "NSats": 9, "HDop": 1.5, "Lat": 58.4, "Lng": 15.6, "RelAlt": 8.0, "Alt": 70.25}
    stamps = 60_000 + 200 * np.arange(20)
    rows += OLD_GPS.rows(20, TimeMS=252_408_000 + 200 * np.arange(20), Spd=4.2, GCrs=270.0, T=stamps, **fix).tobytes()
    made = boot(log_of(OLD_GPS, OLD_ATT, OLD_IMU, rows=rows))
    assert made.stamps_ns["GPS_RAW_INT"].tolist() == (stamps * 1_000_000 + 500_000).tolist()
    assert made.stamps_ns["ATTITUDE"][0] == 60_000_500_000
    assert np.rad2deg(made.tables["ATTITUDE"]["roll"]) == pytest.approx(angle, abs=0.006)
    assert made.tables["ATTITUDE"]["rollspeed"] == pytest.approx(np.sin(angle), abs=1e-6)
    table = made.tables["GPS_RAW_INT"]
    assert (table["alt"][0], table["vel"][0], table["cog"][0]) == pytest.approx((70_250.0, 420.0, 27_000.0))
    # GPS time was 16 s ahead of UTC in December 2012
    utc = datetime(1980, 1, 6, tzinfo=UTC) + timedelta(weeks=1718, milliseconds=252_408_000) - timedelta(seconds=16)
    assert made.tables["SYSTEM_TIME"]["time_unix_usec"][0] * 1e-6 == pytest.approx(utc.timestamp(), abs=1e-6)
    assert {track.name: track.stamp_step_ns for track in made.gyros()} == {"HIGHRES_IMU": 1_000_000}
    with pytest.raises(LogError, match="relative"):
        ownsolution.position_fixes(made, "relative")


RAW = {
    name: Kind(number, name, "QBQfff", f"TimeUS,I,SampleUS,{axis}X,{axis}Y,{axis}Z", "", "")
    for number, name, axis in ((4, "GYR", "Gyr"), (5, "ACC", "Acc"))
}
NEW_IMU = Kind(6, "IMU", "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ", "", "")


def test_raw_samples_are_taken_at_their_own_times_and_averaged() -> None:
    us = 5_000_000 + 250 * np.arange(4000)  # 4 kHz
    turning = np.sin(us * 1e-6 * 6.0)
    rows = RAW["GYR"].rows(4000, TimeUS=us + 700, SampleUS=us, GyrX=turning).tobytes()
    rows += RAW["ACC"].rows(4000, TimeUS=us + 700, SampleUS=us, AccZ=-9.8).tobytes()
    rows += NEW_IMU.rows(50, TimeUS=5_000_000 + 20_000 * np.arange(50), GyrX=np.linspace(0, 1, 50)).tobytes()
    made = boot(log_of(*RAW.values(), NEW_IMU, rows=rows))
    (track,) = made.gyros()
    assert track.rate_hz == pytest.approx(400.0)
    rolling = made.tables["HIGHRES_IMU"]["xgyro"]
    assert rolling == pytest.approx(np.sin(track.time_ns * 1e-9 * 6.0), abs=1e-4)
    assert made.origins["HIGHRES_IMU"] == "dataflash GYR, ACC"


def test_a_dead_imu_gives_way_to_the_next_and_nan_is_left_out_and_counted() -> None:
    us = 5_000_000 + 20_000 * np.arange(100)
    moving = np.sin(us * 1e-6)
    bad = moving.copy()
    bad[7] = np.nan
    rows = NEW_IMU.rows(100, TimeUS=us, I=0).tobytes() + NEW_IMU.rows(100, TimeUS=us + 5, I=1, GyrX=bad).tobytes()
    made, not_finite = boardlog.boot_of(log_of(NEW_IMU, rows=rows))
    assert made is not None
    assert not_finite == 1
    assert len(made.tables["HIGHRES_IMU"]) == 99
    assert made.stamps_ns["HIGHRES_IMU"][0] == 5_000_005_000


def test_a_log_with_nothing_of_use_gives_nothing() -> None:
    assert boardlog.boot_of(log_of(NEW_IMU, rows=b"")) == (None, 0)
