"""Run every benchmark and write docs/benchmarks.md: figures, machine, versions. Run by `make bench`."""

import json
import os
import platform
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "benchmarks.md"
NO_BENCHMARKS = ("all", "drawing", "long_log", "machine", "mutations", "study")
"""This one, what others use, what takes hours, and what measures the tests."""
LIBRARIES = (
    "swath", "numpy", "numba", "scipy", "mcap", "laspy", "lazrs", "pyproj", "pymavlink", "velodyne-decoder", "kiss-icp", "small_gicp",
)  # fmt: skip


NOTES = {"trajectory": "What the figures mean and how they are taken: [accuracy.md](accuracy.md)."}
"""What a section says before its figures."""


def run(script: Path) -> dict[str, Any] | None:
    """Run one benchmark, its output shown as it comes; the JSON object of its last line, None where it failed."""
    print(f"== {script.stem}", flush=True)
    last = ""
    with subprocess.Popen([sys.executable, script], cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            print(line, end="", flush=True)
            last = line if line.strip() else last
    if process.returncode:
        return None
    try:
        figures = json.loads(last)
    except json.JSONDecodeError:
        return None
    return figures if isinstance(figures, dict) else None


def processor() -> str:
    """Name of the processor as the kernel tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def versions() -> dict[str, str]:
    """Versions of what the figures depend on."""
    found = {"Python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def table(rows: dict[str, Any]) -> str:
    """A table of names and values; one line for each name where every value is an object of its own."""
    if rows and all(isinstance(value, dict) for value in rows.values()):
        columns = list(dict.fromkeys(key for value in rows.values() for key in value))
        lines = ["| |" + "".join(f" `{key}` |" for key in columns), "|---" * (len(columns) + 1) + "|"]
        for name, value in rows.items():
            lines.append(f"| {name} |" + "".join(f" {show(value.get(key, ''))} |" for key in columns))
        return "\n".join(lines)
    lines = ["| figure | value |", "|---|---|"]
    return "\n".join([*lines, *(f"| `{name}` | {show(value)} |" for name, value in rows.items())])


def show(value: Any) -> str:
    """A value as the page shows it: four digits are more than a noisy machine is good for."""
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1000 else f"{value:.0f}"
    return json.dumps(value) if isinstance(value, (dict, list)) else "-" if value is None else str(value)


def main() -> int:
    """Run them all, write the page, and give 1 if any failed."""
    scripts = sorted(ROOT.glob("benchmarks/[a-z]*.py"))
    results = {script.stem: run(script) for script in scripts if script.stem not in NO_BENCHMARKS}
    sections = [
        f"## {name}\n\n`make bench-{name}`\n\n"
        + (f"{NOTES[name]}\n\n" if name in NOTES else "")
        + ("It failed." if figures is None else table(figures))
        for name, figures in results.items()
    ]
    machine = f"{processor()}, {os.cpu_count()} processors, {platform.system()} {platform.release()}"
    libraries = ", ".join(f"{name} {number}" for name, number in versions().items())
    head = (
        "# Benchmarks\n\n"
        "Written by `make bench`; the peers of each were measured in turn in the same run. Ratios carry over to other machines, "
        f"absolute figures do not.\n\nMachine: {machine}.\nVersions: {libraries}."
    )
    PAGE.write_text("\n\n".join([head, *sections]) + "\n")
    print(f"written: {PAGE.relative_to(ROOT)}")
    return 1 if None in results.values() else 0


if __name__ == "__main__":
    sys.exit(main())
