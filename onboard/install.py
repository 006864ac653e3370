"""`swathd install` and `uninstall`: the service, its user, devices, network and sysctl files."""

import contextlib
import subprocess
import sys
import sysconfig
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Final

import onboard
from flightlog.config import sample
from flightlog.errors import SwathError, UsageError
from onboard.config import SwathdConfig

PROGRAM: Final = "/opt/swath/bin/swathd"
"""What stands in the files for the program's path."""
INTERFACE: Final = "eth0"
"""What stands in the network file for the lidar's port."""
CONFIG: Final = Path("etc/swathd/swathd.yaml")

_FILES: Final = {
    "swathd.service": Path("etc/systemd/system/swathd.service"),
    "sysusers.conf": Path("etc/sysusers.d/swathd.conf"),
    "tmpfiles.conf": Path("etc/tmpfiles.d/swathd.conf"),
    "udev.rules": Path("etc/udev/rules.d/70-swathd.rules"),
    "sysctl.conf": Path("etc/sysctl.d/70-swathd.conf"),
}
_SSHD: Final = ("sshd.conf", Path("etc/ssh/sshd_config.d/60-swathd.conf"))
_NETWORK: Final = ("lidar.network", Path("etc/systemd/network/10-swath-lidar.network"))
_LINK: Final = Path("usr/local/bin/swathd")
PACKAGED: Final = Path("/usr/lib/swathd")
"""Where Debian's package has its modules; what it puts in place is dpkg's to change."""
_HIDDEN: Final = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")
"""What the service does not see of the file system."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where to install.

    Attributes
    ----------
    root : Path
        The system: `/`, or the root folder of an image that is being built.
    program : Path
        `swathd`, as the service will call it.
    """

    root: Path
    program: Path


def _runs(root: Path) -> bool:
    """Whether it is the system that runs, with systemd."""
    return root == Path("/") and Path("/run/systemd/system").is_dir()


def _call(*words: str) -> None:
    """Run a command of the system; SwathError if it fails."""
    try:
        done = subprocess.run(words, capture_output=True, text=True, check=False)
    except OSError as error:
        raise SwathError(f"`{' '.join(words)}` failed: {error.strerror}") from None
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["it gives no reason"])[-1]
        raise SwathError(f"`{' '.join(words)}` failed: {reason}")


def _try(*words: str) -> None:
    """Run a command of the system that may fail, or not be there."""
    with contextlib.suppress(SwathError):
        _call(*words)


def find_program(given: Path | None) -> Path:
    """Path of `swathd` for the service; UsageError where the service could not run it."""
    program = given or Path(sysconfig.get_path("scripts")) / "swathd"
    if not program.is_absolute() or (given is None and not program.is_file()):
        raise UsageError(f"program {program}: no absolute path of an installed swathd; --program names it")
    # the interpreter and the package must be seen as well as the script
    parts = [program] if given else [program, Path(sys.base_prefix), Path(onboard.__file__).resolve()]
    for part in parts:
        if any(part.is_relative_to(hidden) for hidden in _HIDDEN):
            raise UsageError(
                f"{part}: the service sees nothing in {', '.join(_HIDDEN)}; make the environment in /opt/swath"
            )
    return program


def packaged() -> bool:
    """Whether this is the program of Debian's package."""
    return Path(onboard.__file__).is_relative_to(PACKAGED)


def set_up_network(root: Path, interface: str | None) -> list[str]:
    """All that is left to do where the package has put everything else in place: the lidar's port.

    Raises
    ------
    UsageError
        No port is named.
    SwathError
        A file cannot be written, or a command of the system fails.
    """
    if interface is None:
        raise UsageError(
            "install: swathd is Debian's package here, and in place; --lidar-interface NAME sets up the network port of the lidar"
        )
    name, path = _NETWORK
    _write(root / path, template(name).replace(f"Name={INTERFACE}", f"Name={interface}"))
    if _runs(root):
        _call("systemctl", "enable", "--now", "systemd-networkd.service")
        _try("networkctl", "reload")
    else:
        _try("systemctl", f"--root={root}", "enable", "systemd-networkd.service")
    return [f"wrote /{path}", "enabled systemd-networkd.service"]


def template(name: str) -> str:
    """The text of one of the project's systemd files.

    Raises
    ------
    SwathError
        The installation does not have it.
    """
    places = [Path(onboard.__file__).parents[1] / "systemd" / name]
    try:
        files = distribution("swath").files or []
        places += [Path(str(file.locate())) for file in files if file.parts[-3:] == ("swath", "systemd", name)]
    except PackageNotFoundError:
        pass
    for place in places:
        if place.is_file():
            return place.read_text(encoding="utf-8")
    raise SwathError(f"{name}: the installed swath lacks its systemd files; install it again")


def install(place: Place, interface: str | None, start: bool) -> list[str]:
    """Put everything in place and start the service.

    Parameters
    ----------
    place : Place
    interface : str or None
        Network port of the lidar; None leaves the network as it is.
    start : bool
        Now, and not with the next boot only.

    Returns
    -------
    list of str
        What was done, and what is left to do; one sentence each.

    Raises
    ------
    SwathError
        A file cannot be written, or a command of the system fails.
    """
    said = []
    for name, path in _chosen(place, interface).items():
        text = template(name).replace(PROGRAM, str(place.program))
        if interface is not None and path == _NETWORK[1]:
            text = text.replace(f"Name={INTERFACE}", f"Name={interface}")
        _write(place.root / path, text)
        said.append(f"wrote /{path}")
    if (place.root / CONFIG).exists():
        said.append(f"kept /{CONFIG}")
    else:
        _write(place.root / CONFIG, sample(SwathdConfig))
        said.append(f"wrote /{CONFIG}: look through it")
    said += _link(place)
    said += _bring_up(place.root, interface is not None, start)
    if interface is None:
        said.append("the network was left alone: --lidar-interface NAME sets up the lidar's port")
    return said


def _chosen(place: Place, interface: str | None) -> dict[str, Path]:
    chosen = dict(_FILES)
    if (place.root / _SSHD[1]).parent.is_dir():
        chosen[_SSHD[0]] = _SSHD[1]
    if interface is not None:
        chosen[_NETWORK[0]] = _NETWORK[1]
    return chosen


def _bring_up(root: Path, network: bool, start: bool) -> list[str]:
    if root != Path("/"):
        _call("systemd-sysusers", f"--root={root}", str(root / _FILES["sysusers.conf"]))
        _call("systemctl", f"--root={root}", "enable", "swathd.service")
        if network:
            _try("systemctl", f"--root={root}", "enable", "systemd-networkd.service")
        return ["enabled swathd.service: it starts when that system boots"]
    _call("systemd-sysusers", "/etc/sysusers.d/swathd.conf")
    _call("systemd-tmpfiles", "--create", "/etc/tmpfiles.d/swathd.conf")
    if not _runs(root):
        _call("systemctl", "enable", "swathd.service")
        return ["enabled swathd.service: it starts when systemd boots"]
    # a container can neither set the receive buffers nor have devices: its host has to
    _try("sysctl", "--quiet", "--load=/etc/sysctl.d/70-swathd.conf")
    _try("udevadm", "control", "--reload")
    _try("udevadm", "trigger", "--subsystem-match=tty")
    _call("systemctl", "daemon-reload")
    if network:
        _call("systemctl", "enable", "--now", "systemd-networkd.service")
        _try("networkctl", "reload")
    _try("systemctl", "try-reload-or-restart", "ssh.service")
    _call("systemctl", "enable", "swathd.service")
    if not start:
        return ["enabled swathd.service: it starts with the next boot"]
    _call("systemctl", "restart", "swathd.service")
    return ["enabled and started swathd.service"]


def _link(place: Place) -> list[str]:
    """Put the program on everybody's path, unless something is there already."""
    link = place.root / _LINK
    if place.program == Path("/") / _LINK or link.exists():
        return []
    try:
        link.parent.mkdir(parents=True, exist_ok=True)
        link.unlink(missing_ok=True)  # one that leads nowhere
        link.symlink_to(place.program)
    except OSError as error:
        raise SwathError(f"{link}: cannot be made ({error.strerror})") from None
    return [f"linked /{_LINK}"]


def uninstall(root: Path) -> list[str]:
    """Stop the service and take away what `install` wrote, but neither the configuration nor the logs nor their user.

    Raises
    ------
    SwathError
        A file cannot be removed.
    UsageError
        dpkg put them there.
    """
    if packaged():
        raise UsageError("uninstall: swathd is Debian's package here: apt remove swathd takes it away")
    if _runs(root):
        _try("systemctl", "disable", "--now", "swathd.service")
    else:
        _try("systemctl", f"--root={root}", "disable", "swathd.service")
    said = [f"removed /{path}" for path in (*_FILES.values(), _SSHD[1], _NETWORK[1]) if _remove(root / path)]
    link = root / _LINK
    if link.is_symlink() and link.readlink().name == "swathd" and _remove(link):
        said.append(f"removed /{_LINK}")
    if _runs(root):
        _try("systemctl", "daemon-reload")
        _try("udevadm", "control", "--reload")
        _try("systemctl", "try-reload-or-restart", "ssh.service")
    return [*said, "kept /etc/swathd, the logs in /var/lib/swathd, and their user swath"]


def _remove(path: Path) -> bool:
    try:
        path.unlink()
    except FileNotFoundError:
        return False
    except OSError as error:
        raise SwathError(f"{path}: cannot be removed ({error.strerror})") from None
    return True


def _write(path: Path, text: str) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        path.chmod(0o644)
    except OSError as error:
        raise SwathError(f"{path}: cannot be written ({error.strerror}); sudo swathd install") from None
