"""Every door through which a file comes in, given files that somebody spoilt: the command ends with a sentence and leaves nothing."""

import contextlib
import io
import random
import re
import shutil
import signal
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from unittest import mock

import farther
import seeds
from door import Door, Made, spoilt

from flightlog.errors import SwathError
from groundproc.cli import main
from groundproc.strips import work

CODES = (0, 1, 2, 3)
MOST_TEXT = 20_000
CPU_S = 15
"""Of the processor's time, that a command may take for a small file."""
_ALLOWED = re.compile(r"[^\x00-\x09\x0b-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2066-\u2069\ufeff]*")
"""Text in lines: no controls, nothing invisible, nothing that changes the direction."""


class TooLongError(Exception):
    """A command did not end."""


def doors() -> list[Door]:
    """All of them, on small files."""
    return [*own_doors(), *farther.doors()]


def own_doors() -> list[Door]:
    """Those of flights, recordings and clouds."""
    plain, packed = seeds.log(compression="none"), seeds.log()
    logs: tuple[Made, ...] = (
        spoilt(plain),
        spoilt(packed),
        lambda dice: seeds.log(dice),
        lambda dice: seeds.mutated(seeds.log(dice, "none"), dice),
    )
    recording = ("import", "--pcap", "{good}/a.pcap", "-o", "{out}.mcap")
    kit = (
        "import",
        "--scans",
        "{good}/scans.npz",
        "--imu",
        "{good}/imu.csv",
        "--positions",
        "{good}/a.pos",
        "-o",
        "{out}.mcap",
    )
    strips = ("adjust", "{good}/a.laz", "-t", "{good}/t.csv", "-o", "{out}", "--crs", "32633")

    def other(words: tuple[str, ...], name: str) -> tuple[str, ...]:
        return tuple("{file}" if word == name else word for word in words)

    return [
        Door("info", "a.mcap", ("info", "{file}"), logs),
        Door("info json", "a.mcap", ("info", "--json", "{file}"), logs),
        Door("recover", "a.mcap", ("recover", "{file}", "-o", "{out}.mcap"), logs),
        Door("decode", "a.mcap", ("decode", "{file}", "-o", "{out}.laz"), logs),
        Door("pcap", "b.pcap", other(recording, "{good}/a.pcap"), (spoilt(seeds.pcap()), spoilt(seeds.pcapng()))),
        Door(
            "mavlink", "b.tlog", (*recording, "--mavlink", "{file}"),
            (spoilt(seeds.tlog()), seeds.tlog, spoilt(seeds.dataflash())),
        ),
        Door("mount", "b.yaml", (*recording, "--mount", "{file}"), (spoilt(seeds.MOUNT),)),
        Door("scans", "b.npz", other(kit, "{good}/scans.npz"), (spoilt(seeds.scans_npz()),)),
        Door("scans text", "b.csv", other(kit, "{good}/scans.npz"), (spoilt(seeds.scans_csv()),)),
        Door("imu", "b.csv", other(kit, "{good}/imu.csv"), (spoilt(seeds.imu()),)),
        Door(
            "positions", "b.pos", other(kit, "{good}/a.pos"),
            tuple(map(spoilt, (seeds.pos(), seeds.nmea(), seeds.sbet(), seeds.trajectory()))),
        ),
        Door(
            "cloud", "b.laz", other(strips, "{good}/a.laz"),
            tuple(spoilt(seeds.cloud(*kind)) for kind in (("laz", 6), ("laz", 1), ("las", 3), ("las", 6))),
        ),
        Door(
            "trajectory", "t.pos", other(strips, "{good}/t.csv"),
            tuple(map(spoilt, (seeds.trajectory(), seeds.pos(), seeds.nmea(), seeds.sbet()))),
        ),
        Door("control", "c.csv", (*strips, "--control", "{file}"), (spoilt(seeds.control()),)),
        Door("options", "o.yaml", (*strips, "--config", "{file}"), (spoilt(seeds.OPTIONS),)),
    ]  # fmt: skip


def good_files(folder: Path) -> None:
    """What the other files of a command are."""
    folder.mkdir(exist_ok=True)
    for name, data in (
        ("a.pcap", seeds.pcap()), ("scans.npz", seeds.scans_npz()), ("imu.csv", seeds.imu()), ("a.pos", seeds.pos()),
        ("a.laz", seeds.cloud("laz", 6)), ("t.csv", seeds.trajectory()),
    ):  # fmt: skip
        seeds.write(folder, name, data)
    farther.good_files(folder)


@dataclass
class Findings:
    """What went wrong, by what it was, with the file that did it; and how often what went right."""

    cases: int = 0
    codes: Counter[int] = field(default_factory=Counter)
    wrong: dict[str, Path] = field(default_factory=dict)
    grown_bytes: Counter[str] = field(default_factory=Counter)
    """The most memory that a command asked for beyond what was there before it, by door."""


def run(folder: Path, seed: int, go_on: Callable[[int], bool], chosen: list[Door] | None = None) -> Findings:
    """Spoil files while `go_on`, asked with the number of cases so far, says so."""
    dice, found = random.Random(seed), Findings()
    good_files(folder / "good")
    (folder / "kept").mkdir(exist_ok=True)
    every = chosen or doors()
    with mock.patch.object(work, "_survey", _all_read), farther.readers_only():
        while go_on(found.cases):
            door = every[found.cases % len(every)]
            place = folder / "case"
            place.mkdir()
            file = seeds.write(place, door.file, dice.choice(door.made)(dice))
            before = begin_peak_bytes()
            what, code = ask(door, file, folder / "good")
            found.grown_bytes[door.name] = max(found.grown_bytes[door.name], memory_bytes("VmHWM") - before)
            found.cases += 1
            found.codes[code] += 1
            if what and f"{door.name}: {what}" not in found.wrong:
                kept = folder / "kept" / f"{len(found.wrong)}_{door.name.replace(' ', '_')}_{door.file}"
                found.wrong[f"{door.name}: {what}"] = Path(shutil.copy(file, kept))
            shutil.rmtree(place)
    return found


def memory_bytes(name: str) -> int:
    """VmHWM or VmRSS of this process."""
    found = re.search(rf"{name}:\s+(\d+)", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1]) << 10


def begin_peak_bytes() -> int:
    """Forget the peak so far; what is in use now."""
    with contextlib.suppress(OSError):  # not every sandbox lets it be
        Path("/proc/self/clear_refs").write_text("5")
    return memory_bytes("VmRSS")


def _all_read(site: work.Site, progress: work.Progress) -> None:
    """In the place of an adjustment's first stage: all points are read, and that is all."""
    for chunk in work.chunks(site.clouds, site.clock):
        assert len(chunk.xyz_m)
    raise SwathError("read")


@dataclass
class Said:
    """What a command printed."""

    text: str = ""


def ask(door: Door, file: Path, good: Path, heard: Said | None = None) -> tuple[str, int]:
    """Run a command; what was wrong with it, or nothing, and its exit code."""
    out = file.parent / "out"
    words = [word.format(file=file, out=out, good=good) for word in door.words]
    said = io.StringIO()
    code = -1
    try:
        with (
            within(CPU_S),
            contextlib.redirect_stdout(said),
            contextlib.redirect_stderr(said),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("error")
            warnings.filterwarnings(
                "ignore", "Use `@` matmul", PendingDeprecationWarning
            )  # rasterio 1.4 with affine 3.1
            with farther.aircraft(file):
                code = main(words)
    except SystemExit as error:
        code = int(error.code or 0)
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__} in {Path(where.filename).name}: {where.name}: {str(error)[:80]!r}", code
    if heard is not None:
        heard.text = said.getvalue()
    return _judged(said.getvalue(), code, () if door.keeps else _left(file)), code


def _left(file: Path) -> list[str]:
    """What else is where the file is."""
    return sorted(path.name for path in file.parent.rglob("*") if path != file)


def _judged(text: str, code: int, left: Sequence[str]) -> str:
    """What is wrong with what a command said and left."""
    if code not in CODES:
        return f"exit code {code}"
    if not _ALLOWED.fullmatch(text):
        bad = next(character for character in text if not _ALLOWED.fullmatch(character))
        return f"{bad!r} on the terminal"
    if len(text) > MOST_TEXT:
        return f"{len(text)} characters on the terminal"
    if any(line.startswith("swath: all is well") for line in text.splitlines()):
        return "a forged line on the terminal"
    if any(".part" in name for name in left) or (code in (1, 2) and left):
        return f"left {list(left)}"
    return ""


@contextlib.contextmanager
def within(seconds: int) -> Iterator[None]:
    """TooLongError where what is inside takes more of the processor's time."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise TooLongError(f"more than {seconds} s of the processor")

    before = signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)
