"""The service's files, judged by systemd's own tools."""

import shutil
import subprocess
from pathlib import Path

import pytest

from flightlog.errors import SwathError, UsageError
from onboard import cli, install

PROGRAM = "/srv/flight/bin/swathd"
needs_systemd = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not installed")


def swathd(*words: str) -> int:
    return cli.main(list(words))


USERS = {f"etc/{name}" for name in ("passwd", "group", "shadow", "gshadow", ".pwd.lock")}


def files(root: Path) -> set[str]:
    """All but what makes the user in an empty system."""
    return {str(path.relative_to(root)) for path in root.rglob("*") if not path.is_dir() or path.is_symlink()} - USERS


@pytest.fixture
def root(tmp_path: Path) -> Path:
    (tmp_path / "root/etc/ssh/sshd_config.d").mkdir(parents=True)
    return tmp_path / "root"


@pytest.fixture
def installed(root: Path) -> Path:
    assert swathd("install", "--root", str(root), "--program", PROGRAM, "--lidar-interface", "end0") == 0
    return root


@needs_systemd
def test_everything_is_put_in_place(installed: Path) -> None:
    assert files(installed) == {
        "etc/swathd/swathd.yaml",
        "etc/systemd/system/swathd.service",
        "etc/systemd/system/multi-user.target.wants/swathd.service",
        "etc/systemd/network/10-swath-lidar.network",
        "etc/sysusers.d/swathd.conf",
        "etc/tmpfiles.d/swathd.conf",
        "etc/udev/rules.d/70-swathd.rules",
        "etc/sysctl.d/70-swathd.conf",
        "etc/ssh/sshd_config.d/60-swathd.conf",
        "usr/local/bin/swathd",
    }
    assert f"ExecStart={PROGRAM} run" in (installed / "etc/systemd/system/swathd.service").read_text()
    assert f"ForceCommand {PROGRAM} gate" in (installed / "etc/ssh/sshd_config.d/60-swathd.conf").read_text()
    assert "Name=end0" in (installed / "etc/systemd/network/10-swath-lidar.network").read_text()
    assert install.PROGRAM not in "".join(p.read_text() for p in (installed / "etc").rglob("swathd*") if p.is_file())
    assert (installed / "usr/local/bin/swathd").readlink() == Path(PROGRAM)


@needs_systemd
def test_removed_leaves_the_configuration_only(installed: Path) -> None:
    assert swathd("uninstall", "--root", str(installed)) == 0
    assert files(installed) == {"etc/swathd/swathd.yaml"}
    assert swathd("uninstall", "--root", str(installed)) == 0


@needs_systemd
def test_a_configuration_is_never_overwritten_and_the_network_only_set_up_when_asked(root: Path) -> None:
    config = root / "etc/swathd/swathd.yaml"
    config.parent.mkdir(parents=True)
    config.write_text("mount: mine.yaml\n")
    shutil.rmtree(root / "etc/ssh")
    for _ in range(2):
        assert swathd("install", "--root", str(root), "--program", PROGRAM) == 0
    assert config.read_text() == "mount: mine.yaml\n"
    assert not any("network" in name or "ssh" in name for name in files(root))


@needs_systemd
def test_the_service_is_exposed_to_next_to_nothing(installed: Path) -> None:
    unit = installed / "etc/systemd/system/swathd.service"
    words = ["systemd-analyze", "--offline=true", "security", "--threshold=15", unit]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    # every capability is dropped, and the file is understood to the last word
    assert not [line for line in done.stdout.splitlines() if "CapabilityBoundingSet" in line and line.startswith("✗")]
    assert done.stderr == ""


@needs_systemd
def test_systemd_understands_every_line(installed: Path, tmp_path: Path) -> None:
    unit = tmp_path / "swathd.service"
    unit.write_text((installed / "etc/systemd/system/swathd.service").read_text().replace(PROGRAM, "/bin/true"))
    done = subprocess.run(["systemd-analyze", "verify", "--man=no", unit], capture_output=True, text=True)
    assert (done.returncode, [line for line in done.stderr.splitlines() if "swathd" in line]) == (0, [])


@needs_systemd
def test_the_user_is_one_that_systemd_can_make(installed: Path) -> None:
    words = ["systemd-sysusers", "--dry-run", installed / "etc/sysusers.d/swathd.conf"]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_program_that_the_service_could_not_see_is_refused() -> None:
    for place in ("/home/pi/swath/bin/swathd", "/root/x/swathd", "/tmp/swathd", "swathd"):
        with pytest.raises(UsageError):
            install.find_program(Path(place))
    assert install.find_program(Path(PROGRAM)) == Path(PROGRAM)


def test_a_place_that_cannot_be_written_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "etc").write_text("not a folder")
    assert swathd("install", "--root", str(tmp_path), "--program", PROGRAM) == 1
    assert "cannot be written" in capsys.readouterr().err


def test_a_file_that_is_not_of_the_project_is_not_found() -> None:
    with pytest.raises(SwathError, match="lacks its systemd files"):
        install.template("none.service")
