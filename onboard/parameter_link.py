"""Parameters over MAVLink: read, set, and read back. Frames may be lost both ways; only confirmed values count."""

import functools
import math
import re
import select
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Self

from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog.constants import NS_PER_S
from flightlog.errors import SourceError, UsageError
from flightlog.mavlink import FrameParser, decode
from onboard.config import LinkConfig
from onboard.linkcounts import LinkCounts, note_frames
from onboard.parameters import NAME_BYTES, Difference, as_single
from onboard.sources import Source, open_source
from onboard.timesync import LogTime, read_clocks
from onboard.voice import COMPONENT

_TRIES: Final = 6
_WAIT_S: Final = 0.8
"""For an answer, before the next try; ArduCopter 3.1.3 answers within its 50 Hz loop, a radio adds some 0.3 s."""
_HEARTBEAT_S: Final = 5.0
_HEARTBEAT_FRESH_NS: Final = 3 * NS_PER_S
_TICK_S: Final = 0.01
_BURST: Final = 5
_MOST: Final = 5000
"""Parameters of an autopilot: ArduPilot has 1,400."""
_IN_VAIN: Final = 6
"""Bursts without any answer, after which no more are sent."""
_PARAMETER_NAME: Final = re.compile(r"[A-Za-z0-9_]+")
"""Requests on their way at a time: the autopilot's queue for incoming bytes is short."""
_INTEGERS: Final = {
    dialect.MAV_PARAM_TYPE_UINT8: (0, 2**8 - 1),
    dialect.MAV_PARAM_TYPE_INT8: (-(2**7), 2**7 - 1),
    dialect.MAV_PARAM_TYPE_UINT16: (0, 2**16 - 1),
    dialect.MAV_PARAM_TYPE_INT16: (-(2**15), 2**15 - 1),
    dialect.MAV_PARAM_TYPE_UINT32: (0, 2**32 - 1),
    dialect.MAV_PARAM_TYPE_INT32: (-(2**31), 2**31 - 1),
}
"""Smallest and largest value of the integer types. ArduPilot sends all of them as numbers, not as bits."""


@dataclass(frozen=True, slots=True)
class Value:
    """A parameter as the autopilot has it."""

    value: float
    kind: int
    """MAV_PARAM_TYPE."""
    index: int
    """65535 where the autopilot does not say."""
    count: int


@dataclass(slots=True)
class ParameterCounts:
    """What it took."""

    sent: int = 0
    repeated: int = 0
    bad_names: int = 0
    """Parameters left out because their names are none."""


class ParameterLink:
    """A MAVLink link for parameters, alone on its device: swathd must not be running on it.

    Parameters
    ----------
    config : LinkConfig
        The device.

    Raises
    ------
    SourceError
        The device cannot be opened.
    """

    def __init__(self, config: LinkConfig) -> None:
        self.counts = ParameterCounts()
        self.values: dict[str, Value] = {}
        """All that was heard, by name."""
        self._nameless: set[int] = set()
        """Numbers of those whose name is none."""
        self._device = config.device
        self._log_time = LogTime.start(read_clocks())
        self._source: Source = open_source(config, self._log_time)
        self._poll = select.poll()
        self._poll.register(self._source.fileno(), select.POLLIN)
        self._parser = FrameParser()
        self._life = LinkCounts()
        self._heartbeat_ns = 0
        self._mavlink = dialect.MAVLink(None, srcComponent=COMPONENT)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._source.close()

    # Reading ------------------------------------------------------------------------------------------------------

    def find_autopilot(self, seconds: float = _HEARTBEAT_S) -> tuple[int, int]:
        """Wait for the autopilot's heartbeat; gives its system and component.

        Raises
        ------
        SourceError
            There is none.
        """
        self._until(lambda: self._life.autopilot is not None, seconds)
        if self._life.autopilot is None:
            raise SourceError(
                f"{self._device}: no autopilot was heard within {seconds:g} s; see that it has power, and that the baud rate "
                "is right"
            )
        self._mavlink.srcSystem = self._life.autopilot[0]
        return self._life.autopilot

    def read(self, names: Iterable[str]) -> dict[str, float]:
        """Read parameters by name; those that the autopilot does not have are left out, after all tries."""
        wanted = list(dict.fromkeys(names))
        for name in wanted:
            self.values.pop(name, None)
        before = 0
        for attempt in range(_TRIES):
            missing = [name for name in wanted if name not in self.values]
            # an autopilot does not answer for a parameter that it lacks: once all others arrived, two more tries are enough
            if not missing or (attempt >= 3 and len(missing) == before):
                break
            before = len(missing)
            self.counts.repeated += len(missing) if attempt else 0
            for start in range(0, len(missing), _BURST):
                self._ask(missing[start : start + _BURST])
        return {name: self.values[name].value for name in wanted if name in self.values}

    def _ask(self, names: list[str]) -> None:
        system, component = self.find_autopilot()
        for name in names:
            self._send(self._mavlink.param_request_read_encode(system, component, name.encode(), -1))
        self._until(lambda: all(name in self.values for name in names), _WAIT_S)

    def read_all(self) -> dict[str, float]:
        """Read all parameters.

        Raises
        ------
        SourceError
            Some did not come in spite of all tries.
        """
        system, component = self.find_autopilot()
        self.values.clear()
        self._send(self._mavlink.param_request_list_encode(system, component))
        self._while_they_come()
        for _ in range(_TRIES):
            if not (missing := self._missing()):
                break
            self.counts.repeated += len(missing)
            if not self._ask_again(missing, system, component):
                break
        if not self.values or self._missing():
            lost = len(self._missing()) if self.values else "all"
            raise SourceError(f"{self._device}: {lost} parameters did not come in {_TRIES} tries")
        return {name: value.value for name, value in sorted(self.values.items())}

    def _ask_again(self, missing: Sequence[int], system: int, component: int) -> bool:
        """Ask for parameters by their numbers; False, soon, where nobody answers."""
        in_vain = 0
        for start in range(0, len(missing), _BURST):
            part = missing[start : start + _BURST]
            for index in part:
                self._send(self._mavlink.param_request_read_encode(system, component, b"", index))
            before = len(self.values)
            self._until(functools.partial(self._have, part), _WAIT_S)
            in_vain = 0 if len(self.values) > before else in_vain + 1
            if in_vain == _IN_VAIN:
                return False
        return True

    def _have(self, part: Sequence[int]) -> bool:
        """Whether none of these parameters is missing."""
        return not set(part) & set(self._missing())

    def _missing(self) -> list[int]:
        """Numbers of the parameters that have not come; [0] if none has. SourceError if they are more than any autopilot has."""
        count = max((value.count for value in self.values.values()), default=1)
        if count > _MOST:
            raise SourceError(
                f"{self._device}: the autopilot says that it has {count} parameters, expected {_MOST} at most"
            )
        return sorted(set(range(count)) - {value.index for value in self.values.values()} - self._nameless)

    def _while_they_come(self) -> None:
        before = -1
        while before < len(self.values):
            before = len(self.values)
            self._until(lambda: not self._missing(), 2 * _WAIT_S)

    # Setting ------------------------------------------------------------------------------------------------------

    def apply(self, differences: Iterable[Difference], told: Callable[[Difference], object] | None = None) -> None:
        """Set parameters, each confirmed by the autopilot; stops at the first that is not.

        Parameters
        ----------
        differences : iterable of Difference
            From `compare`; what the autopilot does not have cannot be set and must not be in here.
        told : callable, optional
            Called with each that was set.

        Raises
        ------
        UsageError
            The autopilot is armed, or not heard any more; or it could not hold the value.
        SourceError
            It does not take the value.
        """
        wanted = list(differences)
        self.read(difference.name for difference in wanted)
        for difference in wanted:  # all before the first is set
            _check_type(difference, self.values.get(difference.name))
        for difference in wanted:
            self._set(difference.name, difference.wanted)
            if told is not None:
                told(difference)

    def refuse_if_armed(self) -> None:
        """UsageError unless the autopilot was heard just now and said that it is disarmed."""
        self.find_autopilot()
        fresh = self._log_time.at(read_clocks()) - self._heartbeat_ns < _HEARTBEAT_FRESH_NS
        if not fresh:
            beats = self._life.heartbeats
            self._until(lambda: self._life.heartbeats > beats, _HEARTBEAT_S)
            if self._life.heartbeats == beats:
                raise UsageError(
                    f"{self._device}: the autopilot is not heard any more; parameters are set only while it is"
                )
        if self._life.armed(self._log_time.at(read_clocks())) is not False:
            raise UsageError(f"{self._device}: the autopilot is armed; parameters are set only while it is disarmed")

    def _set(self, name: str, value: float) -> None:
        kind = self.values[name].kind
        single = as_single(value)
        for attempt in range(_TRIES):
            self.refuse_if_armed()
            system, component = self.find_autopilot()
            self.counts.repeated += attempt > 0
            self.values.pop(name, None)
            self._send(self._mavlink.param_set_encode(system, component, name.encode(), single, kind))
            self._until(lambda: name in self.values, _WAIT_S)
            # the reply to PARAM_SET may only echo the value; the answer to a later request is what counts
            if self.read([name]).get(name) == single:
                return
        found = self.values.get(name)
        state = "does not answer" if found is None else f"keeps {found.value:.7g}"
        raise SourceError(f"{self._device}: {name} was set to {single:.7g} {_TRIES} times, the autopilot {state}")

    # Frames -------------------------------------------------------------------------------------------------------

    def _send(self, message: dialect.MAVLink_message) -> None:
        self.counts.sent += 1
        self._source.write(bytes(message.pack(self._mavlink, force_mavlink1=self._life.version == 1)))

    def _until(self, condition: Callable[[], bool], seconds: float) -> None:
        end = time.monotonic() + seconds
        self._listen()
        while not condition() and time.monotonic() < end:
            self._listen()

    def _listen(self) -> None:
        """Take what comes within a tick."""
        try:
            ready = self._poll.poll(_TICK_S * 1000)
            chunks = self._source.read() if ready else []
        except OSError as error:
            raise SourceError(f"{self._device}: {error.strerror or error}") from None
        for time_ns, data in chunks:
            frames = self._parser.feed(time_ns, data)
            beats = self._life.heartbeats
            note_frames(self._life, frames)
            if self._life.heartbeats > beats:
                self._heartbeat_ns = time_ns
            for frame in frames:
                ours = frame.known and (frame.system, frame.component) == self._life.autopilot
                if ours and frame.message_id == dialect.MAVLINK_MSG_ID_PARAM_VALUE:
                    self._note(decode(frame))

    def _note(self, message: dialect.MAVLink_message | None) -> None:
        if message is not None and math.isfinite(message.param_value):
            name = message.param_id[:NAME_BYTES]
            if _PARAMETER_NAME.fullmatch(name) is None:  # it would be a line of a file, and words on a terminal
                self._nameless.add(message.param_index)
                self.counts.bad_names = len(self._nameless)
                return
            self.values[name] = Value(message.param_value, message.param_type, message.param_index, message.param_count)


def _check_type(difference: Difference, found: Value | None) -> None:
    """UsageError where the parameter cannot hold the value."""
    if found is None:
        raise UsageError(f"{difference.name}: the autopilot has no such parameter")
    bounds = _INTEGERS.get(found.kind)
    if bounds is None:
        return
    low, high = bounds
    if difference.wanted != int(difference.wanted) or not low <= difference.wanted <= high:
        raise UsageError(
            f"{difference.name}: {difference.wanted:.7g} wanted, but it holds whole numbers of {low} to {high}"
        )
