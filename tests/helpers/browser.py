"""Chromium without a screen, driven over its DevTools protocol: mouse, pictures, and all that a page says or asks for."""

import base64
import contextlib
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from websockets.sync.client import ClientConnection, connect

PROGRAM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
_FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--hide-scrollbars", "--no-first-run", "--disable-extensions", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--mute-audio", "--remote-debugging-port=0", "--window-size=1200,800",
)  # fmt: skip


class Page:
    """One tab."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self._number = 0
        self.said: list[str] = []
        """Errors and warnings of the console, and exceptions."""
        self.asked: list[str] = []
        """Addresses of all requests."""
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        number = self._number
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=120))
            if message.get("id") == number:
                assert "error" not in message, (method, message["error"])
                result: dict[str, Any] = message["result"]
                return result
            self._heard(message)

    def _heard(self, message: dict[str, Any]) -> None:
        method, told = message.get("method"), message.get("params", {})
        if method == "Runtime.exceptionThrown":
            details = told["exceptionDetails"]
            self.said.append(str(details.get("exception", {}).get("description") or details["text"]))
        elif method == "Runtime.consoleAPICalled" and told["type"] in ("error", "warning", "assert"):
            self.said.append(" ".join(str(each.get("value", each.get("description"))) for each in told["args"]))
        elif method == "Log.entryAdded" and told["entry"]["level"] in ("error", "warning"):
            self.said.append(told["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.asked.append(told["request"]["url"])

    def open(self, address: str) -> None:
        self.call("Page.navigate", url=address)

    def run(self, expression: str) -> Any:
        """The value of an expression; promises are waited for."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, (expression, found["exceptionDetails"])
        return found["result"].get("value")

    def until(self, expression: str, patience_s: float = 90.0) -> Any:
        """Wait for an expression to be true; its value."""
        end = time.monotonic() + patience_s
        while True:
            with contextlib.suppress(AssertionError):  # the page may not be there yet
                if value := self.run(expression):
                    return value
            assert time.monotonic() < end, f"{expression}: not true after {patience_s:g} s; the page said {self.said}"
            time.sleep(0.05)

    def mouse(self, kind: str, x: float, y: float, button: str = "left", **more: Any) -> None:
        """One event: mousePressed, mouseMoved, mouseReleased, mouseWheel."""
        held = {"left": 1, "right": 2}.get(button, 0) if kind != "mouseReleased" else 0
        count = 0 if kind in ("mouseMoved", "mouseWheel") else 1
        self.call(
            "Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, buttons=held, clickCount=count, **more
        )

    def click(self, x: float, y: float) -> None:
        self.mouse("mousePressed", x, y)
        self.mouse("mouseReleased", x, y)

    def drag(self, places: list[tuple[float, float]], button: str = "left") -> None:
        self.mouse("mousePressed", *places[0], button=button)
        for place in places[1:]:
            self.mouse("mouseMoved", *place, button=button)
        self.mouse("mouseReleased", *places[-1], button=button)

    def press(self, selector: str) -> None:
        """Click into the middle of an element."""
        box = self.run(
            f"(() => {{ const e = document.querySelector({json.dumps(selector)}); e.scrollIntoView({{block: 'center'}}); "
            "const b = e.getBoundingClientRect(); return [b.left + b.width / 2, b.top + b.height / 2]; })()"
        )
        self.click(*box)

    def looks(self, width: int, height: int, *, dark: bool = False, phone: bool = False) -> None:
        """Size of the window, and what the user prefers."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=2 if phone else 1,
            mobile=phone,
        )
        if phone:
            self.call("Emulation.setTouchEmulationEnabled", enabled=True)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])

    def key(self, name: str, *, shift: bool = False) -> None:
        """Press a key, such as ArrowLeft, Tab or Enter."""
        number = {
            "Tab": 9,
            "Enter": 13,
            "Escape": 27,
            "ArrowLeft": 37,
            "ArrowUp": 38,
            "ArrowRight": 39,
            "ArrowDown": 40,
        }
        told: dict[str, Any] = {
            "key": name,
            "code": name,
            "modifiers": 8 * shift,
            "windowsVirtualKeyCode": number[name],
        }
        self.call("Input.dispatchKeyEvent", type="keyDown", **told, **({"text": "\r"} if name == "Enter" else {}))
        self.call("Input.dispatchKeyEvent", type="keyUp", **told)

    def picture(self, whole: bool = False) -> bytes:
        """PNG."""
        found = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        return base64.b64decode(found["data"])

    def pixels(self) -> npt.NDArray[np.uint8]:
        """The window, shape (rows, columns, 3)."""
        import io

        from PIL import Image

        return np.asarray(Image.open(io.BytesIO(self.picture())).convert("RGB"))


@contextlib.contextmanager
def browser(folder: Path) -> Iterator[Page]:
    """A browser with one empty tab; its profile lies in a folder."""
    assert PROGRAM is not None
    profile = folder / "profile"
    command = [PROGRAM, *_FLAGS, f"--user-data-dir={profile}", "about:blank"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        with connect(_address(profile, process), max_size=None, proxy=None, open_timeout=60) as socket:
            page = Page(socket)
            try:
                yield page
            finally:
                with contextlib.suppress(Exception):
                    page.call("Browser.close")
    finally:
        process.terminate()
        process.wait(30)


def _address(profile: Path, process: "subprocess.Popen[bytes]") -> str:
    """Of the tab."""
    from urllib.request import ProxyHandler, build_opener

    named, end = profile / "DevToolsActivePort", time.monotonic() + 90.0
    opener = build_opener(ProxyHandler({}))
    while True:
        assert process.poll() is None, f"the browser ended with {process.returncode}"
        assert time.monotonic() < end, "the browser does not answer"
        with contextlib.suppress(OSError, IndexError):
            port = named.read_text().split()[0]
            with opener.open(f"http://127.0.0.1:{port}/json", timeout=10) as answer:
                tabs = json.load(answer)
            for tab in tabs:
                if tab["type"] == "page":
                    return str(tab["webSocketDebuggerUrl"])
        time.sleep(0.05)
