"""An autopilot's boot time and UTC on log time: from TIMESYNC if it speaks that, else its stamps and SYSTEM_TIME."""

import struct
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog.constants import NS_PER_MS, NS_PER_S, NS_PER_US
from flightlog.mavlink import Frame
from flightlog.records import ClockSync, UtcSource
from onboard.clocksync import ClockLine, Envelope, RoundTrips

_ASK_NS: Final = NS_PER_S
_ASK_RARELY_NS: Final = 10 * NS_PER_S
"""So often is asked who has not answered yet."""
_UNANSWERED: Final = 10
_PATIENCE_NS: Final = 2 * NS_PER_S
"""An answer that takes longer says nothing."""
_BOOT_MS_FIRST: Final = (dialect.MAVLINK_MSG_ID_ATTITUDE, dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT)
"""Messages that begin with time_boot_ms."""


class AutopilotClock:
    """Listens to one autopilot.

    Parameters
    ----------
    name : str
        Of the link.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._trips, self._envelope = RoundTrips(), Envelope()
        self._asked: dict[int, None] = {}
        """ts1 of our open questions: log time when they were sent [ns], the oldest first."""
        self._due_ns = 0
        self._unanswered = 0
        self._utc: tuple[int, int] | None = None
        """Boot time and UTC of the newest SYSTEM_TIME that has one [ns]."""

    def hear(self, frame: Frame) -> dialect.MAVLink_message | None:
        """Take in a verified frame of the autopilot; gives the answer to send, if it asks for one."""
        payload = frame.payload
        if frame.message_id == dialect.MAVLINK_MSG_ID_TIMESYNC:
            theirs_ns, ours_ns = struct.unpack("<qq", payload.ljust(16, b"\0")[:16])
            if theirs_ns == 0:
                return dialect.MAVLink_timesync_message(frame.time_ns, ours_ns)
            self._note_answer(frame.time_ns, theirs_ns, ours_ns)
        elif frame.message_id == dialect.MAVLINK_MSG_ID_SYSTEM_TIME:
            unix_us, boot_ms = struct.unpack("<QI", payload.ljust(12, b"\0")[:12])
            self._envelope.add(frame.time_ns, boot_ms * NS_PER_MS)
            if 0 < unix_us < 1 << 53:
                self._utc = boot_ms * NS_PER_MS, unix_us * NS_PER_US
        elif frame.message_id in _BOOT_MS_FIRST:
            self._envelope.add(frame.time_ns, int.from_bytes(payload[:4].ljust(4, b"\0"), "little") * NS_PER_MS)
        return None

    def _note_answer(self, now_ns: int, theirs_ns: int, ours_ns: int) -> None:
        if ours_ns not in self._asked:  # of somebody else's question
            return
        del self._asked[ours_ns]
        self._unanswered = 0
        if 0 <= now_ns - ours_ns <= _PATIENCE_NS:
            self._trips.add(ours_ns, now_ns, theirs_ns)

    def question(self, now_ns: int) -> dialect.MAVLink_message | None:
        """What to ask now, if it is time to; `now_ns` is log time at which it is sent."""
        if now_ns < self._due_ns:
            return None
        self._due_ns = now_ns + (_ASK_RARELY_NS if self._unanswered >= _UNANSWERED else _ASK_NS)
        self._unanswered += 1
        while len(self._asked) >= _UNANSWERED:
            del self._asked[next(iter(self._asked))]
        self._asked[now_ns] = None
        return dialect.MAVLink_timesync_message(0, now_ns)

    def line(self, now_ns: int) -> ClockLine | None:
        """The boot clock at a log time; None where nothing is known."""
        trips, stamps = self._trips.line(now_ns), self._envelope.line(now_ns)
        if trips is None or stamps is None:
            return trips or stamps
        # in some firmware TIMESYNC and the stamps have different zeros; the envelope then has what the log needs
        return trips if abs(trips.offset_ns - stamps.offset_ns) < NS_PER_S else stamps

    def sync(self, now_ns: int) -> ClockSync | None:
        """The record for the log."""
        line = self.line(now_ns)
        if line is None:
            return None
        utc_offset_ns, source = 0, UtcSource.NONE
        if self._utc is not None:
            boot_ns, utc_ns = self._utc
            utc_offset_ns, source = utc_ns - (boot_ns - line.offset_at(now_ns)), UtcSource.SYSTEM_TIME
        return ClockSync(
            log_ns=now_ns,
            clock=self._name,
            offset_ns=line.offset_ns,
            skew_ppm=line.skew_ppm,
            uncertainty_ns=line.uncertainty_ns,
            utc_offset_ns=utc_offset_ns,
            samples=line.samples,
            restarts=self._trips.restarts + self._envelope.restarts,
            method=line.method,
            utc_source=source,
        )
