"""Is a boresight or a clock's shift real? Views that are held out must agree better with it than without.

Every fifth station loses its image points. Its pose is then the trajectory's, with the mounting and the clock that the
others found, and the points that the others placed are viewed from there. All groups of unknowns are free to begin
with, and the one that helps least is removed until every one that is left helps: a boresight that is tried while a
clock is still off by pixels improves nothing.

Points of a view's own strip move with the strip. A wrong clock shows only in the fewer points that strips of other
headings share, and a median does not see them. So the measure of a view is the RMS of all but its worst points. Views
are combined by the geometric mean: a view whose pose is bad anyway, as in a gap of GNSS, is bad with and without the
change, and does not drown the others.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.imagery.bundle.block import Block
from groundproc.imagery.bundle.solve import image_residuals, normal_of, solve
from groundproc.imagery.bundle.unknowns import lay_out
from groundproc.imagery.rig import RigCamera

Mask = npt.NDArray[np.bool_]

LEAST_STATIONS: Final = 10
EVERY: Final = 5
BETTER: Final = 0.98
"""What is accepted makes the residuals of held-out views at least so much smaller."""
KEPT: Final = 0.95
"""Of the points of a held-out view; the others may be wrong matches that were not found."""
LEAST_POINTS: Final = 5
"""That a held-out view judges by."""
BORESIGHT: Final = ("boresight_x", "boresight_y", "boresight_z", "lever_x", "lever_y", "lever_z")
GROUPS: Final = (("boresight", BORESIGHT), ("timeshift", ("timeshift",)), ("line_delay", ("line_delay",)))


def candidates(camera: RigCamera) -> tuple[str, ...]:
    """Groups that a camera could have: those whose prior sigma is stated."""
    keys = {"boresight": "boresight_deg", "timeshift": "timeshift_s", "line_delay": "line_delay_s"}
    return tuple(name for name, _ in GROUPS if camera.sigma.get(keys[name]))


def accepted(block: Block, known: tuple[RigCamera, ...]) -> tuple[tuple[tuple[str, ...], ...], list[dict[str, Any]]]:
    """Which unknowns of the mounting are taken, for each camera, and what held-out views said of each group.

    Parameters
    ----------
    block : Block
        With wrong matches left out.
    known : tuple of RigCamera
    """
    stations = np.unique(block.priors.station)
    wanted = [candidates(one) for one in known]
    if len(stations) < LEAST_STATIONS:
        few = [{"group": name, "accepted": True, "reason": "too few views to hold any out"} for name, _ in GROUPS
               if any(name in own for own in wanted)]  # fmt: skip
        return _unknowns_of([name for name, _ in GROUPS], wanted), few
    held = np.isin(block.station[block.measured.image], stations[EVERY // 2 :: EVERY])
    left = [name for name, _ in GROUPS if any(name in own for own in wanted)]

    def error(groups: Sequence[str]) -> float:
        return _error(block, known, _unknowns_of(groups, wanted), held)

    told: dict[str, dict[str, Any]] = {}
    best = error(left)
    while left:
        without = {name: error([other for other in left if other != name]) for name in left}
        for name in left:
            better = best < BETTER * without[name]
            told[name] = {
                "group": name,
                "accepted": better,
                "held_out_px": _finite(best),
                "without_px": _finite(without[name]),
            }
        least = min(left, key=without.__getitem__)
        if told[least]["accepted"]:
            break
        left, best = [name for name in left if name != least], without[least]
    return _unknowns_of(left, wanted), [told[name] for name, _ in GROUPS if name in told]


def _finite(value_px: float) -> float | None:
    """None where no held-out view has points to judge by."""
    return value_px if np.isfinite(value_px) else None


def _unknowns_of(groups: Sequence[str], wanted: Sequence[tuple[str, ...]]) -> tuple[tuple[str, ...], ...]:
    """Unknowns of each camera where some groups are free."""
    return tuple(tuple(u for name, group in GROUPS if name in groups and name in own for u in group) for own in wanted)


def _error(block: Block, known: tuple[RigCamera, ...], mounting: tuple[tuple[str, ...], ...], held: Mask) -> float:
    """Residual of held-out views [px] with some unknowns of the mounting: the geometric mean of the RMS of each."""
    weight = np.where(held, 0.0, block.measured.weight)
    training = replace(block, measured=replace(block.measured, weight=weight), mounting=mounting)
    # points that only held-out views see say nothing
    kept = normal_of(training, known, lay_out(training)).kept
    weight = np.where(kept.determined[training.measured.point], weight, 0.0)
    solved = solve(replace(training, measured=replace(training.measured, weight=weight)), known)
    residual, reached = image_residuals(solved.block, solved.unknowns)
    seen = held & (block.measured.weight > 0.0) & reached & kept.determined[block.measured.point]
    found = []
    for image in np.unique(block.measured.image[seen]):
        square = np.sort(np.square(residual[seen & (block.measured.image == image)]).sum(axis=1))
        if len(square) >= LEAST_POINTS:
            found.append(0.5 * np.log(square[: int(np.ceil(KEPT * len(square)))].mean()))
    return float(np.exp(np.mean(found))) if found else float("inf")
