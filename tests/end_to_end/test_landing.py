"""The aircraft lands: its flight is closed and can be pulled while `swathd` goes on."""

import contextlib
import json
import socket
import time
from collections.abc import Callable
from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega as dialect
from recording import recording

from onboard import logfolder


class Autopilot:
    """Says each second whether it is armed."""

    def __init__(self, config: Path) -> None:
        host, port = json.loads(config.read_text())["ins"]["device"].removeprefix("udp:").split(":")
        self._address = host, int(port)
        self._mavlink = dialect.MAVLink(None, srcSystem=1, srcComponent=1)

    def beat(self, armed: bool, until: Callable[[], bool]) -> None:
        mode = dialect.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
        end = time.monotonic() + 120
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not until():
                assert time.monotonic() < end
                message = self._mavlink.heartbeat_encode(2, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, mode, 0, 4)
                sender.sendto(message.pack(self._mavlink), self._address)
                time.sleep(0.2)


def test_disarming_closes_the_segment_and_arming_does_not(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    with recording(tmp_path, logs, lidar=False, segment_s=3600):
        autopilot = Autopilot(tmp_path / "swathd.yaml")

        def told(armed: bool) -> bool:
            with contextlib.suppress(FileNotFoundError):
                return json.loads((tmp_path / "status.json").read_text())["links"]["ins"]["armed"] is armed
            return False

        def uptime_s() -> float:
            return float(json.loads((tmp_path / "status.json").read_text())["uptime_s"])

        autopilot.beat(armed=False, until=lambda: told(False))
        autopilot.beat(armed=True, until=lambda: told(True))
        assert not logfolder.read_manifest(logs)
        autopilot.beat(armed=False, until=lambda: bool(logfolder.read_manifest(logs)))
        (name,) = logfolder.read_manifest(logs)
        assert sorted(path.name for path in logs.glob("*.mcap"))[0] == name
        closed_s = uptime_s()
        autopilot.beat(armed=False, until=lambda: uptime_s() > closed_s + 1.5)  # the daemon has looked again
        assert len(logfolder.read_manifest(logs)) == 1
