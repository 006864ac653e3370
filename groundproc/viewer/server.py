"""The viewer's page on this machine alone, for a cloud of any size; and edits of its classes, where they are asked for."""

import json
import secrets
import threading
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Final
from urllib.parse import SplitResult, parse_qs

from flightlog.errors import SwathError
from groundproc.machine.loopback import Handler, Loopback
from groundproc.viewer.edits import Edit, edits_of
from groundproc.viewer.page import VIEWER, held, page, script_of
from groundproc.viewer.served import Served

Save = Callable[[list[Edit]], dict[str, Any]]

STYLES: Final = ("base.css", "viewer.css", "view.css")
_MOST_BODY: Final = 32 << 20
_TOKEN: Final = "X-Swath-Token"


class ViewServer(Loopback):
    """Serves a cloud on the loopback interface.

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
        super().__init__(type("Handler", (_Handler,), {"owner": self}), port, "view")

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


class _Handler(Handler):
    owner: ViewServer
    headers_told: ClassVar[Mapping[str, str]] = {"X-Content-Type-Options": "nosniff", "X-Frame-Options": "DENY"}

    def get(self, url: SplitResult) -> None:
        """Answer."""
        if url.path == "/":
            self.answer(200, "text/html; charset=utf-8", self.owner.page())
        elif url.path == "/node":
            self._node(parse_qs(url.query).get("key", [""])[0])
        else:
            super().get(url)

    def post(self) -> None:
        """Take edits, or save; only from our own page, which knows the token."""
        body = self._body()
        if body is None or not self.is_ours():
            return
        if not secrets.compare_digest(self.headers.get(_TOKEN) or "", self.owner.token):
            self.answer(403, "text/plain", b"only the page of this program may change anything\n")
            return
        try:
            if self.path == "/edits" and self.owner.save is not None:
                self._told(self._edits(body))
            elif self.path == "/save" and self.owner.save is not None:
                self._told(self._save())
            else:
                self.answer(404, "text/plain", b"not here\n")
        except SwathError as error:
            self.answer(400, "text/plain; charset=utf-8", f"{error}\n".encode())

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
            self.answer(404, "text/plain", b"no such node\n")
            return
        level, x, y, z = map(int, parts)
        try:
            found = self.owner.served.node((level, x, y, z))
        except SwathError as error:
            self.answer(500, "text/plain; charset=utf-8", f"{error}\n".encode())
            return
        if found is None:
            self.answer(404, "text/plain", b"no such node\n")
        else:
            self.answer(200, "application/octet-stream", found)

    def _body(self) -> bytes | None:
        """What was sent; None where it is too long to be read, and that is answered."""
        text = self.headers.get("Content-Length") or "0"
        if not text.isdecimal() or int(text) > _MOST_BODY:
            self.close_connection = True
            self.answer(413, "text/plain", b"too long\n")
            return None
        return self.rfile.read(int(text))

    def _told(self, value: dict[str, Any]) -> None:
        self.answer(200, "application/json", json.dumps(value).encode())
