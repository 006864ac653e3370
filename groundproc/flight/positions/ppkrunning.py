"""RTKLIB's programs side by side, and what they say meanwhile."""

import contextlib
import os
import re
import shutil
import subprocess
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from flightlog.errors import SourceError
from groundproc.flight.positions.ppkoptions import PpkError

SOLVER: Final = "rnx2rtkp"
_PROCESSING: Final = re.compile(rb"processing : (\d{4})/(\d\d)/(\d\d) (\d\d):(\d\d):(\d\d)")
_MESSAGE: Final = re.compile(rb"(?:error|warning)[^\r\n]*", re.IGNORECASE)


def tool(name: str) -> str:
    """Where a program of RTKLIB is.

    Raises
    ------
    SourceError
        It is not installed.
    """
    found = shutil.which(name)
    if found is None:
        raise SourceError(f"{name}: is not installed here; apt install rtklib brings it")
    return found


def run(commands: Sequence[Sequence[str]], folder: Path, share: Callable[[int, int], None] | None) -> list[str]:
    """Run programs side by side in a folder; gives the last complaint of each.

    Raises
    ------
    PpkError
        One ends with an error.
    """
    environment = os.environ | {"LC_ALL": "C"}
    with contextlib.ExitStack() as stack:
        running = []
        for words in commands:
            process = subprocess.Popen(
                words,
                cwd=folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
            )
            stack.enter_context(process)
            stack.callback(process.kill)  # does nothing to one that has ended
            running.append(process)
        messages = [""] * len(running)

        def listen(number: int) -> None:
            for message in _words(running[number]):
                at = _PROCESSING.search(message)
                if at is not None and share is not None:
                    share(number, _calendar_ns(at))
                elif _MESSAGE.search(message):
                    messages[number] = message.decode("ascii", errors="replace").strip()

        threads = [threading.Thread(target=listen, args=(number,)) for number in range(len(running))]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        for process, words, message in zip(running, commands, messages, strict=True):
            if process.wait() != 0:
                raise PpkError(
                    f"{Path(words[0]).name}: ended with {process.returncode} ({message or 'it does not say why'})"
                )
    return messages


def _words(process: subprocess.Popen[bytes]) -> Iterator[bytes]:
    """What a program shows on its standard error: pieces that end with a carriage return or a line end."""
    assert process.stderr is not None
    rest = b""
    while chunk := os.read(process.stderr.fileno(), 1 << 16):
        *pieces, rest = re.split(rb"[\r\n]", rest + chunk)
        # of many at once, the last that names an epoch is enough
        yield from (piece for piece in pieces if piece.strip())
    if rest.strip():
        yield rest


def _calendar_ns(found: re.Match[bytes]) -> int:
    year, month, day, hour, minute, second = (int(word) for word in found.groups())
    return int(
        np.datetime64(f"{year:04d}-{month:02d}-{day:02d}T{hour:02d}:{minute:02d}:{second:02d}", "ns").astype(np.int64)
    )
