"""`swath completion`: what the shells themselves make of the scripts."""

import shutil
import subprocess
from pathlib import Path

import pytest

from groundproc.cli import commands, main


@pytest.fixture
def script(capsys: pytest.CaptureFixture[str], request: pytest.FixtureRequest) -> str:
    assert main(["completion", request.param]) == 0
    return capsys.readouterr().out


def completed(script: str, *words: str) -> set[str]:
    """What bash offers for the last of some words."""
    line = " ".join(f"'{word}'" for word in ("swath", *words))
    code = f'{script}\nCOMP_WORDS=({line}); COMP_CWORD={len(words)}; _swath; printf "%s\\n" "${{COMPREPLY[@]}}"'
    run = subprocess.run(["bash", "--norc", "-c", code], capture_output=True, text=True, check=True)
    return set(run.stdout.split())


@pytest.mark.parametrize("script", ["bash"], indirect=True)
def test_bash_completes_commands_options_and_their_values(script: str, tmp_path: Path) -> None:
    assert completed(script, "") >= set(commands())
    assert completed(script, "pro") == {"process", "profile"}
    assert completed(script, "process", "--he") == {"--help", "--height"}
    assert completed(script, "process", "x.mcap", "--height", "") == {"msl", "ellipsoid", "relative"}
    assert completed(script, "process", "--until", "pl") == {"place"}
    assert completed(script, "completion", "f") == {"fish"}
    assert completed(script, "process", f"{tmp_path}/nothing") == set()


@pytest.mark.parametrize("script", ["bash"], indirect=True)
def test_bash_completes_files_where_a_file_is_expected(script: str, tmp_path: Path) -> None:
    (tmp_path / "flight.mcap").touch()
    assert completed(script, "process", f"{tmp_path}/fl") == {f"{tmp_path}/flight.mcap"}
    assert completed(script, "process", "--mount", f"{tmp_path}/fl") == {f"{tmp_path}/flight.mcap"}


@pytest.mark.parametrize("script", ["zsh", "fish"], indirect=True)
def test_the_other_shells_take_their_scripts(script: str, request: pytest.FixtureRequest) -> None:
    shell = request.node.callspec.params["script"]
    for name in commands():
        assert name in script
    assert "ellipsoid" in script
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed: its script was looked at only")
    subprocess.run([shell, "-n", "-c", script], check=True, capture_output=True)
