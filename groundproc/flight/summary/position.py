"""The lidar's position packets in figures: its inertial sensors, its GPS, and what they say about its clock."""

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from flightlog import clock, nmea
from flightlog.constants import NS_PER_S
from flightlog.hdl32e import PpsState
from groundproc.flight.positionpackets import PositionBatch, Sentence, new_sentences
from groundproc.flight.summary.rates import rate_hz, rounded

_HOUR_NS: Final = 3600 * NS_PER_S
_LONGEST_LAG_NS: Final = 3 * NS_PER_S
"""A sentence appears in the packets some time after its second began, 0.85 s in a recording [measured]."""
_MOST_SENTENCES: Final = 100_000
ALIGNED: Final = "aligned to UTC"


@dataclass(slots=True)
class PositionSummary:
    """Sums over all position packets; `result` turns them into figures."""

    packets: int = 0
    with_imu: int = 0
    pps: dict[int, int] = field(default_factory=dict)
    sentences: int = 0
    valid: int = 0
    unreadable: int = 0
    first_ns: int | None = None
    last_ns: int = 0
    lags_ns: list[int] = field(default_factory=list)
    first_fix: nmea.Rmc | None = None
    first_fix_received_ns: int = 0
    first_fix_device_ns: int = 0
    last_fix: nmea.Rmc | None = None
    _text: str = ""

    def add(self, batch: PositionBatch) -> None:
        """Take the next batch."""
        self.packets += len(batch)
        self.with_imu += int(batch.readings.has_imu.sum())
        if self.first_ns is None:
            self.first_ns = int(batch.device_time_ns[0])
        self.last_ns = int(batch.device_time_ns[-1])
        for state, count in zip(*np.unique(batch.readings.pps, return_counts=True), strict=True):
            self.pps[int(state)] = self.pps.get(int(state), 0) + int(count)
        first_of_all = not self.sentences
        for sentence in new_sentences(batch, self._text):
            self._text = sentence.text
            self._sentence(sentence, whole=not first_of_all)
            first_of_all = False

    def _sentence(self, sentence: Sentence, *, whole: bool) -> None:
        """Count a sentence; `whole` says that its first appearance was seen, not only its presence at the start."""
        self.sentences += 1
        rmc = nmea.parse_rmc(sentence.text)
        if rmc is None:
            self.unreadable += 1
            return
        self.valid += rmc.valid
        if rmc.valid:
            if self.first_fix is None:
                self.first_fix, self.first_fix_received_ns = rmc, sentence.receive_time_ns
                self.first_fix_device_ns = sentence.device_time_ns
            self.last_fix = rmc
        if whole and len(self.lags_ns) < _MOST_SENTENCES:
            self.lags_ns.append(_lag_ns(sentence.device_time_ns, rmc))

    def first_utc_ns(self) -> tuple[int, bool] | None:
        """UTC of the first fix when it was received, and whether the lidar's clock tells it exactly; None without a fix."""
        if self.first_fix is None:
            return None
        exact = self._clock_state(self.lag_ns()) == ALIGNED
        return self.first_fix.utc_ns + (_lag_ns(self.first_fix_device_ns, self.first_fix) if exact else 0), exact

    def lag_ns(self) -> int | None:
        """How late sentences appear after their second, by the lidar's clock; None where that is not known."""
        return int(np.median(self.lags_ns)) if self.lags_ns else None

    def result(self) -> dict[str, Any]:
        """The figures; see `swath info --json`."""
        lag_ns = self.lag_ns()
        return {
            "packets": self.packets,
            "rate_hz": rounded(rate_hz(self.packets, self.last_ns - (self.first_ns or 0)), 2),
            "with_imu": self.with_imu,
            "pps": {_pps_name(state): count for state, count in sorted(self.pps.items())},
            "gps": {
                "sentences": self.sentences,
                "valid": self.valid,
                "unreadable": self.unreadable,
                "first_fix": _fix(self.first_fix),
                "last_fix": _fix(self.last_fix),
                "lag_s": None if lag_ns is None else round(lag_ns / NS_PER_S, 3),
            },
            "clock_state": self._clock_state(lag_ns),
        }

    def _clock_state(self, lag_ns: int | None) -> str:
        """What the lidar's clock counts: the PPS byte alone proves nothing, firmware of 2012 leaves it 0."""
        if lag_ns is not None and 0 <= lag_ns < _LONGEST_LAG_NS:
            return ALIGNED
        if self.pps.get(PpsState.LOCKED, 0) > self.packets / 2:
            return "locked to PPS"
        return "free running" if self.packets else "unknown"


def _lag_ns(device_ns: int, rmc: nmea.Rmc) -> int:
    """Lidar time past the hour less that which a sentence states."""
    return (device_ns - rmc.utc_ns + _HOUR_NS // 2) % _HOUR_NS - _HOUR_NS // 2


def _pps_name(state: int) -> str:
    return PpsState(state).name.lower() if state in set(PpsState) else str(state)


def _fix(rmc: nmea.Rmc | None) -> dict[str, Any] | None:
    if rmc is None:
        return None
    return {
        "utc": clock.utc_text(rmc.utc_ns),
        "latitude_deg": round(rmc.latitude_deg, 7),
        "longitude_deg": round(rmc.longitude_deg, 7),
    }
