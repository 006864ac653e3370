"""Step ndvi: the vegetation index, where the photographs have near infrared and red."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from groundproc.steps import photographs
from groundproc.steps.request import Request
from groundproc.steps.run import Run
from groundproc.steps.step import WHOLE, Folders

INDEX: Final = "ndvi"
RASTER: Final = "ndvi.tif"


def settings(request: Request) -> Mapping[str, Any]:
    """The size of a pixel, and the panels."""
    return {"ortho_gsd_m": request.survey.ortho_gsd_m, "panels": request.survey.panels}


def work(run: Run, folders: Folders) -> None:
    """Make it, or say what the photographs lack."""
    from groundproc.imagery.painting.block import RIG
    from groundproc.imagery.painting.indices import INDICES, Task, indices
    from groundproc.imagery.rig import read_rig

    folder, block, panels = folders[WHOLE], run.folder / photographs.BLOCK, run.survey.panels
    bands = {band for camera in read_rig(block / RIG).cameras for band in camera.bands}
    lacking = [band for band in INDICES[INDEX] if band not in bands]
    if lacking:
        told: dict[str, Any] = {"left_out": f"no camera has band {' or '.join(lacking)}"}
        if panels is not None:
            told["warning"] = f"panels: {panels} given, but {told['left_out']}, so that there is no index"
        photographs.tell(folder, STEP.name, told)
        return
    task = Task(
        photographs.cloud_of(run), block, folder / RASTER, run.survey.ortho_gsd_m, INDEX,
        None if panels is None else Path(panels), photos=photographs.root_of(run),
    )  # fmt: skip
    made = indices(task, lambda stage, done: run.progress("ndvi", done))
    told = made.figures()
    photographs.tell(folder, STEP.name, told | {"warnings": [*made.left_out, *made.warnings]})


STEP: Final = photographs.step(
    "ndvi", "vegetation index, of photographs with near infrared and red", settings, work, ("panels",)
)
