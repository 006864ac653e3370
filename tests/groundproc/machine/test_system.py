"""What systems do differently, and what is installed beside us."""

import os
import platform
import subprocess
import sys

import pytest

from groundproc.machine.system import without


def test_what_is_hidden_cannot_be_imported_and_can_afterwards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "wave", raising=False)
    with without("wave"), pytest.raises(ImportError):
        import wave
    import wave

    with without("wave"):  # what is loaded already stays
        assert sys.modules["wave"] is wave


def test_the_steps_of_a_flight_load_no_data_frames_no_cloud_services_and_no_images() -> None:
    """A second of each run, and 60 MB beside the estimation."""
    program = (
        "import sys; import groundproc.steps.process; from groundproc.steps.step import steps; from groundproc.products import chosen;"
        "steps(); chosen(None); unused = {'pandas', 'boto3', 'cv2', 'matplotlib', 'requests', 'scipy.signal', 'scipy.stats'};"
        "print(*((unused | {'groundproc.imagery'}) & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize(("given", "expected"), [(None, "1"), ("3", "3")])
def test_linear_algebra_takes_one_thread_unless_it_is_told_otherwise(given: str | None, expected: str) -> None:
    """Said before numpy is loaded, by the package itself."""
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    if given is not None:
        environment["OPENBLAS_NUM_THREADS"] = given
    program = "import sys, groundproc, os; assert 'numpy' not in sys.modules; print(os.environ['OPENBLAS_NUM_THREADS'])"
    told = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert told.stdout.split() == [expected]


RESIDENT = """
import contextlib, sys
import numpy as np
from groundproc.machine.system import large_blocks_given_back

def resident_mb():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096 / 1e6

np.ones(3_500_000)  # glibc takes all that is smaller from its heap from now on
with large_blocks_given_back() if sys.argv[1] == "given back" else contextlib.nullcontext():
    before = resident_mb()
    blocks = [np.ones(1_000_000) for _ in range(20)]
    kept = blocks[-1]
    del blocks
    print(resident_mb() - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries hold what is free in other ways")
def test_large_blocks_go_back_to_the_system_when_they_are_freed() -> None:
    """Twenty of 8 MB, the last of which stays: what lies below it in the heap would stay too."""
    left_mb = {
        case: float(
            subprocess.run([sys.executable, "-c", RESIDENT, case], capture_output=True, text=True, check=True).stdout
        )
        for case in ("given back", "as it is")
    }
    assert left_mb["as it is"] > 100.0
    assert left_mb["given back"] < 16.0
