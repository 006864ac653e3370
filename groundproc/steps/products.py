"""Step products: those that are made of what the finished steps left."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from groundproc.products import chosen, plain
from groundproc.products.product import Context, draw
from groundproc.steps.place import projection_of
from groundproc.steps.run import Run
from groundproc.steps.step import Request, Step


def settings(request: Request) -> Mapping[str, Any]:
    """The products that are functions of a finished flight; what else they look at, they find in quality.json."""
    return {"products": plain(each for each in chosen(request.survey.products) if not each.takes_points)}


def work(run: Run, folder: Path) -> None:
    """Make them."""
    made = run.estimate
    quality = json.loads((run.folder / "quality.json").read_text(encoding="utf-8"))
    projection = projection_of(made.trajectory.frame, run.survey)
    context = Context(folder, run.folder, run.survey, made, projection, quality, run.names)
    draw(chosen(run.survey.products), context)


STEP: Final = Step(
    name="products",
    about="pictures and tables of what the other steps found",
    after=("trajectory", "place", "quality"),
    reads_logs=False,
    settings=settings,
    work=work,
)
