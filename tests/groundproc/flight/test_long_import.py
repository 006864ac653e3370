import json
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

START_NS = 1_700_000_000_000_000_000
MEASURE = """
import resource, sys
from groundproc.cli import main
code = main(sys.argv[1:])
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, file=sys.stderr)
sys.exit(code)
"""


def measured(*words: object) -> tuple[str, float]:
    """Standard output and peak memory [MB] of a command in a process of its own."""
    command = [sys.executable, "-c", MEASURE, *map(str, words)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode in (0, 3), run.stderr  # a log without an autopilot is doubtful
    return run.stdout, int(run.stderr.splitlines()[-1]) / 1024


# an hour of packets
@pytest.mark.soak
def test_an_hour_is_imported_and_summed_up_in_little_memory(
    tmp_path: Path,
    turning: Callable[..., list[tuple[int, bytes]]],
    ethernet: Callable[..., bytes],
    pcap: Callable[..., bytes],
) -> None:
    capture, log = tmp_path / "hour.pcap", tmp_path / "hour.mcap"
    packets = turning(1.0)
    count = 0
    with capture.open("wb") as file:
        file.write(pcap([]))
        for second in range(3600):
            for time_ns, payload in packets:
                stamp_us = (time_ns // 1000 + second * 1_000_000 + 1_800_000_000) % 3_600_000_000
                frame = ethernet(payload[:1200] + struct.pack("<I", stamp_us) + payload[1204:])
                file.write(pcap([(START_NS + second * 1_000_000_000 + time_ns, frame)])[24:])
                count += 1
    _, import_mb = measured("import", "--pcap", capture, "-o", log)
    capture.unlink()
    text, info_mb = measured("info", "--json", log)
    lidar = json.loads(text)["lidar"]
    assert lidar["packets"] == count
    assert lidar["clock"]["jumps"] == 0
    assert import_mb < 300
    assert info_mb < 300
