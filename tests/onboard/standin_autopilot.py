"""A stand-in autopilot on a real pseudo terminal: pymavlink's own parser and packer, parameters as ArduPilot serves them.

It loses what it is told to lose, in both directions, and answers MAVLink 1 only when it is an old one.
"""

import os
import pty
import select
import struct
import threading
import time
import tty
from collections import Counter
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

UINT8, INT16, INT32, REAL32 = 1, 4, 6, 9
ARMED, DISARMED = 0x80 | 0x51, 0x51


class StandinAutopilot:
    """Runs until `close`; `device` is its serial port.

    `parameters` maps a name to [value, type]; `lose(n)` says whether the n-th frame, in or out, is lost.
    """

    def __init__(
        self,
        parameters: dict[str, list[Any]],
        *,
        version: int = 1,
        lose: Callable[[int], bool] = lambda n: False,
        stubborn: tuple[str, ...] = (),
        arm_after_sets: int | None = None,
    ) -> None:
        self.parameters, self.version, self.lose, self.stubborn = parameters, version, lose, stubborn
        self.armed, self.arm_after_sets = False, arm_after_sets
        self.mute = False
        """Sends nothing more."""
        self.heard: Counter[str] = Counter()
        self.count: int | None = None
        """What it says that it has, where that is not true."""
        self.sets: list[tuple[str, float, int]] = []
        self.lost = 0
        self._frames = 0
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.device = os.ttyname(self._slave)
        self._out = dialect.MAVLink(None, srcSystem=7, srcComponent=1)
        self._in = dialect.MAVLink(None)
        self._in.robust_parsing = True
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        os.close(self._slave)
        os.close(self._master)

    def _run(self) -> None:
        beat_s = 0.0
        while not self._stop.is_set():
            if time.monotonic() > beat_s:
                beat_s = time.monotonic() + 0.25
                gimbal = dialect.MAVLink(None, srcSystem=7, srcComponent=154)
                self._write(dialect.MAVLink_heartbeat_message(26, 8, ARMED, 0, 4, 3), gimbal)
                for name in self.parameters:  # parameters of its own, by the same names
                    self._write(dialect.MAVLink_param_value_message(name.encode(), 77, REAL32, 900, 899), gimbal)
                self._write(dialect.MAVLink_heartbeat_message(2, 3, ARMED if self.armed else DISARMED, 0, 4, 3))
                self._write(dialect.MAVLink_attitude_message(1, 0.1, 0.2, 0.3, 0, 0, 0))
            if select.select([self._master], [], [], 0.01)[0]:
                for message in self._in.parse_buffer(os.read(self._master, 4096)) or []:
                    if self.version == 1 and message.get_msgbuf()[0] != 0xFE:
                        continue  # ArduCopter 3.1.3 is deaf to version 2
                    if not self._lost():
                        self._answer(message)

    def _lost(self) -> bool:
        self._frames += 1
        lost = self.lose(self._frames)
        self.lost += lost
        return lost

    def _write(self, message: Any, mavlink: Any = None) -> None:
        if self.mute:
            return
        os.write(self._master, message.pack(mavlink or self._out, force_mavlink1=self.version == 1))

    def _answer(self, message: Any) -> None:
        kind = message.get_type()
        self.heard[kind] += 1
        if getattr(message, "target_system", 7) != 7:
            return
        names = list(self.parameters)
        if kind == "PARAM_REQUEST_LIST":
            for name in names:
                self._tell(name)
        elif kind == "PARAM_REQUEST_READ":
            by_name = message.param_index == -1
            name = message.param_id if by_name else next(iter(names[message.param_index :]), "")
            if name in self.parameters:
                self._tell(name)
        elif kind == "PARAM_SET":
            self.sets.append((message.param_id, message.param_value, message.param_type))
            if len(self.sets) == self.arm_after_sets:
                self.armed = True
                self._write(dialect.MAVLink_heartbeat_message(2, 3, ARMED, 0, 4, 3))
            if message.param_id in self.parameters:
                slot = self.parameters[message.param_id]
                if message.param_id not in self.stubborn:
                    slot[0] = message.param_value if slot[1] == REAL32 else int(message.param_value)
                self._tell(message.param_id)

    def _tell(self, name: str) -> None:
        if self._lost():
            return
        value, kind = self.parameters[name]
        single = struct.unpack("<f", struct.pack("<f", value))[0]
        index = list(self.parameters).index(name)
        self._write(
            dialect.MAVLink_param_value_message(name.encode(), single, kind, self.count or len(self.parameters), index)
        )
