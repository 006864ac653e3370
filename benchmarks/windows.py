"""A flight that is too long for one window of the adjustment: 1.5 km through the streets of a town, windows joined.

The first 327 s of the named flight `long`, seed 3, are simulated with their truth (a dozen minutes) and adjusted as `swath process`
does by default. The last line is one JSON object:

ate_m, rotation_rms_deg, cloud_floor_ratio, facade_floor_ratio, real_time_factor
                     as in trajectory.py
cpu_s_per_flight_s, peak_memory_mb
                     what it cost
windows              how many were joined
"""

import json
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Final

from trajectory import FIGURES, run, simulate

SECONDS: Final = 327.0
SEED: Final = 3


def main() -> int:
    """Simulate, adjust, judge, and print the figures."""
    folder = Path(tempfile.mkdtemp(prefix="swath-windows-"))
    try:
        results = folder / "results"
        results.mkdir()
        simulate(folder / "flight", "long", SECONDS, SEED, points=True)
        run("truth", folder / "flight", results)  # the floor that the others are held against
        found = run("adjusted", folder / "flight", results)
    finally:
        shutil.rmtree(folder)
    if "error" in found:
        print(found["error"], file=sys.stderr)
        return 1
    shown = {name: found.get(name) for name in (*FIGURES, "cpu_s_per_flight_s", "peak_memory_mb")}
    print(json.dumps(shown | {"windows": len(found["report"]["windows"])}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
