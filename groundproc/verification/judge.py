"""Whether the figures of all panels are what the data sheet promises."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np

from groundproc.verdict import DOUBTFUL, GOOD
from groundproc.verification.measure import Measured, Row
from groundproc.verification.panels import Sheet

_ENOUGH: Final = 30
"""Echoes of one laser, to judge it."""
_SIGMAS: Final = 3.0
"""What a figure may exceed its limit by, for its own uncertainty."""


@dataclass(frozen=True, slots=True)
class Check:
    """One promise held against one figure.

    Attributes
    ----------
    about, where : str
    found, limit, sigma : float
        `sigma` is how well the figure is known.
    meets : bool
    """

    about: str
    where: str
    found: float
    limit: float
    sigma: float
    meets: bool

    @property
    def sentence(self) -> str:
        """For people."""
        return f"{self.where}: {self.about} {self.found:.4g} (± {self.sigma:.2g}), promised {self.limit:g}"


@dataclass(frozen=True, slots=True)
class Judged:
    """All checks, and what they come to."""

    checks: list[Check]

    @property
    def grade(self) -> str:
        """Of `groundproc.verdict`; of a sensor that nothing was held against nothing good is known."""
        return GOOD if self.checks and all(each.meets for each in self.checks) else DOUBTFUL

    @property
    def broken(self) -> list[Check]:
        """Promises that are not kept."""
        return [each for each in self.checks if not each.meets]

    def figures(self) -> dict[str, Any]:
        """For JSON."""
        return {"verdict": self.grade, "checks": [asdict(each) for each in self.checks]}


def judge(measured: Sequence[Measured], sheet: Sheet) -> Judged:
    """Hold the figures of all panels against the data sheet."""
    return Judged([check for each in measured for check in _of_panel(each, sheet)])


def _of_panel(found: Measured, sheet: Sheet) -> Iterator[Check]:
    panel, title, whole = found.panel, found.panel.title, found.whole
    bright = panel.reflectance >= sheet.seen_from and panel.distance_m <= sheet.seen_to_m
    if bright and whole.shots:
        sigma = np.sqrt(max(sheet.detected * (1.0 - sheet.detected), 1e-6) / whole.shots)
        yield _least("share of shots with an echo", title, whole.detected, sheet.detected, float(sigma))
    if not found.seen:
        return
    if bright:
        yield _intensity(found, sheet)
    if panel.surveyed:
        off = found.distance_m - panel.distance_m
        yield _most(
            "distance off the surveyed one [m]",
            title,
            abs(off),
            sheet.range_off_m,
            whole.sigma_m / np.sqrt(whole.echoes),
        )
    if panel.distance_m <= sheet.to_m:
        for row in found.lasers:
            if row.echoes >= _ENOUGH:
                yield from _of_laser(f"{title}, laser {row.laser}", row, sheet)


def _of_laser(where: str, row: Row, sheet: Sheet) -> Iterator[Check]:
    yield _most("scatter of ranges [m]", where, row.sigma_m, sheet.range_sigma_m, row.sigma_of_sigma_m)
    yield _most("mean off the panel [m]", where, abs(row.off_m), sheet.range_off_m, row.sigma_m / np.sqrt(row.echoes))


def _intensity(found: Measured, sheet: Sheet) -> Check:
    nominal = 100.0 * found.panel.reflectance
    off = abs(found.whole.intensity - nominal) / nominal
    known = found.whole.intensity_sigma / np.sqrt(found.whole.echoes) / nominal
    return _most(
        "intensity off its nominal value, as a share", found.panel.title, off, sheet.intensity_share, float(known)
    )


def _most(about: str, where: str, found: float, limit: float, sigma: float) -> Check:
    return Check(about, where, float(found), limit, float(sigma), bool(found <= limit + _SIGMAS * sigma))


def _least(about: str, where: str, found: float, limit: float, sigma: float) -> Check:
    return Check(about, where, float(found), limit, float(sigma), bool(found >= limit - _SIGMAS * sigma))
