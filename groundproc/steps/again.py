"""A product of a finished folder made again, without the logs: they may lie elsewhere by now."""

import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from flightlog import config
from flightlog.errors import UsageError
from groundproc.products import chosen
from groundproc.steps.ledger import Ledger, locked, open_ledger
from groundproc.steps.process import execute, refuse_changed, remembered
from groundproc.steps.products import STEP
from groundproc.steps.request import Request
from groundproc.steps.run import Run
from groundproc.steps.step import Folders, steps

After = Callable[[Path], None]


def again(folder: Path, name: str, after: After, force: bool = False) -> None:
    """Make a product anew of what lies in the folder, and enter it in the ledger; it is chosen from now on.

    Parameters
    ----------
    folder : Path
        Of `swath process`.
    name : str
        Of a product that is a function of a finished flight.
    after : callable
        Is given the folder that it was made in, and may add files to the product.
    force : bool
        Write over what was changed since, or is not ours.

    Raises
    ------
    UsageError
        The folder holds no finished products, or the product was changed since.
    SwathError
        It cannot be made.
    """
    request = remembered(folder)
    if request is None:
        raise UsageError(f"{folder}: no products of `swath process` in this folder, expected the folder of a flight")
    with locked(folder):
        ledger = open_ledger(folder)
        assert ledger is not None
        request = _with(request, name)
        _expect_finished(request, ledger)
        if not force:
            refuse_changed(ledger, [STEP.unit(name)])
        ledger.survey = config.to_mapping(request.survey)
        step = replace(STEP, work=_then(name, after))
        with Run(request, folder, lambda stage, done: None) as run:
            execute(step, [name], run, ledger, force)


def _with(request: Request, name: str) -> Request:
    """The request with one more product, if it has it not."""
    survey = request.survey
    if survey.products is None or any(each.name == name for each in chosen(survey.products)):
        return request
    return replace(request, survey=replace(survey, products=(*survey.products, name)))


def _expect_finished(request: Request, ledger: Ledger) -> None:
    """See that the steps before are there, as the product is made of what they left."""
    for step in steps():
        missing = [unit for unit in step.units(request) if step.name in STEP.after and unit not in ledger.entries]
        if missing:
            raise UsageError(
                f"{ledger.folder}: {missing[0]} is not made yet; `swath process {shlex.quote(str(ledger.folder))}` goes on with it"
            )


def _then(name: str, after: After) -> Callable[[Run, Folders], None]:
    def work(run: Run, folders: Folders) -> None:
        STEP.work(run, folders)
        after(folders[name])

    return work
