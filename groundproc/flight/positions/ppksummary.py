"""What came of a solution: figures for people, and the header of its file."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from groundproc.flight.positions import rinex
from groundproc.flight.positions.combine import Combined
from groundproc.flight.positions.ellipsoid import ecef_from_geodetic, geodetic_from_ecef
from groundproc.flight.positions.ppkoptions import Base, PpkOptions
from groundproc.flight.positions.ppkrunning import SOLVER
from groundproc.flight.positions.solution import Quality, Solution

_LONG_BASELINE_M: Final = {1: 15_000.0, 2: 50_000.0, 3: 50_000.0}
"""Beyond these the ionosphere no longer cancels, and a fix is luck."""


def comments(solution: Solution, inputs: Sequence[str], options: PpkOptions, where: Base) -> list[str]:
    """Header lines of the output."""
    lines = [f"{'program':<10}: swath ppk, by RTKLIB's {SOLVER}"]
    lines += [f"{'inp file':<10}: {name}" for name in inputs]
    if solution.base_ecef_m is not None:
        latitude, longitude, height = (float(v) for v in geodetic_from_ecef(np.array(solution.base_ecef_m)))
        lines.append(f"{'ref pos':<10}: {latitude:.9f} {longitude:.9f} {height:.4f}")
    # RTKLIB's own word "combined" would say that its sigmas are too small; these are not
    direction = "forward and backward" if options.direction == "combined" else options.direction
    lines.append(f"{'solution':<10}: {direction}")
    return lines + [f"{'option':<10}: {' '.join(line.split())}" for line in options.lines(where)]


def summary_of(
    both: Combined,
    wrong: int,
    solution: Solution,
    seen: rinex.Observations,
    base_seen: rinex.Observations,
    where: Base,
    options: PpkOptions,
    notes: Sequence[str],
) -> dict[str, Any]:
    """Counts, sigmas, baseline and notes of a run."""
    base = np.array(solution.base_ecef_m) if solution.base_ecef_m is not None else np.full(3, np.nan)
    places = ecef_from_geodetic(solution.latitude_deg, solution.longitude_deg, solution.height_m)
    length = np.linalg.norm(places - base, axis=1)
    notes = [*notes]
    if float(np.median(length)) > _LONG_BASELINE_M[options.frequencies]:
        notes.append(
            f"the baseline is {np.median(length) / 1e3:.0f} km long: the ionosphere does not cancel, and fixes may be wrong"
        )
    if where.averaged and where.position is None:
        notes.append("the base's own position is known to metres only, and so is everything here, in one piece")
    if wrong:
        notes.append(
            f"{wrong} positions were metres away from what the code says, and are the code's now: does the receiver report its cycle slips?"
        )
    if not (solution.quality == Quality.FIX).any():
        notes.append("no position is fixed: decimetres at best")
    return {
        "rover_epochs": seen.epochs,
        "base_epochs": base_seen.epochs,
        "positions": len(solution),
        "lost_epochs": max(seen.epochs - len(solution), 0),
        "seconds": round(seen.seconds, 3),
        "quality": {name: round(value, 4) for name, value in solution.shares().items()},
        "sigma_m": _sigmas(solution),
        "directions": {"agreed": both.agreed, "contradicted": both.contradicted, "unsupported": both.unsupported},
        "refuted_by_code": wrong,
        "baseline_m": {
            "shortest": _rounded(length.min()),
            "median": _rounded(np.median(length)),
            "longest": _rounded(length.max()),
        },
        "base": {
            "source": where.source(),
            "position": [round(float(v), 9) for v in geodetic_from_ecef(base)],
        },
        "notes": notes,
    }


def _sigmas(solution: Solution) -> dict[str, dict[str, float]]:
    """Median sigma of each kind, horizontal (of both axes together) and vertical [m]."""
    sigma = solution.sigma_m
    found = {}
    for kind in Quality:
        rows = solution.quality == kind
        if rows.any():
            horizontal = np.hypot(sigma[rows, 0], sigma[rows, 1])
            found[kind.name.lower()] = {
                "horizontal": round(float(np.median(horizontal)), 4),
                "vertical": round(float(np.median(sigma[rows, 2])), 4),
            }
    return found


def _rounded(value: Any) -> float:
    return round(float(value), 3)
