"""The service in a real, booted systemd: a container on a copy-on-write view of this very system."""

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from guest import Guest, needs
from mcap.reader import make_reader

ROOT = Path(__file__).resolve().parents[2]
WATCHDOG_S = 4
"""Of the tests; the unit's own would take them long."""
SERVICE = "/etc/systemd/system/swathd.service"

pytestmark = needs

PROBE = """
import ctypes, errno, json, mmap, os, socket, time
def attempt(what):
    try:
        return what() or "done"
    except OSError as error:
        return errno.errorcode[error.errno]
libc = ctypes.CDLL(None, use_errno=True)
def call(name, *words):
    return "done" if getattr(libc, name)(*words) == 0 else errno.errorcode[ctypes.get_errno()]
def send(to):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.sendto(b"x", (to, 9))
json.dump({
    "write /etc": attempt(lambda: open("/etc/x", "w").close()),
    "write /usr": attempt(lambda: open("/usr/x", "w").close()),
    "write logs": attempt(lambda: open("/var/lib/swathd/x", "w").close() or os.remove("/var/lib/swathd/x")),
    "home": attempt(lambda: str(os.listdir("/home"))),
    "root": attempt(lambda: str(os.listdir("/root"))),
    "packet socket": attempt(lambda: socket.socket(socket.AF_PACKET, socket.SOCK_RAW).close()),
    "netlink": attempt(lambda: socket.socket(socket.AF_NETLINK, socket.SOCK_RAW).close()),
    "IPv6": attempt(lambda: socket.socket(socket.AF_INET6).close()),
    "write and run": attempt(lambda: mmap.mmap(-1, 4096, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC).close()),
    "set the clock": attempt(lambda: time.clock_settime(time.CLOCK_REALTIME, time.time())),
    "mount": call("mount", b"none", b"/mnt", b"tmpfs", 0, None),
    "new namespace": call("unshare", 0x10000000),
    "kill init": attempt(lambda: os.kill(1, 0)),
    "see init": attempt(lambda: os.stat("/proc/1").st_uid),
    "send to ourselves": attempt(lambda: send("127.0.0.1")),
    "send elsewhere": attempt(lambda: send("10.99.0.1")),
}, open("/run/swathd/probe.json", "w"))
"""

INSTALL = """
mkdir -p opt/swath-source opt/swath-venv opt/python opt/swath/bin opt/swath/lib/{python}/site-packages etc/swathd
mkdir -p etc/systemd/system/swathd.service.d
cp {files}/swathd opt/swath/bin/swathd
cp {files}/pyvenv.cfg opt/swath/
cp {files}/tree.pth opt/swath/lib/{python}/site-packages/
cp {files}/probe.py opt/swath/
cp {files}/probe.conf etc/systemd/system/swathd.service.d/
cp {files}/key.pub etc/swathd/authorized_keys
ln -s {base}/bin/{python} opt/swath/bin/python3
{executable} -m onboard.cli install --root $PWD --program /opt/swath/bin/swathd --lidar-interface lidar0
"""


def from_checkout(folder: Path) -> Guest:
    """A guest with the service installed from this source tree."""
    python = f"python{sys.version_info.major}.{sys.version_info.minor}"
    outside = not Path(sys.base_prefix).is_relative_to("/usr")
    base = "/opt/python" if outside else sys.base_prefix
    packages = f"lib/{python}/site-packages"
    texts = {
        "swathd": "#!/opt/swath/bin/python3\nimport sys\nfrom onboard.cli import main\nsys.exit(main())\n",
        "pyvenv.cfg": f"home = {base}/bin\ninclude-system-site-packages = false\n",
        "tree.pth": f"/opt/swath-source\n/opt/swath-venv/{packages}\n",
        "probe.py": PROBE,
        "probe.conf": f"[Service]\nWatchdogSec={WATCHDOG_S}\nExecStartPre=-/opt/swath/bin/python3 /opt/swath/probe.py\n",
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    (folder / "swathd").chmod(0o755)
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", folder / "key"], check=True)
    prepare = INSTALL.format(files=folder, python=python, base=base, executable=sys.executable)
    binds = f"--bind-ro={ROOT}:/opt/swath-source --bind-ro={sys.prefix}:/opt/swath-venv"
    return Guest(folder, prepare, binds + (f" --bind-ro={sys.base_prefix}:/opt/python" if outside else ""))


@pytest.fixture(scope="module")
def guest(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guest]:
    guest = from_checkout(tmp_path_factory.mktemp("guest"))
    try:
        guest.boot()
        yield guest
    finally:
        guest.stop()


def test_it_starts_with_the_system_and_is_ready(guest: Guest) -> None:
    guest.wait_for(lambda: guest.show("ActiveState") == "active")
    assert guest.show("NRestarts") == "0"
    assert guest.show("UnitFileState") == "enabled"
    assert guest.show("StatusText").startswith("00001-000.mcap: lidar ")
    started = guest.journal("SWATH_EVENT=recording")
    assert [(line["_SYSTEMD_UNIT"], line["PRIORITY"], line["SWATH_SEGMENT"]) for line in started] == [
        ("swathd.service", "6", "00001-000.mcap")
    ]


def test_packets_are_recorded_and_anybody_may_ask_for_the_health(guest: Guest) -> None:
    before = guest.status()["lidar"]["received"]
    guest.send(count=200)
    guest.wait_for(lambda: guest.status()["lidar"]["received"] >= before + 200)
    words = ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", "/usr/local/bin/swathd", "health", "--json"]
    answer = json.loads(guest.enter(*words, check=False))
    assert answer["status"]["pid"] == guest.pid
    assert answer["armed"] is None


def test_the_network_of_the_lidar_is_set_up(guest: Guest) -> None:
    def addresses() -> str:
        return guest.enter("ip", "-br", "-4", "addr", "show", "lidar0")

    guest.wait_for(lambda: "192.168.1.100/24" in addresses() and "192.168.3.100/24" in addresses())
    # a sender of old firmware, anywhere in 192.168: the way back goes through this port
    assert "dev lidar0" in guest.enter("ip", "route", "get", "192.168.17.162")


@pytest.mark.skipif(shutil.which("udevadm") is None, reason="udev is not installed")
def test_udev_understands_the_rules_and_leaves_other_ports_alone(guest: Guest) -> None:
    done = guest.enter("sh", "-c", "udevadm test /sys/class/tty/tty0 2>&1", check=False)
    assert "/etc/udev/rules.d/70-swathd.rules" in done
    assert [line for line in done.splitlines() if "70-swathd.rules:" in line] == []


def test_the_sandbox_is_in_force(guest: Guest) -> None:
    lines = guest.path(f"/proc/{guest.pid}/status").read_text().splitlines()
    process = {key: value.strip() for key, _, value in (line.partition(":") for line in lines)}
    assert {process[name] for name in ("CapInh", "CapPrm", "CapEff", "CapBnd", "CapAmb")} == {"0" * 16}
    assert (process["NoNewPrivs"], process["Seccomp"]) == ("1", "2")
    assert set(process["Uid"].split()) == {guest.enter("id", "-u", "swath").strip()}


def test_a_hang_ends_in_a_restart_that_records_on(guest: Guest) -> None:
    first = guest.pid
    guest.enter("kill", "-STOP", str(first))
    guest.wait_for(lambda: guest.show("NRestarts") == "1" and guest.show("ActiveState") == "active")
    assert guest.pid != first
    texts = [str(line["MESSAGE"]) for line in guest.journal("-u", "swathd.service")]
    assert any(text.startswith("swathd.service: Watchdog timeout") for text in texts)
    # killed by the watchdog, it said where it was
    assert "Fatal Python error: Aborted" in texts
    guest.send(count=200)
    guest.wait_for(lambda: guest.status()["lidar"]["received"] >= 200)
    assert guest.status()["recorder"]["segment"] == "00001-001.mcap"


def test_what_the_sandbox_forbids_fails(guest: Guest) -> None:
    """Tried under the unit's own sandbox, before the start that followed the hang: then the network was there."""
    assert json.loads(guest.path("/run/swathd/probe.json").read_text()) == {
        "write /etc": "EROFS",
        "write /usr": "EROFS",
        "write logs": "done",
        "home": "EACCES",
        "root": "EACCES",
        "packet socket": "EAFNOSUPPORT",
        "netlink": "EAFNOSUPPORT",
        "IPv6": "EAFNOSUPPORT",
        "write and run": "EPERM",
        "set the clock": "EPERM",
        "mount": "EPERM",
        "new namespace": "EPERM",
        "kill init": "EPERM",
        "see init": "ENOENT",
        "send to ourselves": "done",
        "send elsewhere": "EPERM",
    }


def test_packets_from_beyond_the_lidars_networks_never_reach_the_daemon(guest: Guest) -> None:
    guest.systemctl("restart", "swathd.service")
    # the first sender of good packets is taken for the lidar, if it is heard
    guest.send("10.99.0.1", 100)
    guest.send("192.168.1.201", 100)
    guest.wait_for(lambda: guest.status()["lidar"]["kept"] >= 100)
    texts = [str(line["MESSAGE"]) for line in guest.journal(f"_PID={guest.pid}")]
    assert [text for text in texts if text.startswith("the lidar is at")] == ["the lidar is at 192.168.1.201"]


def test_the_key_of_the_pull_leads_to_the_gate_only(guest: Guest) -> None:
    def ssh(command: str) -> "subprocess.CompletedProcess[str]":
        known = f"UserKnownHostsFile={guest.folder}/known"
        options = ["-o", "StrictHostKeyChecking=no", "-o", known, "-o", "BatchMode=yes"]
        line = ["nsenter", "-n", "-t", str(guest.leader), "ssh", "-i", str(guest.folder / "key"), *options]
        return subprocess.run([*line, "swath@127.0.0.1", command], capture_output=True, text=True, timeout=300)

    guest.systemctl("start", "ssh.service")
    answer = ssh("health --json")
    assert json.loads(answer.stdout)["status"]["pid"] == guest.pid, answer.stderr
    assert ssh("id").returncode == 126
    assert ssh("manifest").returncode == 0


def test_stopping_closes_the_log(guest: Guest) -> None:
    last = guest.status()["recorder"]["segment"]
    guest.systemctl("stop", "swathd.service")
    assert (guest.show("ActiveState"), guest.show("Result")) == ("inactive", "success")
    with guest.path(f"/var/lib/swathd/{last}").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    topics = {
        channel.topic: summary.statistics.channel_message_counts.get(number, 0)
        for number, channel in summary.channels.items()
    }
    assert topics["/velodyne_packets"] > 0
    begun = guest.journal("SWATH_EVENT=recording", "-u", "swathd.service")
    assert [line["SWATH_SEGMENT"] for line in begun] == ["00001-000.mcap", "00001-001.mcap", last]
    assert {line["SYSLOG_IDENTIFIER"] for line in begun} == {"swathd"}
    closed = guest.journal("SWATH_EVENT=closed", f"SWATH_SEGMENT={last}")
    assert [line["_SYSTEMD_UNIT"] for line in closed] == ["swathd.service"]
    manifest = guest.path("/var/lib/swathd/manifest.jsonl").read_text()
    assert {"00001-000.mcap", "00001-001.mcap", last} <= {json.loads(line)["file"] for line in manifest.splitlines()}


def test_uninstalled_and_installed_again_where_it_runs(guest: Guest) -> None:
    guest.enter("/opt/swath/bin/swathd", "uninstall")
    assert guest.show("LoadState") == "not-found"
    assert not guest.path(SERVICE).exists()
    assert guest.path("/var/lib/swathd/00001-001.mcap").exists()
    said = guest.enter("/opt/swath/bin/swathd", "install")
    assert "enabled and started swathd.service" in said
    assert (guest.show("ActiveState"), guest.show("UnitFileState")) == ("active", "enabled")
