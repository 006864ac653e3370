"""The aircraft's side installs and runs with nothing of the ground's."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
GROUND_ONLY = ("scipy", "numba", "pyproj", "laspy", "lazrs", "matplotlib", "tqdm", "embreex", "pytest")

LOOK = f"""
import importlib.util, json, pkgutil, sys
import flightlog, onboard
names = []
for package in (flightlog, onboard):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        __import__(module.name)
        names.append(module.name)
there = [name for name in {GROUND_ONLY!r} if importlib.util.find_spec(name)]
print(json.dumps({{"modules": names, "there": there, "file": flightlog.__file__}}))
"""


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bin folder of a new environment with the project, its base dependencies and pyserial, and nothing else."""
    folder = tmp_path_factory.mktemp("bare")
    subprocess.run([sys.executable, "-m", "venv", folder / "venv"], check=True)
    # a copy, so that building leaves nothing in the source tree
    source = folder / "source"
    source.mkdir()
    tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
    for name in tracked.decode().split("\x00"):
        if (name.endswith((".py", ".toml", ".md", ".yaml", ".param")) or name.startswith("systemd/")) and (
            ROOT / name
        ).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    pip = [folder / "venv/bin/python", "-m", "pip", "install", "--quiet", "--retries", "1"]
    run = subprocess.run([*pip, source, "pyserial"], capture_output=True, text=True)
    offline = ("No matching distribution", "Could not fetch", "Failed to establish", "Temporary failure", "ProxyError")
    if run.returncode and any(words in run.stderr for words in offline):
        pytest.skip("pip reaches no package index: a bare environment cannot be made")
    assert run.returncode == 0, run.stderr
    return folder / "venv/bin"


def call(bare: Path, *words: str) -> str:
    """Standard output of a command of the bare environment, run where the source tree is not on the path."""
    return subprocess.run([bare / words[0], *words[1:]], cwd=bare, capture_output=True, text=True, check=True).stdout


def test_all_of_flightlog_and_onboard_imports_without_any_library_of_the_ground(bare: Path) -> None:
    found = json.loads(call(bare, "python", "-c", LOOK))
    assert Path(found["file"]).is_relative_to(bare.parent)
    assert found["there"] == []
    assert {"flightlog.logfile", "flightlog.mavlink", "onboard.cli", "onboard.daemon"} <= set(found["modules"])


def test_the_daemon_says_how_to_use_it(bare: Path) -> None:
    assert "run" in call(bare, "swathd", "--help")


def test_the_daemon_prints_a_configuration_that_it_takes(bare: Path, tmp_path: Path) -> None:
    sample = call(bare, "swathd", "config")
    assert "lidar:" in sample
    path = tmp_path / "swathd.yaml"
    path.write_text(sample)
    check = "import sys; from flightlog.config import load; from onboard.config import SwathdConfig; load(sys.argv[1], SwathdConfig)"
    call(bare, "python", "-c", check, str(path))


def test_the_wheel_has_the_files_of_the_service(bare: Path) -> None:
    look = "from onboard import install; print(install.template('swathd.service'))"
    assert "WatchdogSec" in call(bare, "python", "-c", look)
