"""Figures of accuracy from differences, axis by axis and together."""

from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

ASPRS_LEAST_POINTS: Final = 30
"""Check points that a statement of accuracy needs (ASPRS Positional Accuracy Standards, edition 2, 2024, section 7.10)."""
_LE90, _CE90 = 1.6449, 1.5175
"""Of RMSE in height, and of RMSE in plan (both axes together), for normal errors (FGDC-STD-007.3-1998, appendix 3-A)."""
_95_UP, _95_PLAN = 1.9600, 1.7308
"""The same for 95 per cent."""


def figures(d_m: Array) -> dict[str, Any]:
    """Figures of differences.

    Parameters
    ----------
    d_m : ndarray, shape (n, 3)
        In x, y, z; NaN where an axis is not known.

    Returns
    -------
    dict
        `count`, `mean`, `mean_abs`, `rmse`, `std`, `median`, `p95_abs`, `largest_abs`: each [x, y, z], None without a value.
        `plan` and `up`: RMSE with the limits for 90 and 95 per cent that follow for normal errors.
    """
    d_m = np.asarray(d_m, np.float64).reshape(-1, 3)
    axes = [column[np.isfinite(column)] for column in d_m.T]
    found: dict[str, Any] = {"count": [len(each) for each in axes]}
    for name, of in _OF.items():
        found[name] = [float(of(each)) if len(each) else None for each in axes]
    found["std"] = [float(np.std(each, ddof=1)) if len(each) > 1 else None for each in axes]
    found["plan"], found["up"] = _plan(d_m), _up(axes[2])
    return found


_OF: Final[dict[str, Callable[[Array], Any]]] = {
    "mean": np.mean,
    "mean_abs": lambda d: np.mean(np.abs(d)),
    "rmse": lambda d: np.sqrt(np.mean(np.square(d))),
    "median": np.median,
    "p95_abs": lambda d: np.percentile(np.abs(d), 95.0),
    "largest_abs": lambda d: np.max(np.abs(d)),
}


def _plan(d_m: Array) -> dict[str, Any] | None:
    both = d_m[np.isfinite(d_m[:, :2]).all(axis=1), :2]
    if not len(both):
        return None
    rmse = float(np.sqrt(np.mean(np.sum(both**2, axis=1))))
    return {"count": len(both), "rmse_m": rmse, "ce90_m": _CE90 * rmse, "ce95_m": _95_PLAN * rmse} | _class(
        len(both), rmse
    )


def _up(d_m: Array) -> dict[str, Any] | None:
    if not len(d_m):
        return None
    rmse = float(np.sqrt(np.mean(d_m**2)))
    return {"count": len(d_m), "rmse_m": rmse, "le90_m": _LE90 * rmse, "le95_m": _95_UP * rmse} | _class(len(d_m), rmse)


def _class(count: int, rmse_m: float) -> dict[str, Any]:
    """The class of ASPRS 2024 is the RMSE itself, stated in whole centimetres; it may be stated from 30 points on."""
    enough = count >= ASPRS_LEAST_POINTS
    return {
        "asprs_2024_class_cm": int(np.ceil(rmse_m * 100.0 - 1e-9)) if enough else None,
        "asprs_2024_points_missing": max(ASPRS_LEAST_POINTS - count, 0),
    }


def table(ids: Sequence[str], d_m: Array, told: dict[str, Any], modes: Sequence[str] | None = None) -> str:
    """Differences and figures as text, in metres."""

    def row(name: str, values: Sequence[float | None], more: str = "") -> str:
        words = ["-" if value is None or not np.isfinite(value) else f"{value:+.4f}" for value in values]
        return f"{name:<14}" + "".join(f"{word:>11}" for word in words) + (f"  {more}" if more else "")

    lines = [f"{'':<14}{'dx [m]':>11}{'dy [m]':>11}{'dz [m]':>11}"]
    lines += [
        row(name[:14], list(d), modes[n] if modes else "") for n, (name, d) in enumerate(zip(ids, d_m, strict=True))
    ]
    for name, label in (("mean", "mean"), ("mean_abs", "mean absolute"), ("rmse", "RMSE"), ("p95_abs", "95 % below")):
        lines.append(row(label, told[name]))
    for part, name, ninety in (("plan", "in plan", "ce90_m"), ("up", "in height", "le90_m")):
        each = told[part]
        if each:
            stated = (
                f"ASPRS 2024 class {each['asprs_2024_class_cm']} cm" if each["asprs_2024_class_cm"] is not None
                else f"ASPRS 2024 asks for {ASPRS_LEAST_POINTS} points, {each['asprs_2024_points_missing']} more"
            )  # fmt: skip
            lines.append(
                f"{name}: RMSE {each['rmse_m']:.4f} m, {ninety[:4].upper()} {each[ninety]:.4f} m of {each['count']} points; {stated}"
            )
    return "\n".join(lines)
