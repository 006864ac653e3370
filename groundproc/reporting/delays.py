"""How late gyros are, as an adjustment found it: a sentence for the terminal and for the report."""

from collections.abc import Mapping
from typing import Any, Final

NAMES: Final = {
    "lidar.delay_s": "the lidar's against its returns",
    "ins.delay_s": "the autopilot's beyond the synchronisation",
}
"""The globals in quality.json, and what they are the delay of."""


def delays(quality: Mapping[str, Any]) -> str:
    """Delay and sigma of each gyro that the flight tells; empty where it tells none."""
    estimated = quality.get(quality["trajectory"]["method"], {}).get("estimated", {})
    found = [
        f"{words} {each['value'][0] * 1e3:+.2f} ms, sigma {each['sigma'][0] * 1e3:.2f} ms"
        for name, words in NAMES.items()
        if (each := estimated.get(name)) is not None and not each["held"][0]
    ]
    return f"delay of gyros: {'; '.join(found)}" if found else ""
