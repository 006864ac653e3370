"""Parameters of the autopilot: the files that say what they should be, and the comparison (pure)."""

import importlib.resources
import re
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from flightlog import text as texts
from flightlog.errors import ConfigError, UsageError

NAME_BYTES: Final = 16
"""The longest name that MAVLink carries."""
_NAME: Final = re.compile(rf"[A-Z][A-Z0-9_]{{0,{NAME_BYTES - 1}}}")

FILES: Final = {
    ("ins", "3.1.3"): "10-ins-3.1.3.param",
    ("ins", "4"): "11-ins-4.param",
    ("fc", "3.1.3"): "20-fc-3.1.3.param",
    ("fc", "4"): "21-fc-4.param",
}
"""Files of firmware_config by the link's name and the firmware's generation."""
GENERATION_MARKS: Final = {"INS_MPU6K_FILTER": "3.1.3", "INS_GYRO_FILTER": "4"}
"""Parameters that tell the generations of ArduPilot apart; the one was renamed to the other in 2014."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A line of a parameter file."""

    name: str
    value: float
    reason: str
    """The comment behind it."""


@dataclass(frozen=True, slots=True)
class Difference:
    """A parameter that is not as wanted; `found` is None where the autopilot has none of that name."""

    name: str
    wanted: float
    found: float | None
    reason: str = ""

    def __str__(self) -> str:
        found = "not there" if self.found is None else f"{self.found:.7g} found"
        return f"{self.name}: {found}, {self.wanted:.7g} wanted" + (f" ({self.reason})" if self.reason else "")


def parse(text: str, place: str) -> dict[str, Parameter]:
    """Parameters of a file's text, `NAME,VALUE` or `NAME VALUE` with a comment after #, by name.

    Parameters
    ----------
    text : str
    place : str
        Names it in errors.

    Raises
    ------
    ConfigError
        A line that is neither, a name given twice, a value that is no finite number.
    """
    found: dict[str, Parameter] = {}
    for number, line in enumerate(text.splitlines(), 1):
        content, _, comment = line.partition("#")
        words = content.replace(",", " ").split()
        if not words:
            continue
        where = f"{place}, line {number}"
        if len(words) != 2 or not _NAME.fullmatch(words[0]):
            raise ConfigError(f"{where}: {content.strip()!r} found, expected NAME,VALUE")
        name, value = words[0], _number(words[1], where)
        if name in found:
            raise ConfigError(f"{where}: {name} stands there twice")
        found[name] = Parameter(name, value, comment.strip())
    return found


def _number(word: str, where: str) -> float:
    try:
        return as_single(float(word))
    except (ValueError, OverflowError):
        raise ConfigError(f"{where}: {word!r} found, expected a number") from None


def as_single(value: float) -> float:
    """The value as MAVLink carries it, in single precision; ValueError or OverflowError where it cannot."""
    single = float(struct.unpack("<f", struct.pack("<f", value))[0])
    if single - single != 0.0:
        raise ValueError(f"{value} is not finite")
    return single


def load(path: str | Path) -> dict[str, Parameter]:
    """Read a parameter file; ConfigError where it is not one."""
    try:
        return parse(texts.decode(Path(path).read_bytes()), str(path))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: is not a text file") from None


def shipped(link: str, generation: str) -> dict[str, Parameter]:
    """The parameters that firmware_config has for a board.

    Parameters
    ----------
    link : str
        `ins` or `fc`.
    generation : str
        As in `GENERATION_MARKS`.
    """
    name = FILES[link, generation]
    text = importlib.resources.files("firmware_config").joinpath(name).read_text(encoding="utf-8")
    return parse(text, f"firmware_config/{name}")


def generation(found: Iterable[str]) -> str:
    """Which generation of ArduPilot has these parameters, of `GENERATION_MARKS`.

    Raises
    ------
    UsageError
        None that we have parameters for.
    """
    names = set(found)
    for mark, of in GENERATION_MARKS.items():
        if mark in names:
            return of
    raise UsageError(
        f"the autopilot has none of {', '.join(GENERATION_MARKS)}: its firmware is neither ArduCopter 3.1.3 nor ArduPilot 4; "
        "name a parameter file of your own with --file"
    )


def compare(wanted: Mapping[str, Parameter], found: Mapping[str, float]) -> list[Difference]:
    """What differs from the parameters wanted, in their order; equal in single precision is equal."""
    return [
        Difference(name, parameter.value, found.get(name), parameter.reason)
        for name, parameter in wanted.items()
        if name not in found or as_single(found[name]) != as_single(parameter.value)
    ]
