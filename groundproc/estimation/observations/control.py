"""Control points and planes as an observation: the map is laid on them as a whole once it is right in itself, and then held to them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.estimation.observations.held import Held, held_to, kept_for, together
from groundproc.estimation.observations.lidar import DEFLATION
from groundproc.estimation.observations.observation import Flown, Observation, Outcome, State, Stretch
from groundproc.estimation.observations.rows import Factor, Unknowns
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.spline import Path
from groundproc.estimation.surveyed import surveyed_control
from groundproc.flight.control import ControlPoint

Array = npt.NDArray[np.float64]


@dataclass(slots=True)
class Control(Observation):
    """The control of a flight.

    Attributes
    ----------
    points : sequence of ControlPoint
        In the local frame.
    whole : bool
        The map is that of the whole flight; that of a window is not held to control, which may be of another surface while the window
        lies metres off.
    seen : Clusters, optional
        What the surfaces are found in, where it is not all that the lidar saw.
    held : Held, optional
        What of it the map meets.
    """

    points: Sequence[ControlPoint]
    whole: bool = True
    seen: Clusters | None = None
    held: Held | None = None
    name: str = "control"

    def begin(self, stretch: Stretch) -> "Control":
        """Not met yet."""
        return replace(self, whole=stretch.whole, held=None)

    def joined(self, values: Mapping[str, Array], kept: Sequence[Any]) -> "Control | None":
        """For the map of all windows, by what they kept."""
        del values
        parts = [clusters for clusters in kept if clusters is not None]
        return replace(self, whole=True, seen=together(parts), held=None) if parts else None

    def factors(self, state: State, unknowns: Unknowns) -> list[Factor]:
        """A row for each place, once the map has been laid on the control."""
        if self.held is None:
            return []
        factor = self.held.factor(self._clusters(state), state.path, unknowns)
        return [] if factor is None else [factor]

    def hold(self, state: State, covariance: Callable[[], Array]) -> Path | None:
        """Find where the map has to go for its surfaces to meet the control."""
        if not self.whole:
            return None
        self.held = held_to(self.points, self._clusters(state), state.path, covariance(), DEFLATION)
        return None if self.held is None else state.path.turned(*self.held.datum.placing.as_turn())

    def keep(self, state: State, frame: Path) -> Clusters | None:
        """Clusters that may be of a surface at some control, wherever the whole has to go."""
        return kept_for(self.points, state.clusters, state.path, frame)

    def tell(self, state: State) -> list[dict[str, Any]] | None:
        """What is to be said of each point; None where the map met none."""
        return None if self.held is None else self.held.report(self._clusters(state), state.path)

    def report(self, outcome: Outcome) -> dict[str, Any]:
        """Used, checked and rejected points."""
        return {self.name: control_report(self.points, self._told(outcome))}

    def warnings(self, outcome: Outcome) -> list[str]:
        """Control that does not fit."""
        return control_warnings(self.points, self._told(outcome))

    def _told(self, outcome: Outcome) -> list[Sequence[dict[str, Any]]]:
        return [told.get(self.name, ()) for told in outcome.told]

    def _clusters(self, state: State) -> Clusters:
        return state.clusters if self.seen is None else self.seen


def of_run(flown: Flown) -> list[Observation]:
    """The control that the survey names."""
    points = surveyed_control(flown.given)
    return [Control(points)] if points else []


def control_report(
    points: Sequence[ControlPoint], windows: Sequence[Sequence[dict[str, Any]]]
) -> dict[str, Any] | None:
    """What quality.json says of the control of a run; None where none was given.

    Parameters
    ----------
    points : sequence of ControlPoint
    windows : sequence of sequence of dict
        What each window says of each point, or nothing.
    """
    if not points:
        return None
    told = [_best([window[i] for window in windows if window], point) for i, point in enumerate(points)]
    by_state = {
        state: [each for each in told if each["state"] == state]
        for state in ("used", "check", "rejected", "doubtful", "not seen")
    }
    notes = [
        f"{each['name']} is {abs(each['after_m']):.3f} m off the surface where {each['sigma_m']:.3f} m is expected, and was left out"
        for each in by_state["rejected"]
    ]
    if by_state["doubtful"]:
        names = ", ".join(each["name"] for each in by_state["doubtful"])
        notes.append(f"{names} left out, because no other point tells which surface they lie on")
    if by_state["not seen"]:
        notes.append(f"no surface seen at {', '.join(each['name'] for each in by_state['not seen'])}")
    alone = [each["name"] for each in by_state["used"] if each["redundancy"] < UNCHECKED]
    if alone:
        notes.append(f"nothing else would tell an error of {', '.join(alone)}")
    return {
        "used": _figures(by_state["used"]),
        "check": _figures(by_state["check"]),
        "rejected": [each["name"] for each in by_state["rejected"]],
        "note": "; ".join(notes),
        "points": told,
    }


UNCHECKED: Final = 0.1
"""Redundancy below which a blunder would be followed without a sign."""


def _best(told: Sequence[dict[str, Any]], point: ControlPoint) -> dict[str, Any]:
    """Of what several windows say of a point, that with the smallest sigma."""
    seen = [each for each in told if each["state"] != "not seen"]
    if seen:
        return min(seen, key=lambda each: float(each["sigma_m"]))
    return {"name": point.name, "use": "check" if point.check else "control", "state": "not seen"}


def _figures(told: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Number and size of distances."""
    if not told:
        return {"count": 0}
    before = [each["before_m"] for each in told if each["before_m"] is not None]
    after = [each["after_m"] for each in told]
    heights = [each["after_m"] for each in told if each["along"][2] == 1.0]
    return {
        "count": len(told),
        "before_rms_m": float(np.sqrt(np.mean(np.square(before)))) if before else None,
        "after_rms_m": float(np.sqrt(np.mean(np.square(after)))),
        "height_mean_m": float(np.mean(heights)) if heights else None,
        "sigma_m": float(np.sqrt(np.mean(np.square([each["sigma_m"] for each in told])))),
    }


def control_warnings(points: Sequence[ControlPoint], windows: Sequence[Sequence[dict[str, Any]]]) -> list[str]:
    """What is wrong with the control as a whole."""
    report = control_report(points, windows)
    if report is None or all(point.check for point in points):
        return []
    used, rejected = report["used"]["count"], len(report["rejected"])
    if not used:
        return ["none of the control points lies on a surface that was seen: the cloud is where it was without them"]
    if rejected > used:
        return [
            f"{rejected} of {used + rejected} control points contradict the others: coordinates, heights or names may be mixed up"
        ]
    return []
