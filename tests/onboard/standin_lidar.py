"""A stand-in for the web server of an HDL-32E: written from the maker's Webserver User Guide, not from what the client does.

It keeps what is set and what is saved apart, as the sensor does: a power cycle brings back what was saved.
"""

import copy
import json
import threading
import urllib.parse
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

FACTORY: dict[str, Any] = {
    "laser": "On",
    "returns": "Strongest",
    "rpm": 600,
    "fov": {"start": 0, "end": 359},
    "phaselock": {"enabled": "Off", "offset": 0},
    "host": {"addr": "255.255.255.255", "dport": 2368, "tport": 8308},
    "net": {"addr": "192.168.1.201", "mask": "255.255.255.0", "gateway": "192.168.1.1", "dhcp": "Off"},
}


class StandinLidar:
    """An HTTP server on the loopback; `address` is ip:port."""

    def __init__(self, *, deaf: bool = False, slow_s: float = 0.0, pages: bool = True) -> None:
        self.settings, self.saved = copy.deepcopy(FACTORY), copy.deepcopy(FACTORY)
        self.posts: list[tuple[str, str]] = []
        self.deaf, self.slow_s, self.pages = deaf, slow_s, pages
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), self._handler())
        self._server.daemon_threads = True
        self.address = f"127.0.0.1:{self._server.server_address[1]}"
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.02})
        self._thread.start()

    def close(self) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    def power_cycle(self) -> None:
        self.settings = copy.deepcopy(self.saved)

    def page(self, path: str) -> dict[str, Any] | None:
        return {
            "/cgi/settings.json": self.settings,
            "/cgi/status.json": {
                "gps": {"pps_state": "Locked", "position": "58 24.6N 15 36.3E"},
                "motor": {"state": "On", "rpm": self.settings["rpm"], "lock": "Off", "phase": 1234},
                "laser": {"state": self.settings["laser"]},
            },
            "/cgi/info.json": {"model": "HDL-32E", "serial": "11001120123456"},
        }.get(path)

    def post(self, path: str, body: str) -> int:
        """Take a form; gives the status."""
        self.posts.append((path, body))
        if path == "/cgi/save":
            if body != "submit":
                return 400
            self.saved = copy.deepcopy(self.settings)
            return 204
        fields = dict(urllib.parse.parse_qsl(body, strict_parsing=True))
        if not all(self._valid(path, name, value) for name, value in fields.items()):
            return 400
        if not self.deaf:
            threading.Timer(self.slow_s, self._set, (path, fields)).start() if self.slow_s else self._set(path, fields)
        return 204

    @staticmethod
    def _valid(path: str, name: str, value: str) -> bool:
        match path, name:
            case "/cgi/setting", "rpm":
                return value.isdecimal() and 300 <= int(value) <= 1200 and int(value) % 60 == 0
            case "/cgi/setting", "returns":
                return value in ("Strongest", "Last", "Dual")
            case "/cgi/setting", "laser":
                return value in ("on", "off")
            case "/cgi/setting/fov", "start" | "end":
                return value.isdecimal() and int(value) <= 359
            case "/cgi/setting/host", "dport" | "tport":
                return value.isdecimal() and 0 < int(value) < 65536
            case "/cgi/setting/host", "addr":
                return len(value.split(".")) == 4
        return False

    def _set(self, path: str, fields: dict[str, str]) -> None:
        part = self.settings if path == "/cgi/setting" else self.settings[path.rpartition("/")[2]]
        for name, value in fields.items():
            part[name] = int(value) if isinstance(part[name], int) else value.capitalize() if name == "laser" else value

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        lidar = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                page = lidar.page(self.path)
                if not lidar.pages:
                    self._answer(200, "text/html", b"<html>a radio bridge</html>")
                elif page is None:
                    self._answer(404, "text/html", b"")
                else:
                    self._answer(200, "application/json", json.dumps(page).encode())

            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"])).decode()
                self._answer(lidar.post(self.path, body), "text/html", b"")

            def _answer(self, status: int, kind: str, body: bytes) -> None:
                self.send_response(status)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *args: object) -> None:
                pass

        return Handler
