"""How many mistakes the tests notice: mutmut changes a module in many small ways, one at a time, and runs the module's own tests.

A module is mutated in a copy of what is in the repository, so that nothing of it is left behind. Of a large module a sample is tried,
drawn by a fixed seed. The survivors are printed as they would be written in the source; the last line is one JSON object: mutants
tried, killed (a run that never ends counts as noticed) and the share. What is behind the survivors: docs/mutations.md.

    pip install '.[mutations]'
    python benchmarks/mutations.py flightlog/nmea.py onboard/gate.py --sample 100
"""

import argparse
import json
import random
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
TESTS: Final[dict[str, tuple[str, ...]]] = {
    "flightlog/clock.py": ("tests/flightlog/test_clock.py",),
    "flightlog/config.py": ("tests/flightlog/test_config.py",),
    "flightlog/container.py": ("tests/flightlog/test_logfile.py", "tests/flightlog/test_mcapwriter.py"),
    "flightlog/dataflash.py": ("tests/flightlog/test_dataflash.py",),
    "flightlog/frames.py": ("tests/flightlog/test_frames.py",),
    "flightlog/hdl32e.py": ("tests/flightlog/test_hdl32e.py",),
    "flightlog/logfile.py": ("tests/flightlog/test_logfile.py",),
    "flightlog/mavlink.py": ("tests/flightlog/test_mavlink.py",),
    "flightlog/mcapwriter.py": ("tests/flightlog/test_mcapwriter.py", "tests/flightlog/test_logfile.py"),
    "flightlog/mount.py": ("tests/flightlog/test_mount.py",),
    "flightlog/nmea.py": ("tests/flightlog/test_nmea.py",),
    "flightlog/records.py": ("tests/flightlog/test_records.py",),
    "flightlog/salvage.py": ("tests/flightlog/test_salvage.py",),
    "flightlog/walk.py": ("tests/flightlog/test_logfile.py", "tests/flightlog/test_salvage.py"),
    "onboard/gate.py": ("tests/onboard/test_gate.py",),
    "onboard/logfolder.py": ("tests/onboard/test_space.py", "tests/onboard/test_recorder.py", "tests/onboard/test_leftovers.py"),
    "onboard/parameter_link.py": ("tests/onboard/test_parameters.py",),
    "onboard/recorder.py": ("tests/onboard/test_recorder.py", "tests/onboard/test_space.py", "tests/onboard/test_slow_disk.py"),
    "groundproc/field/pull.py": ("tests/end_to_end/test_pull.py",),
}  # fmt: skip
"""The fast tests of each module."""
SEED: Final = 1
EXAMPLES: Final = 20
"""That hypothesis draws where a test does not say how many: a fifth of the usual number, for each of many mutants."""
SURVIVED: Final = 0
NO_TESTS: Final = 33


def copy(folder: Path) -> None:
    """What is in the repository, uncommitted changes too."""
    tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
    for name in filter(None, tracked.decode().split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes((ROOT / name).read_bytes())


def mutmut(folder: Path, *words: str) -> str:
    """Run a command of mutmut in the copy; its output."""
    command = [sys.executable, "-m", "mutmut", *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    return done.stdout + done.stderr


def outcomes(folder: Path, module: str) -> dict[str, int | None]:
    """Exit code of the tests by name of the mutant; None: not tried."""
    path = folder / "mutants" / f"{module}.meta"
    if not path.exists():
        return {}
    found: dict[str, int | None] = json.loads(path.read_text())["exit_code_by_key"]
    return found


def examine(module: str, sample: int) -> dict[str, float]:
    """Mutate a module and test it; prints the survivors."""
    with tempfile.TemporaryDirectory(prefix="swath-mutations-") as name:
        folder = Path(name)
        copy(folder)
        with (folder / "tests" / "conftest.py").open("a") as file:
            file.write(f"\nsettings.register_profile('few', settings.get_profile('swath'), max_examples={EXAMPLES})\n")
            file.write("settings.load_profile('few')\n")
        others = sorted(path.name for path in folder.iterdir() if path.is_dir())
        settings = {
            "source_paths": [module],
            "pytest_add_cli_args_test_selection": list(TESTS[module]),
            "pytest_add_cli_args": ["-p", "no:xdist", "-m", "not soak"],
            "also_copy": others,
        }
        with (folder / "pyproject.toml").open("a") as file:
            file.write(
                "\n[tool.mutmut]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in settings.items())
            )
        said = mutmut(
            folder, "run", "--max-children", "1", "no-such-mutant"
        )  # makes them, and sees which test reaches which
        names = sorted(outcomes(folder, module))
        if not names:
            raise SystemExit(f"{module}: mutmut made no mutants:\n{said[-2000:]}")
        chosen = names if len(names) <= sample else sorted(random.Random(SEED).sample(names, sample))
        mutmut(folder, "run", "--max-children", "1", *chosen)
        found = {name: code for name, code in outcomes(folder, module).items() if name in chosen and code is not None}
        for survivor in (name for name, code in found.items() if code in (SURVIVED, NO_TESTS)):
            print(f"--- {survivor}\n{mutmut(folder, 'show', survivor).strip()}", flush=True)
    codes = Counter(found.values())
    survived = codes[SURVIVED] + codes[NO_TESTS]
    tried = len(found)
    return {
        "mutants": len(names),
        "tried": tried,
        "killed": tried - survived,
        "share": round(1 - survived / max(tried, 1), 3),
    }


def main() -> int:
    """Examine the modules named, or all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("modules", nargs="*", metavar="MODULE", help=f"of {', '.join(TESTS)}; default: all")
    parser.add_argument("--sample", type=int, default=100, help="mutants of a module that are tried at most")
    arguments = parser.parse_args()
    figures = {}
    for module in arguments.modules or TESTS:
        figures[module] = examine(module, arguments.sample)
        print(f"{module}: {figures[module]}", flush=True)
    print(json.dumps(figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
