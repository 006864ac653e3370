"""A page on this machine alone that shows the flight: cloud and trajectory as they grow, and the status."""

import json
from collections.abc import Mapping
from importlib import resources
from typing import ClassVar, Final
from urllib.parse import SplitResult, parse_qs

import numpy as np

from groundproc.live.session import Session
from groundproc.machine.loopback import Handler, Loopback

_MOST: Final = 100_000
"""Points in an answer: 1.3 MB."""
_POLICY: Final = "default-src 'self'; script-src 'self' 'unsafe-inline'; style-src 'self' 'unsafe-inline'"


class PageServer(Loopback):
    """Serves a session on the loopback interface.

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
        super().__init__(type("Handler", (_Handler,), {"session": session, "page": page}), port, "page")


class _Handler(Handler):
    session: Session
    page: bytes
    headers_told: ClassVar[Mapping[str, str]] = {"Content-Security-Policy": _POLICY}

    def get(self, url: SplitResult) -> None:
        """Answer."""
        query = {name: values[0] for name, values in parse_qs(url.query).items()}
        if url.path == "/":
            self.answer(200, "text/html; charset=utf-8", self.page)
        elif url.path == "/status":
            self.answer(200, "application/json", json.dumps(self.session.status).encode())
        elif url.path == "/points":
            self._points(query)
        elif url.path == "/path":
            self._path(query)
        else:
            super().get(url)

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
        self.answer(200, "application/octet-stream", body, {name: str(value) for name, value in head.items()})


def _number(query: dict[str, str], name: str) -> int:
    text = query.get(name, "0")
    return int(text) if text.isdecimal() and len(text) < 12 else 0
