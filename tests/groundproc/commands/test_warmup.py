"""What `swath warmup` flies, and what a progress line says of compiling."""

import io
from pathlib import Path

import numpy as np
import pytest
from numba import njit

from flightlog import hdl32e, records
from flightlog.hdl32e import ReturnMode
from flightlog.logfile import LogReader
from flightlog.mavlink import FrameParser
from flightlog.mount import Mount, parse_mount
from groundproc import progress
from groundproc.estimation import ownsolution
from groundproc.field.madeup import ROOM_M, write_flight
from groundproc.flight import autopilot
from groundproc.sensors import firings
from groundproc.sensors.hdl32e import LIDAR
from groundproc.sensors.shots import Gate


@pytest.mark.parametrize("mode", [ReturnMode.STRONGEST, ReturnMode.DUAL])
def test_the_made_up_flight_is_one_of_an_hdl_32e_in_a_room(tmp_path: Path, mode: ReturnMode) -> None:
    write_flight(tmp_path / "log.mcap", 0.5, mode)
    with LogReader(tmp_path / "log.mcap") as reader:
        assert parse_mount(reader.attachments["mount.yaml"].decode(), "log") == Mount()
        scans = [records.decode_scan(message.data) for message in reader.messages((records.LIDAR.topic,))]
        position = [records.decode_position(message.data)[1] for message in reader.messages((records.POSITION.topic,))]
    packets = np.concatenate(scans)
    assert hdl32e.is_data(packets["data"]).all()
    assert len(packets) == -(-500_000_000 // hdl32e.packet_ns(mode))
    assert (np.diff(records.receive_time_ns(packets)) == hdl32e.packet_ns(mode)).all()
    shots = firings.decode(LIDAR.firing, packets, records.receive_time_ns(packets), Gate(), LIDAR.lasers)
    # a second return that is the first once more is no return
    assert len(shots.time_ns) == len(packets) * len(set(hdl32e.firing_index(mode))) * hdl32e.LASERS
    # as far as the walls, from somewhere within
    range_m = np.linalg.norm(shots.xyz_m, axis=1)
    assert range_m.min() > 1.0
    assert range_m.max() < np.linalg.norm(ROOM_M[1] - ROOM_M[0])
    imu = np.concatenate(position)
    assert hdl32e.has_imu(imu).all()
    # a hand's movements on top of gravity
    assert np.abs(np.linalg.norm(hdl32e.accel_g(imu), axis=1) - 1.0).max() < 0.2
    assert 5.0 < np.abs(hdl32e.gyro_deg_s(imu)).max() < 60.0


def test_its_autopilot_says_where_it_is_as_the_lidars_own_unit_feels_it(tmp_path: Path) -> None:
    write_flight(tmp_path / "log.mcap", 2.0)
    parser = FrameParser()
    with LogReader(tmp_path / "log.mcap") as reader:
        found = []
        for message in reader.messages((records.MAVLINK.topic + "ins",)):
            for time_ns, data in records.decode_raw(message.data):
                found += parser.feed(time_ns, data)
        imu = np.concatenate([records.decode_position(m.data)[1] for m in reader.messages((records.POSITION.topic,))])
    (boot,) = autopilot.boots(found)
    assert ownsolution.has_position(boot)
    fixes = ownsolution.position_fixes(boot, "msl")
    assert len(fixes.time_ns) == 10
    gyro = max(boot.gyros(), key=lambda track: len(track.time_ns))
    assert gyro.rate_hz == pytest.approx(50.0, rel=0.01)
    own = np.deg2rad(hdl32e.gyro_deg_s(imu))[::4] @ Mount().mat_ins_lidar().T
    # half a step of 0.1 deg/s, and twice its noise of the same size
    assert np.abs(own[: len(gyro.rate_rad_s)] - gyro.rate_rad_s).max() < np.deg2rad(0.3)


def test_the_progress_line_says_that_it_compiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    (tmp_path / "log").write_bytes(bytes(1000))

    @njit
    def inner(x: float) -> float:
        return x + 1.0

    @njit
    def outer(x: float) -> float:
        return inner(x) * 2.0

    with progress.stages([tmp_path / "log"], {"read": "clocks", "place": "points"}) as advance:
        assert outer(1.0) == 4.0
        assert progress.COMPILING in terminal.getvalue()
        before = len(terminal.getvalue())
        assert outer(2.0) == 6.0
        assert len(terminal.getvalue()) == before
        advance("read", 500)
        assert outer(1) == 4
        assert terminal.getvalue()[before:].count(progress.COMPILING) >= 1
        advance("place", 500)
    assert "points" in terminal.getvalue()


def test_compiling_is_told_once_for_a_kernel_and_those_that_it_calls() -> None:
    @njit
    def inner(x: float) -> float:
        return x - 1.0

    @njit
    def outer(x: float) -> float:
        return inner(x) * 3.0

    told: list[bool] = []
    with progress.compiling(told.append):
        outer(1.0)
        outer(2.0)
    assert told == [True, False]
