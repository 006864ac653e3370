"""What the steps of images have in common: the photographs, the cloud that they are laid on, and what is told of them."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from flightlog.errors import UsageError
from groundproc.products import chosen
from groundproc.steps.ledger import INSIDE
from groundproc.steps.request import Request
from groundproc.steps.run import Run
from groundproc.steps.step import WHOLE, Folders, Step

BLOCK: Final = "block"
"""Folder of what step images leaves, within that of the flight: as `swath images` writes it."""
CLOUDS: Final = ("cloud.laz", "cloud.copc.laz")
"""Products that hold the points; the first that was made is coloured."""
_BESIDE: Final = ("rig", "image_times", "panels", "ortho_gsd_m")


def parts(request: Request) -> Mapping[str, Any]:
    """The step itself, where there are photographs."""
    return {} if request.survey.images is None else {WHOLE: {}}


def reads(request: Request) -> Mapping[str, Sequence[str]]:
    """Of what was placed the cloud only."""
    names = [each.name for each in chosen(request.survey.products)]
    return {"place": [name for name in CLOUDS if name in names][:1]}


def photographs(request: Request) -> list[Path]:
    """The pictures, in the order of their names.

    Raises
    ------
    CaptureError
        There are none.
    """
    if request.survey.images is None:
        return []
    from groundproc.imagery.photos import files_of

    return files_of([Path(request.survey.images)])


def files(request: Request, *named: str) -> dict[str, Path]:
    """All pictures by their names, and files that settings name."""
    pictures = photographs(request)
    if not pictures:
        return {}
    from groundproc.imagery.photos import common_folder

    root = common_folder(pictures)
    found = {f"image {path.absolute().relative_to(root).as_posix()}": path for path in pictures}
    given = {name: getattr(request.survey, name) for name in named}
    return found | {name: Path(path) for name, path in given.items() if path is not None}


def step(
    name: str, about: str, settings: Callable[[Request], Mapping[str, Any]], work: Callable[[Run, Folders], None],
    named: Sequence[str] = (),
) -> Step:  # fmt: skip
    """A step that lays the adjusted photographs on the cloud; `named` settings are files that it reads too."""
    return Step(
        name=name, about=about, after=("place", "images"), reads_logs=False, settings=settings, work=work,
        files=lambda request: files(request, *named), parts=parts, reads=reads,
    )  # fmt: skip


def check(request: Request) -> None:
    """Refuse photographs that are not there, what nothing would use, and points that no product keeps."""
    survey = request.survey
    if survey.images is None:
        plain = {name: getattr(type(survey)(), name) for name in _BESIDE}
        for name, otherwise in plain.items():
            if getattr(survey, name) != otherwise:
                raise UsageError(f"{name}: {getattr(survey, name)} given, but no images; expected with images: DIR")
        return
    photographs(request)
    if not any(each.name in CLOUDS for each in chosen(survey.products)):
        raise UsageError(f"images: they are laid on the points, which no product keeps; expected {' or '.join(CLOUDS)}")


def cloud_of(run: Run) -> Path:
    """The cloud of the flight."""
    return next(run.folder / name for name in CLOUDS if (run.folder / name).is_file())


def root_of(run: Run) -> Path:
    """The folder that names of pictures are below."""
    from groundproc.imagery.photos import common_folder

    return common_folder(photographs(run.request))


def tell(folder: Path, step: str, figures: Mapping[str, Any]) -> None:
    """Keep what quality.json says of a step."""
    path = folder / INSIDE / f"{step}.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(_finite(figures), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _finite(value: Any) -> Any:
    """The same with None for what is no number."""
    if isinstance(value, Mapping):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def found_in(folder: Path) -> dict[str, Any]:
    """What all of them told."""
    return {
        step: json.loads((folder / INSIDE / f"{step}.json").read_text(encoding="utf-8"))
        for step in ("images", "colour", "ortho", "ndvi")
    }
