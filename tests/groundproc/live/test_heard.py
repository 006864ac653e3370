"""What the autopilot states in flight, as the odometry asks for it."""

from pathlib import Path

import numpy as np
import pytest

from flightlog import records
from flightlog.logfile import LogReader
from flightlog.mount import Mount
from groundproc.field.madeup import write_flight
from groundproc.live.clocks import Tie
from groundproc.live.heard import Heard
from groundproc.live.telemetry import Telemetry

BOOT_MINUS_LIDAR_NS = 77_000_500_000
"""Of the made-up flight, whose lidar begins at zero; whole milliseconds are taken for half a one later."""


@pytest.fixture
def heard(tmp_path: Path) -> Heard:
    """Two seconds of an autopilot at 5 positions and 50 attitudes a second, all of it heard."""
    write_flight(tmp_path / "log.mcap", 2.0)
    telemetry = Telemetry()
    with LogReader(tmp_path / "log.mcap") as reader:
        for message in reader.messages((records.MAVLINK.topic + "ins",)):
            for time_ns, data in records.decode_raw(message.data):
                telemetry.feed(time_ns, data)
    found = Heard(telemetry, Mount(), "msl", None)
    found.tie = Tie("host", 1e6, BOOT_MINUS_LIDAR_NS, 0, 0.0, 0, "host", None, "")
    known = found.poses(60.0)
    assert known is not None
    assert 1.5e9 < known.time_ns[-1] < 2e9
    boot = telemetry.boot(3.0)
    assert boot is not None
    found.listen(boot, found.tie)
    found.listen(boot, found.tie)
    return found


def test_each_position_is_given_once_and_none_before_its_time(heard: Heard) -> None:
    assert heard.frame is not None
    first = heard.fixes(900_000_000)
    assert [fix.time_ns for fix in first] == [0, 200_000_000, 400_000_000, 600_000_000, 800_000_000]
    assert [fix.rate_hz for fix in first] == pytest.approx([5.0] * 5)
    # the frame begins at the first position
    np.testing.assert_allclose(first[0].position_m, 0.0, rtol=0, atol=1e-3)
    assert heard.fixes(900_000_000) == []
    assert len(heard.fixes(10_000_000_000)) == 5


def test_an_attitude_is_the_newest_of_its_time_and_given_once(heard: Heard) -> None:
    found = heard.attitude(1_010_000_000)
    assert found is not None
    assert found[0] == 1_000_000_000
    assert np.linalg.norm(found[1]) == pytest.approx(1.0)
    assert heard.attitude(1_010_000_000) is None
    again = heard.attitude(1_030_000_000)
    assert again is not None
    assert again[0] == 1_020_000_000


def test_what_was_heard_before_a_reboot_is_forgotten(heard: Heard) -> None:
    heard.forget()
    assert heard.attitude(1_500_000_000) is None
