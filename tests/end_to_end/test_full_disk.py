"""A full disk and a signal in the middle of the work: one sentence, the right exit code, nothing left; real disks (tmpfs, root)."""

import gzip
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
import seeds

from flightlog.logfile import LogReader
from groundproc.cli import main
from groundproc.field.madeup import write_flight

SWATH = (sys.executable, "-c", "import sys; from groundproc.cli import main; sys.exit(main())")
PATIENCE_S = 600.0
TERMINATED, INTERRUPTED = 143, 130
SOME = ("--method", "ins", "--products", "cloud.laz,density.tif")
"""All others are written by the same doors: each into the step's folder, which gets its name at the end."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log, a cut one, a capture, a cloud with its trajectory: outside of the disk that will be full."""
    folder = tmp_path_factory.mktemp("inputs")
    write_flight(folder / "a.mcap", 3.0)
    write_flight(folder / "short.mcap", 2.5)
    content = (folder / "a.mcap").read_bytes()
    (folder / "cut.mcap").write_bytes(content[: len(content) * 4 // 5])
    (folder / "a.pcap").write_bytes(seeds.pcap(1000))
    (folder / "a.tlog.gz").write_bytes(gzip.compress(seeds.tlog() * 500))
    assert main(["process", str(folder / "a.mcap"), "-o", str(folder / "out"), *SOME]) in (0, 3)
    few = laspy.read(folder / "out" / "cloud.laz")
    few.points = few.points[::12].copy()
    few.write(folder / "few.laz")
    return folder


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Callable[[int], Path]]:
    """A function that mounts a disk of so many kB."""
    if os.geteuid() != 0:
        pytest.skip("needs root to mount a small disk")
    mounted: list[Path] = []

    def mount(size_kb: int) -> Path:
        place = tmp_path / "disk"
        place.mkdir()
        done = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size_kb}k", "swath-test", place], check=False)
        if done.returncode:
            pytest.skip("no tmpfs can be mounted here")
        mounted.append(place)
        return place

    yield mount
    for place in mounted:
        subprocess.run(["umount", place], check=True)


COMMANDS: dict[str, tuple[list[str], int]] = {
    "decode": (["decode", "IN/a.mcap", "--fov", "all", "-o", "DISK/new/a.laz"], 256),
    "recover": (["recover", "IN/cut.mcap", "-o", "DISK/new/whole.mcap"], 256),
    "process, the cloud": (["process", "IN/a.mcap", *SOME, "-o", "DISK/new/out"], 1500),
    "process, the first step": (["process", "IN/a.mcap", "--method", "ins", "-o", "DISK/new/out"], 16),
    "adjust": (["adjust", "IN/few.laz", "-t", "IN/out/trajectory.csv", "-o", "DISK/new/out"], 256),
    "import": (["import", "--pcap", "IN/a.pcap", "-o", "DISK/new/a.mcap"], 0),
    "import, packed": (["import", "--pcap", "IN/a.pcap", "--mavlink", "IN/a.tlog.gz", "-o", "DISK/new/a.mcap"], 16),
    "calibrate": (["calibrate", "IN/short.mcap", "-o", "DISK/new/out"], 0),
    "init": (["init", "IN/a.mcap", "-o", "DISK/new/survey.yaml"], 0),
    "simulate": (["simulate", "--dark", "--duration", "2", "-o", "DISK/new"], 256),
    "live": (["live", "--follow", "IN/a.mcap", "--port", "0", "--idle", "3", "-o", "DISK/new"], 0),
}  # fmt: skip
"""A command and the size of the disk [kB]; 0: not a byte is free."""


OF_ITS_OWN = "process, the cloud"
"""Runs as a process; the others are called, as a process begins with the same function and would only load the libraries again."""


@pytest.mark.parametrize("command", COMMANDS)
def test_on_a_full_disk_there_is_one_sentence_and_nothing_is_left(
    inputs: Path, disk: Callable[[int], Path], capsys: pytest.CaptureFixture[str], command: str
) -> None:
    words, size_kb = COMMANDS[command]
    place = disk(size_kb or 64)
    filler = place / "filler"
    if not size_kb:
        with filler.open("wb", buffering=0) as file:
            while _wrote(file, 4096):
                pass
    line = [word.replace("IN", str(inputs), 1).replace("DISK", str(place), 1) for word in words]
    if command == OF_ITS_OWN:
        done = subprocess.run([*SWATH, *line], capture_output=True, text=True, check=False, timeout=PATIENCE_S)
        code, errors = done.returncode, done.stderr
    else:
        capsys.readouterr()
        code, errors = main(line), capsys.readouterr().err
    said = [text for text in errors.splitlines() if text.startswith("swath: ")]
    assert code == 1, errors
    assert "Traceback" not in errors
    assert len(said) == 1
    assert "No space left on device" in said[0]
    assert ".part" not in said[0]
    filler.unlink(missing_ok=True)
    assert list(place.iterdir()) == []


def _wrote(file: Any, size: int) -> bool:
    try:
        return bool(file.write(bytes(size)))
    except OSError:
        return False


@pytest.mark.parametrize("words", [["info", "--json"], ["info"], ["init"]])
def test_what_is_printed_onto_a_full_disk_is_one_sentence(inputs: Path, words: list[str]) -> None:
    with Path("/dev/full").open("w") as full:
        line = [*SWATH, *words, str(inputs / "a.mcap")]
        done = subprocess.run(line, stdout=full, stderr=subprocess.PIPE, text=True, check=False, timeout=PATIENCE_S)
    assert done.returncode == 1
    assert [text for text in done.stderr.splitlines() if "verdict" not in text] == ["swath: No space left on device"]


SIGNALLED: dict[str, list[str]] = {
    "info": ["info", "IN/a.mcap"],
    "decode": ["decode", "IN/a.mcap", "-o", "OUT/new/a.laz"],
    "recover": ["recover", "IN/cut.mcap", "-o", "OUT/new/a.mcap"],
    "init": ["init", "IN/a.mcap", "-o", "OUT/new/survey.yaml"],
    "process": ["process", "IN/a.mcap", "--method", "ins", "-o", "OUT/new/out"],
    "calibrate": ["calibrate", "IN/a.mcap", "-o", "OUT/new/out"],
    "replay": ["replay", "IN/a.mcap", "--speed", "max"],
}


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, TERMINATED), (signal.SIGINT, INTERRUPTED)])
@pytest.mark.parametrize("command", SIGNALLED)
def test_a_signal_in_the_middle_leaves_nothing(
    inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, number: int, code: int
) -> None:
    read, count = LogReader.messages, 0

    def messages(self: LogReader, *arguments: Any, **named: Any) -> Iterator[Any]:
        nonlocal count
        for message in read(self, *arguments, **named):
            count += 1
            if count == 40:  # of some fifty at the least
                signal.raise_signal(number)
            yield message

    monkeypatch.setattr(LogReader, "messages", messages)
    monkeypatch.chdir(tmp_path)
    line = [word.replace("IN", str(inputs), 1).replace("OUT", str(tmp_path), 1) for word in SIGNALLED[command]]
    assert main(line) == code
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_fills_up_under_products_leaves_those_that_were_there(
    inputs: Path, disk: Callable[[int], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    """A second run with another CRS finds no room: the first run's products are as they were."""
    size_kb = sum(path.stat().st_size for path in (inputs / "out").rglob("*") if path.is_file()) // 1024
    place = disk(size_kb + 600)
    out = Path(shutil.copytree(inputs / "out", place / "out"))
    before = {path: path.read_bytes() for path in out.iterdir() if path.is_file()}
    line = ["process", str(inputs / "a.mcap"), *SOME, "--height", "relative", "-o", str(out)]
    code, errors = main(line), capsys.readouterr().err
    assert code == 1, errors
    assert "No space left on device" in errors
    assert (out / "cloud.laz").read_bytes() == before[out / "cloud.laz"]
    assert {path.name for path in out.iterdir()} - {".swath"} == {path.name for path in before}
    assert np.all([path.suffix != ".part" for path in out.rglob("*")])
