"""Named flights: scene, route, duration and errors in one YAML file, so that the same flight can be asked for by name."""

from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import yaml

from flightlog import config
from flightlog.config import option
from flightlog.errors import UsageError
from simulator.config import Options

_FOLDER: Final = files("simulator") / "flights"


@dataclass(frozen=True, slots=True)
class Plan:
    """What to fly, and with which instruments."""

    about: str = option("", "what the flight is for")
    scene: str = option("village", "name of the scene")
    duration_s: float = option(60.0, "seconds of flight", minimum=1, maximum=1e5)
    cameras: str = option("", "a rig, by name or file; empty: no cameras")
    options: Options = option(Options, "instruments and motion")


def names() -> tuple[str, ...]:
    """The flights that come along, in the order of the alphabet."""
    return tuple(sorted(item.name.removesuffix(".yaml") for item in _FOLDER.iterdir() if item.name.endswith(".yaml")))


def plan(name: str) -> Plan:
    """The flight of a name, or of a file.

    Raises
    ------
    UsageError
        There is neither a flight nor a file of that name.
    ConfigError
        The file is not one.
    """
    if name in names():
        return config.loads((_FOLDER / f"{name}.yaml").read_text(encoding="utf-8"), Plan, f"{name}.yaml")
    if not Path(name).is_file():
        raise UsageError(f"--flight: {name!r} is neither a flight nor a file; known are {', '.join(names())}")
    return config.load(name, Plan)


def changed(options: Options, path: Path) -> Options:
    """Options with those that a file names put in their place.

    Raises
    ------
    ConfigError
        The file cannot be read, or holds what is no option.
    """
    other = config.to_mapping(config.load(path, Options))
    tree = config.to_mapping(options)
    for keys in _named(yaml.compose(path.read_text(encoding="utf-8"), yaml.SafeLoader)):
        into, out_of = tree, other
        for key in keys[:-1]:
            into, out_of = into[key], out_of[key]
        into[keys[-1]] = out_of[keys[-1]]
    return config.from_mapping(tree, Options, str(path))


def _named(node: Any, above: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Paths of all keys that hold a value."""
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            yield from _named(value, (*above, key.value))
    elif above:
        yield above
