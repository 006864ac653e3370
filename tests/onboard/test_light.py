"""What flies carries none of the ground's libraries."""

import subprocess
import sys
from pathlib import Path

HEAVY = "scipy numba laspy lazrs matplotlib pyproj tqdm embreex llvmlite velodyne_decoder rosbags systemd"


def test_the_daemon_runs_with_no_ground_library_installed() -> None:
    program = (
        "import sys\n"
        f"for name in {HEAVY!r}.split(): sys.modules[name] = None  # as if it were not there\n"
        "import onboard.daemon, onboard.cli, onboard.notify\n"
        "sys.exit(onboard.cli.main(['config']))\n"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=300)
    assert run.returncode == 0, run.stderr
    assert "data_port: 2368" in run.stdout


def test_health_loads_nothing_that_takes_time(tmp_path: Path) -> None:
    program = (
        "import sys\n"
        "for name in ['numpy', 'pymavlink', 'mcap', 'serial', 'importlib.metadata']: sys.modules[name] = None\n"
        "import onboard.cli\n"
        "sys.exit(onboard.cli.main(['health', '--config', sys.argv[1]]))\n"
    )
    config = tmp_path / "swathd.yaml"
    config.write_text(f"recorder: {{directory: {tmp_path}}}\n")
    run = subprocess.run(
        [sys.executable, "-c", program, config], capture_output=True, text=True, check=False, timeout=300
    )
    assert run.returncode == 2, run.stderr
    assert "swathd has not run" in run.stdout
