"""What flies carries none of the ground's libraries."""

import subprocess
import sys

HEAVY = "scipy numba laspy lazrs matplotlib pyproj tqdm embreex llvmlite velodyne_decoder rosbags systemd"


def test_the_daemon_runs_with_no_ground_library_installed() -> None:
    program = (
        "import sys\n"
        f"for name in {HEAVY!r}.split(): sys.modules[name] = None  # as if it were not there\n"
        "import onboard.daemon, onboard.cli, onboard.notify\n"
        "sys.exit(onboard.cli.main(['config']))\n"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=60)
    assert run.returncode == 0, run.stderr
    assert "data_port: 2368" in run.stdout
