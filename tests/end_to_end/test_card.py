"""The recipe of a card: on a loop image, and booted."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from guest import ROOT, Guest
from recording import mounted, run

SCRIPT = ROOT / "package" / "card.py"
KEY = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIGFiY2RlZmdoaWprbG1ub3BxcnN0dXZ3eHl6MDEyMzQ1 ground"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "root/etc").mkdir(parents=True)
    (tmp_path / "root/etc/os-release").write_text('PRETTY_NAME="Debian"\nVERSION_ID="12"\n')
    (tmp_path / "root/etc/hosts").write_text("127.0.0.1\tlocalhost\n127.0.1.1\traspberrypi\n")
    (tmp_path / "swathd.deb").write_bytes(b"a package")
    (tmp_path / "id.pub").write_text(KEY + "\n")
    return tmp_path


def card(folder: Path, root: Path, **more: str) -> "subprocess.CompletedProcess[str]":
    options = {
        "deb": str(folder / "swathd.deb"),
        "hostname": "swath1",
        "key": str(folder / "id.pub"),
        "lidar-interface": "end0",
    }
    words = [word for name, value in (options | more).items() for word in (f"--{name}", value)]
    return subprocess.run([sys.executable, SCRIPT, root, *words], capture_output=True, text=True, check=False)


def look(root: Path) -> None:
    assert (root / "etc/hostname").read_text() == "swath1\n"
    assert (root / "etc/hosts").read_text() == "127.0.0.1\tlocalhost\n127.0.1.1\tswath1\n"
    assert (root / "etc/swathd/authorized_keys").read_text() == f'restrict,command="/usr/bin/swathd gate" {KEY}\n'
    assert "Name=end0" in (root / "etc/systemd/network/10-swath-lidar.network").read_text()
    assert (root / "usr/local/share/swathd-first-boot/swathd.deb").read_bytes() == b"a package"
    link = root / "etc/systemd/system/multi-user.target.wants/swathd-first-boot.service"
    assert str(link.readlink()) == "/etc/systemd/system/swathd-first-boot.service"


def test_a_folder_becomes_a_payload_computer_and_doing_it_again_changes_nothing(folder: Path) -> None:
    for _ in range(2):
        done = card(folder, folder / "root")
        assert done.returncode == 0, done.stderr
        look(folder / "root")


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"hostname": "No Name"}, "expected lower-case letters"),
        ({"deb": "none.deb"}, "make deb builds it"),
        ({"key": "none.pub"}, "cannot be read"),
        ({"key": __file__}, "is no public key"),
        ({"config": __file__}, "test_card.py"),
    ],
)
def test_what_cannot_be_right_is_one_sentence_and_nothing_is_written(
    folder: Path, more: dict[str, str], said: str
) -> None:
    before = sorted((folder / "root").rglob("*"))
    done = card(folder, folder / "root", **more)
    assert done.returncode == 1
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
    assert sorted((folder / "root").rglob("*")) == before


def test_other_systems_and_this_very_one_are_refused(folder: Path) -> None:
    (folder / "root/etc/os-release").write_text('VERSION_ID="11"\n')
    assert "is no Debian 12" in card(folder, folder / "root").stderr
    assert "has no /etc/os-release" in card(folder, folder).stderr
    assert "is no card" in card(folder, Path("/")).stderr


@pytest.mark.root
@pytest.mark.skipif(
    os.geteuid() != 0 or shutil.which("mkfs.ext4") is None, reason="mounting an image needs root and mkfs.ext4"
)
def test_on_an_image_that_is_mounted(folder: Path) -> None:
    image = folder / "card.img"
    with image.open("wb") as file:
        file.truncate(16 << 20)
    run("mkfs.ext4", "-q", image)
    (folder / "mount").mkdir()
    with mounted(image, folder / "mount") as root:
        shutil.copytree(folder / "root", root, dirs_exist_ok=True)
        assert card(folder, root).returncode == 0
    with mounted(image, folder / "mount") as root:
        look(root)


@pytest.fixture
def booted(folder: Path) -> Iterator[Guest]:
    """A system that was prepared as a card and boots for the first time."""
    command = [sys.executable, ROOT / "package" / "deb.py", "amd64", "--output", folder / "debs"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"the package cannot be built: {done.stderr[-200:]}")
    others = "usr/sbin/policy-rc.d etc/apt/apt.conf.d/20packagekit etc/ssh/sshd_config.d/60-swathd.conf opt/swath"
    words = f"--hostname swath1 --key {folder}/id.pub --lidar-interface lidar0 --deb {folder}/debs/*.deb"
    prepare = f"rm -rf {others}; PYTHONPATH={ROOT} {sys.executable} {SCRIPT} $PWD {words}"
    guest = Guest(folder, prepare)
    try:
        guest.boot()
        yield guest
    finally:
        guest.stop()


# a card is made and boots as a whole system; in the quick suite: what is on it (above)
@pytest.mark.soak
@pytest.mark.root
@pytest.mark.skipif(
    os.geteuid() != 0 or shutil.which("systemd-nspawn") is None, reason="booting a systemd needs root and nspawn"
)
def test_it_installs_itself_when_it_first_boots(booted: Guest) -> None:
    booted.wait_for(lambda: booted.show("ActiveState") == "active")
    booted.send(count=300)
    booted.wait_for(lambda: booted.status()["lidar"]["kept"] > 0)
    booted.wait_for(lambda: not booted.path("/usr/local/share/swathd-first-boot/swathd.deb").exists())
    assert booted.path("/etc/hostname").read_text() == "swath1\n"
    assert KEY in booted.path("/etc/swathd/authorized_keys").read_text()
    booted.wait_for(lambda: "192.168.1.100/24" in booted.enter("ip", "-br", "-4", "addr", "show", "lidar0"))
