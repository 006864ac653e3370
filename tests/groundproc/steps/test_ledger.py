"""The ledger of an output folder: what it takes for changed, and what a process that died leaves behind."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from flightlog.errors import SourceError, UsageError
from groundproc.steps.ledger import INSIDE, Entry, Fingerprint, Ledger, fingerprint, locked, open_ledger, staging, sweep

DEAD: int
with subprocess.Popen([sys.executable, "-c", ""]) as _gone:
    DEAD = _gone.pid


def committed(folder: Path, step: str, files: dict[str, str], ledger: Ledger | None = None) -> Ledger:
    """A ledger with one finished step."""
    ledger = ledger or Ledger(folder)
    staged = staging(folder, step)
    for name, text in files.items():
        (staged / name).parent.mkdir(parents=True, exist_ok=True)
        (staged / name).write_text(text)
    outputs = {name: fingerprint(staged / name) for name in files}
    ledger.commit(step, Entry({"settings": {}}, outputs, "2026-05-20T10:00:00Z", 1.5), staged)
    shutil.rmtree(staged)
    return ledger


def test_a_finished_step_has_its_files_in_place_and_is_read_again(tmp_path: Path) -> None:
    committed(tmp_path, "place", {"cloud.laz": "points", f"{INSIDE}/place.json": "{}"})
    assert (tmp_path / "cloud.laz").read_text() == "points"
    assert sorted(p.name for p in (tmp_path / INSIDE).iterdir()) == ["ledger.json", "place.json"]
    again = open_ledger(tmp_path)
    assert again is not None
    assert again.entries["place"].seconds == 1.5
    assert set(again.entries["place"].outputs) == {"cloud.laz", f"{INSIDE}/place.json"}
    assert again.changed("place") == {}
    assert open_ledger(tmp_path / "elsewhere") is None


def test_what_a_step_no_longer_makes_goes(tmp_path: Path) -> None:
    ledger = committed(tmp_path, "place", {"cloud.laz": "points", "dsm.tif": "raster"})
    committed(tmp_path, "place", {"cloud.laz": "more points"}, ledger)
    assert (tmp_path / "cloud.laz").read_text() == "more points"
    assert not (tmp_path / "dsm.tif").exists()


def test_missing_and_changed_outputs_are_told_apart(tmp_path: Path) -> None:
    ledger = committed(tmp_path, "place", {"a": "one", "b": "two", "c": "three"})
    (tmp_path / "a").unlink()
    (tmp_path / "b").write_text("owt")
    os.utime(tmp_path / "c")
    assert ledger.changed("place") == {"a": "is missing", "b": "was changed since"}


def test_a_change_is_seen_even_when_size_and_time_of_modification_are_put_back(tmp_path: Path) -> None:
    path = tmp_path / "log"
    path.write_text("one")
    before = fingerprint(path)
    stat = path.stat()
    path.write_text("two")
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert not fingerprint(path, before).same(before)


def test_a_file_that_was_only_touched_or_moved_is_the_same(tmp_path: Path) -> None:
    path = tmp_path / "log"
    path.write_text("one")
    before = fingerprint(path)
    os.utime(path)
    assert fingerprint(path, before).same(before)
    path.rename(tmp_path / "other")
    assert fingerprint(tmp_path / "other", before).same(before)


def test_an_unchanged_file_is_not_read_again(tmp_path: Path) -> None:
    path = tmp_path / "log"
    path.write_text("one")
    seen = fingerprint(path).seen
    known = Fingerprint(3, "as the ledger has it", seen)
    assert fingerprint(path, known) is known
    with pytest.raises(SourceError, match="nowhere"):
        fingerprint(tmp_path / "nowhere")


@pytest.mark.parametrize("moved", [0, 1, 2])
def test_a_process_that_dies_while_files_get_their_names_leaves_what_can_be_settled(tmp_path: Path, moved: int) -> None:
    """Whatever the number of files that have their names already."""
    ledger = committed(tmp_path, "place", {"a": "old a", "b": "old b", "gone": "old"})
    staged = tmp_path / INSIDE / f".place.{DEAD}.part"
    staged.mkdir()
    for name in ("a", "b"):
        (staged / name).write_text(f"new {name}")
    outputs = {name: fingerprint(staged / name) for name in ("a", "b")}
    ledger.pending["place"] = Entry({}, outputs, "", 0.0)
    ledger.save()
    for name in ("a", "b")[:moved]:
        (staged / name).replace(tmp_path / name)

    after = open_ledger(tmp_path)
    assert after is not None
    after.settle("place", staged)
    sweep(tmp_path)
    assert [(tmp_path / name).read_text() for name in ("a", "b")] == ["new a", "new b"]
    assert after.changed("place") == {}
    assert sorted(p.name for p in tmp_path.iterdir()) == [INSIDE, "a", "b"]
    assert [p.name for p in (tmp_path / INSIDE).iterdir()] == ["ledger.json"]
    assert open_ledger(tmp_path) is not None


def test_a_step_whose_staged_files_are_lost_is_not_done(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    ledger.pending["place"] = Entry({}, {"a": Fingerprint(3, "0", (0, 0, 0))}, "", 0.0)
    ledger.save()
    ledger.settle("place", tmp_path / "nowhere")
    assert ledger.entries == {}


def test_leftovers_of_the_dead_are_swept_and_those_of_the_living_are_not(tmp_path: Path) -> None:
    (tmp_path / INSIDE).mkdir()
    dead = [tmp_path / f".cloud.laz.{DEAD}.part", tmp_path / INSIDE / f".place.{DEAD}.part"]
    dead[0].write_text("half")
    dead[1].mkdir()
    (dead[1] / "cloud.laz").write_text("half")
    kept = [tmp_path / f".cloud.laz.{os.getppid()}.part", tmp_path / ".notes.part", tmp_path / "part"]
    for path in kept:
        path.write_text("not ours to judge")
    sweep(tmp_path)
    assert not any(path.exists() for path in dead)
    assert all(path.exists() for path in kept)


@pytest.mark.parametrize(
    "text",
    [
        "", "{}", "[]", "null", "{\"format\": 2}", "[" * 5000, "\x00",
        json.dumps({"format": 1, "logs": [], "trajectory": None, "survey": {}, "files": {}, "pending": {},
                    "steps": {"place": {"key": {}, "finished": "", "seconds": 0,
                                        "outputs": {"../../etc/passwd": {"bytes": 1, "sha256": "0", "seen": [0, 0, 0]}}}}}),
    ],
)  # fmt: skip
def test_what_is_no_ledger_is_refused_in_one_sentence(tmp_path: Path, text: str) -> None:
    (tmp_path / INSIDE).mkdir()
    (tmp_path / INSIDE / "ledger.json").write_text(text)
    with pytest.raises(UsageError, match="--force") as caught:
        open_ledger(tmp_path)
    assert "\n" not in str(caught.value)


def test_two_processes_do_not_work_in_one_folder(tmp_path: Path) -> None:
    with locked(tmp_path), pytest.raises(UsageError, match="another process"), locked(tmp_path):
        pass
    with locked(tmp_path):
        assert list(tmp_path.iterdir()) == []
