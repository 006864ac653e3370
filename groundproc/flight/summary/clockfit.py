"""How fast one clock runs against another, from pairs of readings whose delays are never negative."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.constants import NS_PER_S
from groundproc.numerics import robust

_FEWEST: Final = 5
_SHORTEST_NS: Final = NS_PER_S // 2
"""Over less than this the jitter of receive times, tens of microseconds, is more than any drift."""
_CLIP: Final = 4.0


def drift(pairs: npt.NDArray[np.int64], jumps: Sequence[int]) -> dict[str, Any] | None:
    """Fit a straight line through the longest stretch in which neither clock was set.

    Parameters
    ----------
    pairs : ndarray of int64, shape (n, 2)
        Device time, and how much later the host says it was [ns]; the least delayed of each batch.
    jumps : sequence of int
        Indices at which a clock was set.

    Returns
    -------
    dict or None
        offset_s (host minus device, at the middle), drift_ppm (positive: the device runs fast), drift_sigma_ppm, jitter_us (rms
        about the line), jumps; None for fewer than 5 pairs.
    """
    stretches = np.split(pairs, list(jumps))
    longest = max(stretches, key=len)
    if len(longest) < _FEWEST or longest[-1, 0] - longest[0, 0] < _SHORTEST_NS:
        return None
    middle_ns = int(longest[:, 0].mean())
    time_s = (longest[:, 0] - middle_ns) / NS_PER_S
    base_ns = int(longest[0, 1])
    late_s = (longest[:, 1] - base_ns) / NS_PER_S
    keep = np.ones(len(time_s), np.bool_)
    slope, level = np.polyfit(time_s, late_s, 1)
    for _ in range(3):
        residual = late_s - slope * time_s - level
        sigma = robust.sigma(residual[keep]) + 1e-9
        keep = np.abs(residual - np.median(residual)) <= _CLIP * sigma
        if np.count_nonzero(keep) < _FEWEST:
            return None
        slope, level = np.polyfit(time_s[keep], late_s[keep], 1)
    residual = (late_s - slope * time_s - level)[keep]
    spread = float(np.sqrt(np.square(time_s[keep] - time_s[keep].mean()).sum()))
    rms = float(np.sqrt(np.square(residual).sum() / (len(residual) - 2)))
    return {
        "offset_s": round(base_ns / NS_PER_S + float(level), 6),
        "drift_ppm": round(-float(slope) * 1e6, 3),
        "drift_sigma_ppm": round(rms / spread * _inflation(residual) * 1e6, 3),
        "jitter_us": round(rms * 1e6, 1),
        "jumps": len(jumps),
    }


def _inflation(residual: npt.NDArray[np.float64]) -> float:
    """By how much the sigma of a mean grows because neighbouring residuals are alike (first-order autoregression)."""
    power = float(np.square(residual).sum())
    alike = float((residual[1:] * residual[:-1]).sum()) / power if power > 0 else 0.0
    alike = min(max(alike, 0.0), 0.95)
    return float(np.sqrt((1 + alike) / (1 - alike)))
