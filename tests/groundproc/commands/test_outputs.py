"""What a command writes: of the right name, not over what is there without --force, in folders that are made where they are missing."""

import shutil
from pathlib import Path

import pytest

from flightlog.errors import SourceError, UsageError
from groundproc.cli import main
from groundproc.commands.outputs import claim_file, claim_folder
from groundproc.field.madeup import write_flight
from groundproc.files import made_folder, written_aside

MCAP = b"\x89MCAP0\r\n"
TRIMS = "utc_ns,heading_deg,yaw_deg\n" + "".join(f"{i}000000000,{i * 7 % 360},{i % 5 / 10}\n" for i in range(400))
FILES: dict[str, tuple[list[str], str, str]] = {
    "decode": (["decode", "l.mcap", "-o"], "scan.laz", "scan.txt"),
    "init": (["init", "l.mcap", "-o"], "survey.yaml", "survey.mcap"),
    "recover": (["recover", "l.mcap", "-o"], "whole.mcap", "whole"),
    "import": (["import", "--pcap", "a.pcap", "-o"], "flight.mcap", "flight.bag"),
    "compass": (["compass", "trims.csv", "-o"], "compass.yaml", "compass.csv"),
    "ppk": (["ppk", "a.obs", "--base", "b.obs", "-o"], "out.pos", "out.txt"),
}
"""Commands that write one file: a right name and a wrong one."""
FOLDERS: dict[str, tuple[list[str], str]] = {
    "calibrate": (["calibrate", "l.mcap", "-o"], "mount.yaml"),
    "calibrate --lasers": (["calibrate", "l.mcap", "--lasers", "-o"], "lasers.yaml"),
    "adjust": (["adjust", "a.las", "-t", "trajectory.csv", "-o"], "adjustment.json"),
    "adjust, a cloud": (["adjust", "a.las", "-t", "trajectory.csv", "-o"], "a.laz"),
    "live": (["live", "--port", "0", "-o"], "cloud_live.laz"),
    "simulate": (["simulate", "--duration", "1", "-o"], "flight.mcap"),
}
"""Commands that write into a folder: a file that they would write."""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Inputs, and the working directory."""
    for name, content in (("l.mcap", MCAP), ("a.pcap", b"\xd4\xc3\xb2\xa1" + bytes(20)), ("a.las", b"LASF" + bytes(9))):
        (tmp_path / name).write_bytes(content)
    rinex = "     3.04           OBSERVATION DATA    M                   RINEX VERSION / TYPE\n"
    for name, text in (("a.obs", rinex), ("b.obs", rinex), ("trims.csv", TRIMS), ("trajectory.csv", "utc_ns,a\n1,2\n")):
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("command", FILES)
def test_a_name_of_another_kind_is_refused(folder: Path, command: str, capsys: pytest.CaptureFixture[str]) -> None:
    words, right, wrong = FILES[command]
    assert main([*words, wrong]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"swath: {wrong}: ends in ")
    assert Path(right).suffix in said
    assert said.count("\n") == 1
    assert main([*words, str(folder)]) == 2
    assert "is a folder" in capsys.readouterr().err
    assert not (folder / wrong).exists()


@pytest.mark.parametrize("command", FILES)
def test_a_file_that_is_there_stays(folder: Path, command: str, capsys: pytest.CaptureFixture[str]) -> None:
    words, right, _ = FILES[command]
    (folder / right).write_text("of great value\n")
    assert main([*words, right]) == 2
    assert capsys.readouterr().err == (
        f"swath: {right}: exists already; give another name, or --force to write over it\n"
    )
    assert (folder / right).read_text() == "of great value\n"


@pytest.mark.parametrize("command", FOLDERS)
def test_a_file_within_the_folder_stays_too(folder: Path, command: str, capsys: pytest.CaptureFixture[str]) -> None:
    words, name = FOLDERS[command]
    (folder / "out").mkdir()
    (folder / "out" / name).write_text("of great value\n")
    assert main([*words, "out"]) == 2
    said = capsys.readouterr().err
    assert said == f"swath: out/{name}: exists already; give another name, or --force to write over it\n"
    assert (folder / "out" / name).read_text() == "of great value\n"


def test_every_command_that_writes_takes_force(capsys: pytest.CaptureFixture[str]) -> None:
    for command in {words[0] for words, *_ in (*FILES.values(), *FOLDERS.values())} | {"process"}:
        with pytest.raises(SystemExit):
            main([command, "--help"])
        assert "--force" in capsys.readouterr().out, command


def test_with_force_it_is_written_over_and_folders_that_are_missing_are_made(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_flight(folder / "l.mcap", 4.0)
    for words, name in (
        (["decode", "l.mcap", "-o"], "scan.laz"),
        (["recover", "l.mcap", "-o"], "whole.mcap"),
        (["init", "l.mcap", "-o"], "survey.yaml"),
    ):
        path = folder / words[0] / "deep" / name
        assert main([*words, str(path)]) == 0, capsys.readouterr().err
        made = path.read_bytes()
        path.write_text("old\n")
        assert main([*words, str(path)]) == 2
        assert main([*words, str(path), "--force"]) == 0
        assert len(path.read_bytes()) == len(made)


def test_a_log_is_never_recovered_onto_itself(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copy(folder / "l.mcap", folder / "b.mcap")
    assert main(["recover", "b.mcap", "-o", "../" + folder.name + "/b.mcap", "--force"]) == 2
    assert "is an input" in capsys.readouterr().err
    assert (folder / "b.mcap").read_bytes() == MCAP


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["live", "-o", "out", "--link", "fc"], "--link fc given, but nothing uses it"),
        (["live", "-o", "out", "--follow", "l.mcap", "--lidar-port", "2369"], "--lidar-port 2369 given"),
        (["live", "-o", "out", "--follow", "l.mcap", "--mavlink", "udp:0.0.0.0:1"], "--follow reads a log"),
        (["live", "-o", "out", "--baud", "9600"], "--baud 9600 given, but nothing uses it"),
        (["replay", "l.mcap", "--link", "fc"], "--link fc given, but nothing uses it without --mavlink"),
        (["simulate", "-o", "out", "--duration", "1", "--pty-link", "p"], "nothing uses it without --live"),
    ],
)
def test_an_option_that_nothing_uses_is_refused(
    folder: Path, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    assert said in capsys.readouterr().err
    assert not (folder / "out").exists()


def test_what_fails_leaves_no_folders(tmp_path: Path) -> None:
    def half() -> None:
        with written_aside(tmp_path / "a" / "b" / "c.laz") as aside:
            aside.write_text("half")
            raise SourceError(f"{aside}: full")

    with pytest.raises(SourceError, match="full"):
        half()
    with pytest.raises(KeyError), made_folder(tmp_path / "a" / "b"):
        raise KeyError
    assert list(tmp_path.iterdir()) == []


def test_an_error_names_the_file_that_was_asked_for_and_not_the_one_beside_it(tmp_path: Path) -> None:
    with pytest.raises(SourceError) as caught, written_aside(tmp_path / "c.laz") as aside:
        raise SourceError(f"{aside}: cannot be written")
    assert str(caught.value) == f"{tmp_path / 'c.laz'}: cannot be written"


def test_upper_case_endings_are_as_good(tmp_path: Path) -> None:
    claim_file(tmp_path / "SCAN.LAZ", (".laz",), force=False)


def test_a_folder_may_not_be_a_file(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    with pytest.raises(UsageError, match="is a file, expected a folder"):
        claim_folder(tmp_path / "out", (), force=True)
