"""From the package to the first recorded packet, in a booted guest: `make bench-kit`, as root.

Its last line is one JSON object: deb_mb (the larger package), install_to_packet_s (from `apt-get install ./swathd.deb`, no network, to
a lidar packet in the recorder's account), exposure (`systemd-analyze security` of the packaged unit) and memory_mb (of the daemon).
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "helpers"))

from guest import Guest  # noqa: E402 (found by the path above)


def main() -> int:
    """Build, boot, install, measure."""
    if os.geteuid() != 0:
        print("bench-kit boots a system, which needs root", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory(prefix="bench-kit-") as name:
        folder = Path(name)
        subprocess.run([sys.executable, ROOT / "package" / "deb.py", "--output", folder / "debs"], check=True)
        sizes = [path.stat().st_size for path in (folder / "debs").glob("*.deb")]
        others = "usr/sbin/policy-rc.d etc/apt/apt.conf.d/20packagekit etc/ssh/sshd_config.d/60-swathd.conf opt/swath"
        guest = Guest(folder, f"rm -rf {others}; mkdir -p srv; cp {folder}/debs/*_amd64.deb srv/")
        try:
            guest.boot()
            print(json.dumps({"deb_mb": round(max(sizes) / 1e6, 2)} | measured(guest)))
        finally:
            guest.stop()
            shutil.rmtree(folder / "work", ignore_errors=True)
    return 0


def measured(guest: Guest) -> dict[str, float]:
    """What the guest shows."""

    def recording() -> bool:
        try:
            return int(guest.status()["lidar"]["kept"]) > 0
        except (OSError, ValueError, KeyError):
            return False

    with guest.sending():
        begin = time.monotonic()
        guest.enter("sh", "-c", "apt-get install -y -q /srv/swathd_*_amd64.deb 2>&1")
        guest.wait_for(recording)
        took_s = time.monotonic() - begin
        time.sleep(10.0)
        status = guest.path(f"/proc/{guest.pid}/status").read_text()
    told = guest.enter("systemd-analyze", "security", "swathd.service", "--no-pager", check=False)
    exposure = re.search(r"Overall exposure level for swathd.service: ([0-9.]+)", told)
    resident = re.search(r"VmRSS:\s+(\d+) kB", status)
    assert exposure is not None, told
    assert resident is not None, status
    return {
        "install_to_packet_s": round(took_s, 1),
        "exposure": float(exposure[1]),
        "memory_mb": round(int(resident[1]) / 1024, 1),
    }


if __name__ == "__main__":
    sys.exit(main())
