"""What a step is: what it reads, the settings it looks at, what it makes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from groundproc.steps import ORDER
from groundproc.steps.request import Request
from groundproc.steps.run import Run

WHOLE: Final = ""
"""The part that is the step itself."""
BETWEEN: Final = ": "
"""In the ledger, between the name of a step and that of a part."""

Folders = Mapping[str, Path]
"""A folder for the outputs of each part, by its name."""

Key = dict[str, Any]
"""What decides about a step's outcome, as plain values: a step whose key is as it was need not run again."""


@dataclass(frozen=True, slots=True)
class Step:
    """One step from logs to products.

    Attributes
    ----------
    name : str
        That of its module, of `--until` and of the ledger.
    about : str
        What it makes, for people.
    after : tuple of str
        Steps whose outputs it reads.
    reads_logs : bool
    settings : callable
        The settings it looks at, by name, as plain values; a change of any other does not concern it. Files that settings name stand
        under `files`.
    files : callable
        Files beside the logs that it reads, by the name of the setting.
    work : callable
        Makes the parts that it is told to; each has a folder to write into: all of the files there are its outputs, whatever their names.
    check : callable
        Refuses what cannot be before any step begins.
    parts : callable
        What of it can be made alone, such as one of several products: settings of each that concern no other, by name. A step that is one
        thing has one part without a name.
    reads : callable
        Of steps in `after`, the parts that it reads, by the step's name; of a step that is not named all of them.
    singly : bool
        Parts are made one after the other and entered in the ledger each when it is there; else in one go, which may share its work.
    """

    name: str
    about: str
    after: tuple[str, ...]
    reads_logs: bool
    settings: Callable[[Request], Mapping[str, Any]]
    work: "Callable[[Run, Folders], None]"
    files: Callable[[Request], Mapping[str, Path]] = lambda request: {}
    check: Callable[[Request], None] = lambda request: None
    parts: Callable[[Request], Mapping[str, Any]] = lambda request: {WHOLE: {}}
    reads: Callable[[Request], Mapping[str, Sequence[str]]] = lambda request: {}
    singly: bool = False

    def unit(self, part: str) -> str:
        """Name of a part in the ledger."""
        return f"{self.name}{BETWEEN}{part}" if part else self.name

    def forerunners(self, request: Request) -> dict[str, list[str]]:
        """What it reads of each step before it: names in the ledger."""
        some, found = self.reads(request), {}
        for other in steps():
            if other.name in self.after:
                wanted = some.get(other.name)
                found[other.name] = [
                    other.unit(part) for part in other.parts(request) if wanted is None or part in wanted
                ]
        return found

    def units(self, request: Request) -> dict[str, Any]:
        """Own settings of each part by its name in the ledger."""
        return {self.unit(part): own for part, own in self.parts(request).items()}


def steps() -> list[Step]:
    """All steps, in the order of the flight."""
    return [import_module(f"groundproc.steps.{name}").STEP for name in ORDER]
