"""Man pages of swathd, made from its command line and its options, so that page and program cannot differ.

swathd(8) has the commands with their options, swathd.yaml(5) every option of the configuration with default and bounds.
"""

import argparse
import dataclasses
import json
from collections.abc import Iterator
from typing import Any, Final

from flightlog.config import to_mapping
from onboard.cli import _parser
from onboard.config import SwathdConfig

_FILES: Final = {
    "/etc/swathd/swathd.yaml": "the configuration",
    "/etc/swathd/authorized_keys": "keys that may fetch the logs",
    "/var/lib/swathd": "flight logs and their manifest",
    "/run/swathd/status.json": "how it goes, once a second",
}


def escaped(text: str) -> str:
    """Text as roff takes it: no command at the begin of a line, no minus turned into a hyphen."""
    text = text.replace("\\", "\\e").replace("-", "\\-")
    return "\n".join("\\&" + line if line.startswith((".", "'")) else line for line in text.splitlines())


def head(name: str, section: int, version: str, about: str) -> list[str]:
    """Title and name."""
    title = f'.TH {name.upper()} {section} "" "swathd {version}" "swath"'
    return [title, ".SH NAME", f"{name} \\- {escaped(about)}"]


def program(version: str) -> str:
    """swathd(8)."""
    parser = _parser()
    lines = head("swathd", 8, version, "flight log recorder for a lidar and an autopilot")
    lines += [".SH SYNOPSIS", ".B swathd", ".I COMMAND", "[options]", ".SH DESCRIPTION"]
    lines += [
        escaped(
            "swathd records the packets of a Velodyne HDL-32E and the MAVLink stream of an ArduPilot board to flight logs (MCAP). "
            "It is a service; its other commands look at it, at the lidar and at the autopilot."
        ),
        ".SH COMMANDS",
    ]
    for name, about, child in commands(parser):
        lines += [".TP", f".B {escaped(name)}", escaped(f"{about[:1].upper()}{about[1:]}.")]
        for action in child._actions:
            if isinstance(action, argparse._HelpAction):
                continue
            lines += [".RS", ".TP", f".B {escaped(written(action))}", escaped(help_of(action)), ".RE"]
    lines += [
        ".SH EXIT STATUS",
        "0 good, 1 warning or an error, 2 critical, or a wrong command line or configuration.",
        ".SH FILES",
    ]
    for path, about in _FILES.items():
        lines += [".TP", f".I {escaped(path)}", escaped(about)]
    lines += [".SH SEE ALSO", ".BR swathd.yaml (5),", ".BR systemctl (1),", ".BR journalctl (1)"]
    return "\n".join(lines) + "\n"


def commands(parser: argparse.ArgumentParser) -> Iterator[tuple[str, str, argparse.ArgumentParser]]:
    """Name, help and parser of each command."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            abouts = {choice.dest: choice.help or "" for choice in action._choices_actions}
            for name, child in action.choices.items():
                yield name, abouts[name], child


def written(action: argparse.Action) -> str:
    """An option or argument with its value."""
    value = action.metavar if isinstance(action.metavar, str) else ""
    if not action.option_strings:
        return value or action.dest
    choices = "|".join(map(str, action.choices)) if action.choices else ""
    return " ".join(filter(None, (", ".join(action.option_strings), value or choices)))


def help_of(action: argparse.Action) -> str:
    """What an option is, with percent signs as they are shown."""
    return (action.help or "").replace("%%", "%")


def configuration(version: str) -> str:
    """swathd.yaml(5)."""
    lines = head("swathd.yaml", 5, version, "configuration of swathd")
    lines += [".SH DESCRIPTION"]
    lines += [
        escaped(
            "A YAML file of sections and keys. A key that is left out has its default; one that is not known, or a value out of range, "
            "is an error that names it. `swathd config` prints the file with every default."
        )
    ]
    for section in dataclasses.fields(SwathdConfig):
        value = getattr(SwathdConfig(), section.name)
        lines += [f'.SH "{section.name.upper()}"', escaped(section.metadata.get("about", ""))]
        if dataclasses.is_dataclass(value):
            lines += [line for entry in keys(value, section.name) for line in entry]
        else:
            lines += entry(section, section.name, value)
    lines += [".SH SEE ALSO", ".BR swathd (8)"]
    return "\n".join(lines) + "\n"


def keys(section: Any, prefix: str) -> Iterator[list[str]]:
    """The entries of a section and of those within it."""
    for field in dataclasses.fields(section):
        value = getattr(section, field.name)
        name = f"{prefix}.{field.name}"
        if dataclasses.is_dataclass(value):
            yield from keys(value, name)
        else:
            yield entry(field, name, value)


def entry(field: "dataclasses.Field[Any]", name: str, value: Any) -> list[str]:
    """One key."""
    low, high, choices = (field.metadata.get(word) for word in ("minimum", "maximum", "choices"))
    bounds = f" One of {', '.join(map(str, choices))}." if choices else ""
    if low is not None and high is not None:
        bounds = f" {low} to {high}."
    shown = json.dumps(to_mapping(value))
    about = field.metadata.get("about", "")
    return [".TP", f".B {escaped(name)}", escaped(f"{about[:1].upper()}{about[1:]}.{bounds} Default: {shown}.")]
