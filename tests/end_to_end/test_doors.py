"""Spoilt files of every kind through the commands themselves: a sentence and an exit code, and nothing left behind."""

import json
import os
import random
import re
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

import farther
import fuzzing
import pytest
import seeds

from flightlog.logwriter import LogWriter
from groundproc.cli import main

EACH = 2
"""Spoilt files for each door in every run of the tests."""
SOAK_S = 600.0
MEMORY_BYTES = 1 << 30
INTERPRETER_BYTES = 300 << 20
"""What a command has before it reads anything, with the largest of its libraries."""
PEAK = """
import re, sys
from pathlib import Path
from groundproc.cli import main
code = main()
print("peak", re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1], file=sys.stderr)
sys.exit(code)
"""
SWATH = (sys.executable, "-c", PEAK)
"""The command, which says at its end how much memory it had at most [KiB]."""


def told(found: fuzzing.Findings) -> str:
    return "\n".join(f"{what}: {path}" for what, path in found.wrong.items())


def reasons(log: Path, capsys: pytest.CaptureFixture[str]) -> set[str]:
    """What `swath info` finds wrong with a log that it read to its end."""
    capsys.readouterr()
    assert main(["info", "--json", str(log)]) == 1
    return {reason["about"] for reason in json.loads(capsys.readouterr().out)["verdict_reasons"]}


def test_good_files_go_through_every_door(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without this the rest would prove nothing."""
    good = tmp_path / "good"
    fuzzing.good_files(good)
    whole = {
        "a.mcap": seeds.log(), "b.pcap": seeds.pcapng(), "b.tlog": seeds.tlog(), "b.yaml": seeds.MOUNT, "b.npz": seeds.scans_npz(),
        "b.csv": seeds.imu(), "b.pos": seeds.nmea(),
    }  # fmt: skip
    for door in fuzzing.own_doors():
        if door.words[0] == "adjust":  # minutes; its files are read in tests/groundproc/strips
            continue
        place = tmp_path / "case"
        place.mkdir()
        data = seeds.scans_csv() if door.name == "scans text" else whole[door.file]
        file = seeds.write(place, door.file, data)
        # the log is whole, but of a second and of few packets: its verdict is bad
        judged = door.words[0] == "info"
        assert fuzzing.ask(door, file, good) == ("", 1 if judged else 0), door
        assert not judged or reasons(file, capsys) == {"together", "lost_packets"}
        shutil.rmtree(place)


ENDS = {
    "process log": "0.9 s of both together|0.8 s of both together", "process positions": "read|states no sigma", "process": "read",
    "process trajectory": "shots lie outside it", "compass": "has to move past something", "assess pairs": "", "assess": "4 or more",
    "volume polygons": "of its edge is not known", "pull manifest": "the next pull goes on from here",
}  # fmt: skip
"""What good files that lie beside a flight end in, where that is no product."""


def test_good_files_beside_a_flight_are_read_to_their_end(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(seeds, "mutated", lambda data, dice: data)
    good = tmp_path / "good"
    fuzzing.good_files(good)
    for door in farther.doors():
        ends = ENDS.get(door.name, ENDS.get(door.name.split()[0], ""))
        for made in door.made:
            place = tmp_path / "case"
            place.mkdir()
            file = seeds.write(place, door.file, made(random.Random(1)))
            said = fuzzing.Said()
            with farther.readers_only():
                what, code = fuzzing.ask(door, file, good, said)
            assert what == "", door
            assert code == int(bool(ends)) or "states no sigma" in said.text, (door, said.text)
            assert re.search(ends, said.text), (door, said.text)
            shutil.rmtree(place)


def test_spoilt_files_of_every_kind_end_in_a_sentence(tmp_path: Path) -> None:
    found = fuzzing.run(tmp_path, 11, lambda cases: cases < EACH * len(fuzzing.doors()))
    assert not found.wrong, told(found)
    assert found.codes[1] > 0
    assert found.codes[0] > 0


# ten minutes by the clock, others each time; in the quick suite two files for each door
@pytest.mark.soak
def test_ten_minutes_of_spoilt_files(tmp_path: Path) -> None:
    end, seed = time.monotonic() + SOAK_S, time.time_ns() % 1_000_000
    found = fuzzing.run(tmp_path, seed, lambda cases: time.monotonic() < end)
    if path := os.environ.get("SWATH_FIGURES"):
        with Path(path).open("a") as file:
            codes = {f"fuzz_exit_{code}": count for code, count in sorted(found.codes.items())}
            file.write(
                json.dumps({"fuzz_seed": seed, "fuzz_cases": found.cases, "fuzz_findings": len(found.wrong)} | codes)
                + "\n"
            )
    assert not found.wrong, f"seed {seed}:\n{told(found)}"
    door, grown_bytes = found.grown_bytes.most_common(1)[0]
    children_bytes = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss << 10
    assert grown_bytes + children_bytes < MEMORY_BYTES - INTERPRETER_BYTES, (seed, door)


def test_arrays_that_say_they_are_larger_than_their_file_are_one_sentence(tmp_path: Path) -> None:
    good = tmp_path / "good"
    fuzzing.good_files(good)
    for shape in ("(1000000000000, 5)", "(4000000000,)", "(0, 1000000000000)", "(-1, 5)", "()"):
        place = tmp_path / "case"
        place.mkdir()
        (door,) = (door for door in fuzzing.doors() if door.name == "scans")
        assert fuzzing.ask(door, seeds.write(place, "b.npz", seeds.npz_bomb(shape)), good) == ("", 1)
        shutil.rmtree(place)


def hostile_log(path: Path) -> None:
    """A log whose every word is meant for the terminal: topics, metadata, attachments, sentences, texts, names of parameters."""
    word = seeds.HOSTILE.decode("utf-8", errors="replace")
    with path.open("wb") as stream:
        writer = LogWriter(
            stream, metadata={"swath.session": {"version": word, "software": word + "x" * 100_000, "origin": word}},
            attachments={word: b"x"}, library=word,
        )  # fmt: skip
        for topic in (f"/mavlink/{word}", f"/mavlink/{word}" + "x" * 50_000):
            writer.write(topic, seeds.START_NS, b"nothing")
        writer.finish()


@pytest.mark.parametrize("command", ["info", "info json", "recover", "decode"])
def test_words_of_a_log_reach_the_terminal_harmless_and_short(
    tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.mcap"
    hostile_log(path)
    (door,) = (door for door in fuzzing.doors() if door.name == command)
    what, code = fuzzing.ask(door, path, tmp_path)
    assert code == (0 if command == "recover" else 1)
    # info read it to its end, and says what is not in it
    assert "info" not in command or reasons(path, capsys) == {"lidar", "autopilot", "messages"}
    assert not what or (command == "info json" and "characters" in what), what


def test_names_of_files_and_keys_of_yaml_reach_the_terminal_harmless(tmp_path: Path) -> None:
    good = tmp_path / "good"
    fuzzing.good_files(good)
    name = "a\x1b[2J\nswath: all is well\u202e.mcap"
    for words in (
        ("info", "{file}"),
        ("recover", "{file}", "-o", "{out}.mcap"),
        ("import", "--pcap", "{file}", "-o", "{out}.mcap"),
    ):
        place = tmp_path / "case"
        place.mkdir()
        what, code = fuzzing.ask(fuzzing.Door("name", name, words, ()), seeds.write(place, name, b"x"), good)
        assert (what, code) == ("", 1)
        shutil.rmtree(place)
    keys = b'"a\\e[2J\\nswath: all is well": 1\n"' + b"k" * 100_000 + b'": 2\n'
    for door in fuzzing.doors():
        if door.file.endswith(".yaml"):
            place = tmp_path / "case"
            place.mkdir()
            assert fuzzing.ask(door, seeds.write(place, door.file, keys), good) == ("", 2)
            shutil.rmtree(place)


def test_the_cases_that_failed_once(cases: Path, tmp_path: Path) -> None:
    """Each in a process of its own, with the memory and the time that a small file may cost."""
    hostile = cases / "hostile"
    for words, code in (
        (["info", hostile / "info_system_time.mcap"], 3),  # shown, but without a lidar
        (["info", hostile / "bomb_zstd_256M.mcap"], None),
        (["recover", hostile / "quadratic_500000.mcap", "-o", tmp_path / "r.mcap"], None),
        (["adjust", hostile / "laz_abort.laz", "-t", hostile / "traj.csv", "-o", tmp_path / "o"], 1),
        (["adjust", hostile / "las_memory.las", "-t", hostile / "traj.csv", "-o", tmp_path / "o"], 1),
        (["adjust", cases / "las_week_end/c.laz", "-t", hostile / "overflow.pos", "-o", tmp_path / "o", "--crs", "32633"], 1),
        (["adjust", hostile / "laz_abort.laz", "-t", hostile / "traj.csv", "--config", hostile / "yaml_alias_bomb.yaml", "-o", "o"], 2),
    ):  # fmt: skip
        line = [*SWATH, *map(str, words)]
        done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=300)
        assert "Traceback" not in done.stderr
        assert done.returncode in (0, 1, 2, 3)
        assert code is None or done.returncode == code, done.stderr
        assert int(done.stderr.split()[-1]) << 10 < MEMORY_BYTES
