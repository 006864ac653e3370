"""JSON Schema of what `swathd health --json` prints, made from the records themselves."""

import dataclasses
import enum
import types
import typing
from typing import Any, Final

from onboard.health import SCHEMA, Level
from onboard.status import Status

_PLAIN: Final = {bool: "boolean", int: "integer", float: "number", str: "string", types.NoneType: "null"}


def schema() -> dict[str, Any]:
    """The schema (draft 2020-12). Other fields may be there: they come without a new number."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "swathd health --json",
        "type": "object",
        "required": ["schema", "verdict", "findings", "armed", "status"],
        "properties": {
            "schema": {"const": SCHEMA},
            "verdict": {"enum": [level.name for level in Level]},
            "findings": {"type": "array", "items": {"type": "string"}},
            "armed": {"type": ["boolean", "null"]},
            "status": {"anyOf": [of_record(Status), {"type": "null"}]},
        },
    }


def of_record(record: type) -> dict[str, Any]:
    """Of a dataclass: every field is there."""
    hints = typing.get_type_hints(record)
    names = [field.name for field in dataclasses.fields(record)]
    return {"type": "object", "required": names, "properties": {name: of_type(hints[name]) for name in names}}


def of_type(hint: Any) -> dict[str, Any]:
    """Of a field."""
    arms = typing.get_args(hint)
    if typing.get_origin(hint) is dict:
        return {"type": "object", "additionalProperties": of_type(arms[1])}
    if typing.get_origin(hint) is list:
        return {"type": "array", "items": of_type(arms[0])}
    if arms:
        return {"anyOf": [of_type(arm) for arm in arms]}
    if dataclasses.is_dataclass(hint):
        return of_record(typing.cast(type, hint))
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        return {"enum": [member.value for member in hint]}
    return {"type": _PLAIN[hint]}
