"""What the uses of a flight found, as they left it in their folder."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from groundproc.reporting.markup import Html, joined, section, table, tag
from groundproc.verdict import warnings_in

FOLDER: Final = "uses"
"""Of the flight's folder: what the uses leave lies here, and of each NAME.json with `use`, `found`, `files` and `figures`."""

Found = Mapping[str, Any]


def read(folder: Path) -> list[Found]:
    """Of each use of a flight's folder what it found, by name."""
    trees: list[Found] = []
    for path in sorted((folder / FOLDER).glob("*.json")):
        tree = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(tree, dict) and "use" in tree:  # others are figures of their own
            trees.append(tree)
    return trees


def told(found: Sequence[Found]) -> Html:
    """The part of the report; empty where there is none."""
    if not found:
        return Html("")
    rows = [(each["use"], each["found"], ", ".join(each["files"])) for each in found]
    notes = [tag("li", f"{each['use']}: {text}") for each in found for text in warnings_in(each["figures"])]
    where = tag(
        "p", f"Their files are in {FOLDER}/ beside this page; their rasters are among the maps.", class_="aside"
    )
    return section(
        "uses", "Uses", joined([table(("Use", "Found", "Files"), rows), tag("ul", notes) if notes else "", where])
    )
