"""Figures of accuracy from differences, axis by axis and together."""

from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

ASPRS_LEAST_POINTS: Final = 30
"""Check points that a statement of accuracy needs up to 1000 km2 (ASPRS Positional Accuracy Standards, edition 2, of 2023 and 2024).

The same edition adds the check points' own error: RMSE = sqrt(measured^2 + survey^2), in plan, in height, and of both in space.
"""
_LE90, _CE90 = 1.6449, 1.5175
"""Of RMSE in height, and of RMSE in plan (both axes together), for normal errors (FGDC-STD-007.3-1998, appendix 3-A)."""
_95_UP, _95_PLAN = 1.9600, 1.7308
"""The same for 95 per cent."""


def figures(d_m: Array, survey_m: Array | None = None, in_plan: npt.NDArray[np.bool_] | None = None) -> dict[str, Any]:
    """Figures of differences.

    Parameters
    ----------
    d_m : ndarray, shape (n, 3)
        In x, y, z; NaN where an axis is not known.
    survey_m : ndarray, shape (n, 3), optional
        Sigma of the reference; NaN where it is not stated.
    in_plan : ndarray of bool, shape (n,), optional
        Whose differences in plan say how accurate it is, and not how densely it was sampled. Default: all.

    Returns
    -------
    dict
        `count`, `mean`, `mean_abs`, `rmse`, `std`, `median`, `p95_abs`, `largest_abs`: each [x, y, z], None without a value.
        `plan`, `up` and `space`: RMSE with the limits for 90 and 95 per cent that follow for normal errors, and the ASPRS class.
    """
    d_m = np.asarray(d_m, np.float64).reshape(-1, 3)
    survey_m = np.full(d_m.shape, np.nan) if survey_m is None else survey_m
    axes = [column[np.isfinite(column)] for column in d_m.T]
    found: dict[str, Any] = {"count": [len(each) for each in axes]}
    for name, of in _OF.items():
        found[name] = [float(of(each)) if len(each) else None for each in axes]
    found["std"] = [float(np.std(each, ddof=1)) if len(each) > 1 else None for each in axes]
    plan, up = np.isfinite(d_m[:, :2]).all(axis=1), np.isfinite(d_m[:, 2])
    plan &= True if in_plan is None else in_plan
    found["plan"] = _limits(d_m[plan, :2], survey_m[plan, :2], {"ce90_m": _CE90, "ce95_m": _95_PLAN})
    found["up"] = _limits(d_m[up, 2:], survey_m[up, 2:], {"le90_m": _LE90, "le95_m": _95_UP})
    found["space"] = _space(found["plan"], found["up"])
    return found


_OF: Final[dict[str, Callable[[Array], Any]]] = {
    "mean": np.mean,
    "mean_abs": lambda d: np.mean(np.abs(d)),
    "rmse": lambda d: np.sqrt(np.mean(np.square(d))),
    "median": np.median,
    "p95_abs": lambda d: np.percentile(np.abs(d), 95.0),
    "largest_abs": lambda d: np.max(np.abs(d)),
}


def _limits(d_m: Array, survey_m: Array, factors: dict[str, float]) -> dict[str, Any] | None:
    """RMSE of all axes together, and what follows from it."""
    if not len(d_m):
        return None
    rmse = float(np.sqrt(np.mean(np.sum(d_m**2, axis=1))))
    found: dict[str, Any] = {"count": len(d_m), "rmse_m": rmse} | {name: by * rmse for name, by in factors.items()}
    stated = np.isfinite(survey_m).all()
    survey = float(np.sqrt(np.mean(np.sum(survey_m**2, axis=1)))) if stated else None
    total = rmse if survey is None else float(np.hypot(rmse, survey))
    return found | {"survey_rmse_m": survey, "asprs_2024_rmse_m": total} | _class(len(d_m), total)


def _space(plan: dict[str, Any] | None, up: dict[str, Any] | None) -> dict[str, Any] | None:
    """Three-dimensional accuracy: plan and height together."""
    if plan is None or up is None:
        return None
    total = float(np.hypot(plan["asprs_2024_rmse_m"], up["asprs_2024_rmse_m"]))
    count = min(plan["count"], up["count"])
    return {"count": count, "asprs_2024_rmse_m": total} | _class(count, total)


def _class(count: int, rmse_m: float) -> dict[str, Any]:
    """The class is the RMSE itself, stated in whole centimetres; it may be stated from 30 points on."""
    enough = count >= ASPRS_LEAST_POINTS
    return {
        "asprs_2024_class_cm": int(np.ceil(rmse_m * 100.0 - 1e-9)) if enough else None,
        "asprs_2024_points_missing": max(ASPRS_LEAST_POINTS - count, 0),
    }


def summary(told: dict[str, Any]) -> list[str]:
    """Lines on plan, height and both."""
    lines = []
    for part, name, ninety in (("plan", "in plan", "ce90_m"), ("up", "in height", "le90_m"), ("space", "in space", "")):
        each = told[part]
        if not each:
            continue
        stated = (
            f"ASPRS 2024 class {each['asprs_2024_class_cm']} cm" if each["asprs_2024_class_cm"] is not None
            else f"ASPRS 2024 asks for {ASPRS_LEAST_POINTS} points, {each['asprs_2024_points_missing']} more"
        )  # fmt: skip
        if ninety:
            wide = ninety.replace("90", "95")
            within = f"{ninety[:4].upper()} {each[ninety]:.4f} m, 95 % {each[wide]:.4f} m"
            survey = (
                "" if each["survey_rmse_m"] is None else f", with the survey's own {each['asprs_2024_rmse_m']:.4f} m"
            )
            lines.append(f"{name}: RMSE {each['rmse_m']:.4f} m{survey}, {within} of {each['count']} points; {stated}")
        else:
            lines.append(f"{name}: RMSE {each['asprs_2024_rmse_m']:.4f} m; {stated}")
    return lines


ROWS: Final = (("mean", "mean"), ("mean_abs", "mean absolute"), ("rmse", "RMSE"), ("p95_abs", "95 % below"))
"""Figures of each axis below the points of a table."""


def cells(values: Sequence[float | None]) -> list[str]:
    """Numbers of a row, in words."""
    return ["-" if value is None or not np.isfinite(value) else f"{value:+.4f}" for value in values]


def table(
    ids: Sequence[str], d: Array, told: dict[str, Any], modes: Sequence[str] | None = None, unit: str = "m"
) -> str:
    """Differences and figures as plain text, those of x, y and z in a unit."""

    def row(name: str, values: Sequence[float | None], more: str = "") -> str:
        return f"{name:<14}" + "".join(f"{word:>11}" for word in cells(values)) + (f"  {more}" if more else "")

    head = [f"{name} [{unit}]" for name in ("dx", "dy", "dz")] if unit == "m" else ["dx", "dy", "dz"]
    lines = [] if unit == "m" else [f"x, y and z are in the unit of the cloud: {unit}"]
    lines.append(f"{'':<14}" + "".join(f"{name:>11}" for name in head))
    lines += [
        row(name[:14], list(each), modes[n] if modes else "") for n, (name, each) in enumerate(zip(ids, d, strict=True))
    ]
    lines += [row(label, told[name]) for name, label in ROWS]
    return "\n".join([*lines, *summary(told)])
