"""Messages to systemd: READY, STATUS, WATCHDOG, STOPPING. Does nothing if systemd did not start us."""

import os
import socket
from contextlib import suppress

from flightlog.constants import NS_PER_US

try:
    from systemd.daemon import notify as _systemd_notify
except ImportError:
    _systemd_notify = None


def notify(state: str) -> None:
    """Send one or more lines of `KEY=value` (sd_notify(3))."""
    if _systemd_notify is not None:
        _systemd_notify(state)
    else:
        notify_socket(state)


def notify_socket(state: str) -> None:
    """Do what systemd's own library does, where that is not installed."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    if address.startswith("@"):  # an abstract socket
        address = "\0" + address[1:]
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sock:
        sock.sendto(state.encode(), address)


def ready(status: str) -> None:
    """Tell that everything runs."""
    notify(f"READY=1\nSTATUS={status}")


def status(text: str) -> None:
    """Tell one line for `systemctl status`."""
    notify(f"STATUS={text}")


def watchdog() -> None:
    """Tell that every worker gets on; to be earned."""
    notify("WATCHDOG=1")


def stopping() -> None:
    """Tell that the end has begun."""
    notify("STOPPING=1")


def watchdog_ns() -> int | None:
    """How often systemd wants to hear from us [ns], None if it does not."""
    if os.environ.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return None
    text = os.environ.get("WATCHDOG_USEC", "")
    return int(text) * NS_PER_US if text.isdecimal() and int(text) else None
