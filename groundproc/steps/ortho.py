"""Step ortho: the photographs as one picture that lies on the map."""

from collections.abc import Mapping
from typing import Any, Final

from groundproc.steps import photographs
from groundproc.steps.request import Request
from groundproc.steps.run import Run
from groundproc.steps.step import WHOLE, Folders

MOSAIC: Final = "ortho.tif"


def settings(request: Request) -> Mapping[str, Any]:
    """The size of a pixel."""
    return {"ortho_gsd_m": request.survey.ortho_gsd_m}


def work(run: Run, folders: Folders) -> None:
    """Make it."""
    from groundproc.imagery.painting.block import COLOURS, RIG
    from groundproc.imagery.painting.ortho import Task, ortho
    from groundproc.imagery.rig import read_rig

    folder, block = folders[WHOLE], run.folder / photographs.BLOCK
    kinds = [camera.bands or COLOURS for camera in read_rig(block / RIG).cameras]
    task = Task(
        photographs.cloud_of(run), block, folder / MOSAIC, run.survey.ortho_gsd_m, photographs.root_of(run),
        COLOURS if COLOURS in kinds else kinds[0],
    )  # fmt: skip
    made = ortho(task, lambda stage, done: run.progress("ortho", done))
    photographs.tell(folder, STEP.name, made.figures() | {"warnings": list(made.left_out)})


STEP: Final = photographs.step("ortho", "ortho mosaic, and which photograph made each pixel", settings, work)
