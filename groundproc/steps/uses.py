"""Step uses: what people fly for, made of the finished cloud, each alone."""

import functools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from flightlog.errors import UsageError
from groundproc.products import chosen as chosen_products
from groundproc.products import plain
from groundproc.products.product import named
from groundproc.reporting.cloudpart import CLOUDS
from groundproc.reporting.usesfound import FOLDER
from groundproc.steps.request import Request
from groundproc.steps.run import Run
from groundproc.steps.step import Folders, Step
from groundproc.uses import chosen
from groundproc.uses.site import Site


def settings(request: Request) -> Mapping[str, Any]:
    """The targets: of the others each use has its own."""
    return {"targets": request.survey.targets}


def files(request: Request) -> Mapping[str, Path]:
    """The targets."""
    targets = request.survey.targets
    return {} if targets is None else {"targets": Path(targets)}


def parts(request: Request) -> Mapping[str, Any]:
    """Each use that is chosen."""
    return {each.name: plain([each]) for each in chosen(request.survey.uses)}


def check(request: Request) -> None:
    """Refuse uses without a cloud to make them of, and targets that nothing uses."""
    names = [each.name for each in chosen(request.survey.uses)]
    if names and not cloud_names(request):
        raise UsageError(
            f"uses: {', '.join(names)} asked for, but no product holds the points; expected cloud.laz among the products"
        )
    targets = request.survey.targets
    if targets is not None and "reflectance" not in names:
        raise UsageError(f"targets: {targets} given, but nothing uses it; expected reflectance among the uses")
    if targets is not None and not Path(targets).is_file():
        raise UsageError(f"targets: {targets}: no such file; expected polygons of known reflectance (.geojson, .gpkg)")


def reads(request: Request) -> Mapping[str, Sequence[str]]:
    """Of what was placed the cloud only."""
    return {"place": cloud_names(request)[:1]}


def cloud_names(request: Request) -> list[str]:
    """Products that hold the points."""
    products = [each.name for each in chosen_products(request.survey.products)]
    return [name for name in reversed(CLOUDS) if name in products]


def work(run: Run, folders: Folders) -> None:
    """Make those that are due; each leaves what it found as JSON beside its files."""
    cloud = run.folder / cloud_names(run.request)[0]
    for each in chosen(run.survey.uses):
        if each.name not in folders:
            continue
        folder = folders[each.name] / FOLDER
        folder.mkdir()
        site = Site(
            folder, cloud, run.folder / "trajectory.csv", run.estimate, run.survey,
            functools.partial(run.progress, each.name),
        )  # fmt: skip
        with named(each.name):
            told = each.maker(site, *each.options)
            files = sorted(path.name for path in folder.iterdir())
            tree = {"use": each.name, "found": told.sentence, "files": files, "figures": told.figures}
            (folder / f"{each.name}.json").write_text(json.dumps(tree, indent=1) + "\n", encoding="utf-8")


STEP: Final = Step(
    name="uses",
    about="what people fly for: ground, trees, wires and others, of the finished cloud",
    after=("trajectory", "place"),
    reads_logs=False,
    settings=settings,
    work=work,
    files=files,
    check=check,
    parts=parts,
    reads=reads,
    singly=True,
)
