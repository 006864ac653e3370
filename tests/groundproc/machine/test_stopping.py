"""Signals that end a command: heard through native code too, and nothing half-written stays behind."""

import io
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import laspy
import lazrs
import numpy as np
import pytest

from flightlog.errors import SourceError
from groundproc.cloud.storing import storing
from groundproc.machine.stopping import Stopped, stoppable


class Writing(io.BytesIO):
    """A file at whose first write something happens."""

    def __init__(self, happens: Any) -> None:
        super().__init__()
        self._happens = happens

    def write(self, data: Any) -> int:
        happens, self._happens = self._happens, lambda: None
        happens()
        return super().write(data)


def pack(file: Writing) -> None:
    """Points packed by native code, which writes by calling back."""
    packer = lazrs.LazVlr.new_for_compression(6, 0)
    compressor = lazrs.LasZipCompressor(file, packer)
    compressor.compress_many(np.zeros(30 * 100_000, np.uint8))
    compressor.done()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_while_native_code_writes_is_no_failed_write(tmp_path: Path, number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with pytest.raises(Stopped) as stopped, stoppable(), storing(tmp_path / "c.laz"):
        pack(Writing(lambda: os.kill(os.getpid(), number)))
    assert stopped.value.number == number
    assert signal.getsignal(number) is before


def test_a_failed_write_is_one_still(tmp_path: Path) -> None:
    def fail() -> None:
        raise OSError("no")

    with pytest.raises(SourceError, match=r"c\.laz: cannot be written"), stoppable(), storing(tmp_path / "c.laz"):
        pack(Writing(fail))


@pytest.mark.skipif(not hasattr(signal, "SIGXCPU"), reason="this system limits no process's time")
def test_a_process_whose_time_is_used_up_says_so_and_leaves_nothing(tmp_path: Path) -> None:
    las = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    las.x, las.y, las.z = np.random.default_rng(1).uniform(0, 90, (3, 200_000))
    (tmp_path / "in").mkdir()
    las.write(tmp_path / "in" / "c.laz")
    (tmp_path / "out").mkdir()
    code = (
        "import os, signal, sys; from groundproc.analysis import ground; from groundproc.cli import main\n"
        "survey = ground._Area.survey\n"
        "def used_up(area):\n    survey(area); os.kill(os.getpid(), signal.SIGXCPU)\n"
        "ground._Area.survey = used_up\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    words = ["ground", str(tmp_path / "in" / "c.laz"), "-o", str(tmp_path / "out" / "g.laz")]
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 128 + signal.SIGXCPU, done.stderr
    assert done.stderr.startswith("swath: the processor's time")
    assert done.stderr.count("\n") == 1
    assert list((tmp_path / "out").iterdir()) == []
