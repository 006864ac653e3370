"""Which mount holds: the survey file's, else the log's, else the project's own airframe."""

from collections.abc import Sequence
from importlib import resources

from flightlog.errors import ConfigError
from flightlog.logfile import LogReader
from flightlog.mount import Mount, load_mount, parse_mount

ATTACHMENT = "mount.yaml"


def find_mount(chosen: Mount | str | None, readers: Sequence[LogReader]) -> tuple[Mount, str]:
    """The mount, and where it comes from.

    Raises
    ------
    ConfigError
        The logs hold different mounts, or one that cannot be read.
    """
    if isinstance(chosen, str):
        return load_mount(chosen), chosen
    if chosen is not None:
        return chosen, "survey"
    found = {
        parse_mount(reader.attachments[ATTACHMENT].decode(errors="replace"), f"{reader.path}: {ATTACHMENT}"): reader
        for reader in readers
        if ATTACHMENT in reader.attachments
    }
    if len(found) > 1:
        paths = ", ".join(str(reader.path) for reader in found.values())
        raise ConfigError(f"{paths}: hold different mounts; give the right one in the survey file")
    if found:
        return next(iter(found)), "log"
    default = resources.files("firmware_config").joinpath("mount.yaml").read_text(encoding="utf-8")
    return parse_mount(default, "firmware_config/mount.yaml"), "firmware_config/mount.yaml"
