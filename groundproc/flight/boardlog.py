"""An autopilot's own log (dataflash) as one boot: the same tables that MAVLink fills, at the rates at which the board measured.

The log is kept byte for byte in the flight log and decoded here, at each reading: what reads it better tomorrow reads old logs better.
Values keep the units of the MAVLink message whose table they fill, without its rounding. The log has no receive times; in their place
stands UTC as the GPS module states it.
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import records
from flightlog.constants import NS_PER_S, NS_PER_US
from flightlog.dataflash import Dataflash, Parser
from flightlog.logfile import Message
from groundproc.flight.autopilot import Boot, increasing
from groundproc.flight.boardtables import (
    ATTITUDES,
    FILTERS,
    IMUS,
    RAW_ACCELEROMETERS,
    RAW_GYROS,
    add_rates,
    converted,
    packed,
    stamps_ns,
)
from groundproc.flight.sound import possible

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]
Table = npt.NDArray[np.void]

KEPT: Final = ("MODE", "EV", "CAM", "TRIG", "PARM", "MSG", "MAG", "ARM", "ORGN")
"""Messages that are kept as they are, beside the tables."""
WANTED: Final = frozenset(
    (*KEPT, *ATTITUDES, *FILTERS, *IMUS, *RAW_GYROS, *RAW_ACCELEROMETERS, "POS", "GPS", "GPA", "BARO")
)
MOST_UNIX_NS: Final = 4_102_444_800 * NS_PER_S


class BoardLogs:
    """Gathers the dataflash logs of a flight, message by message: what is not wanted is not kept.

    Attributes
    ----------
    bad_bytes : int
        Bytes of all of them that belong to no message.
    not_finite : int
        Messages that were left out because a value in them is no number.
    """

    def __init__(self) -> None:
        self.bad_bytes = 0
        self.not_finite = 0
        self._parser: Parser | None = None
        self._next_ns = 0
        self._boots: list[Boot] = []

    def feed(self, message: Message) -> None:
        """Take the next message of the topic; where its stamps leave a gap, another file begins."""
        for time_ns, data in records.decode_raw(message.data):
            if self._parser is None or time_ns != self._next_ns:
                self._close()
                self._parser = Parser(WANTED)
            self._next_ns = time_ns + 1
            self._parser.feed(data)

    def boots(self) -> list[Boot]:
        """One for each log with anything of use in it."""
        self._close()
        return self._boots

    def _close(self) -> None:
        if self._parser is None:
            return
        log = self._parser.finish()
        self.bad_bytes += log.bad_bytes
        boot, not_finite = boot_of(log, len(self._boots))
        self.not_finite += not_finite
        if boot is not None:
            self._boots.append(boot)
        self._parser = None


def boot_of(log: Dataflash, number: int = 0) -> tuple[Boot | None, int]:
    """The tables of one log, None where nothing in it has a time; and how many messages were left out for values that are no numbers.

    Parameters
    ----------
    log : Dataflash
        With the messages of `WANTED`.
    number : int
        Of the boot.
    """
    found: dict[str, tuple[str, Times, dict[str, Array]]] = {}
    not_finite = 0
    for name, source, stamp_ns, columns in converted(log):
        finite = np.all([np.isfinite(column) for column in columns.values()], axis=0)
        not_finite += int((~finite).sum())
        keep = np.flatnonzero(finite)
        keep = keep[increasing(stamp_ns[keep])]
        if len(keep):
            found[name] = source, stamp_ns[keep], {key: column[keep] for key, column in columns.items()}
    if not found:
        return None, not_finite
    if "ATTITUDE" in found:
        add_rates(found)
    tables = {name: packed(columns) for name, (_, _, columns) in found.items()}
    stamps = {name: stamp_ns for name, (_, stamp_ns, _) in found.items()}
    left_out = _judged(tables, stamps)
    origins = {name: f"dataflash {source}" for name, (source, _, _) in found.items()}
    first_ns = min(int(stamp_ns[0]) for stamp_ns in stamps.values())
    for name in KEPT:
        if log.has(name):
            tables[name] = log.tables[name]
            own = stamps_ns(log, name)
            stamps[name] = np.full(len(tables[name]), first_ns) if own is None else own
    return Boot(number, _system(log), 1, tables, stamps, _heard(stamps, tables), "gps", origins, left_out), not_finite


def _judged(tables: dict[str, npt.NDArray[np.void]], stamps: dict[str, Times]) -> dict[str, int]:
    """Leave out rows with values that cannot be; how many, by table."""
    left_out = {}
    for name, table in tables.items():
        good = possible(table, name)
        if not good.all():
            left_out[name] = int((~good).sum())
            tables[name], stamps[name] = table[good], stamps[name][good]
    return left_out


# Inertial sensors -----------------------------------------------------------------------------------------------------


# What the autopilot states --------------------------------------------------------------------------------------------


def _heard(stamps: dict[str, Times], tables: dict[str, Table]) -> tuple[Times, Times] | None:
    """Boot time and UTC of the fixes, as if they had been received: the truest where both fit best, all others later."""
    if "SYSTEM_TIME" not in tables:
        return None
    boot_ns = stamps["SYSTEM_TIME"]
    unix_ns = tables["SYSTEM_TIME"]["time_unix_usec"].astype(np.int64) * NS_PER_US
    offset_ns = unix_ns - boot_ns
    near = np.abs(offset_ns - np.median(offset_ns)) < NS_PER_S
    # a fix is logged some time after its epoch, so that the largest difference is the truest
    return boot_ns[near], boot_ns[near] + 2 * int(offset_ns[near].max()) - offset_ns[near]


def _system(log: Dataflash) -> int:
    """Its MAVLink system id, by its parameters; 1, as all leave the factory, where these do not tell."""
    if log.has("PARM", "Name", "Value"):
        table = log.tables["PARM"]
        mine = np.isin(table["Name"], [b"SYSID_THISMAV", b"MAV_SYSID"])
        if mine.any() and 1 <= (value := float(table["Value"][mine][-1])) <= 255:
            return int(value)
    return 1
