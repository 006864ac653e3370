"""The first `swath process` after `swath warmup` compiles nothing."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from groundproc.cli import main
from groundproc.progress import compiling

SWATH = [sys.executable, "-c", "import sys; from groundproc.cli import main; sys.exit(main(sys.argv[1:]))"]


@pytest.fixture(scope="module")
def flight(live_flight: Any) -> Any:
    return live_flight


# a warm-up, and a whole flight by the default method
@pytest.mark.soak
def test_a_flight_after_warming_up_compiles_nothing(
    tmp_path: Path, flight: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    compiled: list[bool] = []
    assert main(["warmup"]) == 0
    assert "kept in" in capsys.readouterr().out
    with compiling(compiled.append):
        assert main(["process", str(flight.log), "-o", str(tmp_path / "out"), "--json"]) == 0
    assert compiled == []


# everything is compiled anew
@pytest.mark.soak
def test_a_new_process_finds_all_of_it_in_the_users_cache(tmp_path: Path, flight: Any) -> None:
    """From an empty cache: the files of compiled code after a warm-up, and after a flight that was processed then, are the same."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    environment.pop("NUMBA_CACHE_DIR", None)
    subprocess.run([*SWATH, "warmup"], check=True, env=environment, capture_output=True)
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").rglob("*.nbc")}
    words = ["process", str(flight.log), "-o", str(tmp_path / "out")]
    subprocess.run([*SWATH, *words], check=True, env=environment, capture_output=True)
    assert len(before) > 30
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").rglob("*.nbc")} == before
