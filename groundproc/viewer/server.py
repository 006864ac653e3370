"""The viewer's page on this machine alone, for a cloud of any size; and edits of its classes, where they are asked for."""

import json
import secrets
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final
from urllib.parse import parse_qs, urlsplit

from flightlog.errors import SourceError, SwathError
from groundproc.viewer.edits import Edit, edits_of
from groundproc.viewer.page import VIEWER, held, page, script_of
from groundproc.viewer.served import Served

Save = Callable[[list[Edit]], dict[str, Any]]

STYLES: Final = ("base.css", "viewer.css", "view.css")
_NAMES: Final = ("localhost", "127.0.0.1", "[::1]")
_MOST_BODY: Final = 32 << 20
_TOKEN: Final = "X-Swath-Token"


class ViewServer:
    """Serves a cloud on the loopback interface, in threads of its own.

    Parameters
    ----------
    served : Served
    port : int
        0: any free one.
    save : callable, optional
        Writes a copy with the edits that it is given, and says what came of it; None: there is no editing.

    Raises
    ------
    SourceError
        The port is taken.
    """

    def __init__(self, served: Served, port: int, save: Save | None = None) -> None:
        self.served, self.save = served, save
        self.token = secrets.token_urlsafe(24)
        self.edits: list[Edit] = []
        self.plain: list[Any] = []
        """The edits as the page sent them, for a page that is loaded again."""
        self.unsaved = 0
        self.lock = threading.Lock()
        viewer = self

        class Handler(_Handler):
            owner = viewer

        try:
            self._server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
        except OSError as error:
            raise SourceError(f"TCP port {port} at 127.0.0.1 cannot be opened: {error.strerror or error}") from None
        self._server.daemon_threads = True
        self.port = int(self._server.server_address[1])
        self._thread = threading.Thread(target=self._server.serve_forever, name="view", daemon=True)
        self._thread.start()

    def page(self) -> bytes:
        """The page as it is now."""
        told = self.served.scene | {"token": self.token, "editable": self.save is not None, "edits": self.plain}
        body = f'<div id="viewer" class="viewer whole"></div>{held("scene", told)}'
        text = page(
            f"{self.served.scene['name']} - swath view",
            STYLES,
            body,
            script_of((*VIEWER, "view.js")),
            "; connect-src 'self'",
        )
        return text.encode()

    def close(self) -> None:
        """Stop to serve."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(5.0)


class _Handler(BaseHTTPRequestHandler):
    owner: ViewServer
    protocol_version = "HTTP/1.1"
    timeout = 30

    def do_GET(self) -> None:
        """Answer; only to who calls this machine by its own name, so that no other site's page reads along."""
        if not self._is_ours():
            return
        url = urlsplit(self.path)
        if url.path == "/":
            self._answer(200, "text/html; charset=utf-8", self.owner.page())
        elif url.path == "/node":
            self._node(parse_qs(url.query).get("key", [""])[0])
        else:
            self._answer(404, "text/plain", b"not here\n")

    def do_POST(self) -> None:
        """Take edits, or save; only from our own page, which knows the token."""
        body = self._body()
        if body is None or not self._is_ours():
            return
        if not secrets.compare_digest(self.headers.get(_TOKEN) or "", self.owner.token):
            self._answer(403, "text/plain", b"only the page of this program may change anything\n")
            return
        try:
            if self.path == "/edits" and self.owner.save is not None:
                self._told(self._edits(body))
            elif self.path == "/save" and self.owner.save is not None:
                self._told(self._save())
            else:
                self._answer(404, "text/plain", b"not here\n")
        except SwathError as error:
            self._answer(400, "text/plain; charset=utf-8", f"{error}\n".encode())

    def _edits(self, body: bytes) -> dict[str, Any]:
        try:
            plain = json.loads(body)
        except (ValueError, RecursionError):
            plain = None
        edits = edits_of(plain)
        with self.owner.lock:
            self.owner.edits, self.owner.plain, self.owner.unsaved = edits, plain, len(edits)
        return {"edits": len(edits)}

    def _save(self) -> dict[str, Any]:
        assert self.owner.save is not None
        with self.owner.lock:
            found = self.owner.save(self.owner.edits)
            self.owner.unsaved = 0
        return found

    def _node(self, name: str) -> None:
        parts = name.split("-")
        if len(parts) != 4 or not all(part.isdecimal() and len(part) < 11 for part in parts):
            self._answer(404, "text/plain", b"no such node\n")
            return
        level, x, y, z = map(int, parts)
        try:
            found = self.owner.served.node((level, x, y, z))
        except SwathError as error:
            self._answer(500, "text/plain; charset=utf-8", f"{error}\n".encode())
            return
        if found is None:
            self._answer(404, "text/plain", b"no such node\n")
        else:
            self._answer(200, "application/octet-stream", found)

    def _is_ours(self) -> bool:
        host = (self.headers.get("Host") or "").rsplit(":", 1)[0]
        if host in _NAMES:
            return True
        self._answer(403, "text/plain", b"this page is for this machine\n")
        return False

    def _body(self) -> bytes | None:
        """What was sent; None where it is too long to be read, and that is answered."""
        text = self.headers.get("Content-Length") or "0"
        if not text.isdecimal() or int(text) > _MOST_BODY:
            self.close_connection = True
            self._answer(413, "text/plain", b"too long\n")
            return None
        return self.rfile.read(int(text))

    def _told(self, value: dict[str, Any]) -> None:
        self._answer(200, "application/json", json.dumps(value).encode())

    def _answer(self, code: int, kind: str, body: bytes) -> None:
        try:
            self.send_response(code)
            for name, value in {
                "Content-Type": kind,
                "Content-Length": str(len(body)),
                "Cache-Control": "no-store",
                "X-Content-Type-Options": "nosniff",
                "X-Frame-Options": "DENY",
            }.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)
        except ConnectionError:
            self.close_connection = True

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - the base class calls it so
        """Say nothing: the terminal is the command's."""
