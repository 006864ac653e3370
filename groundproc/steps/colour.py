"""Step colour: the cloud in the colours of the photographs, and the cloud over a photograph of each camera."""

from collections.abc import Mapping
from typing import Any, Final

from groundproc.steps import photographs
from groundproc.steps.request import Request
from groundproc.steps.run import Run
from groundproc.steps.step import WHOLE, Folders

CLOUD: Final = "cloud_colour.laz"
OVERLAYS: Final = "overlays"


def settings(request: Request) -> Mapping[str, Any]:
    """None."""
    del request
    return {}


def work(run: Run, folders: Folders) -> None:
    """Colour it."""
    from groundproc.imagery.painting.colour import Task, colour

    folder = folders[WHOLE]
    task = Task(
        photographs.cloud_of(run), run.folder / photographs.BLOCK, folder / CLOUD, photographs.root_of(run),
        overlays=folder / OVERLAYS,
    )  # fmt: skip
    made = colour(task, lambda stage, done: run.progress("colour", done))
    photographs.tell(folder, STEP.name, made.figures() | {"warnings": list(made.left_out)})


STEP: Final = photographs.step("colour", "the cloud in the colours of the photographs", settings, work)
