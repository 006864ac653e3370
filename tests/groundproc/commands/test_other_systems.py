"""The ground tool where Linux is not: without the modules of POSIX alone, on consoles without UTF-8, and as a wheel for any system."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from groundproc.cli import main

ROOT = Path(__file__).resolve().parents[3]
POSIX_ONLY = ("fcntl", "grp", "nis", "pty", "pwd", "resource", "spwd", "syslog", "termios", "tty", "systemd")
LINUX_ONLY = (
    "fork",
    "getuid",
    "geteuid",
    "memfd_create",
    "sched_getaffinity",
    "posix_fadvise",
    "statvfs",
    "O_DIRECTORY",
    "O_NOCTTY",
)
SIGNALS = ("SIGPIPE", "SIGHUP", "SIGKILL", "SIGXCPU", "SIGUSR1", "SIGALRM")

ELSEWHERE = f"""
import sys
# what the standard library and the libraries need of it here, they need before
import asyncio, ctypes, multiprocessing, numpy, os, pathlib, random, selectors, shutil, signal, socket, subprocess, tempfile, uuid
import concurrent.futures.process, http.server, importlib.metadata, matplotlib.pyplot, numba, pyproj, rasterio, scipy.spatial, tqdm
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {POSIX_ONLY!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
        return None
sys.meta_path.insert(0, Missing())
for name in {POSIX_ONLY!r}:
    sys.modules.pop(name, None)
import importlib.util
find = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: None if name in {POSIX_ONLY!r} else find(name, package)
for name in {LINUX_ONLY!r}:
    if hasattr(os, name):
        delattr(os, name)
for name in {SIGNALS!r}:
    if hasattr(signal, name):
        delattr(signal, name)
"""


def elsewhere(code: str, *words: str | Path, cwd: Path | None = None) -> "subprocess.CompletedProcess[str]":
    """Run a program on a system that has none of these."""
    return subprocess.run(
        [sys.executable, "-c", ELSEWHERE + code, *map(str, words)], capture_output=True, text=True, encoding="utf-8",
        cwd=cwd, env=os.environ | {"PYTHONPATH": str(ROOT)}, timeout=300,
    )  # fmt: skip


def test_every_module_of_the_ground_can_be_imported() -> None:
    done = elsewhere(
        "import importlib, pkgutil, flightlog, groundproc, simulator\n"
        "names = [m.name for p in (flightlog, groundproc, simulator) for m in pkgutil.walk_packages(p.__path__, p.__name__ + '.')]\n"
        "for name in names: importlib.import_module(name)\n"
        "print(len(names))\n"
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert int(done.stdout) > 200


COMMANDS = """
import json
from groundproc.cli import main
print(json.dumps([main(words) for words in json.loads(sys.argv[1])]))
"""
COMMAND = "from groundproc.cli import main\nsys.exit(main(sys.argv[1:]))\n"


def test_clouds_are_written_and_read(dual_flight: Any, tmp_path: Path) -> None:
    """LAZ is unpacked in the same process there, and comes out the same."""
    lines = [
        ["info", str(dual_flight.log)],
        ["decode", str(dual_flight.log), "-o", "d.laz", "--max-range", "12"],
        ["export", "d.laz", "-o", "d.csv"],
        ["export", "d.laz", "-o", "d.copc.laz"],
        ["raster", "d.laz", "-o", "r.tif"],
    ]
    done = elsewhere(COMMANDS, json.dumps(lines), cwd=tmp_path)
    assert "Traceback" not in done.stderr, done.stderr[-2000:]
    assert set(json.loads(done.stdout.splitlines()[-1])) <= {0, 3}, done.stderr[-2000:]
    assert main(["export", str(tmp_path / "d.laz"), "-o", str(tmp_path / "here.csv")]) == 0
    assert (tmp_path / "here.csv").read_bytes() == (tmp_path / "d.csv").read_bytes()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["pull", "swath@192.168.1.100"], "needs ssh and rsync"),
        (["live", "-o", "out"], "swath live --follow LOG"),
    ],
)
def test_what_needs_linux_says_so_in_one_sentence(words: list[str], said: str, tmp_path: Path) -> None:
    done = elsewhere(COMMAND, *words, cwd=tmp_path)
    assert done.returncode in (1, 2)
    assert said in done.stderr
    assert done.stderr.count("\n") == 1


def test_pull_names_the_program_that_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "ssh").write_text("#!/bin/sh\n")
    (tmp_path / "ssh").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert main(["pull", "swath@192.168.1.100", "-o", str(tmp_path / "logs")]) == 1
    said = capsys.readouterr().err
    assert "needs ssh and rsync" in said
    assert "and rsync not found" in said
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize("encoding", ["ascii", "cp437"])
def test_a_console_without_utf8_shows_what_it_can(dual_flight: Any, encoding: str, tmp_path: Path) -> None:
    """Signs that it lacks are replaced, and nothing ends in an error."""
    log = tmp_path / "flug_\N{LATIN SMALL LETTER U WITH DIAERESIS}ber_\N{SNOWMAN}.mcap"
    log.symlink_to(dual_flight.log)
    cloud = tmp_path / "\N{SNOWMAN}.laz"
    lines = [
        ["info", str(log)],
        ["decode", str(log), "-o", str(cloud), "--max-range", "12"],
        ["info", "\N{SNOWMAN}"],
    ]
    done = subprocess.run(
        [sys.executable, "-c", "import sys\n" + COMMANDS, json.dumps(lines)], capture_output=True, timeout=300,
        env=os.environ | {"PYTHONIOENCODING": f"{encoding}:strict", "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert b"Traceback" not in done.stderr, done.stderr[-1500:]
    assert "\\u2603.laz" in done.stdout.decode(encoding)
    assert "\\u2603: no such file" in done.stderr.decode(encoding)
    codes = json.loads(done.stdout.splitlines()[-1])
    assert set(codes[:2]) <= {0, 3}
    assert codes[2] == 1
