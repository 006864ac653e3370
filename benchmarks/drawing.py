"""Pictures of `trajectory`: where each method went, its errors over time, and slices through a facade."""

from pathlib import Path
from typing import Any, Final

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

Courses = dict[str, dict[str, Any]]

SHOWN_M: Final = 30.0
"""A trajectory that strays further than this from the true one leaves the map."""
SLICE_M: Final = np.array([6.0, 0.75])
"""Half length and half depth of a slice as drawn."""
DPI: Final = 110


def draw(results: Path, names: list[str], title: str, duration_s: float) -> None:
    """Draw all pictures of what `names` left in the folder of results."""
    courses = {name: dict(np.load(results / f"{name}.npz")) for name in names}
    colours = {name: plt.get_cmap("tab10")(i % 10) for i, name in enumerate(names)}
    colours["truth"] = "black"
    _map(results / "trajectories.png", courses, colours, title)
    _over_time(results / "errors.png", courses, colours, title, duration_s)
    _heading(results / "heading.png", courses, colours, title, duration_s)
    _sections(results / "sections.png", courses, title)


def _finish(figure: Any, path: Path) -> None:
    figure.savefig(path, dpi=DPI)
    plt.close(figure)


def _map(path: Path, courses: Courses, colours: dict[str, Any], title: str) -> None:
    figure, axes = plt.subplots(figsize=(10, 7), layout="constrained")
    true = next(iter(courses.values()))["true_position_m"]
    for name, course in courses.items():
        position = course["position_m"]
        axes.plot(position[:, 0], position[:, 1], color=colours[name], label=name, lw=2.5 if name == "truth" else 1.2)
    low, high = true.min(axis=0) - SHOWN_M, true.max(axis=0) + SHOWN_M
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="east [m]", ylabel="north [m]", aspect="equal")
    axes.set_title(f"{title}: after one rigid alignment")
    axes.grid(alpha=0.3)
    axes.legend(loc="upper right", fontsize=8)
    _finish(figure, path)


def _over_time(path: Path, courses: Courses, colours: dict[str, Any], title: str, duration_s: float) -> None:
    figure, axes = plt.subplots(3, 1, figsize=(10, 9), sharex=True, layout="constrained")
    for name, course in courses.items():
        if name != "truth":
            axes[0].semilogy(course["time_s"], course["position_error_m"], color=colours[name], label=name, lw=1)
            axes[1].semilogy(course["time_s"], course["rotation_error_deg"], color=colours[name], lw=1)
        axes[2].semilogy(course["cloud_time_s"], course["point_rms_m"], color=colours[name], label=name, lw=1)
    axes[0].set(ylabel="position error [m]", title=f"{title}: lidar poses and points after one rigid alignment")
    axes[1].set(ylabel="rotation error [deg]")
    axes[2].set(ylabel="points from true echoes, rms [m]", xlabel="time [s]", xlim=(0, duration_s))
    for each in axes:
        each.grid(alpha=0.3, which="both")
    axes[2].legend(fontsize=8, ncols=4)
    _finish(figure, path)


def _heading(path: Path, courses: Courses, colours: dict[str, Any], title: str, duration_s: float) -> None:
    figure, axes = plt.subplots(2, 1, figsize=(10, 7), sharex=True, layout="constrained")
    for name, course in courses.items():
        if name == "truth":
            continue
        axes[0].plot(course["time_s"], course["heading_error_deg"], color=colours[name], label=name, lw=1)
        if "absolute_heading_error_deg" in course:
            axes[1].plot(course["time_s"], course["absolute_heading_error_deg"], color=colours[name], label=name, lw=1)
    axes[0].set(ylabel="heading error, constant off [deg]", title=f"{title}: heading", ylim=(-15, 15))
    axes[1].set(ylabel="heading against true north [deg]", xlabel="time [s]", xlim=(0, duration_s))
    for each in axes:
        each.axhspan(-1, 1, color="0.9", zorder=0)
        each.grid(alpha=0.3)
        each.legend(fontsize=8, ncols=4, loc="upper right")
    _finish(figure, path)


def _sections(path: Path, courses: Courses, title: str) -> None:
    """The slice of every method, seen from above, coloured by time: one wall is one line where the passes agree."""
    shown = {name: course for name, course in courses.items() if len(course.get("section_m", ()))}
    if not shown:
        return
    stamps = np.concatenate([course["section_time_s"] for course in shown.values()])
    first_s, last_s = float(stamps.min()), float(stamps.max())
    figure, axes = plt.subplots(
        len(shown), 1, figsize=(10, 1.7 * len(shown) + 0.8), sharex=True, layout="constrained", squeeze=False
    )
    for (name, course), each in zip(shown.items(), axes[:, 0], strict=True):
        points, time_s = course["section_m"], course["section_time_s"]
        chosen = np.random.default_rng(0).permutation(len(points))[:20_000]
        middle = np.median(points[:, :2], axis=0)
        off = np.where(np.abs(middle) > SLICE_M, middle, 0.0)
        along, out = (points[chosen, :2] - off).T
        dots = each.scatter(along, out, c=time_s[chosen], s=0.4, cmap="viridis", vmin=first_s, vmax=last_s)
        each.set(ylabel=f"{name}\n[m]", xlim=(-SLICE_M[0], SLICE_M[0]), ylim=(-0.75, 0.75))
        if off.any():
            each.text(
                0.01, 0.05, f"moved: {-off[0]:+.1f} m along, {-off[1]:+.1f} m out", transform=each.transAxes, fontsize=8
            )
        each.grid(alpha=0.3)
    axes[0, 0].set_title(f"{title}: a facade from above, points of a slice of 0.3 m, the street side up")
    axes[-1, 0].set_xlabel("along the facade [m]")
    figure.colorbar(dots, ax=axes[:, 0], label="time [s]", aspect=40)
    _finish(figure, path)
