"""Options of the command line made from the survey's dataclasses, so that words, units and help are written once."""

import argparse
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

from flightlog import config
from groundproc.commands.values import field_of_view, milliseconds
from groundproc.survey.setting import Command, command_of, default_of, value_text

T = TypeVar("T")
READERS: Final[dict[str, Callable[[str, str], Any]]] = {"azimuths": field_of_view, "milliseconds": milliseconds}


def add_settings(
    parser: argparse.ArgumentParser,
    sections: Sequence[type[Any]],
    only: Sequence[str] = (),
    defaults: Mapping[str, Any] | None = None,
) -> None:
    """Declare an option for every field that has a word on the command line.

    Parameters
    ----------
    parser : ArgumentParser
    sections : sequence of dataclass
        Of `groundproc.survey`.
    only : sequence of str
        Names of the fields to take; all where empty.
    defaults : mapping, optional
        What holds in this command where it is not as in the survey.
    """
    own = defaults or {}
    for section in sections:
        for field in dataclasses.fields(section):
            command = command_of(field)
            if command.words and (not only or field.name in only):
                add_setting(parser, field, command, own.get(field.name, default_of(field)))


def add_setting(
    parser: argparse.ArgumentParser, field: "dataclasses.Field[Any]", command: Command, default: Any
) -> None:
    """Declare one option; what is not given is None."""
    choices = field.metadata.get("choices")
    about = command.about.replace("%", "%%")
    if isinstance(default, bool):
        parser.add_argument(*command.words, dest=field.name, action="store_true", default=None, help=about)
        return
    looks: dict[str, Any] = {"choices": choices} if choices else {"metavar": command.metavar}
    told = command.absent or default_words(command, default)
    parser.add_argument(*command.words, dest=field.name, help=f"{about}; default: {told}", **looks)


def default_words(command: Command, default: Any) -> str:
    """A default as it would be typed."""
    return "{:g}-{:g}".format(*default) if command.reads == "azimuths" else value_text(default)


def given_settings(arguments: argparse.Namespace, sections: Sequence[type[Any]]) -> dict[str, Any]:
    """The settings that stand on the command line, as a survey file would hold them, by name.

    Raises
    ------
    UsageError
        A value that cannot be read.
    """
    found: dict[str, Any] = {}
    for section in sections:
        for field in dataclasses.fields(section):
            value = getattr(arguments, field.name, None)
            if value is not None:
                found[field.name] = _read(value, field)
    return found


def chosen_settings(arguments: argparse.Namespace, section: type[T], defaults: Mapping[str, Any] | None = None) -> T:
    """A section of the survey as the command line has it; what is not given is the command's own default, else the survey's.

    Raises
    ------
    UsageError, ConfigError
        A value that cannot be read, or cannot be.
    """
    tree = config.to_mapping(section()) | dict(defaults or {}) | given_settings(arguments, [section])
    return config.from_mapping(tree, section, "command line")


def _read(value: Any, field: "dataclasses.Field[Any]") -> Any:
    """A word of the command line as the file's value; a number that is none is left for the check of types."""
    command = command_of(field)
    if command.reads in READERS:
        return config.to_mapping(READERS[command.reads](value, command.words[0]))
    if command.reads == "names":
        return [name.strip() for name in value.split(",") if name.strip()]
    if isinstance(default_of(field), float):
        try:
            return float(value)
        except ValueError:
            return value
    return value


def beside(tree: dict[str, Any], folder: Path, names: Sequence[str], words: Sequence[str]) -> None:
    """Make names of files that stand in a survey file relative to its folder; `words` are no files."""
    for name in names:
        if isinstance(tree[name], str) and tree[name] not in words:
            tree[name] = str(folder / tree[name])
