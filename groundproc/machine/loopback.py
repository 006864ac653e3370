"""Pages that are served on this machine alone, for a browser beside the program: the live view, and the viewer of clouds."""

import threading
from collections.abc import Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, ClassVar, Final
from urllib.parse import SplitResult, urlsplit

from flightlog.errors import SourceError

_NAMES: Final = ("localhost", "127.0.0.1", "[::1]")


class Loopback:
    """Serves requests on the loopback interface, in threads of its own.

    Parameters
    ----------
    handler : type
        Of its own class: what its requests need is an attribute of the class.
    port : int
        0: any free one.
    name : str
        Of the thread.

    Attributes
    ----------
    port : int
        Where it serves.

    Raises
    ------
    SourceError
        The port is taken.
    """

    def __init__(self, handler: type["Handler"], port: int, name: str) -> None:
        try:
            self._server = ThreadingHTTPServer(("127.0.0.1", port), handler)
        except OSError as error:
            raise SourceError(f"TCP port {port} at 127.0.0.1 cannot be opened: {error.strerror or error}") from None
        self._server.daemon_threads = True
        self.port = int(self._server.server_address[1])
        self._thread = threading.Thread(target=self._server.serve_forever, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop to serve."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(5.0)


class Handler(BaseHTTPRequestHandler):
    """Answers requests; only of who calls this machine by its own name, so that no other site's page reads along.

    Attributes
    ----------
    headers_told : mapping
        Headers of every answer, beside type and length.
    """

    protocol_version = "HTTP/1.1"
    timeout = 30
    headers_told: ClassVar[Mapping[str, str]] = {}

    def get(self, url: SplitResult) -> None:
        """Answer a GET of one's own machine; a page has its own answers."""
        self.answer(404, "text/plain", b"not here\n")

    def post(self) -> None:
        """Answer a POST, of whomever: its body must be read before it is refused."""
        self.answer(405, "text/plain", b"nothing to be sent here\n")

    def do_GET(self) -> None:
        """Answer, or refuse."""
        if self.is_ours():
            self.get(urlsplit(self.path))

    def do_POST(self) -> None:
        """Answer, or refuse."""
        self.post()

    def is_ours(self) -> bool:
        """Whether the request comes from a page of this machine; where not, it is refused here."""
        host = (self.headers.get("Host") or "").rsplit(":", 1)[0]
        if host in _NAMES:
            return True
        self.answer(403, "text/plain", b"this page is for this machine\n")
        return False

    def answer(self, code: int, kind: str, body: bytes, more: Mapping[str, str] | None = None) -> None:
        """Send an answer of a media type; who has hung up is no error."""
        headers = {"Content-Type": kind, "Content-Length": str(len(body)), "Cache-Control": "no-store"}
        try:
            self.send_response(code)
            for name, value in (headers | dict(self.headers_told) | dict(more or {})).items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)
        except ConnectionError:
            self.close_connection = True

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - the base class calls it so
        """Say nothing: the terminal is the command's."""
