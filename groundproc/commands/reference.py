"""docs/commands.md: the options of all commands, from the parsers that the commands themselves use."""

import argparse
from typing import Final

from groundproc.cli import OURS, commands
from groundproc.commands import grouped

READ_ON: Final = {
    "adjust": "methods/strips.md", "assess": "assess.md", "bag": "ros.md", "banks": "uses/banks.md", "batch": "campaigns.md",
    "calibrate": "methods/calibration.md", "change": "uses/change.md", "colour": "imagery.md",
    "compass": "methods/dynamic.md", "completion": "tutorial.md", "contours": "clouds.md#contours", "decode": "sensors.md",
    "detect": "uses/detect.md", "displacement": "uses/displacement.md",
    "drape": "uses/drape.md", "export": "clouds.md", "fuse": "uses/fuse.md", "ground": "uses/ground.md",
    "images": "imagery.md", "import": "importing.md", "info": "importing.md", "init": "survey.md",
    "live": "methods/live.md",
    "merge": "clouds.md#several-flights-in-one-cloud", "moving": "uses/moving.md",
    "ndvi": "imagery.md", "ortho": "imagery.md", "orthophoto": "uses/reflectance.md",
    "passability": "uses/passability.md",
    "pipes": "uses/pipes.md", "plan": "plan.md", "ppk": "positions.md", "process": "processing.md", "profile": "clouds.md#profiles",
    "pull": "install.md#get-the-logs-swath-pull", "raster": "clouds.md", "recover": "aircraft.md#flight-logs",
    "reflectance": "uses/reflectance.md", "replay": "tutorial.md", "report": "report.md", "section": "uses/section.md",
    "simulate": "simulator.md", "smooth": "uses/smooth.md", "soil": "uses/soil.md",
    "tile": "clouds.md#tiles", "tin": "clouds.md#triangles-for-design-and-machine-control",
    "transform": "transform.md", "trees": "uses/trees.md",
    "verify-sensor": "uses/verify-sensor.md", "view": "view.md", "viewshed": "uses/viewshed.md", "volume": "clouds.md#volumes",
    "warmup": "install.md#on-the-ground-compile-once", "mesh": "imagery.md", "wide": "imagery.md",
    "windows": "uses/windows.md",
    "wires": "uses/wires.md",
}  # fmt: skip
"""Pages that say what a command is for and how it works."""


def commands_page() -> str:
    """commands.md, from the parsers that the commands themselves use."""
    found = {name: point for name, point in commands().items() if point.value.partition(".")[0] in OURS}
    parts = [
        "# Commands",
        "",
        "<!-- Made by docs/generate.py from the commands themselves: change those, not this. -->",
        "",
        "`swath COMMAND --help` says the same on the terminal. Exit codes: 0 all is well; 1 a file or the world is not as it should",
        "be, in one sentence; 2 the command line is wrong. `info`, `process` and `recover` give 3 where the result is doubtful.",
    ]
    for chapter, names in grouped(found).items():
        parts += ["", f"## {chapter[0].upper()}{chapter[1:]}"]
        for name in names:
            module = found[name].load()
            parser = argparse.ArgumentParser(prog=f"swath {name}", add_help=False)
            module.add_arguments(parser)
            parts += ["", f"### swath {name}", "", _sentence(parser.description or module.HELP, module.HELP, name)]
            rows = [_row(action) for action in parser._actions if action.help is not argparse.SUPPRESS]
            if rows:
                parts += ["", *rows]
    return "\n".join([*parts, ""])


def _sentence(description: str, about: str, name: str) -> str:
    told = about if about == description else f"{about}. {description.rstrip('.')}"
    more = f" [Read on]({READ_ON[name]})." if name in READ_ON else ""
    return f"{told[0].upper()}{told[1:]}.{more}".replace("<", "&lt;")


def _row(action: argparse.Action) -> str:
    """An item of a list, which wraps; a table would not."""
    names = ", ".join(action.option_strings)
    words = f"{names} {'' if action.nargs == 0 else _value(action)}".strip()
    about = (action.help or "").replace("%%", "%").replace("%(default)s", str(action.default))
    return f"- `{words}`: {about.replace('<', '&lt;')}"


def _value(action: argparse.Action) -> str:
    if isinstance(action.metavar, str):
        name = action.metavar
    elif action.choices is not None:
        name = "|".join(map(str, action.choices))
    else:
        name = action.dest.upper()
    return f"{name} ..." if action.nargs in ("*", "+") else name
