"""What commands of clouds have in common: the bar of points done, figures as JSON, warnings."""

import argparse
import contextlib
import json
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, TextIO


@contextlib.contextmanager
def points_bar() -> Iterator[Callable[[int], object]]:
    """A function that is told of points done; it shows a bar on a terminal."""
    from tqdm import tqdm

    with tqdm(unit="points", unit_scale=True, leave=False, disable=not sys.stderr.isatty()) as bar:
        yield bar.update


def claim_json(arguments: argparse.Namespace) -> None:
    """See that `--json` may be written."""
    from groundproc.commands.outputs import claim_file

    if arguments.json is not None:
        claim_file(arguments.json, (".json",), arguments.force)


def write_json(arguments: argparse.Namespace, figures: Mapping[str, Any]) -> None:
    """Write figures where `--json` says."""
    from groundproc.files import written_aside

    if arguments.json is not None:
        with written_aside(arguments.json) as aside:
            aside.write_text(json.dumps(figures, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def warn(warnings: Iterable[str], stream: TextIO) -> None:
    """Say warnings, each on its line."""
    for line in warnings:
        print(f"swath: warning: {line}", file=stream)
