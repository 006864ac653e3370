"""adjustment.png: what the adjustment left over, over time, and how well it knows what it estimated."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter
from matplotlib.transforms import Bbox

from flightlog import frames
from groundproc.estimation.adjustment.adjusted import CausalRun, Run
from groundproc.estimation.method import Given
from groundproc.estimation.observations.attitudes import attitude_track
from groundproc.estimation.observations.fixes import position_track
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.spline import Path as SensorPath
from groundproc.estimation.odometry.stated import Attitudes, Positions
from groundproc.estimation.odometry.track import boundaries_ns
from groundproc.files import written_aside
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]

BLIND_BELOW: Final = 50
"""Matched clusters of a tenth of a second below which the lidar has next to no planes."""
AXES_OF: Final = {
    "bias": "x y z", "scale": "x y z", "shear": "yz zx xy", "turn": "x y z", "accel_bias": "x y z", "accel_turn": "x y z",
    "lever": "x y z", "delay": "", "drift": "", "compass": "const sin cos sin2 cos2",
}  # fmt: skip
"""What the numbers of an estimated parameter are of."""
UNITS_OF: Final = {
    "bias": "deg/s", "scale": "%", "shear": "%", "turn": "deg", "accel_bias": "m/s^2", "accel_turn": "deg",
    "lever": "cm", "delay": "ms", "drift": "ppm", "compass": "deg",
}  # fmt: skip
FACTORS: Final = {"scale": 100.0, "shear": 100.0, "lever": 100.0, "delay": 1000.0, "drift": 1e6}
"""From the unit of quality.json to that of the table, where they differ."""
DOT: Final[dict[str, Any]] = {"marker": ".", "linestyle": "", "markersize": 3}


@dataclass(frozen=True, slots=True)
class Sheet:
    """What the picture shows of one run.

    Attributes
    ----------
    title : str
    slice_s : ndarray, shape (n,)
        End of each slice of a tenth of a second, from the run's first.
    matched, seen : ndarray, shape (n,)
        Clusters that found a plane in the odometry, and all.
    residual_m : ndarray, shape (n,)
        RMS of their distances; not-a-number where nothing was seen.
    sigma_s : ndarray, shape (m,)
    sigma_position_m, sigma_attitude_rad : ndarray, shape (m, 3)
        Of the trajectory: east, north, up; roll, pitch, heading.
    moved_m, turned_rad : ndarray, shape (n + 1, 3)
        Final path less the odometry, laid on it as a whole: local frame; about the sensor's axes. Empty without a batch.
    position_s, position_off_m, position_sigma_m : ndarray, shape (k,), (k, 3), (k, 3)
        Stated positions less the path.
    heading_rad, heading_off_rad : ndarray, shape (j,)
        Stated headings less those of the path.
    curve_rad : ndarray, shape (5,) or None
        The compass curve as estimated.
    estimated : dict
        As in quality.json.
    """

    title: str
    slice_s: Array
    matched: Array
    seen: Array
    residual_m: Array
    sigma_s: Array
    sigma_position_m: Array
    sigma_attitude_rad: Array
    moved_m: Array
    turned_rad: Array
    position_s: Array
    position_off_m: Array
    position_sigma_m: Array
    heading_rad: Array
    heading_off_rad: Array
    curve_rad: Array | None
    estimated: dict[str, Any]


def sheet_of(run: Run | CausalRun, given: Given, trajectory: Trajectory) -> Sheet:
    """Gather the picture's numbers.

    Parameters
    ----------
    run : Run or CausalRun
    given : Given
    trajectory : Trajectory
        Of the ins frame, as it is written.
    """
    track = run.track
    knots_ns = boundaries_ns(track, run.motion)
    begin_ns = int(knots_ns[0])
    place = trajectory.after(begin_ns - 1).before(int(knots_ns[-1]))
    moved, turned = np.zeros((0, 3)), np.zeros((0, 3))
    if isinstance(run, Run):
        quat, position_m = run.path.quat[::STEPS], run.path.position_m[::STEPS]
        moved, turned = _changed(np.array(track.quat), np.array(track.position_m), quat, position_m)
    offs = [_position_off(position_track(given, leg), run.path) for leg in given.placed]
    attitudes = [a for leg in given.placed if (a := attitude_track(leg)) is not None]
    headings = [_heading_off(a, run.path, run.mount(given.mount).mat_ins_lidar()) for a in attitudes]
    report = run.report(given.mount)
    compass = report.get("estimated", {}).get("compass_deg")
    blind = float(np.mean(np.array(track.matched) < BLIND_BELOW))
    log = run.windows[-1].log[-1] if isinstance(run, Run) else {}
    parts = [f"{len(track) * 0.1:.0f} s", "causal" if isinstance(run, CausalRun) else f"{len(run.windows)} window(s)"]
    parts += [f"{100.0 * blind:.0f} % without planes", f"{track.restarts} restarts"]
    if run.is_worse():
        parts[3] += "; the trajectory is what the adjustment began from"
    if log:
        parts.append(f"lidar chi-square {log['chi_square']:.2f}")
        parts += [
            f"{k.removesuffix('_rms')} {v:.2f}" for k, v in log.items() if k.endswith("_rms") and k != "prior_rms"
        ]
    return Sheet(
        ", ".join(parts[:4]) + ("\nresiduals in sigma, last round: " + ", ".join(parts[4:]) if log else ""),
        np.asarray((knots_ns[1:] - begin_ns) * 1e-9),
        np.array(track.matched, np.float64),
        np.array(track.seen, np.float64),
        np.array(track.residual_m, np.float64),
        np.asarray((place.time_ns[::STEPS] - begin_ns) * 1e-9),
        place.sigma_position_m[::STEPS],
        place.sigma_attitude_rad[::STEPS],
        moved,
        turned,
        (np.concatenate([t for t, _, _ in offs]) - begin_ns) * 1e-9,
        np.concatenate([off for _, off, _ in offs]),
        np.concatenate([sigma for _, _, sigma in offs]),
        np.concatenate([h for h, _ in headings]) if headings else np.zeros(0),
        np.concatenate([off for _, off in headings]) if headings else np.zeros(0),
        None if compass is None else np.deg2rad(compass["value"]),
        report.get("estimated", {}),
    )


def _changed(quat: Array, position_m: Array, final_quat: Array, final_position_m: Array) -> tuple[Array, Array]:
    """Final poses less earlier ones that are turned and moved as a whole onto them: positions; rotations in the body."""
    count = min(len(quat), len(final_quat))
    quat, position_m = quat[:count], position_m[:count]
    final_quat, final_position_m = final_quat[:count], final_position_m[:count]
    total = (frames.mat_from_quat(final_quat) @ np.swapaxes(frames.mat_from_quat(quat), 1, 2)).sum(axis=0)
    u, _, vt = np.linalg.svd(total)
    mat = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    laid = position_m @ mat.T
    laid += (final_position_m - laid).mean(axis=0)
    turn = np.repeat(frames.quat_from_mat(mat[None]), count, axis=0)
    return final_position_m - laid, frames.quat_log(
        frames.quat_multiply(frames.quat_inverse(frames.quat_multiply(turn, quat)), final_quat)
    )


def _position_off(given: Positions, path: SensorPath) -> tuple[Array, Array, Array]:
    """Times, stated positions less those of the path, and their sigmas."""
    inside, node = _nodes(given.time_ns, path)
    made = path.position_m[node] + frames.mat_from_quat(path.quat[node]) @ given.lever_m
    return given.time_ns[inside].astype(np.float64), given.position_m[inside] - made, given.sigma_m[inside]


def _heading_off(given: Attitudes, path: SensorPath, mat_ins_lidar: Array) -> tuple[Array, Array]:
    """Headings of the path, and stated ones less them."""
    inside, node = _nodes(given.time_ns, path)
    made = frames.attitude_of(frames.mat_from_quat(path.quat[node]) @ mat_ins_lidar.T)[0]
    stated = frames.attitude_of(frames.mat_from_quat(given.quat[inside]))[0]
    return made % (2.0 * np.pi), (stated - made + np.pi) % (2.0 * np.pi) - np.pi


def _nodes(time_ns: npt.NDArray[np.int64], path: SensorPath) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.int64]]:
    """Which times lie on a path, and the nearest nodes of its grid to these."""
    inside = (time_ns >= path.start_ns) & (time_ns <= path.start_ns + (len(path.quat) - 1) * STEP_NS)
    return inside, np.rint((time_ns[inside] - path.start_ns) / STEP_NS).astype(np.int64)


def draw_adjustment(path: Path, sheet: Sheet) -> None:
    """Draw the sheet."""
    rows = _table(sheet.estimated)
    below = 0.1 + 0.21 * ((len(rows) + 1) // 2 + 1)  # inches of the table
    changed = 2.6 if len(sheet.moved_m) else 0.01
    figure = Figure(figsize=(13, 8.4 + changed + below), layout="constrained")
    grid = figure.add_gridspec(5, 2, height_ratios=[2.6, 2.6, changed, 2.6, below])
    axes = [[figure.add_subplot(grid[row, column]) for column in range(2)] for row in range(4)]
    figure.suptitle(sheet.title, fontsize=10)
    _lines(axes[0][0], sheet.sigma_s, sheet.sigma_position_m, ("east", "north", "up"), "position sigma [m]")
    _lines(
        axes[0][1],
        sheet.sigma_s,
        np.rad2deg(sheet.sigma_attitude_rad),
        ("roll", "pitch", "heading"),
        "attitude sigma [deg]",
    )
    axes[0][1].set_yscale("log")
    for scale in axes[0][1].yaxis.set_major_formatter, axes[0][1].yaxis.set_minor_formatter:
        scale(FormatStrFormatter("%g"))
    axis = axes[1][0]
    axis.plot(sheet.slice_s, sheet.seen, color="0.7", lw=1, label="seen")
    axis.plot(sheet.slice_s, sheet.matched, lw=1, label="on a plane of the map")
    _finish(axis, "clusters of 0.1 s")
    axis = axes[1][1]
    axis.plot(sheet.slice_s, 100.0 * sheet.residual_m, lw=1, label="RMS off the plane, odometry")
    _finish(axis, "distance [cm]")
    knots = np.concatenate([[0.0], sheet.slice_s])[: len(sheet.moved_m)]
    if len(knots):
        _lines(axes[2][0], knots, 100.0 * sheet.moved_m, ("east", "north", "up"), "path - odometry [cm]")
        _lines(axes[2][1], knots, np.rad2deg(sheet.turned_rad), ("x", "y", "z of the sensor"), "path - odometry [deg]")
    else:
        for axis in axes[2]:
            axis.set_visible(False)
    axis = axes[3][0]
    for i, name in enumerate(("east", "north", "up")):
        axis.plot(sheet.position_s, sheet.position_off_m[:, i], **DOT, color=f"C{i}", label=name)
    _finish(axis, "stated position - path [m]")
    for axis in (axes[0][0], axes[0][1], axes[1][0], axes[1][1], axes[2][0], axes[2][1], axes[3][0]):
        for start, end in _stretches(sheet.matched < BLIND_BELOW):
            left = sheet.slice_s[start - 1] if start else 0.0
            axis.axvspan(float(left), float(sheet.slice_s[end - 1]), color="0.85", zorder=0)
        axis.set_xlim(0.0, float(sheet.slice_s[-1]))
    for axis in axes[3][0], axes[2][1], axes[1][1]:
        axis.set_xlabel("time [s]")
    _draw_compass(axes[3][1], sheet)
    _draw_table(figure.add_subplot(grid[4, :]), rows)
    with written_aside(path) as aside:
        figure.savefig(aside, dpi=90, format="png")


def _lines(axis: Axes, seconds: Array, values: Array, names: tuple[str, str, str], label: str) -> None:
    for i, name in enumerate(names):
        axis.plot(seconds, values[:, i], lw=1, label=name)
    _finish(axis, label)


def _finish(axis: Axes, label: str) -> None:
    axis.set_ylabel(label)
    axis.grid(alpha=0.3)
    axis.legend(loc="upper right", fontsize=8)


def _stretches(flags: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Begin and end of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _draw_compass(axis: Axes, sheet: Sheet) -> None:
    axis.plot(
        np.rad2deg(sheet.heading_rad), np.rad2deg(sheet.heading_off_rad), **DOT, color="0.5", label="stated - path"
    )
    if sheet.curve_rad is not None:
        at = np.linspace(0.0, 2.0 * np.pi, 181)
        terms = np.stack([np.ones_like(at), np.sin(at), np.cos(at), np.sin(2 * at), np.cos(2 * at)], axis=1)
        axis.plot(np.rad2deg(at), np.rad2deg(terms @ sheet.curve_rad), lw=1.5, color="C3", label="compass curve")
    axis.set_xlim(0.0, 360.0)
    axis.set_xticks(range(0, 361, 45))
    axis.set_xlabel("heading [deg]")
    _finish(axis, "heading error [deg]")


def _table(estimated: dict[str, Any]) -> list[tuple[list[str], bool]]:
    """Rows of text, one for each number, and whether it is held."""
    rows = []
    for key, entry in estimated.items():
        last = key.rsplit(".", 1)[-1]
        base = next((n for n in sorted(UNITS_OF, key=len, reverse=True) if last == n or last.startswith(n + "_")), last)
        source = "autopilot" if key.startswith("ins.") else ("lidar's IMU" if key.startswith("lidar.") else "")
        name = {
            "turn": "boresight" if key.startswith("ins.") else "misalignment",
            "lever": "place",
            "shear": "cross-axis",
            "accel_turn": "accel misalignment",
        }.get(base, base)
        factor = FACTORS.get(base, 1.0)
        axes = AXES_OF.get(base, "").split() or [""] * len(entry["value"])
        for axis, value, sigma, prior, held in zip(
            axes, entry["value"], entry["sigma"], entry["prior_sigma"], entry["held"], strict=True
        ):
            numbers = [f"{factor * number:.3g}" if number else "0" for number in (value, sigma, prior)]
            label = f"{name.replace('_', ' ')} {axis} [{UNITS_OF.get(base, '')}]"
            rows.append(([source, label, *numbers, "held" if held else ""], bool(held)))
    return rows


def _draw_table(axis: Axes, rows: list[tuple[list[str], bool]]) -> None:
    axis.set_axis_off()
    if not rows:
        return
    # two columns side by side
    half = (len(rows) + 1) // 2
    head = ["unit", "parameter", "value", "sigma", "before +-", ""]
    for column, part in enumerate((rows[:half], rows[half:])):
        if not part:
            continue
        table = axis.table(
            cellText=[text for text, _ in part], colLabels=head, cellLoc="right", edges="horizontal",
            bbox=Bbox.from_bounds(0.51 * column, 1.0 - (len(part) + 1) / (half + 1), 0.49, (len(part) + 1) / (half + 1)),
            colWidths=[0.15, 0.31, 0.16, 0.14, 0.14, 0.1],
        )  # fmt: skip
        table.auto_set_font_size(False)
        table.set_fontsize(8)
        for (row, _), cell in table.get_celld().items():
            cell.set_edgecolor("0.8")
            if row and part[row - 1][1]:
                cell.get_text().set_color("0.6")
