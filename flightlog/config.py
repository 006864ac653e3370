"""YAML to frozen dataclasses and back: unknown keys, wrong types and values out of range are named errors.

There is one list of options, the dataclass; the commented sample file is made from it.
"""

import dataclasses
import sys
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import yaml

from flightlog.errors import ConfigError
from flightlog.text import decode

T = TypeVar("T")


LARGEST_BYTES: Final = 1 << 20
"""Of a file."""
_SHOWN: Final = 200
"""Characters of a wrong value that an error repeats."""


class _Loader(yaml.SafeLoader):
    """YAML that refuses a key given twice and aliases, and leaves dates and times as the text they are."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):  # a few lines of aliases of aliases make gigabytes
            raise yaml.composer.ComposerError(
                problem="an alias (*) stands there, which is not taken; write the value out",
                problem_mark=cast(Any, self).peek_event().start_mark,  # untyped in the stubs
            )
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in seen:
                raise yaml.constructor.ConstructorError(
                    problem=f"key {key.value!r} stands there twice", problem_mark=key.start_mark
                )
            seen.add(key.value if isinstance(key, yaml.ScalarNode) else None)
        return super().construct_mapping(node, deep)


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag != "tag:yaml.org,2002:timestamp"]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


def option(
    default: Any,
    about: str,
    *,
    minimum: float | None = None,
    maximum: float | None = None,
    choices: Sequence[Any] | None = None,
) -> Any:
    """Declare a field of a configuration dataclass.

    Parameters
    ----------
    default : object
        Its value when the file does not state it; a dataclass type makes a nested section with that section's own defaults.
    about : str
        One line for the sample file: meaning and unit.
    minimum, maximum : float, optional
        Inclusive bounds of a number, or of each number of a list.
    choices : sequence, optional
        The only values allowed.
    """
    metadata = {"about": about, "minimum": minimum, "maximum": maximum, "choices": choices}
    if isinstance(default, type):
        return dataclasses.field(default_factory=default, metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def load(path: str | Path, cls: type[T]) -> T:
    """Read a YAML file into a frozen dataclass.

    Raises
    ------
    ConfigError
        The file cannot be read, is no YAML mapping, or holds an unknown key, a wrong type or a value out of range.
    """
    return from_mapping(load_tree(path), cls, str(path))


def load_tree(path: str | Path) -> Any:
    """Read a YAML file whose keys are not known beforehand: lists, mappings and scalars as they stand there.

    Raises
    ------
    ConfigError
        The file cannot be read, or is no YAML.
    """
    try:
        with Path(path).open("rb") as file:
            data = file.read(LARGEST_BYTES + 1)
        text = decode(data)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: is not a text file") from None
    except ValueError:
        raise ConfigError(f"{str(path)!r}: is no name of a file") from None
    if len(data) > LARGEST_BYTES:
        raise ConfigError(f"{path}: is larger than {LARGEST_BYTES >> 10} KiB, which no configuration is")
    return _tree(text, str(path))


def loads(text: str, cls: type[T], place: str) -> T:
    """Read YAML text; `place` names it in errors. See `load`."""
    return from_mapping(_tree(text, place), cls, place)


def _tree(text: str, place: str) -> Any:
    try:
        tree = yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError, IndexError, RecursionError) as error:  # PyYAML lets the last three through
        reason = " ".join(str(error).split())
        raise ConfigError(f"{place}: is not valid YAML ({reason})") from None
    return {} if tree is None else tree


def from_mapping(tree: Any, cls: type[T], place: str) -> T:
    """Build a dataclass from a parsed tree; `place` is the path so far. See `load`."""
    if not isinstance(tree, Mapping):
        raise ConfigError(f"{place}: {_shown(tree)} found, expected keys and values")
    assert dataclasses.is_dataclass(cls)
    known = {field.name: field for field in dataclasses.fields(cls)}
    hints = typing.get_type_hints(cls)
    for key in tree:
        if key not in known:
            raise ConfigError(f"{place}: unknown key {key!r}; known are {', '.join(known)}")
    values = {}
    for name, field in known.items():
        if name in tree:
            values[name] = _convert(tree[name], hints[name], field.metadata, f"{place}: {name}")
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise ConfigError(f"{place}: {name} is missing")
    try:
        return typing.cast(T, cls(**values))
    except ValueError as error:  # what a __post_init__ finds between several keys
        raise ConfigError(f"{place}: {error}") from None


def _convert(value: Any, hint: Any, rules: Mapping[str, Any], place: str) -> Any:
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in typing.get_args(hint):
            return None
        arms = [arm for arm in typing.get_args(hint) if arm is not type(None)]
        # of several types, a text is taken as a text, everything else as the first type
        hint = str if str in arms and isinstance(value, str) else arms[0]
        return _convert(value, hint, rules, place)
    if dataclasses.is_dataclass(hint):
        return from_mapping(value, typing.cast(type, hint), place)
    if origin is tuple:
        return _convert_tuple(value, typing.get_args(hint), rules, place)
    return _check(_scalar(value, hint, place), rules, place)


def _convert_tuple(value: Any, arms: tuple[Any, ...], rules: Mapping[str, Any], place: str) -> Any:
    if not isinstance(value, list):
        raise ConfigError(f"{place}: {_shown(value)} found, expected a list")
    if len(arms) == 2 and arms[1] is Ellipsis:
        arms = (arms[0],) * len(value)
    if len(value) != len(arms):
        raise ConfigError(f"{place}: {len(value)} values found, expected {len(arms)}")
    return tuple(
        _convert(item, arm, rules, f"{place}[{i}]") for i, (item, arm) in enumerate(zip(value, arms, strict=True))
    )


def _scalar(value: Any, hint: Any, place: str) -> Any:
    names = {float: "a number", int: "a whole number", str: "a text", bool: "true or false"}
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        if not abs(value) <= sys.float_info.max:  # a whole number may be larger, and none is infinite
            raise ConfigError(f"{place}: {_shown(value)} found, expected a finite number")
        return float(value)
    if hint is Any or (isinstance(value, hint) and isinstance(value, bool) == (hint is bool)):
        return value
    raise ConfigError(f"{place}: {_shown(value)} found, expected {names.get(hint, hint.__name__)}")


def _shown(value: Any) -> str:
    """A wrong value as an error repeats it."""
    text = repr(value)
    return text if len(text) <= _SHOWN else text[:_SHOWN] + "..."


def _check(value: Any, rules: Mapping[str, Any], place: str) -> Any:
    low, high, choices = rules.get("minimum"), rules.get("maximum"), rules.get("choices")
    if choices is not None and value not in choices:
        raise ConfigError(f"{place}: {value!r} found, expected one of {', '.join(map(str, choices))}")
    if (low is not None and value < low) or (high is not None and value > high):
        bounds = f"at least {low}" if high is None else f"at most {high}" if low is None else f"{low} to {high}"
        raise ConfigError(f"{place}: {value} found, expected {bounds}")
    return value


def to_mapping(config: Any) -> Any:
    """The plain tree of a configuration, as YAML or JSON hold it."""
    if dataclasses.is_dataclass(config) and not isinstance(config, type):
        return {field.name: to_mapping(getattr(config, field.name)) for field in dataclasses.fields(config)}
    if isinstance(config, (tuple, list)):
        return [to_mapping(item) for item in config]
    return config


def dump(config: Any) -> str:
    """The YAML text of a configuration; `loads` turns it back into an equal one (but for the line separators of Unicode)."""
    return yaml.safe_dump(to_mapping(config), sort_keys=False, allow_unicode=True)


def sample(cls: type[Any]) -> str:
    """A commented YAML file with every option at its default."""
    return "\n".join(_sample_lines(cls(), 0)) + "\n"


def _sample_lines(config: Any, depth: int) -> list[str]:
    lines: list[str] = []
    indent = "  " * depth
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        choices = field.metadata.get("choices")
        about = field.metadata.get("about", "") + (f" ({' | '.join(map(str, choices))})" if choices else "")
        if about:
            lines.append(f"{indent}# {about}")
        if dataclasses.is_dataclass(value):
            lines += [f"{indent}{field.name}:", *_sample_lines(value, depth + 1)]
        else:
            tree = to_mapping(value)
            text = yaml.safe_dump(tree, default_flow_style=True, allow_unicode=True, width=1000)
            lines.append(f"{indent}{field.name}: {text.removesuffix(chr(10)).removesuffix('...').strip()}")
    return lines
