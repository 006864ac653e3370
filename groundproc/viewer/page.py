"""Pages put together from `web/`: style and script stand in them, and a policy that lets nothing else in."""

import base64
import hashlib
import html
import json
from collections.abc import Sequence
from importlib import resources
from typing import Any, Final

VIEWER: Final = ("palette.js", "camera.js", "measure.js", "renderer.js", "viewer.js", "controls.js")
"""Scripts of the viewer, in the order in which they need each other."""


def web(name: str) -> str:
    """A file of `web/`."""
    return resources.files("groundproc.viewer").joinpath("web", name).read_text(encoding="utf-8")


def script_of(names: Sequence[str]) -> str:
    """Scripts as one, with names of its own."""
    return '(() => {\n"use strict";\n' + "\n".join(web(name) for name in names) + "\n})();"


def page(title: str, styles: Sequence[str], body: str, script: str, more: str = "") -> str:
    """A whole page.

    Parameters
    ----------
    title : str
        Plain text.
    styles : sequence of str
        Files of `web/`.
    body : str
        HTML.
    script : str
        JavaScript, at the end of the body.
    more : str
        Of the policy: what is allowed beside the page's own style and script, and pictures within it.
    """
    style = "\n".join(web(name) for name in styles)
    policy = (
        f"default-src 'none'; style-src '{_hash(style)}'; script-src '{_hash(script)}'; img-src data: blob:; "
        f"base-uri 'none'; form-action 'none'{more}"
    )
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<link rel="icon" href="data:,">\n<title>{html.escape(title)}</title>\n<style>{style}</style>\n</head>\n'
        f"<body>\n{body}\n<script>{script}</script>\n</body>\n</html>\n"
    )


def held(name: str, value: Any) -> str:
    """A value for the page's script, whatever it holds: nothing in it ends the element or begins another."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    for sign in "<>&\u2028\u2029":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return f'<script type="application/json" id="{name}">{text}</script>'


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
