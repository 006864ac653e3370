"""`swathd lidar`: the sensor's settings against firmware_config/hdl32e.yaml."""

import argparse
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from onboard.commands.health import CONFIG

if TYPE_CHECKING:
    from onboard.lidar_settings import LidarSettings, LidarWeb

HELP = "show the lidar's settings against those wanted, or set them"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.add_argument("action", choices=("show", "apply"), help="compare only, or set, save and verify")
    parser.add_argument("--settings", type=Path, metavar="FILE", help="settings wanted (default: hdl32e.yaml of swath)")
    parser.add_argument("--address", metavar="IP[:PORT]", help="where the lidar is (default: as the settings say)")
    parser.add_argument("--config", type=Path, default=CONFIG, metavar="FILE", help="configuration of the swathd here")
    parser.add_argument("--yes", action="store_true", help="apply without asking")


def run(options: argparse.Namespace) -> int:
    """Compare, and apply if asked to; 0 when all is as wanted, else 1."""
    from onboard.commands.agree import agreed
    from onboard.lidar_settings import LidarWeb, compare

    wanted = _wanted(options.settings)
    if options.address:
        wanted = dataclasses.replace(wanted, address=options.address)
    web = LidarWeb(wanted.address)
    differences = compare(wanted, web.read("settings"))
    print(_who(web))
    print("\n".join(map(str, differences)) or "all settings are as wanted")
    if not differences or options.action == "show":
        return int(bool(differences))
    _refuse_if_armed(options.config)
    if not agreed(f"set {len(differences)} of them in the lidar at {wanted.address}", options.yes):
        return 1
    web.apply(differences)
    web.verify(wanted)
    print(f"set, saved and read back: {', '.join(difference.name for difference in differences)}")
    return 0


def _wanted(path: Path | None) -> "LidarSettings":
    import importlib.resources

    from flightlog import config
    from onboard.lidar_settings import LidarSettings

    if path is not None:
        return config.load(path, LidarSettings)
    shipped = importlib.resources.files("firmware_config").joinpath("hdl32e.yaml")
    return config.loads(shipped.read_text(encoding="utf-8"), LidarSettings, "firmware_config/hdl32e.yaml")


def _refuse_if_armed(config: Path) -> None:
    """UsageError where a running swathd knows that the vehicle is armed: a head that changes its speed cannot scan.

    On the bench there may be no autopilot and no swathd: an unknown state is no reason to refuse.
    """
    import json

    from flightlog.errors import SwathError, UsageError
    from onboard.commands.health import look, status_path

    try:
        _, text = look(status_path(config), as_json=True)
    except SwathError:  # not configured
        return
    if json.loads(text).get("armed"):
        raise UsageError("the vehicle is armed; the lidar is set only while it is not")


def _who(web: "LidarWeb") -> str:
    """One line about the sensor: model, serial number, what its motor and GPS do."""
    info, status = web.read("info"), web.read("status")
    motor, gps = status.get("motor"), status.get("gps")
    words = [f"lidar at {web.address}", *(f"{name} {info[name]}" for name in ("model", "serial") if name in info)]
    if isinstance(motor, dict):
        words.append(f"motor {motor.get('state', '?')} at {motor.get('rpm', '?')} rpm")
    if isinstance(gps, dict):
        words.append(f"PPS {gps.get('pps_state', '?')}")
    return ", ".join(words)
