"""The methods by their names: which are tried, what each looks at, and the estimate of the one that was chosen."""

import importlib
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any, Final

from flightlog.errors import CoverageError, LogError, UsageError
from groundproc.estimation.method import Given, Method, Progress
from groundproc.estimation.tiesigma import with_tie_sigma
from groundproc.flight.timeline import ties_of
from groundproc.sensors.lasers import ESTIMATE
from groundproc.survey import Survey
from groundproc.survey.methods import METHODS
from groundproc.trajectory.estimate import Estimate

BEST: Final = ("adjusted", "filtered", "ins")
"""What `best` tries, the best first; each needs less of the log than the one before."""


def find(name: str) -> Method:
    """The method of a name."""
    found: Method = importlib.import_module(METHODS[name]).METHOD
    return found


def estimate(given: Given, progress: Progress) -> Estimate:
    """Make the trajectory with the method that the survey chose, or with the best that the log allows.

    Raises
    ------
    UsageError
        An option is given that the method would not look at.
    SwathError
        The log does not hold what the method needs.
    """
    check(given.survey)
    names = candidates(given.survey)
    reasons: list[str] = []
    for name in names:
        try:
            made = find(name).estimate(given, progress)
        except (LogError, CoverageError) as error:
            if name == names[-1]:
                raise
            reasons.append(f"not {name}, because {str(error).removeprefix(f'{name}: ')}")
            continue
        trajectory, warning = with_tie_sigma(made.trajectory, given.timeline)
        return replace(
            made,
            trajectory=trajectory,
            warning="; ".join(filter(None, (made.warning, warning))),
            method=name,
            note="; ".join(reasons),
            corrections=made.corrections if given.survey.lasers == ESTIMATE else given.corrections,
            ties=ties_of(given.timeline),
            mount_source=made.mount_source or given.mount_source,
        )
    raise AssertionError(f"no method for {given.survey.method}")


def candidates(survey: Survey) -> tuple[str, ...]:
    """Methods to try, the best first.

    `best` goes down only as far as the other options allow: a method that would not look at one of them is not tried.
    """
    if survey.method != "best":
        return (survey.method,)
    asked = set(given_options(survey))
    first, *others = BEST
    return (first, *(name for name in others if asked <= set(find(name).options)))


def check(survey: Survey) -> None:
    """Refuse options that the chosen method would not look at.

    Raises
    ------
    UsageError
    """
    first = candidates(survey)[0]
    asked, known = given_options(survey), users()
    for name, value in asked.items():
        if first not in known[name]:
            raise UsageError(
                f"{name}: {value} given, but only method {' or '.join(known[name])} uses it, not {survey.method}"
            )
        if survey.causal and name != "causal":
            raise UsageError(
                f"{name}: {value} given together with causal, which uses nothing that is known after the flight only"
            )
    if survey.lasers == ESTIMATE and (survey.causal or not find(first).finds_lasers):
        finders = " or ".join(name for name in METHODS if find(name).finds_lasers)
        raise UsageError(f"lasers: estimate given, but only method {finders} finds them, and not with --causal")


def users() -> Mapping[str, tuple[str, ...]]:
    """Methods that look at an option, by the options that not all methods look at."""
    options = {name: find(name).options for name in METHODS}
    names = dict.fromkeys(option for each in options.values() for option in each)
    return {name: tuple(method for method in METHODS if name in options[method]) for name in names}


def given_options(survey: Survey) -> dict[str, Any]:
    """Options that not all methods look at and that are not at their defaults."""
    plain, own = Survey(), users()
    return {
        field.name: getattr(survey, field.name)
        for field in fields(survey)
        if field.name in own and getattr(survey, field.name) != getattr(plain, field.name)
    }
