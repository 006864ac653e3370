"""A page on this machine alone that shows the flight: cloud and trajectory as they grow, and the status."""

import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any, Final
from urllib.parse import parse_qs, urlsplit

import numpy as np

from flightlog.errors import SourceError
from groundproc.live.session import Session

_NAMES: Final = ("localhost", "127.0.0.1", "[::1]")
_MOST: Final = 100_000
"""Points in an answer: 1.3 MB."""
_POLICY: Final = "default-src 'self'; script-src 'self' 'unsafe-inline'; style-src 'self' 'unsafe-inline'"


class PageServer:
    """Serves a session on the loopback interface, in threads of its own.

    Parameters
    ----------
    session : Session
    port : int
        0: any free one.

    Raises
    ------
    SourceError
        The port is taken.
    """

    def __init__(self, session: Session, port: int) -> None:
        page = resources.files("groundproc.live").joinpath("page.html").read_bytes()

        class Handler(_Handler):
            pass

        Handler.session, Handler.page = session, page
        try:
            self._server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
        except OSError as error:
            raise SourceError(f"TCP port {port} at 127.0.0.1 cannot be opened: {error.strerror or error}") from None
        self._server.daemon_threads = True
        self.port = int(self._server.server_address[1])
        self._thread = threading.Thread(target=self._server.serve_forever, name="page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop to serve."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(5.0)


class _Handler(BaseHTTPRequestHandler):
    session: Session
    page: bytes
    protocol_version = "HTTP/1.1"
    timeout = 30

    def do_GET(self) -> None:
        """Answer; only to who calls this machine by its own name, so that no other site's page reads along."""
        host = (self.headers.get("Host") or "").rsplit(":", 1)[0]
        if host not in _NAMES:
            self._answer(403, "text/plain", b"this page is for this machine\n")
            return
        url = urlsplit(self.path)
        query = {name: values[0] for name, values in parse_qs(url.query).items()}
        if url.path == "/":
            self._answer(200, "text/html; charset=utf-8", self.page)
        elif url.path == "/status":
            self._answer(200, "application/json", json.dumps(self.session.status).encode())
        elif url.path == "/points":
            self._points(query)
        elif url.path == "/path":
            self._path(query)
        else:
            self._answer(404, "text/plain", b"not here\n")

    def _points(self, query: dict[str, str]) -> None:
        """Positions as float32 triples, then intensities as bytes."""
        generation, start, xyz, intensity = self.session.cloud.part(
            _number(query, "generation"), _number(query, "from"), _MOST
        )
        self._send(generation, start, len(xyz), np.ascontiguousarray(xyz).tobytes() + intensity.tobytes())

    def _path(self, query: dict[str, str]) -> None:
        line = self.session.path
        generation, count, start = line.generation, line.count, _number(query, "from")
        if _number(query, "generation") != generation or start > count:
            start = 0
        self._send(generation, start, count - start, line.xyz[start:count].tobytes())

    def _send(self, generation: int, start: int, count: int, body: bytes) -> None:
        head = {"X-Generation": generation, "X-From": start, "X-Count": count}
        self._answer(200, "application/octet-stream", body, {name: str(value) for name, value in head.items()})

    def _answer(self, code: int, kind: str, body: bytes, more: dict[str, str] | None = None) -> None:
        try:
            self.send_response(code)
            for name, value in {
                "Content-Type": kind,
                "Content-Length": str(len(body)),
                "Cache-Control": "no-store",
                "Content-Security-Policy": _POLICY,
                **(more or {}),
            }.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)
        except ConnectionError:
            self.close_connection = True

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - the base class calls it so
        """Say nothing: the terminal is the status line's."""


def _number(query: dict[str, str], name: str) -> int:
    text = query.get(name, "0")
    return int(text) if text.isdecimal() and len(text) < 12 else 0
