"""Methods by their names: what is tried, what is refused, and that a method is one module and one line."""

import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from flightlog.errors import LogError, UsageError
from flightlog.mount import Mount
from groundproc.estimation import methods
from groundproc.estimation.method import Given, Method, Progress
from groundproc.flight.autopilot import Vehicle
from groundproc.flight.flight import Flight
from groundproc.flight.vehicle import Choice
from groundproc.geodesy import LocalFrame
from groundproc.sensors.hdl32e import LIDAR
from groundproc.sensors.lasers import ESTIMATE, LaserCorrections
from groundproc.survey import Survey
from groundproc.survey.methods import METHODS
from groundproc.trajectory.estimate import Estimate
from groundproc.trajectory.trajectory import Trajectory

FOUND = LaserCorrections(range_m=(0.01,) * 32)
STATED = LaserCorrections(range_m=(0.02,) * 32)


def trajectory() -> Trajectory:
    time_ns = np.array([10**18, 10**18 + 10**9])
    zero, level = np.zeros((2, 3)), np.array([[1.0, 0.0, 0.0, 0.0]] * 2)
    covered = np.array([True, False])
    return Trajectory(LocalFrame(58.4, 15.6, 60.0), time_ns, zero, zero, level, zero, zero, zero, covered)


def given(survey: Survey) -> Given:
    """Nothing but a survey and where mount and lasers come from."""
    flight = Flight([], [], LIDAR, Choice(Vehicle((), [])))
    return Given((), flight, (), (), (), LocalFrame(58.4, 15.6, 60.0), Mount(), survey, STATED, "log")


def quiet(stage: str, done: int) -> None:
    del stage, done


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Registers a method that a test makes up: a module and a line."""

    def register(name: str, method: Method) -> None:
        module = ModuleType(f"made_up_{name}")
        module.METHOD = method  # type: ignore[attr-defined] # a module made here has no such name
        monkeypatch.setitem(sys.modules, module.__name__, module)
        monkeypatch.setitem(METHODS, name, module.__name__)

    return register


def still(given: Given, progress: Progress) -> Estimate:
    del progress
    return Estimate(trajectory(), given.mount, "none", FOUND)


def unable(given: Given, progress: Progress) -> Estimate:
    raise LogError("adjusted: no gyros")


def test_every_method_has_a_module_with_its_options_in_the_survey() -> None:
    names = set(vars(Survey()))
    for name in METHODS:
        assert set(methods.find(name).options) <= names
    assert set(methods.BEST) <= set(METHODS)


def test_a_method_is_a_module_and_a_line(registered: Any) -> None:
    """It is found by its name, its options are refused elsewhere, and the estimate says who made it and where the mount is from."""
    registered("still", Method(still, options=("pose_grid_ms",)))
    made = methods.estimate(given(replace(Survey(), method="still", pose_grid_ms=10.0)), quiet)
    assert (made.method, made.mount_source, made.note) == ("still", "log", "")
    with pytest.raises(UsageError, match="only method ins or still uses it, not filtered"):
        methods.check(replace(Survey(), method="filtered", pose_grid_ms=10.0))


def test_lasers_are_the_methods_where_they_are_asked_for_and_else_the_surveys(registered: Any) -> None:
    registered("still", Method(still, finds_lasers=True))
    survey = replace(Survey(), method="still")
    assert methods.estimate(given(survey), quiet).corrections == STATED
    assert methods.estimate(given(replace(survey, lasers=ESTIMATE)), quiet).corrections == FOUND


def test_a_mount_that_was_estimated_says_so_itself(registered: Any) -> None:
    registered(
        "still", Method(lambda *words: replace(still(*words), mount_source="estimated by still, begun from log"))
    )
    made = methods.estimate(given(replace(Survey(), method="still")), quiet)
    assert made.mount_source == "estimated by still, begun from log"


def test_best_goes_down_and_says_why(registered: Any) -> None:
    registered("adjusted", Method(unable))
    registered("filtered", Method(still))
    made = methods.estimate(given(Survey()), quiet)
    assert made.method == "filtered"
    assert made.note == "not adjusted, because no gyros"
    with pytest.raises(LogError, match="no gyros"):
        methods.estimate(given(replace(Survey(), method="adjusted")), quiet)


@pytest.mark.parametrize(
    ("options", "tried"),
    [
        ({}, ("adjusted", "filtered", "ins")),
        ({"positions": "better.pos"}, ("adjusted", "filtered")),
        ({"poses": "trajectory.csv"}, ("adjusted", "filtered")),
        ({"control": "points.csv"}, ("adjusted",)),
        ({"causal": True}, ("adjusted",)),
        ({"lasers": ESTIMATE}, ("adjusted", "filtered", "ins")),
        ({"method": "ins"}, ("ins",)),
    ],
)
def test_best_tries_only_what_looks_at_all_that_is_given(options: dict[str, Any], tried: tuple[str, ...]) -> None:
    assert methods.candidates(replace(Survey(), **options)) == tried


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (
            {"method": "ins", "positions": "better.pos"},
            "positions: better.pos given, but only method adjusted or filtered",
        ),
        ({"method": "filtered", "control": "points.csv"}, "only method adjusted uses it, not filtered"),
        ({"method": "filtered", "causal": True}, "only method adjusted"),
        ({"compass": "compass.yaml"}, "only method dynamic uses it, not best"),
        ({"pose_grid_ms": 10.0}, "only method ins uses it, not best"),
        ({"causal": True, "positions": "better.pos"}, "together with causal"),
        ({"method": "ins", "lasers": ESTIMATE}, "only method adjusted finds them"),
        ({"causal": True, "lasers": ESTIMATE}, "not with --causal"),
    ],
)
def test_an_option_that_the_method_would_not_look_at_is_refused(options: dict[str, Any], reason: str) -> None:
    with pytest.raises(UsageError, match=reason):
        methods.check(replace(Survey(), **options))


def test_the_defaults_of_another_methods_options_are_no_options() -> None:
    """A survey file that was written with all of them is one of any method."""
    for name in METHODS:
        methods.check(replace(Survey(), method=name))
    plain = Survey()
    other = replace(plain, dynamic=replace(plain.dynamic, start="filtered"), method="filtered")
    with pytest.raises(UsageError, match="only method dynamic"):
        methods.check(other)


def test_what_is_given_of_the_lasers_is_a_table(tmp_path: Path) -> None:
    assert (given(Survey()).lasers.range_offset_m == 0.02).all()
