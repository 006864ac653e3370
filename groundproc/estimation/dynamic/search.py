"""The search of the dynamic calibration: once per revolution, one variable after another, the step that makes two models agree best.

Source: FOI-R--4045--SE (2014), Eq. 9 and its table of steps:

    trim(t) = trim(t - dt) + d,   d = argmin RMSE[GM(t - dt), GM(t, d)]

The robust mode keeps that frame, 22 evaluations included, and changes what is compared with what; docs/methods/dynamic.md says why.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.constants import NS_PER_S
from groundproc.estimation.dynamic import ground_model, plan
from groundproc.estimation.dynamic.ground_model import Raster
from groundproc.estimation.dynamic.plan import DistanceMap
from groundproc.estimation.dynamic.revolutions import LONGEST_NS, Revolution
from groundproc.survey.dynamic import DynamicOptions

Array = npt.NDArray[np.float64]

VARIABLES: Final = ("yaw", "altitude", "pitch", "roll", "x", "y")
"""In the order in which the source tries them, and of every array of trims: rad, m, rad, rad, m, m."""
YAW: Final = 0
ANGLES: Final = [0, 2, 3]
SHIFTS: Final = [4, 5, 1]
"""Places of heading, pitch, roll and of east, north, up in an array of trims."""
IN_PLAN: Final = ("yaw", "x", "y")
"""What upright things tell, where they are looked at; the ground tells the rest."""
CHECKED: Final = 10
"""Every so many revolutions the trims are compared with no trims at all."""


@dataclass(frozen=True, slots=True)
class Found:
    """What the search found at one revolution.

    Attributes
    ----------
    time_ns : int
        UTC.
    heading_rad : float
        Of the trajectory that is trimmed.
    trims : ndarray, shape (6,)
        In the order of VARIABLES.
    ground_m, plan_m : tuple of float
        Root mean square by which ground models, and upright things in plan, differ from the reference before and after the steps of
        this revolution [m]; nan where there is no reference, or they are not compared.
    pixels : int
        Pixels that the ground models have in common.
    evaluations : int
    """

    time_ns: int
    heading_rad: float
    trims: Array
    ground_m: tuple[float, float]
    plan_m: tuple[float, float]
    pixels: int
    evaluations: int


@dataclass(frozen=True, slots=True)
class Scan:
    """A revolution, its ground and what stands upright on it (none where that is not looked at), with the trims that hold for it."""

    ground: Revolution
    upright: Revolution | None
    trims: Array

    def placing(self, trims: Array, middle_m: Array) -> tuple[Array, Array]:
        """Turn, shape (3, 3), and shift, shape (3,), that place it under trims in a raster about `middle_m`."""
        return self.ground.turn(trims[ANGLES]), self.ground.position_m + trims[SHIFTS] - middle_m


@dataclass(frozen=True, slots=True)
class Difference:
    """Of a scan from the reference.

    Attributes
    ----------
    square_m2 : float
        Mean square; infinite where there is too little to compare.
    count : int
        Pixels or points compared.
    """

    square_m2: float = np.inf
    count: int = 0

    @property
    def rms_m(self) -> float:
        """Root mean square; nan where there is too little to compare."""
        return float(np.sqrt(self.square_m2)) if np.isfinite(self.square_m2) else float("nan")


@dataclass(slots=True)
class Check:
    """Sums of squares over some revolutions, with the trims and without any: whether the flight fits itself better with them."""

    trimmed: Array = field(default_factory=lambda: np.zeros(2))
    untrimmed: Array = field(default_factory=lambda: np.zeros(2))
    count: int = 0

    def ratio(self) -> float:
        """Root mean square with trims over that without, the larger of ground's and plan's; nan where nothing was compared."""
        known = self.untrimmed > 0
        return float(np.sqrt(self.trimmed[known] / self.untrimmed[known]).max()) if known.any() else float("nan")


def steps_of(options: DynamicOptions) -> dict[str, list[float]]:
    """Steps of each variable, in the order of VARIABLES, in rad and m."""
    s = options.steps
    return {
        "yaw": np.deg2rad(s.yaw_deg).tolist(),
        "altitude": list(s.altitude_m),
        "pitch": np.deg2rad(s.pitch_deg).tolist(),
        "roll": np.deg2rad(s.roll_deg).tolist(),
        "x": list(s.x_m),
        "y": list(s.y_m),
    }


class Search:
    """Takes the revolutions of a flight one by one and gives the trims of each; keeps no more of them than its reference.

    Parameters
    ----------
    options : DynamicOptions
    """

    def __init__(self, options: DynamicOptions) -> None:
        self._options = o = options.effective()
        self._steps = steps_of(o)
        self._window: deque[Scan] = deque(maxlen=None if o.robust else 1)
        self._last_ns: int | None = None
        self._new = Raster.empty(o.pixel_m, o.half_width_m)
        self._reference = Raster.empty(o.pixel_m, o.half_width_m)
        self._map = DistanceMap.empty(o.plan_pixel_m, o.half_width_m, o.plan_m) if o.plan_m > 0 else None
        self._revolutions = 0
        self.trims: Array = np.zeros(6)
        self.check = Check()

    def step(self, revolution: Revolution, course_trim_rad: float | None = None) -> Found:
        """The trims at a revolution.

        Parameters
        ----------
        revolution : Revolution
            Later than those before.
        course_trim_rad : float, optional
            Course over ground less heading, where the vehicle drives and the course is to aid.
        """
        self._age(revolution.time_ns, course_trim_rad)
        scan = self._scan(revolution)
        ground = in_plan = (Difference(), Difference())
        count = 0
        if self._window:
            self._build(scan, np.zeros(6))
            for variable in VARIABLES:
                if self._map is not None and variable in IN_PLAN:
                    first, best = self._try(scan, variable, self._apart)
                    in_plan = (in_plan[0] if in_plan[0].count else first, best)
                else:
                    first, best = self._try(scan, variable, self._differ)
                    ground = (ground[0] if ground[0].count else first, best)
                count += len(self._steps[variable])
            if self._revolutions % CHECKED == 0:
                self._compare_with_none(scan)
        self._window.append(replace(scan, trims=self.trims.copy()))
        self._last_ns = revolution.time_ns
        self._revolutions += 1
        return Found(
            revolution.time_ns,
            float(revolution.angles_rad[0]),
            self.trims.copy(),
            (ground[0].rms_m, ground[1].rms_m),
            (in_plan[0].rms_m, in_plan[1].rms_m),
            ground[1].count,
            count,
        )

    def _try(
        self, scan: Scan, variable: str, differ: Callable[[Scan, Array], Difference]
    ) -> tuple[Difference, Difference]:
        """Try the steps of one variable, the first of which is none, and keep the best: its difference, after that of none."""
        common = variable in self._options.common and self._baseline_m(scan) >= self._options.baseline_m
        moved = np.zeros(6)
        place = VARIABLES.index(variable)
        first = best = Difference()
        chosen = 0.0
        for number, step in enumerate(self._steps[variable]):
            moved[place] = step
            if common and number:
                self._build(scan, moved, only=differ)
            found = differ(scan, self.trims + moved)
            if number == 0:
                first = best = found
            elif found.square_m2 < best.square_m2 and found.square_m2 < first.square_m2 * (
                1 - self._options.least_gain
            ):
                best, chosen = found, step
        moved[place] = chosen
        self.trims = self.trims + moved
        if common:
            self._move(moved)
            self._build(scan, np.zeros(6), only=None if chosen else differ)
        return first, best

    def _baseline_m(self, scan: Scan) -> float:
        """How far the INS has come since the oldest revolution of the reference."""
        return float(np.linalg.norm(scan.ground.position_m - self._window[0].ground.position_m))

    def _move(self, moved: Array) -> None:
        """Turn the reference with a step that is in it as well."""
        for i, old in enumerate(self._window):
            self._window[i] = replace(old, trims=old.trims + moved)

    def _age(self, time_ns: int, course_trim_rad: float | None) -> None:
        """Drop the reference where it is too old; let the trims return towards zero, and yaw towards the course where that is given."""
        o = self._options
        longest_ns = o.window_s * NS_PER_S if o.robust else LONGEST_NS
        while self._window and time_ns - self._window[0].ground.time_ns > longest_ns:
            self._window.popleft()
        if self._last_ns is None:
            return
        passed_s = (time_ns - self._last_ns) / NS_PER_S
        if o.decay_s > 0:
            self.trims[1:] *= np.exp(-passed_s / o.decay_s)
        if course_trim_rad is not None and o.course_s > 0:
            apart = (course_trim_rad - self.trims[YAW] + np.pi) % (2 * np.pi) - np.pi
            moved = np.zeros(6)
            moved[YAW] = apart * -np.expm1(-passed_s / o.course_s)
            self.trims = self.trims + moved
            self._move(moved)

    def _scan(self, revolution: Revolution) -> Scan:
        """The ground of a revolution: what is not higher than the cut over the median height; and what is."""
        o = self._options
        over = revolution.height_m()
        over = over - np.median(over)
        ground = revolution.some(over <= o.cut_m)
        if self._map is None:
            return Scan(ground, None, self.trims)
        upright = revolution.some((over > o.cut_m) & (over < o.plan_top_m))
        return Scan(
            ground.thinned(o.pixel_m, o.half_width_m), upright.thinned(o.plan_pixel_m, o.half_width_m), self.trims
        )

    def _references(self) -> Sequence[Scan]:
        """Those of the window that make the reference: evenly spaced, the last among them."""
        places = np.linspace(len(self._window) - 1, 0, self._options.window_revolutions)
        return [self._window[i] for i in np.unique(places.round().astype(int))]

    def _build(
        self, scan: Scan, moved: Array, only: Callable[[Scan, Array], Difference] | None = None, bare: bool = False
    ) -> None:
        """The reference's models about a scan, its trims moved, or bare of any; only those that one way to compare needs."""
        of_ground, of_plan = only != self._apart, only != self._differ and self._map is not None
        middle_m = scan.ground.position_m
        if of_ground:
            ground_model.clear(self._reference)
        if of_plan and self._map is not None:
            plan.clear(self._map)
        for old in self._references():
            placing = old.placing(moved if bare else old.trims + moved, middle_m)
            if of_ground:
                ground_model.add(self._reference, old.ground.turned_m, old.ground.base_m, *placing)
            if of_plan and self._map is not None and old.upright is not None:
                plan.occupy(self._map, old.upright.turned_m, old.upright.base_m, *placing)
        if of_ground:
            ground_model.finish(self._reference, self._options.fill_pixels)
        if of_plan and self._map is not None:
            plan.spread(self._map)

    def _differ(self, scan: Scan, trims: Array) -> Difference:
        """Of the ground models."""
        o = self._options
        total, count = ground_model.evaluate(
            self._new,
            self._reference,
            scan.ground.turned_m,
            scan.ground.base_m,
            *scan.placing(trims, scan.ground.position_m),
            o.fill_pixels,
            o.loss_m,
            self._map,
        )
        return Difference(total / count, count) if count >= o.least_pixels else Difference(count=count)

    def _apart(self, scan: Scan, trims: Array) -> Difference:
        """Of what stands upright, in plan."""
        count = 0 if scan.upright is None else len(scan.upright)
        if self._map is None or scan.upright is None or count < self._options.least_pixels:
            return Difference(count=count)
        placing = scan.placing(trims, scan.ground.position_m)
        total = plan.distance(self._map, scan.upright.turned_m, scan.upright.base_m, *placing)
        return Difference(total / count, count)

    def _compare_with_none(self, scan: Scan) -> None:
        """Add to the check what this scan differs by with its trims and without any."""
        trimmed = [self._differ(scan, self.trims), self._apart(scan, self.trims)]
        self._build(scan, np.zeros(6), bare=True)
        untrimmed = [self._differ(scan, np.zeros(6)), self._apart(scan, np.zeros(6))]
        for i, (with_trims, without) in enumerate(zip(trimmed, untrimmed, strict=True)):
            if np.isfinite(with_trims.square_m2) and np.isfinite(without.square_m2):
                self.check.trimmed[i] += with_trims.square_m2
                self.check.untrimmed[i] += without.square_m2
        self.check.count += 1
