"""quality.json: what went in, what was dropped and why, how well it fits."""

import json

from groundproc.files import written_aside
from groundproc.products.product import Context


def write(context: Context) -> None:
    """Write what the flight's steps have to say."""
    with written_aside(context.folder / "quality.json") as aside:
        aside.write_text(json.dumps(context.quality, indent=2) + "\n", encoding="utf-8")
