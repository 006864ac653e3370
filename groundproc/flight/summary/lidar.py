"""The lidar in figures: rate of turn, field of view, and packets lost, told apart from packets that were not wanted.

A packet may be missing for three reasons. It lay outside the window that was applied aboard; the sensor's own field of view was
limited, so that it never sent it; or it was lost. The stamps say how many are missing, the rate of turn says where each of them
would have looked, and that tells the reasons apart.
"""

import math
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.constants import NS_PER_S
from flightlog.records import LidarAccount
from groundproc.flight.load import LidarBatch
from groundproc.flight.summary.clockfit import drift
from groundproc.sensors.model import Digest, Lidar

AZIMUTH_STEPS: Final = 36_000
"""Of 0.01 deg in a turn."""
_COVERED: Final = 50
"""Azimuth counts as covered in pieces of this width [0.01 deg]."""
_EDGE: Final = 10
"""How far a packet that is not there may be off the place where it is looked for [0.01 deg]."""
_NARROWEST: Final = 400
"""An empty sector narrower than two packets at 600 rpm is no field of view [0.01 deg]."""
_FEWEST_TURNS: Final = 3
_USUAL: Final = 0.2
"""Steps of azimuth further off the median than this are no steps between neighbours."""
_LARGEST_GAP: Final = 20_000
"""Packets of a gap that are looked at one by one."""


@dataclass(slots=True)
class LidarSummary:
    """Sums over all batches; `result` turns them into figures."""

    model: Lidar
    packets: int = 0
    shots_with_return: int = 0
    modes: dict[int, int] = field(default_factory=dict)
    packet_ns: dict[int, int] = field(default_factory=dict)
    """Nominal time from packet to packet [ns] in each mode."""
    accounts: int = 0
    totals: dict[str, int] = field(default_factory=dict)
    window: tuple[int, int] | None = None
    """The window applied aboard [0.01 deg]."""
    seen: npt.NDArray[np.bool_] = field(default_factory=lambda: np.zeros(AZIMUTH_STEPS, np.bool_))
    """Azimuths of blocks."""
    turned: float = 0.0
    """Azimuth passed [0.01 deg], and the time it took [ns], over neighbouring packets."""
    turning_ns: int = 0
    rates_rpm: list[float] = field(default_factory=list)
    missing: list[npt.NDArray[np.float64]] = field(default_factory=list)
    """Of each gap: first azimuth of the packet before [0.01 deg], missing packets, step of azimuth per packet [0.01 deg]."""
    clock: list[tuple[int, int]] = field(default_factory=list)
    """Of each batch: lidar time, and the least that its packets came after it [ns]."""
    jumps: list[int] = field(default_factory=list)
    out_of_order: int = 0
    duplicates: int = 0
    late: int = 0
    """Of those out of order, that came a message late: they were counted as missing."""
    _last: tuple[int, int] | None = None

    def add(self, batch: LidarBatch) -> None:
        """Take the next batch."""
        if batch.account is not None:
            self._account(batch.account)
        if batch.jumped:
            self._last = None
            self.jumps.append(len(self.clock))
        if not len(batch.packets):
            return
        self.duplicates += batch.duplicates
        self.out_of_order += batch.moved
        digest = self.model.digest(batch.packets)
        self.packets += len(batch.packets)
        self.shots_with_return += digest.returns
        modes, first, counts = np.unique(digest.mode, return_index=True, return_counts=True)
        for mode, at, count in zip(modes.tolist(), first.tolist(), counts.tolist(), strict=True):
            self.modes[mode] = self.modes.get(mode, 0) + count
            self.packet_ns[mode] = int(digest.record_ns[at])
        self.seen[digest.azimuth_cdeg.ravel()] = True
        self._steps(digest, batch.device_time_ns)
        late_ns = batch.receive_time_ns - batch.device_time_ns
        earliest = int(np.argmin(late_ns))
        self.clock.append((int(batch.device_time_ns[earliest]), int(late_ns[earliest])))

    def _account(self, account: LidarAccount) -> None:
        self.accounts += 1
        for name in account.__slots__:
            if not name.startswith("fov"):
                self.totals[name] = self.totals.get(name, 0) + int(getattr(account, name))
        if not math.isfinite(account.fov_start_deg + account.fov_end_deg):
            return
        start, end = (round(a * 100) % AZIMUTH_STEPS for a in (account.fov_start_deg, account.fov_end_deg))
        if start != end:
            self.window = (start, end)

    def _steps(self, digest: Digest, device_ns: npt.NDArray[np.int64]) -> None:
        """Rate of turn and gaps between neighbouring packets, the last of the batch before included."""
        azimuth = digest.azimuth_cdeg[:, 0]
        if self._last is not None:
            early = device_ns < self._last[1]
            self.late += int(early.sum())
            azimuth = np.concatenate([[self._last[0]], azimuth[~early]])
            device_ns = np.concatenate([[self._last[1]], device_ns[~early]])
        self._last = int(azimuth[-1]), int(device_ns[-1])
        passed_ns = np.diff(device_ns)
        packet_ns = int(digest.record_ns[0])
        missing = np.rint(passed_ns / packet_ns).astype(np.int64) - 1
        neighbours = missing == 0
        turned = (np.diff(azimuth) % AZIMUTH_STEPS)[neighbours]
        if turned.any():
            middle = np.median(turned)
            usual = np.abs(turned - middle) <= _USUAL * middle
            turned_sum, sum_ns = int(turned[usual].sum()), int(passed_ns[neighbours][usual].sum())
            self.turned += turned_sum
            self.turning_ns += sum_ns
            if sum_ns:
                self.rates_rpm.append(turned_sum / sum_ns * 60 * NS_PER_S / AZIMUTH_STEPS)
        gaps = missing > 0
        if gaps.any() and self.turning_ns:
            step = self.turned / self.turning_ns * packet_ns
            columns = [azimuth[:-1][gaps], missing[gaps], np.full(gaps.sum(), step), passed_ns[gaps]]
            self.missing.append(np.stack(columns, axis=1).astype(np.float64))

    def result(self) -> dict[str, Any]:
        """The figures; see `swath info --json`."""
        turns = self.turned / AZIMUTH_STEPS
        sensor_off = self._empty_sector() if turns >= _FEWEST_TURNS else None
        gaps = np.concatenate([np.empty((0, 4)), *self.missing])
        missing, aboard, sensor = _reasons(gaps, self.window, sensor_off, self._packet_ns(), self.model.idle_ns)
        missing -= min(self.late, missing - aboard - sensor)
        rates = np.array(self.rates_rpm)
        return {
            "model": self.model.name,
            "packets": self.packets,
            "shots_with_return": self.shots_with_return,
            "return_mode": self._mode(),
            "rpm": round(float(np.median(rates)), 2) if len(rates) else None,
            "rpm_spread": round(float(rates.std()), 2) if len(rates) else None,
            "turns": round(turns, 2),
            "missing_packets": missing,
            "lost_packets": missing - aboard - sensor,
            "missing_outside_window_aboard": aboard,
            "missing_outside_sensor_fov": sensor,
            "out_of_order": self.out_of_order + self.late,
            "duplicates": self.duplicates,
            "account": dict(self.totals) if self.accounts else None,
            "window_aboard_deg": [value / 100 for value in self.window] if self.window else None,
            "sensor_fov_deg": [sensor_off[1] / 100, sensor_off[0] / 100] if sensor_off else None,
            "azimuth_coverage_deg": int(self.seen.reshape(-1, _COVERED).any(axis=1).sum()) * _COVERED / 100,
            "clock": drift(np.array(self.clock, np.int64).reshape(-1, 2), self.jumps),
        }

    def _mode(self) -> str | None:
        known = self.model.mode_names
        modes = sorted(self.modes, key=lambda mode: -self.modes[mode])
        names = [known[mode] for mode in modes if mode in known]
        if unknown := len(modes) - len(names):
            names.append(f"{unknown} unknown")
        return " and ".join(names) if names else None

    def _packet_ns(self) -> int:
        return self.packet_ns[max(self.modes, key=lambda mode: self.modes[mode])] if self.modes else 1

    def _empty_sector(self) -> tuple[int, int] | None:
        """Widest sector (start, end) [0.01 deg] that no block ever looked into, inside the window applied aboard."""
        seen = self.seen
        if self.window is not None:
            start, end = self.window
            seen = seen | ((np.arange(AZIMUTH_STEPS) - start) % AZIMUTH_STEPS > (end - start) % AZIMUTH_STEPS)
        azimuths = np.flatnonzero(seen)
        widths = np.diff(azimuths, append=azimuths[0] + AZIMUTH_STEPS)
        widest = int(np.argmax(widths))
        if widths[widest] < _NARROWEST:
            return None
        start = int(azimuths[widest])
        return start, (start + int(widths[widest])) % AZIMUTH_STEPS


def _reasons(
    gaps: npt.NDArray[np.float64],
    window: tuple[int, int] | None,
    sensor_off: tuple[int, int] | None,
    packet_ns: int,
    idle_ns: int,
) -> tuple[int, int, int]:
    """Of all gaps: packets missing, those that lay outside the window aboard, those that the sensor never sent."""
    total = aboard = sensor = 0
    for before, count, step, passed_ns in gaps:
        missing = int(count)
        outside = _outside(before, missing, step, window, idle_ns / packet_ns)
        unsent = 0
        if sensor_off is not None:
            # the sensor fills a packet on the far side of its gap: time, not place, says how many it did not send
            turned = before + np.array([0.0, step * passed_ns / packet_ns])
            unsent_ns = _overlap(turned, sensor_off) / step * packet_ns
            unsent = min(missing - outside, round(unsent_ns / packet_ns))
        total, aboard, sensor = total + missing, aboard + outside, sensor + unsent
    return total, aboard, sensor


def _outside(before: float, missing: int, step: float, window: tuple[int, int] | None, idle: float) -> int:
    """How many of the packets after the one at azimuth `before` lie wholly outside the window aboard; `idle`: without shots at its end."""
    if window is None:
        return 0
    looked_at = min(missing, _LARGEST_GAP)
    first = before + step * np.arange(1, looked_at + 1)
    last_shot = step * (1 - idle)
    start, end = window
    dark = (start - end) % AZIMUTH_STEPS
    past = (first - end + _EDGE) % AZIMUTH_STEPS
    outside = int(np.count_nonzero(past + last_shot < dark + 2 * _EDGE))
    return round(outside * missing / looked_at)


def _overlap(turned: npt.NDArray[np.float64], sector: tuple[int, int]) -> float:
    """How much of the way from turned[0] to turned[1] [0.01 deg, running on over turns] lies in a sector."""
    width = (sector[1] - sector[0]) % AZIMUTH_STEPS
    whole, rest = np.divmod(turned - sector[0], AZIMUTH_STEPS)
    inside = whole * width + np.minimum(rest, width)
    return float(inside[1] - inside[0])
