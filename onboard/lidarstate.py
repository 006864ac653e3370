"""The state of the lidar, by name: whether to check the cable, the power or the settings. Pure but for `carrier`."""

import socket
import struct
from collections.abc import Mapping
from enum import StrEnum
from fcntl import ioctl
from pathlib import Path
from typing import Final

SILENT_S: Final = 1.0
"""A lidar unheard for this long is silent; it sends every 0.6 ms."""
LOW: Final = 0.9
"""Share of the expected rate below which it is low: the first seconds of health have sectors half seen."""

WRONG_LENGTH: Final = "data packet of a wrong length"
WRONG_CONTENT: Final = "data packet without block flags"
WRONG_SENDER: Final = "data packet from another sender than the lidar"
WRONG_MODEL: Final = "data packet of another sensor"
REFUSED: Final = "packet of another sender or length, refused by the kernel"
"""Reasons for which a packet is not recorded; of another sensor, its name follows."""

_SYSFS: Final = Path("/sys/class/net")
_ETHERNET: Final = "1"
_SIOCGIFADDR: Final = 0x8915


class State(StrEnum):
    """What the lidar does."""

    GOOD = "good"
    NO_LINK = "no link"
    NO_PACKETS = "no packets"
    SILENT = "silent"
    WRONG_MODEL = "wrong model"
    WRONG_LENGTH = "wrong length"
    WRONG_SENDER = "wrong sender"
    WRONG_CONTENT = "wrong content"
    RATE_LOW = "rate low"


_BY_REASON: Final = (
    (WRONG_MODEL, State.WRONG_MODEL),
    (WRONG_LENGTH, State.WRONG_LENGTH),
    (WRONG_SENDER, State.WRONG_SENDER),
    (WRONG_CONTENT, State.WRONG_CONTENT),
)

REMEDY: Final = {
    State.NO_LINK: "is the cable plugged in and the lidar powered?",
    State.NO_PACKETS: "none yet, but a network link is up; check its destination address and the ports",
    State.SILENT: "the network link is not down; check its power and its laser switch",
    State.WRONG_MODEL: "an HDL-32E is needed",
    State.WRONG_LENGTH: "does something else send to its port?",
    State.WRONG_SENDER: "the one taken for the lidar, or named by lidar.sensor, is silent, and another one sends",
    State.WRONG_CONTENT: "packets of no Velodyne arrive; does something else send to its port?",
    State.RATE_LOW: "check cable, network load and receive buffer",
}
"""What to tell, and what to do about it."""


def classify(
    age_s: float | None, link: bool | None, rejected: Mapping[str, float], rate: float, expected: float
) -> State:
    """Name the state.

    Parameters
    ----------
    age_s : float or None
        Since the newest good packet; None: there was none.
    link : bool or None
        Whether the network link is up; None: not known.
    rejected : mapping of reason to float
        What is being rejected [packets/s].
    rate, expected : float
        Good packets; 0 expected: not known [packets/s].
    """
    if age_s is not None and age_s <= SILENT_S:
        return State.RATE_LOW if rate < LOW * expected else State.GOOD
    if link is False:
        return State.NO_LINK
    arriving = [(rate_s, reason) for reason, rate_s in rejected.items() if rate_s > 0]
    for _, reason in sorted(arriving, reverse=True):
        for start, state in _BY_REASON:
            if reason.startswith(start):
                return state
    return State.NO_PACKETS if age_s is None else State.SILENT


def carrier(interface: str | None, sysfs: Path = _SYSFS) -> bool | None:
    """Whether a network interface has a link; None: not known. Without a name: whether any wired one has."""
    if interface is not None:
        return _carrier(sysfs / interface)
    try:
        wired = [entry for entry in sysfs.iterdir() if _is_wired(entry)]
    except OSError:
        return None
    known = [link for entry in wired if (link := _carrier(entry)) is not None]
    return any(known) if known else None


def _carrier(entry: Path) -> bool | None:
    try:
        return (entry / "carrier").read_text(encoding="ascii").strip() == "1"
    except FileNotFoundError:
        return None
    except OSError:  # an interface that is set down has none to tell (EINVAL)
        return False


def _is_wired(entry: Path) -> bool:
    try:
        kind = (entry / "type").read_text(encoding="ascii").strip()
        return kind == _ETHERNET and not (entry / "wireless").exists()
    except OSError:
        return False


def _interfaces() -> list[str]:
    """Names of the network's interfaces, without asking over netlink: the sandbox has none."""
    try:
        return sorted(entry.name for entry in Path("/sys/class/net").iterdir())
    except OSError:
        return []


def interface_towards(address: int) -> str | None:
    """The interface that a sensor's packets come in on, found by the route back to it; None where there is no route."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        try:
            sock.connect((socket.inet_ntoa(struct.pack(">I", address)), 9))
            local = socket.inet_aton(sock.getsockname()[0])
        except OSError:
            return None
        for name in _interfaces():
            try:
                answer = ioctl(sock.fileno(), _SIOCGIFADDR, struct.pack("256s", name.encode()))
            except OSError:
                continue
            if answer[20:24] == local:
                return name
    return None
