"""When a flight has ended: the aircraft disarmed, and stays so."""

from typing import Final

from flightlog.constants import NS_PER_S


class Landing:
    """Tells a landing from an autopilot, or a stranger, that flips between armed and disarmed.

    A vehicle has landed if it stays disarmed for `DISARMED_S`; no second landing counts within `APART_S`.
    """

    DISARMED_S: Final = 5.0
    APART_S: Final = 30.0

    def __init__(self) -> None:
        self._was_armed = False
        self._since_ns: int | None = None
        self._landed_ns: int | None = None

    def look(self, is_armed: bool | None, now_ns: int) -> bool:
        """Take what is known now, None where nothing is; whether the aircraft has just landed."""
        if is_armed is not False:
            self._was_armed |= bool(is_armed)
            self._since_ns = None
            return False
        self._since_ns = now_ns if self._since_ns is None else self._since_ns
        if not self._was_armed or now_ns - self._since_ns < self.DISARMED_S * NS_PER_S:
            return False
        if self._landed_ns is not None and now_ns - self._landed_ns < self.APART_S * NS_PER_S:
            return False
        self._was_armed, self._landed_ns = False, now_ns
        return True
