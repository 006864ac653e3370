"""How much memory and time a large cloud takes: a made-up square kilometre, written in tiles, and commands on it.

    make bench-large_cloud      or  benchmarks/large_cloud.py [MILLIONS] [COMMAND ...]

The last line is one JSON object: millions of points, and for each command `peak_mb` (the command's own resident memory), `cpu_s`, `wall_s`
and `million_per_cpu_s`. 500 million points need some 4 GB of disk and an hour on two cores.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Final

import laspy
import numpy as np
import pyproj

AT_ONCE: Final = 1_000_000
SIDE_M: Final = 1000.0
"""Of the square; density grows with the number of points."""
COMMANDS: Final = {
    "raster": ["raster", "{cloud}", "--what", "dsm", "--cell", "0.5", "-o", "{out}/dsm.tif"],
    "ground": ["ground", "{cloud}", "-o", "{out}/ground.laz", "--dtm", "{out}/dtm.tif"],
    "passability": ["passability", "{cloud}", "-o", "{out}/passability"],
    "trees": ["trees", "{cloud}", "-o", "{out}/trees.geojson"],
}
CHILD: Final = """
import json, resource, sys, time
from groundproc.cli import main
begun = time.monotonic()
code = main(sys.argv[2:])
peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
usage = resource.getrusage(resource.RUSAGE_SELF)
told = {"code": code, "peak_mb": int(peak.split()[1]) / 1024, "cpu_s": usage.ru_utime + usage.ru_stime, "wall_s": time.monotonic() - begun}
open(sys.argv[1], "w").write(json.dumps(told))
"""


def main() -> int:
    """Make the cloud and run the commands, each in a process of its own."""
    parser = argparse.ArgumentParser(description="Memory and time of commands on a large cloud.")
    parser.add_argument("millions", type=int, nargs="?", default=500)
    parser.add_argument(
        "commands", nargs="*", default=list(COMMANDS), metavar="COMMAND", help=f"of {', '.join(COMMANDS)}"
    )
    asked = parser.parse_args()
    found: dict[str, Any] = {"millions": asked.millions}
    with tempfile.TemporaryDirectory(prefix="large-cloud-") as name:
        folder = Path(name)
        cloud = write(folder / "cloud.laz", asked.millions)
        found["file_gb"] = round(cloud.stat().st_size / 1e9, 2)
        for each in asked.commands:
            told = measured([part.format(cloud=cloud, out=folder) for part in COMMANDS[each]], folder / "told.json")
            told["million_per_cpu_s"] = round(asked.millions / told["cpu_s"], 3)
            found[each] = told
            print(json.dumps({each: told}), file=sys.stderr, flush=True)
    print(json.dumps(found))
    return 0


def write(path: Path, millions: int) -> Path:
    """Rolling ground with houses and trees, in strips of tiles as a flight would leave them."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, [533_000.0, 6_472_000.0, 0.0]
    header.add_crs(pyproj.CRS.from_epsg(32633))
    side = int(np.ceil(np.sqrt(millions)))
    tile_m = SIDE_M / side
    rng = np.random.default_rng(7)
    base = rng.random((AT_ONCE, 2)) * tile_m
    noise = 0.02 * rng.standard_normal(AT_ONCE)
    with laspy.open(path, mode="w", header=header, laz_backend=laspy.LazBackend.LazrsParallel, do_compress=True) as out:
        for tile in range(millions):
            corner = np.array(divmod(tile, side)) * tile_m
            x, y = (base + corner).T
            z = 5.0 * np.sin(x / 60.0) + 3.0 * np.cos(y / 45.0) + noise
            roof = (np.abs(x % 50.0 - 25.0) < 6.0) & (np.abs(y % 40.0 - 20.0) < 4.0)
            crown = np.hypot(x % 17.0 - 8.5, y % 19.0 - 9.5) < 2.0
            z = z + np.where(roof, 6.0, np.where(crown & (base[:, 0] % 0.03 < 0.02), 4.0 + 20.0 * np.abs(noise), 0.0))
            record = laspy.ScaleAwarePointRecord.zeros(AT_ONCE, header=header)
            record.x, record.y, record.z = x + 533_000.0, y + 6_472_000.0, z
            record.return_number[:] = 1
            record.number_of_returns[:] = 1
            record.gps_time = tile + np.arange(AT_ONCE) * 1e-6
            out.write_points(record)
    return path


def measured(words: list[str], told: Path) -> dict[str, Any]:
    """Peak memory and time of one command."""
    begun = time.monotonic()
    subprocess.run(
        [sys.executable, "-c", CHILD, str(told), *words], check=True, stdout=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[1])},
    )  # fmt: skip
    found = json.loads(told.read_text())
    assert found["code"] == 0, (words, found)
    return {
        "peak_mb": round(found["peak_mb"]),
        "cpu_s": round(found["cpu_s"]),
        "wall_s": round(time.monotonic() - begun),
    }


if __name__ == "__main__":
    sys.exit(main())
