"""Compiled kernels are kept where the user may write, apart for every state of the sources that each is made from."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from groundproc.machine import kernelcache

KERNELS = """from numba import njit

from groundproc.grid import STEP
from groundproc.words import HELP
from groundproc.rooms import arrays

@njit(cache=True)
def doubled(x):
    return 2.0 * x * STEP
"""
FILES = {
    "groundproc/__init__.py": "",
    "groundproc/kernels.py": KERNELS,
    "groundproc/grid.py": "from groundproc.cell import CELL\n\nSTEP = CELL\n",
    "groundproc/cell.py": "CELL = 1.0\n",
    "groundproc/words.py": "help = 'a word'\n",
    "groundproc/rooms/__init__.py": "",
    "groundproc/rooms/arrays.py": "from typing import NamedTuple\n",
    "groundproc/others.py": KERNELS.replace("from groundproc.grid import STEP", "STEP = 1.0"),
}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        path = tmp_path / "sources" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text.replace("import HELP", "import help"))
    return tmp_path / "sources" / "groundproc"


def stamps(root: Path) -> tuple[str, str]:
    """Of the two files with kernels, read anew."""
    kernelcache.stamp.cache_clear()
    kernelcache._content.cache_clear()
    return kernelcache.stamp(root / "kernels.py"), kernelcache.stamp(root / "others.py")


@pytest.mark.parametrize("name", ["kernels.py", "grid.py", "cell.py", "rooms/arrays.py"])
def test_a_kernel_is_another_when_anything_that_it_holds_is(root: Path, name: str) -> None:
    before = stamps(root)
    with (root / name).open("a") as file:
        file.write("# changed\n")
    after = stamps(root)
    assert after[0] != before[0]
    assert (after[1] != before[1]) == (name == "rooms/arrays.py"), "the other holds no constant of the grid"


def test_a_kernel_stays_when_what_changes_is_not_compiled_in(root: Path) -> None:
    before = stamps(root)
    (root / "words.py").write_text("help = 'another'\n")
    assert stamps(root) == before


def test_kernels_of_this_version_know_what_they_hold() -> None:
    """Gravity is compiled into the odometry, and stands in another package."""
    top = Path(kernelcache.__file__).parents[1]
    found = kernelcache.sources(top / "estimation" / "odometry" / "matching.py")
    for name in ("estimation/odometry/state.py", "numerics/rotations.py", "../flightlog/constants.py"):
        assert (top / name).resolve() in found
    assert top / "raster" / "cells.py" not in found


def printed(code: str, **environment: str) -> str:
    """By a new process."""
    kept = {name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    done = subprocess.run(
        [sys.executable, "-c", code], env=kept | environment, check=True, capture_output=True, text=True
    )
    return done.stdout.strip()


FOLDER = "from groundproc.machine import kernelcache; print(kernelcache.folder())"


def test_the_cache_is_the_users_and_another_place_may_be_said(tmp_path: Path) -> None:
    assert printed(FOLDER, XDG_CACHE_HOME=str(tmp_path)) == str(tmp_path / "swath")
    assert printed(FOLDER, HOME=str(tmp_path)) == str(tmp_path / ".cache" / "swath")
    assert printed(FOLDER, NUMBA_CACHE_DIR=str(tmp_path / "there")) == str(tmp_path / "there")


def test_where_the_user_has_no_folder_kernels_are_kept_for_the_process_alone(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    folder = Path(printed(FOLDER, XDG_CACHE_HOME=str(tmp_path / "file"), TMPDIR=str(tmp_path)))
    assert folder.parent == tmp_path
    assert not folder.exists(), "it goes with the process"


def test_kernels_that_are_not_used_go_when_they_are_old(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 1_700_000_000.0
    for name, age_s in (("kernels-old-1", kernelcache.KEPT_S + 1), ("kernels-new-1", 10), ("own", 1e9)):
        (tmp_path / name).mkdir()
        os.utime(tmp_path / name, (now_s - age_s, now_s - age_s))
    monkeypatch.setattr(kernelcache, "folder", lambda: tmp_path)
    kernelcache.remove_old(now_s)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["kernels-new-1", "own"]


def test_processes_that_compile_one_kernel_for_different_arrays_at_once_do_not_mix_them(tmp_path: Path) -> None:
    """Each would take the first free number of the index for its own code; here all look at the index before one has written."""
    (tmp_path / "groundproc_kernel.py").write_text(
        "from numba import njit\n\n\n@njit(cache=True)\ndef size(x):\n    return x.itemsize\n"
    )
    kinds = ["float64", "float32", "int16", "int8"]
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
        "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path]),
    }
    code = (
        "import sys, pathlib, time, groundproc, numpy as np\n"
        "from numba.core.caching import IndexDataCacheFile as Index\n"
        "from groundproc_kernel import size\n"
        "load = Index._load_index\n"
        "Index._load_index = lambda index: (load(index), time.sleep(0.3))[0]\n"
        "pathlib.Path(sys.argv[2]).touch()\n"
        f"while len(list(pathlib.Path({str(tmp_path)!r}).glob('*.ready'))) < {len(kinds)}: time.sleep(0.001)\n"
        "print(size(np.zeros(1, sys.argv[1])))\n"
    )
    running = [
        subprocess.Popen([sys.executable, "-c", code, kind, str(tmp_path / f"{kind}.ready")], env=environment)
        for kind in kinds
    ]
    assert [process.wait() for process in running] == [0] * len(kinds)
    code = (
        "import groundproc, numpy as np\n"
        "from groundproc_kernel import size\n"
        f"print([size(np.zeros(1, kind)) for kind in {kinds!r}], sum(size.stats.cache_hits.values()))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], env=environment, check=True, capture_output=True, text=True)
    assert done.stdout.strip() == f"{[np.dtype(kind).itemsize for kind in kinds]} {len(kinds)}"


@pytest.mark.parametrize(("given", "taken"), [(None, kernelcache.OPTIMISES), ("0", "0")])
def test_how_far_kernels_are_optimised_is_the_users_to_say(
    monkeypatch: pytest.MonkeyPatch, given: str | None, taken: str
) -> None:
    monkeypatch.delenv(kernelcache.OPTIMISES_VARIABLE, raising=False)
    if given is not None:
        monkeypatch.setenv(kernelcache.OPTIMISES_VARIABLE, given)
    line = "import groundproc; from numba import config; print(int(config.OPT))"
    done = subprocess.run([sys.executable, "-c", line], capture_output=True, text=True, check=True)
    assert done.stdout.split() == [taken]
