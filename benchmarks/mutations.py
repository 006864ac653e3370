"""How many mistakes the tests notice: mutmut changes a module in many small ways, one at a time, and runs the module's own tests.

A module is mutated in a copy of what is in the repository, so that nothing of it is left behind. Of a large module a sample is tried,
drawn by a fixed seed. Numba's kernels are run as plain Python there: a compiled function cannot be exchanged for a mutant of it. The
survivors are printed as they would be written in the source; the last line is one JSON object: mutants tried, killed (the endless
among them) and the share with its standard deviation. What is behind the survivors: docs/mutations.md.

    pip install '.[mutations]'
    python benchmarks/mutations.py flightlog/nmea.py onboard/gate.py --sample 120
    python benchmarks/mutations.py flightlog/nmea.py --only flightlog.nmea.x_degrees__mutmut_3    # survivors once more
"""

import argparse
import json
import math
import os
import random
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
LOGS: Final = tuple(
    f"tests/flightlog/test_{name}.py" for name in ("walk", "container", "logfile", "salvage", "hostile_logs")
)
GYROS: Final = tuple(f"tests/groundproc/flight/test_{name}.py" for name in ("sync", "sync_grid", "sync_parts"))
SYNC: Final = ("__init__", "correlation", "fit", "result", "tracks")
SENSORS: Final = ("__init__", "blocks", "firings", "lasers", "linescan", "shots", "velodyne")
TESTS: Final[dict[str, tuple[str, ...]]] = {
    "flightlog/clock.py": ("tests/flightlog/test_clock.py",),
    "flightlog/config.py": ("tests/flightlog/test_config.py",),
    "flightlog/container.py": (*LOGS, "tests/flightlog/test_mcapwriter.py"),
    "flightlog/dataflash.py": ("tests/flightlog/test_dataflash.py",),
    "flightlog/frames.py": ("tests/flightlog/test_frames.py",),
    "flightlog/hdl32e.py": ("tests/flightlog/test_hdl32e.py",),
    "flightlog/logfile.py": LOGS,
    "flightlog/logwriter.py": LOGS,
    "flightlog/mavlink.py": ("tests/flightlog/test_mavlink.py",),
    "flightlog/mcapwriter.py": ("tests/flightlog/test_mcapwriter.py", "tests/flightlog/test_logfile.py"),
    "flightlog/mount.py": ("tests/flightlog/test_mount.py",),
    "flightlog/nmea.py": ("tests/flightlog/test_nmea.py",),
    "flightlog/records.py": ("tests/flightlog/test_records.py",),
    "flightlog/salvage.py": ("tests/flightlog/test_salvage.py", "tests/flightlog/test_hostile_logs.py"),
    "flightlog/walk.py": LOGS,
    "onboard/backlog.py": ("tests/onboard/test_recorder.py", "tests/onboard/test_slow_disk.py"),
    "onboard/gate.py": ("tests/onboard/test_gate.py",),
    "onboard/logfolder.py": ("tests/onboard/test_space.py", "tests/onboard/test_recorder.py", "tests/onboard/test_leftovers.py"),
    "onboard/parameter_link.py": ("tests/onboard/test_parameters.py",),
    "onboard/spacewatch.py": ("tests/onboard/test_space.py",),
    "onboard/recorder.py": ("tests/onboard/test_recorder.py", "tests/onboard/test_space.py", "tests/onboard/test_slow_disk.py"),
    "flightlog/vehicles.py": ("tests/flightlog/test_vehicles.py",),
    "flightlog/words.py": ("tests/flightlog/test_words.py",),
    "groundproc/field/bounded.py": ("tests/groundproc/field/test_bounded.py", "tests/groundproc/field/test_pull_hostile.py"),
    "groundproc/field/pull.py": ("tests/groundproc/field/test_pull_hostile.py", "tests/end_to_end/test_pull.py"),
    **{f"groundproc/flight/sync/{name}.py": GYROS for name in SYNC},
    **{f"groundproc/sensors/{name}.py": ("tests/groundproc/sensors",) for name in SENSORS},
}  # fmt: skip
"""The fast tests of each module."""
SEED: Final = 1
EXAMPLES: Final = 20
"""That hypothesis draws where a test does not say how many: a fifth of the usual number, for each of many mutants."""
COMPILED: Final = re.compile(r"^@njit\(.*\)\n", re.MULTILINE)
OPTIONS: Final = ("-p", "no:xdist", "-m", "not soak")
PATIENCE: Final = 15.0
"""A mutant that takes so many times as long as its tests do counts as endless; generous, for a machine that is busy."""
SURVIVED: Final = 0
NO_TESTS: Final = 33
ENDLESS: Final = (24, -24, 36, 152, 255)
"""Ended by mutmut's clock."""


DIFFERENCES: Final = """
import sys
from mutmut.mutation.diff_apply import get_diff_for_mutant
for name in sys.argv[1:]:
    print(f"--- {name}", get_diff_for_mutant(name), sep="\\n")
"""


def copy(folder: Path) -> None:
    """What is in the repository, uncommitted changes too."""
    tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
    for name in filter(None, tracked.decode().split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes((ROOT / name).read_bytes())


def python(folder: Path, *words: str) -> str:
    """Run Python in the copy; its output."""
    done = subprocess.run([sys.executable, *words], cwd=folder, capture_output=True, text=True, check=False)
    return done.stdout + done.stderr


def mutate(folder: Path, *names: str) -> str:
    """Run mutmut in the copy."""
    return python(folder, "-m", "mutmut", "run", "--max-children", "1", *names)


def differences(folder: Path, names: list[str]) -> str:
    """What mutants changed, all of them by one process."""
    return python(folder, "-c", DIFFERENCES, *names)


def outcomes(folder: Path, module: str) -> dict[str, int | None]:
    """Exit code of the tests by name of the mutant; None: not tried."""
    path = folder / "mutants" / f"{module}.meta"
    if not path.exists():
        return {}
    found: dict[str, int | None] = json.loads(path.read_text())["exit_code_by_key"]
    return found


def alive(folder: Path, module: str, survivor: str) -> bool:
    """Whether a survivor lives in a process of its own too, against all tests of the module.

    Mutmut forks after the import, and what a module calls then is not called again; and of a fixture that several tests share it runs the
    first test only.
    """
    words = [sys.executable, "-m", "pytest", "-q", "-x", *OPTIONS, *TESTS[module]]
    environment = os.environ | {"MUTANT_UNDER_TEST": survivor}
    done = subprocess.run(words, cwd=folder / "mutants", env=environment, capture_output=True, check=False)
    return done.returncode == 0


def prepare(folder: Path, module: str, chosen: str) -> None:
    """The repository's copy, with mutmut's settings and few examples."""
    copy(folder)
    source = (folder / module).read_text()
    (folder / module).write_text(COMPILED.sub("", source))
    with (folder / "tests" / "conftest.py").open("a") as file:
        file.write(f"\nsettings.register_profile('few', settings.get_profile('swath'), max_examples={EXAMPLES})\n")
        file.write("settings.load_profile('few')\n")
    options = {
        "source_paths": [module],
        "pytest_add_cli_args_test_selection": list(TESTS[module]),
        "pytest_add_cli_args": [*OPTIONS, "-k", chosen],
        "also_copy": sorted(path.name for path in folder.iterdir() if path.is_dir()),
        "timeout_multiplier": PATIENCE,
    }
    with (folder / "pyproject.toml").open("a") as file:
        file.write("\n[tool.mutmut]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in options.items()))


def examine(module: str, sample: int, only: list[str], chosen_tests: str) -> dict[str, float]:
    """Mutate a module and test it; prints the survivors."""
    with tempfile.TemporaryDirectory(prefix="swath-mutations-") as name:
        folder = Path(name)
        prepare(folder, module, chosen_tests)
        said = mutate(folder, "no-such-mutant")  # makes them, and sees which test reaches which
        names = sorted(outcomes(folder, module))
        if not names:
            raise SystemExit(f"{module}: mutmut made no mutants:\n{said[-2000:]}")
        chosen = names if len(names) <= sample else sorted(random.Random(SEED).sample(names, sample))
        if only:
            chosen = [name for name in names if name in only]
        said = mutate(folder, *chosen)
        found = {name: code for name, code in outcomes(folder, module).items() if name in chosen and code is not None}
        if not found:
            raise SystemExit(f"{module}: no mutant was tried:\n{said[-2000:]}")
        survivors = [name for name, code in found.items() if code in (SURVIVED, NO_TESTS)]
        survivors = [name for name in survivors if alive(folder, module, name)]
        endless = [name for name, code in found.items() if code in ENDLESS]
        print(differences(folder, survivors), "endless:", differences(folder, endless), sep="\n", flush=True)
    tried, killed = len(found), len(found) - len(survivors)
    share = killed / tried
    # of a sample, not of all mutants: one standard deviation of the share, the binomial's
    sigma = math.sqrt(share * (1.0 - share) / tried * (1.0 - tried / len(names)))
    return {
        "mutants": len(names),
        "tried": tried,
        "killed": killed,
        "endless": len(endless),
        "share": round(share, 3),
        "sigma": round(sigma, 3),
    }


def main() -> int:
    """Examine the modules named, or all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("modules", nargs="*", metavar="MODULE", help=f"of {', '.join(TESTS)}; default: all")
    parser.add_argument("--sample", type=int, default=120, help="mutants of a module that are tried at most")
    parser.add_argument("--only", nargs="+", default=[], metavar="MUTANT", help="try these, by name")
    parser.add_argument("-k", default="", metavar="TESTS", help="as of pytest: leave out the slow ones, to look first")
    arguments = parser.parse_args()
    figures = {}
    for module in arguments.modules or TESTS:
        figures[module] = examine(module, arguments.sample, arguments.only, arguments.k)
        print(f"{module}: {figures[module]}", flush=True)
    print(json.dumps(figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
