"""The HDL-32E's settings through the web server that newer firmware has: read, compared, set, saved, read again.

Addresses and forms are those of the maker's "Webserver User Guide" for the VLP-16 and HDL-32E. Older firmware has no web server:
it turns at about 10 Hz, sends to 192.168.3.255, and cannot be set at all.
"""

import http.client
import json
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from flightlog.config import option
from flightlog.errors import SourceError

_TIMEOUT_S: Final = 3.0
_SETTLE_S: Final = 5.0
"""How long the sensor may take until it shows what it was told."""
_LONGEST_ANSWER: Final = 65536


@dataclass(frozen=True, slots=True)
class FovSetting:
    """The sector that the sensor sends."""

    start: int = option(255, "azimuth where it begins [deg]", minimum=0, maximum=359)
    end: int = option(105, "azimuth where it ends, clockwise [deg]", minimum=0, maximum=359)


@dataclass(frozen=True, slots=True)
class HostSetting:
    """Whom the sensor sends to."""

    addr: str = option("255.255.255.255", "IP address")
    dport: int = option(2368, "port of the data packets", minimum=1, maximum=65535)
    tport: int = option(8308, "port of the position packets", minimum=1, maximum=65535)


@dataclass(frozen=True, slots=True)
class LidarSettings:
    """A settings file, firmware_config/hdl32e.yaml."""

    address: str = option("192.168.1.201", "where the sensor's web server is, perhaps with :port")
    rpm: int = option(600, "turns per minute, in steps of 60", minimum=300, maximum=1200)
    returns: str = option("Strongest", "return mode", choices=("Strongest", "Last", "Dual"))
    laser: bool = option(True, "whether it fires")
    fov: FovSetting = option(FovSetting, "azimuths sent")
    host: HostSetting = option(HostSetting, "whom it sends to")

    def __post_init__(self) -> None:
        if self.rpm % 60:
            raise ValueError(f"rpm {self.rpm} found, expected a multiple of 60")

    def values(self) -> dict[str, str]:
        """By the names that `_FORMS` has, as the web server writes them."""
        return {
            "rpm": str(self.rpm),
            "returns": self.returns,
            "laser": "on" if self.laser else "off",
            "fov.start": str(self.fov.start),
            "fov.end": str(self.fov.end),
            "host.addr": self.host.addr,
            "host.dport": str(self.host.dport),
            "host.tport": str(self.host.tport),
        }


_FORMS: Final = {
    "rpm": "/cgi/setting",
    "returns": "/cgi/setting",
    "laser": "/cgi/setting",
    "fov.start": "/cgi/setting/fov",
    "fov.end": "/cgi/setting/fov",
    "host.addr": "/cgi/setting/host",
    "host.dport": "/cgi/setting/host",
    "host.tport": "/cgi/setting/host",
}
"""Name in settings.json, and where the form of its last word is sent to."""


@dataclass(frozen=True, slots=True)
class Difference:
    """A setting that is not as wanted; `found` is None where the sensor does not name it."""

    name: str
    wanted: str
    found: str | None

    def __str__(self) -> str:
        found = "not told by the sensor" if self.found is None else f"{self.found} found"
        return f"{self.name}: {found}, {self.wanted} wanted"


def compare(wanted: LidarSettings, tree: Mapping[str, Any]) -> list[Difference]:
    """What differs between the settings wanted and those of a settings.json."""
    differences = []
    for name, value in wanted.values().items():
        found = _found(tree, name)
        if found is None or found.lower() != value.lower():
            differences.append(Difference(name, value, found))
    return differences


def _found(tree: Mapping[str, Any], name: str) -> str | None:
    """A setting by its dotted name, numbers and truth values as the web server writes them in forms."""
    node: Any = tree
    for word in name.split("."):
        if not isinstance(node, Mapping) or word not in node:
            return None
        node = node[word]
    if isinstance(node, bool):
        return "on" if node else "off"
    if isinstance(node, float) and node.is_integer():
        node = int(node)
    return str(node)


class LidarWeb:
    """The sensor's web server.

    Parameters
    ----------
    address : str
        IP address, perhaps with `:port`.
    """

    def __init__(self, address: str) -> None:
        self.address = address
        # the sensor is on the local cable: ignore any proxy that the environment names
        self._opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))

    def read(self, name: str) -> dict[str, Any]:
        """Read one of settings, status, info, diag.

        Raises
        ------
        SourceError
            Nobody answers, or not as a lidar does.
        """
        text = self._ask(f"/cgi/{name}.json", None)
        try:
            tree = json.loads(text)
        except ValueError:
            tree = None
        if not isinstance(tree, dict):
            raise SourceError(f"http://{self.address}/cgi/{name}.json is not what an HDL-32E's web server gives")
        return tree

    def apply(self, differences: list[Difference]) -> None:
        """Set what differs, one form for each value, and save it for the next power-on.

        Raises
        ------
        SourceError
            As in `read`, or a form is refused.
        """
        for difference in differences:
            form = urllib.parse.urlencode({difference.name.split(".")[-1]: difference.wanted})
            self._ask(_FORMS[difference.name], form.encode())
        self._ask("/cgi/save", b"submit")

    def verify(self, wanted: LidarSettings, settle_s: float = _SETTLE_S) -> None:
        """Read back until all is as wanted.

        Raises
        ------
        SourceError
            Something is still different after `settle_s` seconds.
        """
        end = time.monotonic() + settle_s
        while differences := compare(wanted, self.read("settings")):
            if time.monotonic() > end:
                told = "; ".join(map(str, differences))
                raise SourceError(f"the lidar at {self.address} did not take its settings: {told}")
            time.sleep(0.2)

    def _ask(self, path: str, form: bytes | None) -> bytes:
        request = urllib.request.Request(f"http://{self.address}{path}", form)
        try:
            with self._opener.open(request, timeout=_TIMEOUT_S) as answer:
                return bytes(answer.read(_LONGEST_ANSWER))
        except urllib.error.HTTPError as error:
            error.close()
            raise SourceError(
                f"http://{self.address}{path} answers {error.code} {error.reason}: not the web server of an HDL-32E, "
                "or firmware too old for it"
            ) from None
        except (OSError, http.client.HTTPException, ValueError) as error:
            raise SourceError(self._silence(error)) from None

    def _silence(self, error: Exception) -> str:
        """Why there is no answer, and what to do."""
        reason = error.reason if isinstance(error, urllib.error.URLError) else error
        if isinstance(reason, ConnectionRefusedError):
            return (
                f"the lidar at {self.address} has no web server (connection refused): old HDL-32E firmware has none, turns at "
                "about 10 Hz, sends to 192.168.3.255 and cannot be set; swathd records it all the same"
            )
        if isinstance(reason, TimeoutError):
            return (
                f"nothing answers at {self.address} within {_TIMEOUT_S:g} s: see that the lidar has power and this computer an "
                "address in its network; old HDL-32E firmware has no web server and is at an address made from its serial number"
            )
        return f"the lidar at {self.address} cannot be asked: {getattr(reason, 'strerror', None) or reason}"
