"""What a run does again and what it leaves as it is, what it refuses, and what an interrupt leaves behind."""

import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

from groundproc.cli import main
from groundproc.cloud import laz, lazworker
from groundproc.cloud.setaside import SetAside
from groundproc.reporting import cloudpart
from groundproc.steps import OF_IMAGES, place
from groundproc.steps import ORDER as ALL
from groundproc.steps.ledger import INSIDE
from groundproc.steps.step import steps

ORDER = tuple(name for name in ALL if name not in (*OF_IMAGES, "uses"))
"""The steps of a flight without photographs."""
PATIENCE_S = 300.0
COMPLETE = (0, 3)
"""Exit codes with which the products are there: 3 s of flight are too short to tie the clocks well."""
SOME = ("--method", "ins", "--products", "cloud.laz,density.tif,trajectory.gpkg")
"""A cloud, a raster of the one pass and a table."""
PICTURED = "cloud.laz,pictures,density.tif,trajectory.gpkg"
"""With pictures of what is written, too: a product of each kind; they take as long as all the others."""


@pytest.fixture(scope="module")
def log(dual_flight: Any) -> Path:
    """3 s of flight."""
    path: Path = dual_flight.log
    return path


@pytest.fixture(scope="module")
def made(log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its products, made in one go."""
    folder = tmp_path_factory.mktemp("made") / "out"
    assert main(["process", str(log), *SOME, "-o", str(folder)]) in COMPLETE
    return folder


@pytest.fixture
def out(made: Path, tmp_path: Path) -> Path:
    """A copy of the products, to be changed."""
    return Path(shutil.copytree(made, tmp_path / "out"))


def finished(folder: Path) -> dict[str, str]:
    """When each step was finished."""
    tree = json.loads((folder / INSIDE / "ledger.json").read_text())
    return {name: entry["finished"] for name, entry in tree["steps"].items()}


def units(log: Path, folder: Path, *words: object) -> set[str]:
    """Run, and name the parts of steps that were made."""
    before = finished(folder) if (folder / INSIDE).is_dir() else {}
    assert main(["process", str(log), *SOME, *map(str, words), "-o", str(folder)]) in COMPLETE
    after = finished(folder)
    return {name for name in after if before.get(name) != after[name]}


def process(log: Path, folder: Path, *words: object) -> set[str]:
    """Run, and name the steps that were done, or some parts of them."""
    return steps_of(units(log, folder, *words))


def steps_of(names: Iterable[str]) -> set[str]:
    """Steps that parts belong to."""
    return {name.partition(": ")[0] for name in names}


def status(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, dict[str, Any]]:
    """What --status says, by step."""
    capsys.readouterr()
    assert main(["process", *map(str, words), "--status", "--json"]) == 0
    return {state["step"]: state for state in json.loads(capsys.readouterr().out)["steps"]}


def names(folder: Path) -> set[str]:
    """All files."""
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


# What is done again ---------------------------------------------------------------------------------------------------


def test_a_second_run_does_nothing_and_says_the_same(log: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    process(log, out)  # a copy has other inodes: it is looked through once
    said = capsys.readouterr().out
    content = {name: (out / name).read_bytes() for name in names(out)}
    assert process(log, out) == set()
    assert capsys.readouterr().out == said
    assert {name: (out / name).read_bytes() for name in names(out)} == content


def test_force_does_everything_and_gives_the_same_points(log: Path, out: Path, made: Path) -> None:
    assert process(log, out, "--force") == set(ORDER)
    assert (out / "cloud.laz").read_bytes() == (made / "cloud.laz").read_bytes()


def test_what_the_report_shows_of_a_cloud_is_read_once_where_it_is_made_in_one_go(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads, read, unpacked, start = list[str](), cloudpart._of, list[str](), laz.start

    def counted(path: Path, most: int, aside: SetAside | None = None) -> cloudpart.CloudPart:
        reads.append(path.parent.parent.name)
        return read(path, most, aside)

    def started(task: lazworker.Task) -> Any:
        unpacked.append(task.path)
        return start(task)

    monkeypatch.setattr(cloudpart, "_of", counted)
    monkeypatch.setattr(laz, "start", started)
    monkeypatch.setattr(place, "cores", lambda: 2)
    folder = tmp_path / "out"
    words = ("process", str(log), "--method", "ins", "--products", "cloud.laz,report.html", "-o", str(folder))
    assert main([*words, "--until", "place"]) in COMPLETE
    assert reads == [], "nothing asks for it yet"
    assert main(list(words)) in COMPLETE
    assert reads == [tmp_path.name], "from the finished folder"
    assert unpacked
    unpacked.clear()
    once = (folder / "report.html").read_text()
    assert main([*words, "--force"]) in COMPLETE
    assert len(reads) == 2
    assert reads[1] != tmp_path.name, "from where it is made"
    assert not unpacked, "its points were set aside as they were written"
    data = [re.findall(r'id="cloud-data">[^<]*', page) for page in (once, (folder / "report.html").read_text())]
    assert data[0] == data[1]
    assert data[0]


@pytest.mark.parametrize(
    ("words", "done"),
    [
        (["--crs", "3009"], {"place", "quality", "products"}),
        # others of the same steps: that each setting is looked at by some step is said below without a run
        pytest.param(["--min-range", "5"], {"place", "quality", "products"}, marks=pytest.mark.soak),
        pytest.param(["--height", "relative"], {"trajectory", "place", "quality", "products"}, marks=pytest.mark.soak),
        pytest.param(["--pose-grid", "10ms"], {"trajectory", "place", "quality", "products"}, marks=pytest.mark.soak),
        (["--height", "ellipsoid", "--geoid", "30"], {"trajectory", "place", "quality", "products"}),
    ],
)
def test_a_setting_concerns_the_steps_that_look_at_it(
    log: Path, out: Path, words: list[str], done: set[str], capsys: pytest.CaptureFixture[str]
) -> None:
    said = status(capsys, log, *SOME, *words, "-o", out)
    assert process(log, out, *words) == done
    stale = steps_of(name for name, state in said.items() if state["state"] == "stale")
    assert stale >= done
    first = min(done, key=ORDER.index)
    assert any(words[0].strip("-").replace("-", "_") in reason for reason in said[first]["reasons"])


def test_the_window_concerns_the_trajectory_where_it_is_estimated_from_points() -> None:
    from groundproc.steps.request import Request
    from groundproc.survey import Survey

    step = next(step for step in steps() if step.name == "trajectory")
    for method in ("best", "adjusted", "dynamic"):
        assert "fov_deg" in step.settings(Request([], Survey(method=method)))
    assert "crs" not in step.settings(Request([], Survey()))
    assert "crs" in step.settings(Request([], Survey(control="points.csv")))
    assert "dynamic" not in step.settings(Request([], Survey()))


def test_every_setting_is_looked_at_by_some_step() -> None:
    """By the figures, where they all stand, and by one that makes something."""
    import dataclasses

    from groundproc.steps.request import Request
    from groundproc.survey import METHODS, Survey

    requests = [Request([], Survey(method=method, control="c.csv")) for method in METHODS]
    fields = {field.name for field in dataclasses.fields(Survey)}
    makers = [step for step in steps() if step.name != "quality"]
    quality = next(step for step in steps() if step.name == "quality")
    assert set(quality.settings(requests[0])) == fields
    looked_at = {name for step in makers for request in requests for name in step.settings(request)}
    assert looked_at == fields - {"products", "uses"}
    assert any("place: cloud.laz" in step.units(requests[0]) for step in makers)  # products are parts


def test_a_file_of_the_survey_counts_by_its_content(log: Path, out: Path, tmp_path: Path) -> None:
    mount = tmp_path / "mount.yaml"
    mount.write_text("lidar: {pitch_deg: -21}\n")
    assert process(log, out, "--mount", mount) == set(ORDER)
    moved = mount.rename(tmp_path / "other.yaml")
    assert process(log, out, "--mount", moved) == {"quality", "products"}  # where its name stands
    moved.write_text("lidar: {pitch_deg: -22}\n")
    assert process(log, out, "--mount", moved) >= {"trajectory", "place", "quality"}


def test_a_product_that_is_gone_is_made_again(log: Path, out: Path, made: Path) -> None:
    (out / "cloud.laz").unlink()
    assert units(log, out) == {"place: cloud.laz"}
    assert (out / "cloud.laz").read_bytes() == (made / "cloud.laz").read_bytes()


def test_products_are_made_one_by_one_and_go_when_they_are_not_asked_for(log: Path, out: Path, made: Path) -> None:
    before = (out / "cloud.laz").stat()
    assert steps_of(units(log, out, "--products", "cloud.laz")) == {"quality"}
    assert not (out / "density.tif").exists()
    assert steps_of(units(log, out, "--products", PICTURED)) == {"place", "quality", "products"}
    picture = (out / "cloud_height.png").read_bytes()
    assert steps_of(units(log, out)) == {"quality", "products"}
    assert names(out) == names(made)
    after = (out / "cloud.laz").stat()
    assert (after.st_ino, after.st_mtime_ns) == (before.st_ino, before.st_mtime_ns)  # neither made again nor touched
    assert steps_of(units(log, out, "--products", PICTURED)) == {"place", "quality", "products"}
    assert (out / "cloud_height.png").read_bytes() == picture


def test_until_stops_and_the_folder_goes_on_by_its_ledger(
    log: Path, tmp_path: Path, made: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert process(log, out, "--until", "trajectory") == {"clocks", "trajectory"}
    assert not (out / "cloud.laz").exists()
    assert re.search(r"^place +missing +not made yet$", capsys.readouterr().out, re.MULTILINE)
    assert main(["process", str(out)]) in COMPLETE
    assert names(out) == names(made)
    assert (out / "cloud.laz").read_bytes() == (made / "cloud.laz").read_bytes()
    # and options may be laid over what the ledger remembers
    assert main(["process", str(out), "--crs", "3009"]) in COMPLETE
    assert json.loads((out / "quality.json").read_text())["crs"]["epsg"] == 3009
    states = status(capsys, out)
    assert {state["state"] for state in states.values()} == {"done"}
    assert main(["process", str(tmp_path)]) == 2
    assert "no products" in capsys.readouterr().err


# What is refused ------------------------------------------------------------------------------------------------------


def refused(capsys: pytest.CaptureFixture[str], log: Path, folder: Path) -> str:
    """The sentence of a run that touches nothing."""
    content = {name: (folder / name).read_bytes() for name in names(folder)}
    capsys.readouterr()
    assert main(["process", str(log), *SOME, "-o", str(folder)]) == 2
    said = capsys.readouterr().err.strip()
    assert "\n" not in said
    assert "--force" in said
    assert {name: (folder / name).read_bytes() for name in names(folder)} == content
    return said


def test_a_folder_with_other_things_is_touched_with_force_only(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("years of work")
    assert "thesis.tex" in refused(capsys, log, tmp_path / "out")
    process(log, tmp_path / "out", "--force")
    assert (tmp_path / "out" / "thesis.tex").read_text() == "years of work"


def test_products_of_other_logs_are_replaced_with_force_only(
    log: Path, out: Path, still_flight: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert str(log) in refused(capsys, still_flight.log, out)
    assert process(still_flight.log, out, "--force") == set(ORDER)
    assert process(still_flight.log, out) == set()


def test_the_same_log_under_another_name_is_the_same(log: Path, out: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copy(log, tmp_path / "again.mcap"))
    assert process(copy, out) == set()


def test_a_product_that_somebody_changed_is_replaced_with_force_only(
    log: Path, out: Path, made: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (out / "cloud.laz").write_bytes(b"classified by hand")
    assert "cloud.laz" in refused(capsys, log, out)
    process(log, out, "--force")
    assert (out / "cloud.laz").read_bytes() == (made / "cloud.laz").read_bytes()


def test_a_file_in_the_place_of_a_product_is_replaced_with_force_only(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    process(log, out, "--until", "trajectory")
    (out / "cloud.laz").write_bytes(b"mine")
    capsys.readouterr()
    assert main(["process", str(out)]) == 2
    assert "--force" in capsys.readouterr().err
    assert (out / "cloud.laz").read_bytes() == b"mine"
    assert main(["process", str(out), "--force"]) in COMPLETE
    assert (out / "cloud.laz").read_bytes() != b"mine"


def test_a_folder_that_holds_only_what_is_read_is_no_stranger(log: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copy(log, tmp_path / "flight.mcap"))
    (tmp_path / "survey.yaml").write_text("method: ins\n")
    assert process(copy, tmp_path, "--config", tmp_path / "survey.yaml") == set(ORDER)
    assert copy.is_file()


# Interrupts -----------------------------------------------------------------------------------------------------------


HELD = """
import sys, time
from dataclasses import replace
from importlib import import_module
from groundproc.cli import main

module = import_module("groundproc.steps." + sys.argv[1])
work = module.STEP.work

def held(run, folders):
    work(run, folders)
    print("at work", flush=True)
    time.sleep(600)

module.STEP = replace(module.STEP, work=held)
sys.exit(main(sys.argv[2:]))
"""
"""`swath`, but for one step that has written all of its outputs and does not end: a signal finds it at work however slow the machine."""


def interrupted(log: Path, folder: Path, step: str, number: int) -> int:
    """Run `swath process` as a process of its own and send it a signal when a step is at work; its exit code."""
    words = ["process", str(log), *SOME, "-o", str(folder)]
    with subprocess.Popen([sys.executable, "-c", HELD, step, *words], stdout=subprocess.PIPE) as run:
        assert run.stdout is not None
        assert run.stdout.readline() == b"at work\n"
        assert list((folder / INSIDE).glob(f".{step}.*.part"))
        run.send_signal(number)
        return run.wait(timeout=PATIENCE_S)


STEPS = ("clocks", "trajectory", "place")
SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGKILL)


@pytest.mark.parametrize(
    ("step", "number"),
    [
        # every step and every signal once, and all of each with each where there is time
        pytest.param(step, number, marks=[] if SIGNALS.index(number) == STEPS.index(step) else pytest.mark.soak)
        for step, number in itertools.product(STEPS, SIGNALS)
    ],
)
def test_a_run_that_is_interrupted_goes_on_after_the_last_finished_step(
    log: Path, made: Path, tmp_path: Path, step: str, number: int
) -> None:
    out = tmp_path / "out"
    code = interrupted(log, out, step, number)
    assert code == (-signal.SIGKILL if number == signal.SIGKILL else 128 + number)
    whole = ORDER[: ORDER.index(step)]
    if number != signal.SIGKILL:
        # finished products and the ledger, and no temporary file; nothing at all where nothing was finished
        assert out.exists() == bool(whole)
        assert not [name for name in names(out) if name.endswith(".part")]
        assert not list(tmp_path.rglob(".*.part"))
    before = finished(out) if out.exists() and (out / INSIDE / "ledger.json").exists() else {}
    assert steps_of(before) == set(whole)
    assert process(log, out) == set(ORDER) - set(whole)
    assert before.items() <= finished(out).items()
    assert names(out) == names(made)
    assert (out / "cloud.laz").read_bytes() == (made / "cloud.laz").read_bytes()
    assert not list(out.rglob(".*.part"))


def test_an_interrupt_while_products_get_their_names_waits(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The signal comes in the middle of a commit; the step is finished, the next one does not begin."""
    from groundproc.steps.ledger import Ledger

    settle = Ledger.settle

    def disturbed(ledger: Ledger, step: str, staged: Path) -> None:
        if step == "trajectory":
            os.kill(os.getpid(), signal.SIGINT)
        settle(ledger, step, staged)

    monkeypatch.setattr(Ledger, "settle", disturbed)
    assert main(["process", str(log), *SOME, "-o", str(tmp_path / "out")]) == 130
    assert steps_of(finished(tmp_path / "out")) == {"clocks", "trajectory"}
    assert not list((tmp_path / "out").rglob(".*.part"))


def test_an_error_leaves_a_new_folder_empty_and_an_old_one_as_it_was(
    log: Path, out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A disk that fills up while points are placed."""
    import errno

    from groundproc.steps import place

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "cloud.laz")

    monkeypatch.setattr(place, "STEP", place.STEP.__class__(**{
        name: getattr(place.STEP, name) for name in place.STEP.__slots__} | {"work": full}))  # fmt: skip
    assert main(["process", str(log), *SOME, "-o", str(tmp_path / "new")]) == 1
    assert "No space left" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
    before = {name: (out / name).read_bytes() for name in names(out) if INSIDE not in name}
    assert main(["process", str(log), *SOME, "--crs", "3009", "-o", str(out)]) == 1
    assert {name: (out / name).read_bytes() for name in names(out) if INSIDE not in name} == before
    monkeypatch.undo()
    assert process(log, out) <= {"quality", "products"}
