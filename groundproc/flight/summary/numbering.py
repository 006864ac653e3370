"""The numbers of a sender's MAVLink frames, modulo 256: what they say of frames lost, late and given twice."""

from dataclasses import dataclass, field
from typing import Final

from flightlog.constants import NS_PER_S
from flightlog.mavlink import Frame

_BACK: Final = 128
"""A number so far ahead may as well be one from behind."""
_LATE_NS: Final = NS_PER_S
"""A late frame comes within this of the gap that it left."""
_FIRST: Final = 8
"""Numbers before the first one heard that may still come."""
_RECENT: Final = 32
_REBOOT_NS: Final = 10 * NS_PER_S
"""A new boot is known by this after its first frame."""


@dataclass(slots=True)
class Numbering:
    """Counts frames of one component.

    Attributes
    ----------
    lost, late, duplicates : int
    """

    lost: int = 0
    late: int = 0
    duplicates: int = 0
    _last: int | None = None
    _missing: dict[int, tuple[int, bool]] = field(default_factory=dict)
    """Time at which each number was seen to be missing [ns], and whether it was counted."""
    _recent: dict[int, bytes] = field(default_factory=dict)
    """The latest frames, by their numbers."""
    _jump: tuple[int, int] = (0, 0)
    """When the last gap was seen [ns], and its frames."""

    def take(self, frame: Frame) -> None:
        """Count the next frame."""
        number = frame.sequence
        if self._last is None:
            self._missing = {(number - i) % 256: (frame.time_ns, False) for i in range(1, _FIRST + 1)}
        elif self._recent.get(number) == frame.data:
            self.duplicates += 1
            return
        else:
            skipped = (number - self._last - 1) % 256
            if skipped >= _BACK and self._fills(number, frame.time_ns):
                self._remember(frame)
                return
            self._skip(skipped, frame.time_ns)
        self._last = number
        self._missing.pop(number, None)
        self._remember(frame)

    def _fills(self, number: int, time_ns: int) -> bool:
        """Whether a number was missed shortly before."""
        missed_ns, counted = self._missing.get(number, (0, False))
        if number not in self._missing or time_ns - missed_ns > _LATE_NS:
            return False
        del self._missing[number]
        self.late += 1
        self.lost -= counted
        return True

    def _skip(self, skipped: int, time_ns: int) -> None:
        if skipped:
            assert self._last is not None
            self.lost += skipped
            self._jump = (time_ns, skipped)
            for i in range(1, skipped + 1):
                self._missing[(self._last + i) % 256] = (time_ns, True)

    def _remember(self, frame: Frame) -> None:
        self._recent.pop(frame.sequence, None)
        self._recent[frame.sequence] = frame.data
        if len(self._recent) > _RECENT:
            del self._recent[next(iter(self._recent))]

    def restarted(self, time_ns: int) -> None:
        """The sender has started anew, as a message at this time [ns] shows: its numbers began again, nothing was lost."""
        at_ns, skipped = self._jump
        if skipped and time_ns - at_ns < _REBOOT_NS:
            self.lost -= skipped
            self._jump = (0, 0)
