"""The viewer's page on this machine alone, for a cloud of any size; and edits of its classes, where they are asked for."""

import json
import secrets
import threading
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Final
from urllib.parse import SplitResult, parse_qs

from flightlog.errors import SwathError, UsageError
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
        self.version = 0
        """Of the edits: a page that has not seen the last of them, because another window drew it, changes nothing."""
        self.unsaved = 0
        self.saving = False
        self.lock = threading.Lock()
        super().__init__(type("Handler", (_Handler,), {"owner": self}), port, "view")

    def close(self) -> None:
        """Stop to serve, when what is being saved is whole or has failed."""
        super().close()
        with self.lock:
            pass

    def page(self) -> bytes:
        """The page as it is now."""
        told = self.served.scene | {"token": self.token, "editable": self.save is not None} | self.drawn()
        body = f'<div id="viewer" class="viewer whole"></div>{held("scene", told)}'
        text = page(
            f"{self.served.scene['name']} - swath view",
            STYLES,
            body,
            script_of((*VIEWER, "view.js")),
            "; connect-src 'self'",
        )
        return text.encode()

    def drawn(self) -> dict[str, Any]:
        """The edits, and which they are."""
        return {"edits": self.plain, "version": self.version}


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
                self._changed(body, self._edits)
            elif self.path == "/save" and self.owner.save is not None:
                self._changed(body, self._save)
            else:
                self.answer(404, "text/plain", b"not here\n")
        except SwathError as error:
            self.answer(400, "text/plain; charset=utf-8", f"{error}\n".encode())

    def _changed(self, body: bytes, change: Callable[[Any], dict[str, Any]]) -> None:
        """Do what is asked for by a page that knows all edits; any other is told them (409)."""
        try:
            plain = json.loads(body)
        except (ValueError, RecursionError):
            plain = None
        if not isinstance(plain, dict):
            raise UsageError("edits: expected an object with version and edits")
        with self.owner.lock:
            if plain.get("version") != self.owner.version:
                self._told(self.owner.drawn(), 409)
            else:
                self._told(change(plain.get("edits")))

    def _edits(self, plain: Any) -> dict[str, Any]:
        edits = edits_of(plain)
        owner = self.owner
        owner.edits, owner.plain, owner.unsaved = edits, plain, len(edits)
        owner.version += 1
        return {"edits": len(edits), "version": owner.version}

    def _save(self, _: Any) -> dict[str, Any]:
        assert self.owner.save is not None
        self.owner.saving = True
        try:
            found = self.owner.save(self.owner.edits)
        finally:
            self.owner.saving = False
        self.owner.unsaved = 0
        return found

    def _node(self, name: str) -> None:
        parts = name.split("-")
        if len(parts) != 5 or not all(part.isdecimal() and len(part) < 11 for part in parts):
            self.answer(404, "text/plain", b"no such node\n")
            return
        tree, level, x, y, z = map(int, parts)
        try:
            found = self.owner.served.node(tree, (level, x, y, z))
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

    def _told(self, value: dict[str, Any], code: int = 200) -> None:
        self.answer(code, "application/json", json.dumps(value).encode())
