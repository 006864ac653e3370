"""Run benchmarks and write docs/benchmarks.md: figures, machine, versions. Run by `make bench`.

Every figure of the page is in docs/benchmarks.json, section by section, with the machine that it was measured on. `--only` measures some
sections anew and leaves the others as they are; `--page` writes the page alone.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).resolve().parents[1]
PAGE: Final = ROOT / "docs" / "benchmarks.md"
FIGURES: Final = ROOT / "docs" / "benchmarks.json"
NO_BENCHMARKS: Final = (
    "all", "drawing", "imagery_painting", "large_products", "long_log", "machine", "mutations", "uses_banks", "uses_change",
    "uses_closeups", "uses_clouds", "uses_ground", "uses_peers", "uses_places", "uses_radiometry", "uses_sight",
)  # fmt: skip
"""This one, what others use, and what measures the tests."""
ON_DEMAND: Final = ("kit", "study", "windows")
"""What takes an hour and more, or root: measured where `--only` names it."""
LIBRARIES: Final = (
    "swath", "numpy", "numba", "scipy", "mcap", "laspy", "lazrs", "pyproj", "pymavlink", "velodyne-decoder", "kiss-icp", "small_gicp",
)  # fmt: skip
NOTES: Final = {
    "trajectory": "What the figures mean and how they are taken: [accuracy.md](accuracy.md).",
    "windows": "A long flight in windows, and a lap flown again and again; one line a figure.",
}
"""What a section says before its figures."""
HEAD: Final = """\
# Benchmarks

Written by `make bench` from docs/benchmarks.json. The peers of a benchmark are measured in turn with ours in the same
run: ratios carry over to other machines, absolute figures do not."""
WIDTH: Final = 118
"""Of the page's lines, but for tables."""


def run(name: str) -> dict[str, Any]:
    """Run one benchmark, its output shown as it comes: the JSON object of its last line, None where it failed, and its notes."""
    print(f"== {name}", flush=True)
    last, notes = "", []
    command = [sys.executable, ROOT / "benchmarks" / f"{name}.py"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            print(line, end="", flush=True)
            last = line if line.strip() else last
            if line.startswith("note: "):
                notes.append(line.removeprefix("note: ").strip())
    try:
        figures = json.loads(last)
    except json.JSONDecodeError:
        figures = None
    good = not process.returncode and isinstance(figures, dict)
    return {"figures": figures if good else None} | ({"notes": notes} if notes else {})


def machine() -> str:
    """Processor and system, as the kernel tells them."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    processor = names[0] if names else platform.processor() or platform.machine()
    return f"{processor}, {os.cpu_count()} processors, {platform.system()} {platform.release()}"


def versions() -> str:
    """Versions of what the figures depend on."""
    found = {"Python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return ", ".join(f"{name} {number}" for name, number in found.items())


def table(rows: dict[str, Any]) -> str:
    """A table of names and values; one line for each name where every value is an object of its own, and one for each in that again."""
    if rows and all(isinstance(value, dict) for value in rows.values()):
        rows = {name: value for row in rows.items() for name, value in _with_inner(*row)}
        columns = list(dict.fromkeys(key for value in rows.values() for key in value))
        lines = ["| |" + "".join(f" `{key}` |" for key in columns), "|---" * (len(columns) + 1) + "|"]
        for name, value in rows.items():
            lines.append(f"| {name} |" + "".join(f" {show(value.get(key, ''))} |" for key in columns))
        return "\n".join(lines)
    lines = ["| figure | value |", "|---|---|"]
    return "\n".join([*lines, *(f"| `{name}` | {show(value)} |" for name, value in rows.items())])


def _with_inner(name: str, row: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    yield name, {key: value for key, value in row.items() if not isinstance(value, dict)}
    yield from ((f"{name}, {key}", value) for key, value in row.items() if isinstance(value, dict))


def show(value: Any) -> str:
    """A value as the page shows it: four digits are more than a noisy machine is good for."""
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1000 else f"{value:.0f}"
    return json.dumps(value) if isinstance(value, (dict, list)) else "-" if value is None else str(value)


def wrapped(text: str, indent: str = "") -> str:
    """A paragraph in lines; words with a hyphen stay whole."""
    return textwrap.fill(text, WIDTH, subsequent_indent=indent, break_on_hyphens=False, break_long_words=False)


def page(sections: dict[str, Any]) -> str:
    """The whole page."""
    parts = [HEAD]
    for name, section in sorted(sections.items()):
        parts += [f"## {name}", f"`make bench-{name}`"]
        parts += [NOTES[name]] if name in NOTES else []
        parts += ["It failed." if section["figures"] is None else table(section["figures"])]
        parts += ["\n".join(wrapped(f"- {each}.", "  ") for each in section["notes"])] if "notes" in section else []
        parts += [wrapped(f"On {section['machine']}; {section['versions']}.")]
    return "\n\n".join(parts) + "\n"


def main() -> int:
    """Run the benchmarks asked for, write the page, and give 1 if any failed."""
    every = [path.stem for path in sorted(ROOT.glob("benchmarks/[a-z]*.py")) if path.stem not in NO_BENCHMARKS]
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=every, metavar="NAME", help=f"some of {', '.join(every)}")
    parser.add_argument("--page", action="store_true", help="measure nothing, write the page")
    arguments = parser.parse_args()
    sections = json.loads(FIGURES.read_text()) if FIGURES.is_file() else {}
    chosen = [] if arguments.page else arguments.only or [name for name in every if name not in ON_DEMAND]
    for name in chosen:
        sections[name] = {"machine": machine(), "versions": versions()} | run(name)
        # in the order of the benchmark, not of the alphabet: the page made of the file must be this one
        FIGURES.write_text(json.dumps(dict(sorted(sections.items())), indent=1) + "\n")
    PAGE.write_text(page(sections))
    print(f"written: {PAGE.relative_to(ROOT)}")
    return 1 if any(sections[name]["figures"] is None for name in chosen) else 0


if __name__ == "__main__":
    sys.exit(main())
