"""How an option is declared once: from the declaration come the YAML sample, the command line with its help, and the docs."""

import dataclasses
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

import yaml

from flightlog import config
from flightlog.config import option

COMMAND: Final = "command"
"""Key of a `Command` in the metadata of a dataclass field."""


WIDTH: Final = 112
"""Of the comments in a sample file."""


@dataclass(frozen=True, slots=True)
class Command:
    """How an option looks on the command line.

    Attributes
    ----------
    words : tuple of str
        Such as ("--crs", "--epsg"); empty where the option stands in the file only.
    metavar : str
    reads : str
        "file", "azimuths", "milliseconds", "names"; empty for what the field's own type says.
    about : str
        What the help says.
    absent : str
        What holds where the option is not given, in words; empty where the default speaks for itself.
    """

    words: tuple[str, ...]
    metavar: str
    reads: str
    about: str
    absent: str


def setting(
    default: Any,
    about: str,
    *,
    words: Sequence[str] = (),
    metavar: str = "",
    reads: str = "",
    absent: str = "",
    in_file: str = "",
    **rules: Any,
) -> Any:
    """Declare an option of the survey: `flightlog.config.option` with its looks on the command line.

    Parameters
    ----------
    default, about, **rules
        As for `option`.
    words, metavar, reads, absent
        See `Command`.
    in_file : str
        What the sample file says beyond `about`.
    """
    said = f"{about}{'; ' + in_file if in_file else ''}{'; null: ' + absent if absent else ''}"
    declared: dataclasses.Field[Any] = option(default, said, **rules)
    command = Command(tuple(words), metavar, reads, about, absent)
    declared.metadata = MappingProxyType({**declared.metadata, COMMAND: command})
    return declared


def command_of(field: "dataclasses.Field[Any]") -> Command:
    """How a field looks on the command line."""
    command = field.metadata[COMMAND]
    assert isinstance(command, Command)
    return command


def default_of(field: "dataclasses.Field[Any]") -> Any:
    """The value where the user says nothing."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def value_text(value: Any) -> str:
    """A value as YAML writes it, on one line."""
    text = yaml.safe_dump(config.to_mapping(value), default_flow_style=True, allow_unicode=True, width=1000)
    return text.removesuffix("\n").removesuffix("...").strip()


def sample_lines(values: Any, field: "dataclasses.Field[Any]", notes: Sequence[str] = ()) -> Iterator[str]:
    """One option of a commented YAML file: its meaning, notes about this flight, its value."""
    choices = field.metadata.get("choices")
    about = field.metadata["about"] + (f" ({' | '.join(map(str, choices))})" if choices else "")
    for text in (about, *notes):
        yield from (f"# {line}" for line in textwrap.wrap(text, WIDTH))
    value = getattr(values, field.name)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        yield f"{field.name}:"
        for nested in dataclasses.fields(value):
            yield from (f"  {line}" for line in sample_lines(value, nested))
    else:
        yield f"{field.name}: {value_text(value)}"
