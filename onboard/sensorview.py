"""The lidar's settings, inferred from its packets: speed, field of view, return mode, and the expected rate. Pure."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.constants import NS_PER_S
from flightlog.hdl32e import AZIMUTH_STEPS, FIRING_NS, ReturnMode, firing_index, packet_ns

SECTORS: Final = 120
"""The full circle is looked at in so many sectors, 3 deg each."""


@dataclass(frozen=True, slots=True)
class SensorView:
    """How a lidar is set, as its packets show."""

    return_mode: str = ""
    rpm: float = 0.0
    fov_start_deg: float = 0.0
    """Where its field of view begins, clockwise, to the next sector; equal to the end: the full circle."""
    fov_end_deg: float = 0.0
    expected_packets_s: float = 0.0
    """A sensor whose own field of view is narrower sends fewer packets."""


def sectors_seen(azimuth: npt.NDArray[np.uint16]) -> npt.NDArray[np.bool_]:
    """Which sectors azimuths [0.01 deg] lie in, shape (SECTORS,)."""
    seen = np.zeros(SECTORS, np.bool_)
    seen[azimuth % AZIMUTH_STEPS // (AZIMUTH_STEPS // SECTORS)] = True
    return seen


def view(packet: npt.NDArray[np.void], seen: npt.NDArray[np.bool_]) -> SensorView:
    """Look at one good packet, shape () or (1,) of DATA_DTYPE, and at the sectors of at least a turn."""
    one = packet.reshape(-1)[0]
    mode = int(one["return_mode"])
    count = np.count_nonzero(seen)
    start, end = _widest(seen) if count < SECTORS else (0.0, 0.0)
    return SensorView(
        return_mode=ReturnMode(mode).name.lower(),
        rpm=round(rpm(one), 0),
        fov_start_deg=start,
        fov_end_deg=end,
        expected_packets_s=round(NS_PER_S / packet_ns(mode) * count / SECTORS, 1),
    )


def rpm(packet: np.void) -> float:
    """Turns per minute from the azimuths of a packet's blocks, but for steps over a gap in the field of view."""
    azimuth: list[int] = packet["blocks"]["azimuth"].tolist()
    firing: list[int] = firing_index(int(packet["return_mode"])).tolist()
    of_firing = [at for at, number, before in zip(azimuth, firing, [-1, *firing], strict=False) if number != before]
    steps = [(after - before) % AZIMUTH_STEPS for before, after in pairwise(of_firing)]
    largest = 2 * sorted(steps)[len(steps) // 2]
    usual = [step for step in steps if step <= largest]  # azimuths are whole hundredths: a mean has more than a median
    return sum(usual) / len(usual) / AZIMUTH_STEPS * 60 * NS_PER_S / FIRING_NS


def _widest(seen: npt.NDArray[np.bool_]) -> tuple[float, float]:
    """Where the sectors seen begin and end [deg]: beside the widest gap between them."""
    at = np.flatnonzero(seen)
    if not len(at) or seen.all():
        return 0.0, 0.0
    gaps = np.diff(np.append(at, at[0] + SECTORS))
    last = int(np.argmax(gaps))
    width = 360 / SECTORS
    return float(at[(last + 1) % len(at)] * width), float((at[last] + 1) * width % 360)
