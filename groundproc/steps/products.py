"""Step products: those that are made of what the finished steps left."""

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

from groundproc.products import chosen, plain
from groundproc.products.product import Context, draw
from groundproc.steps.place import projection_of
from groundproc.steps.request import Request
from groundproc.steps.run import Run
from groundproc.steps.step import Folders, Step


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
    context = Context(run.folder, run.folder, run.survey, made, projection, quality, run.names)
    for each in chosen(run.survey.products):
        if each.name in folders:
            draw([each], replace(context, folder=folders[each.name]))


STEP: Final = Step(
    name="products",
    about="pictures and tables of what the other steps found",
    after=("trajectory", "place", "quality"),
    reads_logs=False,
    settings=settings,
    work=work,
    parts=parts,
)
