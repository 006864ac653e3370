"""Compiled kernels are kept where the user may write, apart for every state of the sources."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from groundproc import kernelcache

KERNELS = """from numba import njit

from groundproc.grid import STEP

@njit(cache=True)
def doubled(x):
    return 2.0 * x * STEP
"""


@pytest.fixture
def sources(tmp_path: Path) -> Path:
    root = tmp_path / "sources"
    for name, text in (
        ("groundproc/__init__.py", ""),
        ("groundproc/kernels.py", KERNELS),
        ("groundproc/grid.py", "STEP = 1.0\n"),
        ("groundproc/words.py", "HELP = 'a word'\n"),
        ("flightlog/__init__.py", ""),
    ):
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


def test_kernels_and_the_constants_that_they_hold_make_the_hash_and_nothing_else(sources: Path) -> None:
    before = kernelcache.source_hash(sources)
    (sources / "groundproc" / "words.py").write_text("HELP = 'another'\n")
    assert kernelcache.source_hash(sources) == before
    (sources / "groundproc" / "grid.py").write_text("STEP = 2.0\n")
    after = kernelcache.source_hash(sources)
    assert after != before
    (sources / "groundproc" / "kernels.py").write_text(KERNELS.replace("2.0", "3.0"))
    assert kernelcache.source_hash(sources) not in (before, after)


def test_the_kernels_of_this_version_are_hashed_with_their_constants() -> None:
    """Gravity is compiled into the odometry, and stands in another package."""
    root = Path(kernelcache.__file__).parent.parent
    found = dict(kernelcache.sources(root))
    for name in (
        "groundproc/estimation/odometry/state.py",
        "groundproc/numerics/rotations.py",
        "flightlog/constants.py",
    ):
        assert root / name in found


def chosen(**environment: str) -> str:
    """What a new process chooses."""
    kept = {name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    code = "import os, groundproc; print(os.environ['NUMBA_CACHE_DIR'])"
    done = subprocess.run(
        [sys.executable, "-c", code], env=kept | environment, check=True, capture_output=True, text=True
    )
    return done.stdout.strip()


def test_the_cache_is_the_users_and_another_place_may_be_said(tmp_path: Path) -> None:
    name = "kernels-" + kernelcache.source_hash(Path(kernelcache.__file__).parent.parent)
    assert chosen(XDG_CACHE_HOME=str(tmp_path)) == str(tmp_path / "swath" / name)
    assert chosen(HOME=str(tmp_path)) == str(tmp_path / ".cache" / "swath" / name)
    assert chosen(NUMBA_CACHE_DIR="/somewhere") == "/somewhere"
    # that of the program that started this one, perhaps of another version
    inherited = str(tmp_path / "swath" / "kernels-0123456789abcdef")
    assert chosen(XDG_CACHE_HOME=str(tmp_path), NUMBA_CACHE_DIR=inherited) == str(tmp_path / "swath" / name)


def test_where_the_user_has_no_folder_kernels_are_kept_for_the_process_alone(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    folder = Path(chosen(XDG_CACHE_HOME=str(tmp_path / "file"), TMPDIR=str(tmp_path)))
    assert folder.parent.parent == tmp_path
    assert not folder.parent.exists(), "it goes with the process"


def test_caches_of_other_sources_go_when_they_are_old(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 1_700_000_000.0
    for name, age_s in (
        ("kernels-now", 1e9),
        ("kernels-old", kernelcache.KEPT_S + 1),
        ("kernels-new", 10),
        ("own", 1e9),
    ):
        (tmp_path / name).mkdir()
        os.utime(tmp_path / name, (now_s - age_s, now_s - age_s))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels-now"))
    kernelcache.remove_old(now_s)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["kernels-new", "kernels-now", "own"]
