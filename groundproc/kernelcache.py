"""Where compiled kernels are kept: the user's cache folder, apart for every state of the sources that they are made from.

numba looks for a changed source in the file of the kernel alone. What it calls or takes a constant from in other files it
has compiled in, and does not look at again: after an update of one file of two, old machine code would go on running. And beside the
sources, where it keeps its cache by default, nobody may write in a proper installation.
"""

import contextlib
import hashlib
import os
import re
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Final

VARIABLE: Final = "NUMBA_CACHE_DIR"
KEPT_S: Final = 30 * 86400
"""Caches of other sources that were not used for so long are removed."""
_PREFIX: Final = "kernels-"
_PACKAGES: Final = ("groundproc", "flightlog")
_IMPORT: Final = re.compile(rb"^from ((?:groundproc|flightlog)[\w.]*) import (?:\(([^)]*)\)|(.*))$", re.MULTILINE)


def choose() -> None:
    """Have numba keep its cache there, unless the user has said where; to be called before the first kernel is declared."""
    given = os.environ.get(VARIABLE)
    if given and not _is_ours(Path(given)):
        return
    chosen = str(_made(_user_folder() / f"{_PREFIX}{source_hash(Path(__file__).parent.parent)}"))
    os.environ[VARIABLE] = chosen
    loaded = sys.modules.get("numba")
    if loaded is not None:
        loaded.config.CACHE_DIR = chosen


def folder() -> Path:
    """The folder in use."""
    return Path(os.environ[VARIABLE])


def sources(root: Path) -> dict[Path, bytes]:
    """All sources that kernels are made from: files that declare some, and those that constants of theirs come from.

    Parameters
    ----------
    root : Path
        Folder of the packages.
    """
    found: dict[Path, bytes] = {}
    for package in _PACKAGES:
        for path in (root / package).rglob("*.py"):
            content = path.read_bytes()
            if b"njit" in content and path.name != Path(__file__).name:
                found[path] = content
    for content in list(found.values()):
        for module, several, one in _IMPORT.findall(content):
            if any(name.isupper() for name in re.findall(rb"\w+", several or one)):
                path = root.joinpath(*module.decode().split(".")).with_suffix(".py")
                if path.is_file():
                    found[path] = path.read_bytes()
    return found


def source_hash(root: Path) -> str:
    """Hash of what `sources` finds."""
    digest = hashlib.sha256()
    for path, content in sorted(sources(root).items()):
        digest.update(f"{path.relative_to(root)} {len(content)}\n".encode() + content)
    return digest.hexdigest()[:16]


def remove_old(now_s: float) -> None:
    """Remove caches of other sources that nobody has used for a long time."""
    if not _is_ours(folder()):
        return
    for other in folder().parent.glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):
            if other != folder() and other.stat().st_mtime < now_s - KEPT_S:
                shutil.rmtree(other)


def _user_folder() -> Path:
    """The user's folder for caches, by the XDG base directory specification."""
    given = Path(os.environ.get("XDG_CACHE_HOME", ""))
    with contextlib.suppress(RuntimeError):  # a user without a home
        return (given if given.is_absolute() else Path("~/.cache").expanduser()) / "swath"
    return Path("/nonexistent")


def _is_ours(path: Path) -> bool:
    return path.name.startswith(_PREFIX)


def _made(path: Path) -> Path:
    """The folder, there and writable; where that cannot be, one for this process alone."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        os.utime(path)
        if os.access(path, os.W_OK | os.X_OK):
            return path
    except OSError:
        pass
    import atexit

    own = tempfile.mkdtemp(prefix=f"swath-{_PREFIX}")
    atexit.register(shutil.rmtree, own, ignore_errors=True)
    return Path(own) / f"{_PREFIX}once"
