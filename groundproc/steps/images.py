"""Step images: the photographs adjusted on the trajectory and the cloud, as `swath images` does."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from groundproc.steps import photographs
from groundproc.steps.photographs import BLOCK
from groundproc.steps.request import Request
from groundproc.steps.run import Run
from groundproc.steps.step import WHOLE, Folders, Step

_TOLD: Final = ("crs", "sigma0", "observations", "unknowns", "datum", "settled", "counts", "residual_rms_px", "cameras")
"""Of bundle.json, what quality.json repeats."""


def files(request: Request) -> Mapping[str, Path]:
    """The pictures, and what is known of cameras and times."""
    return photographs.files(request, "rig", "image_times")


def settings(request: Request) -> Mapping[str, Any]:
    """Files, which count by their content; that of the folder is in the pictures."""
    return {"images": None, "rig": request.survey.rig, "image_times": request.survey.image_times}


def work(run: Run, folders: Folders) -> None:
    """Adjust them."""
    from groundproc.imagery import work as adjustment
    from groundproc.imagery.session import Task

    survey = run.survey
    assert survey.images is not None
    rig, times = (None if path is None else Path(path) for path in (survey.rig, survey.image_times))
    task = Task(
        folders[WHOLE] / BLOCK, (Path(survey.images),), trajectory=run.folder, rig=rig, cloud=photographs.cloud_of(run),
        times=times, noted=tuple(run.request.logs),
    )  # fmt: skip
    told = adjustment.run(task, lambda stage, done: run.progress("images", done))
    left_out = [f"{name} is left out: {why}" for name, why in told["left_out"].items()]
    figures = {name: told[name] for name in _TOLD} | {"warnings": [*told["warnings"], *left_out]}
    photographs.tell(folders[WHOLE], STEP.name, figures)


STEP: Final = Step(
    name="images",
    about="where each photograph was taken from",
    after=("trajectory", "place"),
    reads_logs=False,
    settings=settings,
    work=work,
    files=files,
    check=photographs.check,
    parts=photographs.parts,
    reads=photographs.reads,
)
