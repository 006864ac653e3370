"""Makes a payload computer of a card image: of a Raspberry Pi OS (64 bit) or Debian 12 whose root file system is mounted somewhere.

Host name, configuration, the lidar's port and the key of `swath pull` are files; the package is installed by the image itself when it first
boots, because the image may be of another processor than this computer. docs/install.md has the steps around it.
"""

import argparse
import os
import re
import shutil
import sys
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

DEB: Final = Path("usr/local/share/swathd-first-boot/swathd.deb")
UNIT: Final = "swathd-first-boot.service"
NAME: Final = re.compile(r"[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?")
KEY: Final = re.compile(r"(ssh-(ed25519|rsa)|ecdsa-sha2-nistp\d+|sk-\S+) [A-Za-z0-9+/=]+( .*)?")
FIRST_BOOT: Final = f"""\
# Installs the package that lies on the card, once; where Debian's archive is not reached yet, again and again.
[Unit]
Description=Install swathd from the card
After=network.target
ConditionPathExists=/{DEB}

[Service]
Type=oneshot
Environment=DEBIAN_FRONTEND=noninteractive
# the lists of the archive may be there, and all that is needed may be installed already
ExecStartPre=-/usr/bin/apt-get update -q
# the configuration of the card stays
ExecStart=/usr/bin/apt-get install -y -q -o Dpkg::Options::=--force-confold /{DEB}
ExecStartPost=/bin/rm -f /{DEB}
Restart=on-failure
RestartSec=30

[Install]
WantedBy=multi-user.target
"""


def refusal(root: Path, arguments: argparse.Namespace) -> str:
    """Why it cannot be done, in a sentence; empty where it can."""
    try:
        release = (root / "etc/os-release").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return f"{root}: has no /etc/os-release, expected the mounted root file system of a Debian 12"
    if 'VERSION_ID="12"' not in release:
        return f"{root}: is no Debian 12 or Raspberry Pi OS of it, which the package is for"
    if not arguments.deb.is_file():
        return f"{arguments.deb}: no such file; make deb builds it"
    if NAME.fullmatch(arguments.hostname) is None:
        return f"--hostname {arguments.hostname}: expected lower-case letters, digits and hyphens, 63 at most"
    try:
        key = arguments.key.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return f"{arguments.key}: cannot be read, expected a public key of SSH"
    if KEY.fullmatch(key) is None:
        return f"{arguments.key}: is no public key of SSH on one line (the file that ends in .pub)"
    return ""


def write(path: Path, text: str, mode: int = 0o644) -> None:
    """A file with its folders."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    path.chmod(mode)


def enable(root: Path, unit: str, wanted_by: str) -> None:
    """As `systemctl enable` does it, without running anything of the image."""
    link = root / f"etc/systemd/system/{wanted_by}.wants/{unit}"
    link.parent.mkdir(parents=True, exist_ok=True)
    folder = "/etc" if (root / "etc/systemd/system" / unit).exists() else "/lib"
    if not link.is_symlink():
        link.symlink_to(f"{folder}/systemd/system/{unit}")


def prepare(root: Path, arguments: argparse.Namespace) -> list[str]:
    """Write everything; what was done, in sentences."""
    from flightlog.config import sample
    from onboard import config, install

    settings = sample(config.SwathdConfig) if arguments.config is None else arguments.config.read_text(encoding="utf-8")
    if arguments.config is not None:
        config.load(arguments.config)
    write(root / "etc/hostname", arguments.hostname + "\n")
    hosts = root / "etc/hosts"
    lines = hosts.read_text(encoding="utf-8").splitlines() if hosts.exists() else ["127.0.0.1\tlocalhost"]
    kept = [line for line in lines if not line.startswith("127.0.1.1")]
    write(hosts, "\n".join([*kept, f"127.0.1.1\t{arguments.hostname}"]) + "\n")
    write(root / "etc/swathd/swathd.yaml", settings)
    key = arguments.key.read_text(encoding="utf-8").strip()
    write(root / "etc/swathd/authorized_keys", f'restrict,command="/usr/bin/swathd gate" {key}\n')
    network = install.template("lidar.network").replace(
        f"Name={install.INTERFACE}", f"Name={arguments.lidar_interface}"
    )
    write(root / "etc/systemd/network/10-swath-lidar.network", network)
    write(root / "etc/systemd/system" / UNIT, FIRST_BOOT)
    (root / DEB).parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(arguments.deb, root / DEB)
    enable(root, UNIT, "multi-user.target")
    enable(root, "systemd-networkd.service", "multi-user.target")
    os.sync()
    return [
        f"host name {arguments.hostname}",
        f"lidar's port {arguments.lidar_interface}",
        f"{arguments.deb.name} is installed at the first boot, from Debian's archive and the card",
    ]


def main() -> int:
    """Prepare a mounted image."""
    from flightlog.errors import SwathError

    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("root", type=Path, metavar="ROOT", help="where the image's root file system is mounted")
    parser.add_argument("--deb", type=Path, required=True, metavar="FILE", help="the package")
    parser.add_argument("--hostname", required=True, metavar="NAME")
    parser.add_argument(
        "--key", type=Path, required=True, metavar="FILE.pub", help="of the ground station, for swath pull"
    )
    parser.add_argument(
        "--lidar-interface", required=True, metavar="NAME", help="network port of the lidar, such as eth0"
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="swathd.yaml; default: every option at its default")
    arguments = parser.parse_args()
    root = arguments.root.resolve()
    why = "this computer's own root is no card" if root == Path("/") else refusal(root, arguments)
    try:
        said = [] if why else prepare(root, arguments)
    except (SwathError, OSError) as error:
        why = str(error)
    if why:
        print(f"card: {why}", file=sys.stderr)
        return 1
    print("\n".join(said))
    return 0


if __name__ == "__main__":
    sys.exit(main())
