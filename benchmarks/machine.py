"""What else the machine was doing while something was measured."""

import os
from pathlib import Path


def busy_s() -> float:
    """CPU time that all programs, the kernel and other guests of the host have taken on this machine [s]."""
    user, nice, system, _, _, irq, softirq, steal = map(int, Path("/proc/stat").read_text().split("\n")[0].split()[1:9])
    return (user + nice + system + irq + softirq + steal) / os.sysconf("SC_CLK_TCK")
