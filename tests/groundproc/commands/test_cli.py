import subprocess
import sys
from pathlib import Path

import pytest

from groundproc import cli
from groundproc.cli import commands, main

BIN = Path(sys.executable).parent


def test_all_commands_of_the_package_are_found() -> None:
    assert {"import", "info", "decode", "process", "simulate"} <= set(commands())


def test_help_names_every_command_and_loads_no_numpy() -> None:
    code = """if True:
        import sys
        from groundproc.cli import main
        try:
            main(["import", "--help"])
        except SystemExit:
            print("numpy" in sys.modules)
    """
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.splitlines()[-1] == "False"
    run = subprocess.run([BIN / "swath", "--help"], capture_output=True, text=True, check=True)
    for name in commands():
        assert f"\n  {name} " in run.stdout


def test_version_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("swath ")


@pytest.mark.parametrize("words", [["imports"], ["import"], ["info", "--nonsense", "x"]])
def test_a_wrong_command_line_ends_with_2(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize(("given", "frozen"), [("", True), ('["--version"]', False)])
def test_the_collector_has_nothing_to_look_through_at_the_program_s_end(given: str, frozen: bool) -> None:
    """Another program that calls this one ends as it likes."""
    code = f"""if True:
        import atexit, gc, sys
        from groundproc.cli import main
        atexit.register(lambda: print(len(gc.get_objects()) < gc.get_freeze_count() > 10_000))  # after what comes later
        sys.argv[1:] = ["--version"]
        main({given})
        assert gc.get_freeze_count() == 0
    """
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.splitlines()[-1] == str(frozen)


def test_no_command_shows_the_help_and_ends_with_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert "import" in capsys.readouterr().err


def test_a_missing_log_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(tmp_path / "none.mcap")]) == 1
    error = capsys.readouterr().err
    assert error.startswith("swath: ")
    assert error.count("\n") == 1
    assert "none.mcap" in error


def test_a_reader_that_goes_away_leaves_no_traceback(monterey_log: Path) -> None:
    with subprocess.Popen(
        [BIN / "swath", "info", str(monterey_log)], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as run:
        assert run.stdout is not None
        assert run.stderr is not None
        run.stdout.close()
        assert run.stderr.read() == b""
        assert run.wait() == 141


def test_ctrl_c_ends_with_130(monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(_: list[str]) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr("groundproc.cli._dispatch", stop)
    assert main(["info"]) == 130


def test_a_library_that_is_not_installed_is_one_sentence_and_a_mistake_of_ours_is_not(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def without(name: str) -> None:
        def dispatch(_: list[str]) -> int:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

        monkeypatch.setattr(cli, "_dispatch", dispatch)

    without("embreex.rtcore")
    assert cli.main(["simulate"]) == 1
    assert "embreex.rtcore is not installed" in capsys.readouterr().err
    without("groundproc.nothing")
    with pytest.raises(ModuleNotFoundError):
        cli.main(["info"])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["proces", "a.mcap"], "did you mean process?"),
        (["process", "--metod", "ins", "a.mcap"], "did you mean --method?"),
        (["process", "a.mcap", "-o", "out", "--height", "mls"], "did you mean msl?"),
        (["process"], "the following arguments are required: LOG"),
        (["decode", "a.mcap"], "the following arguments are required: -o/--output"),
        (["-x"], "unrecognized arguments: -x"),
    ],
)
def test_a_slip_of_the_finger_is_one_sentence_with_what_was_meant(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        main(words)
    assert caught.value.code == 2
    text = capsys.readouterr().err
    assert said in text
    assert "--help` lists all" in text
    assert text.count("\n") == 1


def test_help_may_be_asked_for_by_its_name(capsys: pytest.CaptureFixture[str]) -> None:
    for words, said in ((["help"], "commands (swath COMMAND"), (["help", "decode"], "usage: swath decode")):
        with pytest.raises(SystemExit) as caught:
            main(words)
        assert caught.value.code == 0
        assert said in capsys.readouterr().out


def test_a_word_with_a_zero_byte_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", "a\0b.mcap"]) == 2
    assert capsys.readouterr().err == "swath: 'a\\x00b.mcap' found, expected words without zero bytes\n"
