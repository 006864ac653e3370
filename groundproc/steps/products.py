"""Step products: those that are made of what the finished steps left."""

import functools
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from groundproc.machine.readahead import beside
from groundproc.products import chosen, longest_first, plain
from groundproc.products.product import Context, draw
from groundproc.steps import OF_IMAGES
from groundproc.steps.ledger import INSIDE, open_ledger
from groundproc.steps.place import projection_of
from groundproc.steps.request import Request
from groundproc.steps.run import Run
from groundproc.steps.step import BETWEEN, Folders, Step


def settings(request: Request) -> Mapping[str, Any]:
    """None: what the products look at, they find in the estimate and in quality.json."""
    del request
    return {}


def parts(request: Request) -> Mapping[str, Any]:
    """Each product that is a function of a finished flight."""
    return {each.name: plain([each]) for each in chosen(request.survey.products) if not each.takes_points}


def work(run: Run, folders: Folders) -> None:
    """Make them."""
    made = run.estimate
    quality = json.loads((run.folder / "quality.json").read_text(encoding="utf-8"))
    projection = projection_of(made.trajectory.frame, run.survey)
    digests = digests_of(run.folder)
    context = Context(
        run.folder, run.folder, run.survey, made, projection, quality, digests, run.names, foreseen=run.foreseen
    )
    run.foreseen = None
    beside(
        [
            functools.partial(draw, [each], replace(context, folder=folders[each.name]))
            for each in longest_first(chosen(run.survey.products))
            if each.name in folders
        ]
    )


def digests_of(folder: Path) -> dict[str, str]:
    """SHA-256 of the logs and of what the other steps left, by name: the same whether this step was done before or not."""
    ledger = open_ledger(folder)
    if ledger is None:
        return {}
    found: dict[str, str] = {}
    for log in ledger.logs:
        if log in ledger.files:  # several may have one name, in folders of their own
            name = Path(log).name
            found[name] = ", ".join(filter(None, (found.get(name), ledger.files[log].digest)))
    for unit, entry in ledger.entries.items():
        if unit.partition(BETWEEN)[0] != STEP.name:
            found |= {name: mark.digest for name, mark in entry.outputs.items() if not name.startswith(INSIDE)}
    return found


STEP: Final = Step(
    name="products",
    about="pictures and tables of what the other steps found",
    after=("trajectory", "place", *OF_IMAGES, "quality", "uses"),
    reads_logs=False,
    settings=settings,
    work=work,
    parts=parts,
)
