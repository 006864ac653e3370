"""What came of an adjustment: adjustment.json, trajectory.csv, and pictures."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog import __version__, config, frames
from flightlog.clock import utc_text
from groundproc.files import written_aside
from groundproc.strips.adjust import Adjusted, Sigmas
from groundproc.strips.cutting import BIN_NS, Strips, headings_differ
from groundproc.strips.differences import Differences
from groundproc.strips.route import as_trajectory
from groundproc.strips.site import Site
from groundproc.trajectory.table import write_trajectory

Array = npt.NDArray[np.float64]

JSON: Final = "adjustment.json"
FILES: Final = ("trajectory.csv", "differences.png", "corrections.png", JSON)
"""All that is written beside the clouds."""
_SHOWN: Final = 20_000
_DOT: Final = 3


class Moved:
    """By how much points were moved, summed over chunks."""

    def __init__(self) -> None:
        self.count, self.squares, self.largest = 0, np.zeros(3), 0.0

    def add(self, move_m: Array) -> None:
        """Take moves, shape (n, 3)."""
        if len(move_m):
            self.count += len(move_m)
            self.squares += np.square(move_m).sum(axis=0)
            self.largest = max(self.largest, float(np.sqrt(np.square(move_m).sum(axis=1).max())))

    def summary(self) -> dict[str, Any]:
        """RMS along map axes, and the largest [m]."""
        rms = np.sqrt(self.squares / max(self.count, 1))
        return {"rms_m": [round(float(v), 5) for v in rms], "largest_m": round(self.largest, 5)}


@dataclass(slots=True)
class Facts:
    """All that the report is made of."""

    site: Site
    strips: Strips
    voxel_m: float
    sigmas: Sigmas
    share: float
    adjusted: Adjusted
    before: Differences
    after: Differences
    moved: Moved
    note: str
    control: Path | None


def finished(folder: Path) -> dict[str, Any]:
    """What was written."""
    return dict(json.loads((folder / JSON).read_text(encoding="utf-8")))


def write(folder: Path, facts: Facts) -> None:
    """Write everything but the clouds."""
    sigma = facts.adjusted.sigma()
    tree = _tree(facts, sigma)
    poses = facts.site.route.poses
    value = _at(facts, sigma, poses.time_ns)
    lever = np.array(facts.site.options.lever_arm_m)
    correction = facts.adjusted.correction
    position, quat = correction.poses(poses.time_ns, poses.position_m, poses.quat_local_ins_wxyz, lever)
    write_trajectory(
        folder / "trajectory.csv",
        as_trajectory(facts.site.route, position, quat, value[:, 3:], _about_body(value[:, :3], quat)),
    )
    _draw_differences(folder / "differences.png", facts)
    _draw_corrections(folder / "corrections.png", facts, sigma)
    with written_aside(folder / JSON) as aside:
        aside.write_text(json.dumps(tree, indent=2) + "\n", encoding="utf-8")


def _at(facts: Facts, sigma: Array, time_ns: npt.NDArray[np.int64]) -> Array:
    """Sigmas at times, shape (n, 6), of those at the knots; those of the given trajectory where nothing was adjusted."""
    poses = facts.site.route.poses
    if facts.adjusted.linear is None:
        return np.concatenate([poses.sigma_attitude_rad, poses.sigma_position_m], axis=1)
    correction = facts.adjusted.correction
    knots = np.arange(len(sigma)) * correction.knots_s
    since = (time_ns - correction.start_ns) * 1e-9
    return np.stack([np.interp(since, knots, sigma[:, k]) for k in range(6)], axis=1)


def _about_body(sigma_rad: Array, quat: Array) -> Array:
    """Sigmas of roll, pitch, heading of those about map axes, shape (n, 3), taken as independent."""
    heading, _, _ = frames.attitude_of(frames.mat_from_quat(quat))
    sine, cosine = np.sin(heading), np.cos(heading)
    roll = np.hypot(sine * sigma_rad[:, 0], cosine * sigma_rad[:, 1])
    pitch = np.hypot(cosine * sigma_rad[:, 0], sine * sigma_rad[:, 1])
    return np.stack([roll, pitch, sigma_rad[:, 2]], axis=1)


def _tree(facts: Facts, sigma: Array) -> dict[str, Any]:
    site, strips, adjusted = facts.site, facts.strips, facts.adjusted
    correction = adjusted.correction
    knots = correction.at(
        correction.start_ns + np.rint(np.arange(correction.intervals + 1) * correction.knots_s * 1e9).astype(np.int64)
    )
    seen = _seen(facts, len(knots))
    return {
        "software": {"swath": __version__},
        "note": facts.note,
        "adjusted": adjusted.linear is not None,
        "inputs": [{"file": cloud.path.name, "points": cloud.points} for cloud in site.clouds],
        "trajectory": {"source": site.route.source, "poses": len(site.route.poses), "attitude": site.route.has_attitude},
        "config": config.to_mapping(site.options),
        "control": None if facts.control is None else facts.control.name,
        "points": {
            "read": sum(cloud.points for cloud in site.clouds), "outside_trajectory": site.outside, "no_surface": site.no_surface,
            "moved": facts.moved.summary(),
        },
        "strips": {
            "count": len(strips), "cut_by": strips.by, "headings_differ_deg": round(np.rad2deg(headings_differ(site.route, strips)), 1),
            "list": [
                {
                    "start": utc_text(int(strips.start_ns + first * BIN_NS)),
                    "seconds": round(float((last - first + 1) * BIN_NS * 1e-9), 1),
                }
                for first, last in zip(strips.first_bin.tolist(), strips.last_bin.tolist(), strict=True)
            ],
        },
        "knots_s": round(correction.knots_s, 3),
        "voxel_m": round(facts.voxel_m, 3),
        "voxels_kept": facts.share,
        "prior": {"position_sigma_m": facts.sigmas.position_m, "attitude_sigma_deg": float(np.rad2deg(facts.sigmas.attitude_rad))},
        "differences": {"before": facts.before.summary(), "after": facts.after.summary()},
        "pairs": {"before": facts.before.by_pair(), "after": facts.after.by_pair()},
        "corrections": {
            "shift_m": _list(correction.shift_m),
            "position_rms_m": _list(_rms(knots[seen, 3:])), "position_sigma_m": _list(_rms(sigma[seen, 3:])),
            "rotation_rms_deg": _list(np.rad2deg(_rms(knots[seen, :3]))), "rotation_sigma_deg": _list(np.rad2deg(_rms(sigma[seen, :3]))),
        },
        "mount": _mount(adjusted),
        "steps": adjusted.log,
    }  # fmt: skip


def _seen(facts: Facts, knots: int) -> npt.NDArray[np.bool_]:
    """Knots at which there are points, shape (knots,)."""
    used = np.flatnonzero(facts.strips.of_bin >= 0) * (BIN_NS * 1e-9)
    at = np.clip(np.rint(used / facts.adjusted.correction.knots_s).astype(int), 0, knots - 1)
    out = np.zeros(knots, np.bool_)
    out[at] = True
    return out


def _mount(adjusted: Adjusted) -> dict[str, Any]:
    told: dict[str, Any] = {}
    for name, (key, unit) in _MOUNT.items():
        found = adjusted.constants.get(name)
        if found is None:
            continue
        told[key] = {
            "state": ["estimated" if known else "held" for known in found["estimated"]],
            "right_forward_up": _list(unit * found["value"]),
            "sigma": _list(unit * found["sigma"]),
            "prior_sigma": round(float(unit * found["prior_sigma"][0]), 6),
        }
    return told


_MOUNT: Final = {"boresight_rad": ("boresight_deg", 180.0 / np.pi), "lever_m": ("lever_m", 1.0)}


def _rms(value: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(np.square(value), axis=0))) if len(value) else np.full(value.shape[1], np.nan)


def _list(value: Sequence[float] | Array) -> list[float | None]:
    return [round(float(v), 6) if np.isfinite(v) else None for v in value]


def _pyplot() -> Any:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    return plt


def _draw_differences(path: Path, facts: Facts) -> None:
    """Maps of the differences before and after, and how they are spread."""
    plt = _pyplot()
    figure, axes = plt.subplots(1, 3, figsize=(15, 5), dpi=100)
    before, after = facts.before, facts.after
    limit = float(np.percentile(np.abs(before.along_m), 90)) if len(before) else 0.1
    limit = max(limit, 1e-3)
    for shown, which, name in ((axes[0], before, "before"), (axes[1], after, "after")):
        some = slice(None, None, max(len(which) // _SHOWN, 1))
        dots = shown.scatter(
            which.place_m[some, 0], which.place_m[some, 1], c=which.along_m[some] * 100, s=_DOT, cmap="RdBu", vmin=-limit * 100,
            vmax=limit * 100, rasterized=True,
        )  # fmt: skip
        shown.set(title=f"strip differences {name} [cm]", xlabel="easting [m]", ylabel="northing [m]", aspect="equal")
        figure.colorbar(dots, ax=shown, shrink=0.8)
    edges = np.linspace(-2 * limit, 2 * limit, 101) * 100
    for which, name, colour in ((before, "before", "tab:red"), (after, "after", "tab:blue")):
        if len(which):
            value = np.clip(which.along_m * 100, edges[0], edges[-1])
            axes[2].hist(value, edges, color=colour, alpha=0.6, label=f"{name}: {len(which)} patches", density=True)
            axes[2].legend()
    axes[2].set(title="along the normal", xlabel="difference [cm]", ylabel="share of the patches for each cm")
    figure.tight_layout()
    with written_aside(path) as aside:
        figure.savefig(aside, format="png")
    plt.close(figure)


def _draw_corrections(path: Path, facts: Facts, sigma: Array) -> None:
    """The splines over time with twice their sigma."""
    plt = _pyplot()
    correction = facts.adjusted.correction
    since = np.arange(correction.intervals + 1) * correction.knots_s
    value = correction.at(correction.start_ns + np.rint(since * 1e9).astype(np.int64))
    value[:, 3:] += correction.shift_m
    figure, axes = plt.subplots(2, 1, figsize=(12, 7), dpi=100, sharex=True)
    for shown, part, names, unit, label in (
        (axes[0], slice(3, 6), ("east", "north", "up"), 100.0, "position [cm]"),
        (axes[1], slice(0, 3), ("about east", "about north", "about up"), float(np.rad2deg(1.0)), "rotation [deg]"),
    ):
        for k, name in enumerate(names):
            line, band = unit * value[:, part][:, k], 2.0 * unit * sigma[:, part][:, k]
            shown.plot(since, line, label=name, lw=1.2)
            if np.isfinite(band).all():
                shown.fill_between(since, line - band, line + band, alpha=0.2)
        shown.set(ylabel=label)
        shown.legend(loc="upper right")
        shown.grid(alpha=0.3)
    for first, last in zip(facts.strips.first_bin.tolist(), facts.strips.last_bin.tolist(), strict=True):
        for shown in axes:
            shown.axvspan(first * BIN_NS * 1e-9, last * BIN_NS * 1e-9, color="k", alpha=0.04)
    axes[0].set(title="corrections, with two sigmas; strips are shaded")
    axes[1].set(xlabel="time [s]")
    figure.tight_layout()
    with written_aside(path) as aside:
        figure.savefig(aside, format="png")
    plt.close(figure)
