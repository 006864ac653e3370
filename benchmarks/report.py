"""The flight report: how long it takes to write, how large it is, and how soon its million points are seen: `make bench-report`.

A cloud of four million points with the usual attributes is put beside the products of a short simulated flight. `report_seconds` is the
time from the begin of the page's load to the end of the first frame with all its points, in Chromium without a screen that draws by
software; the median of some loads. `busy_share` says what else the machine was doing meanwhile. The last line is one JSON object.
"""

import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "helpers"))

from browser import PROGRAM, browser  # noqa: E402 (found by the path above)
from machine import busy_s  # noqa: E402 (found by the path above)

from groundproc.cloud import exports, reader  # noqa: E402 (found by the path above)
from groundproc.cloud.points import Points  # noqa: E402 (found by the path above)
from groundproc.cloud.writer import CloudWriter  # noqa: E402 (found by the path above)
from groundproc.geodesy import projected_crs  # noqa: E402 (found by the path above)

POINTS = 4_000_000
LOADS = 5
SIDE_M = 200.0


def made_cloud(folder: Path) -> None:
    """Hills with boxes on them, seen from a path along the middle: cloud.copc.laz."""
    rng = np.random.default_rng(1)
    east = rng.normal(0.0, SIDE_M / 6, POINTS)
    north = rng.uniform(-SIDE_M / 2, SIDE_M / 2, POINTS)
    up = 3.0 * np.sin(east / 25.0) * np.cos(north / 31.0) + rng.normal(0.0, 0.02, POINTS)
    up += 6.0 * ((abs(east % 40.0 - 20.0) < 5.0) & (abs(north % 50.0 - 25.0) < 7.0))
    place = np.stack([533_500.0 + east, 6_472_500.0 + north, 60.0 + up], axis=1)
    order = np.argsort(north, kind="stable")
    columns = {
        "intensity": rng.gamma(4.0, 12.0, POINTS).clip(0, 255).astype(np.uint16),
        "laser": rng.integers(0, 32, POINTS).astype(np.uint8),
        "range": np.hypot(east, 30.0).clip(0.0, 130.0).astype(np.float32),
    }
    points = Points(1_779_272_223_000_000_000 + np.arange(POINTS) * 2_000, place[order], columns)
    plain = folder / "plain.laz"
    with CloudWriter(plain, columns, crs=projected_crs(32633), offset_m=(533_500.0, 6_472_500.0, 0.0)) as writer:
        writer.write(points)
    exports.write(reader.look(plain), folder / "cloud.copc.laz", folder / "cloud.copc.laz", lambda done: None)
    plain.unlink()


def write_report(folder: Path) -> None:
    """Compose the page of a folder, and say what it took: the work of a process of its own."""
    from groundproc.reporting.flightreport import Subject, compose
    from groundproc.steps.products import digests_of
    from groundproc.trajectory.estimate import read_estimate

    quality = json.loads((folder / "quality.json").read_text())
    subject = Subject(folder, quality, read_estimate(folder), [], digests_of(folder))
    compose(subject, 10_000, 12_000_000)  # what is compiled or imported at first use is so now
    begin = time.process_time() + resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    text = compose(subject, 1_000_000, 12_000_000)
    took = time.process_time() + resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - begin
    (folder / "report.html").write_text(text)
    peak = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    print(json.dumps({"report_cpu_s": round(took, 2), "report_peak_mb": round(int(peak.split()[1]) / 1024)}))


def shown(page_file: Path, folder: Path) -> dict[str, Any]:
    """Load the page some times."""
    seconds, points, complaints, asked = [], 0, 0, 0
    begin_s, busy_before = time.monotonic(), busy_s()
    for number in range(LOADS):
        with browser(folder / f"browser{number}") as page:
            page.looks(1200, 800)
            page.open(page_file.as_uri())
            seconds.append(page.until("window.swathViewer && swathViewer.shownAt") / 1000.0)
            points = page.run("swathViewer.drawn")
            complaints += len(page.said)
            asked += sum(not each.startswith(("data:", page_file.as_uri())) for each in page.asked)
    share = (busy_s() - busy_before) / (time.monotonic() - begin_s) / (os.cpu_count() or 1)
    return {
        "report_seconds": round(statistics.median(seconds), 2),
        "report_seconds_least": round(min(seconds), 2),
        "report_points": points,
        "report_mb": round(page_file.stat().st_size / 1e6, 2),
        "console_errors": complaints,
        "requests": asked,
        "busy_share": round(share, 2),
    }


def main() -> int:
    """Make, write, look."""
    if len(sys.argv) > 1:
        write_report(Path(sys.argv[1]))
        return 0
    if PROGRAM is None:
        print("bench-report looks at pages with Chromium, and there is none", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory(prefix="bench-report-") as name:
        folder = Path(name)
        swath = [sys.executable, "-c", "import sys; from groundproc.cli import main; sys.exit(main())"]
        flight, out = folder / "flight", folder / "out"
        subprocess.run(
            [*swath, "simulate", "--scene", "panels", "--duration", "6", "--seed", "1", "-o", flight], check=True
        )
        words = [
            "process",
            flight / "flight.mcap",
            "--method",
            "ins",
            "--products",
            "density.tif,dsm.tif,hillshade.tif",
            "-o",
            out,
        ]
        subprocess.run([*swath, *words], check=False)
        made_cloud(out)
        told = subprocess.run([sys.executable, __file__, out], check=True, stdout=subprocess.PIPE, text=True).stdout
        figures = json.loads(told.splitlines()[-1]) | shown(out / "report.html", folder)
    print(json.dumps(figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
