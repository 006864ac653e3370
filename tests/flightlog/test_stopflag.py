"""The flag that ends a program: any handler may set it, whatever the main thread is at."""

import subprocess
import sys
import threading
import time

from flightlog.stopflag import StopFlag

SIGNALS_AT_EVERY_STEP = """
import signal, time
from flightlog.stopflag import StopFlag

flag, heard = StopFlag(), 0

def on_signal(number, frame):
    global heard
    heard += 1
    flag.set()

signal.signal(signal.SIGALRM, on_signal)
signal.setitimer(signal.ITIMER_REAL, 1e-3, 3e-4)
end = time.monotonic() + 2
while time.monotonic() < end:
    flag = StopFlag()
    flag.wait(1e-6)
signal.setitimer(signal.ITIMER_REAL, 0)
print(heard)
"""


def test_signals_that_come_while_it_is_waited_for_do_not_block() -> None:
    run = subprocess.run([sys.executable, "-c", SIGNALS_AT_EVERY_STEP], capture_output=True, timeout=120, check=True)
    assert int(run.stdout) > 100


def test_it_stays_set_however_often_it_is_set_and_waited_for() -> None:
    flag = StopFlag()
    assert not flag.is_set()
    assert not flag.wait(0.001)
    flag.set()
    flag.set()
    assert [flag.wait(0), flag.wait(0), flag.wait(), flag.is_set()] == [True] * 4


def test_another_thread_wakes_who_waits() -> None:
    flag = StopFlag()
    threading.Timer(0.05, flag.set).start()
    began = time.monotonic()
    assert flag.wait(60)
    assert time.monotonic() - began < 30
