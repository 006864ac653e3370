"""What a method found of a flight, as data; and its folder, from which the same cloud is made again.

trajectory.csv   poses for people and other programs (`table`)
trajectory.npz   the same without rounding, with velocities, rates and the origin of the local frame
covariance.npz   6 x 6 covariance of the poses about every tenth of a second
mount.yaml       mount to place points with
lasers.yaml      corrections of the single lasers
ties.yaml        how the lidar's time becomes UTC
report.json      method, sources, warnings and all that the method says of itself; written last
figures.npz      arrays that pictures are drawn from

docs/estimate.md describes each file.
"""

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog import config
from flightlog.errors import LogError
from flightlog.mount import Mount, load_mount
from groundproc.arrays import read_arrays
from groundproc.files import written_aside
from groundproc.flight.timeline import ClockTie
from groundproc.geodesy import LocalFrame
from groundproc.sensors.lasers import LaserCorrections, read_lasers, write_lasers
from groundproc.trajectory.covariance import SIZE, STATES, correlation_of
from groundproc.trajectory.table import read_trajectory, write_trajectory
from groundproc.trajectory.trajectory import HOLD, SMOOTH, Trajectory

Array = npt.NDArray[np.float64]

TRAJECTORY: Final = "trajectory.csv"
EXACT: Final = "trajectory.npz"
COVARIANCE: Final = "covariance.npz"
MOUNT: Final = "mount.yaml"
LASERS: Final = "lasers.yaml"
TIES: Final = "ties.yaml"
REPORT: Final = "report.json"
FIGURES: Final = "figures.npz"
FILES: Final = (TRAJECTORY, EXACT, COVARIANCE, MOUNT, LASERS, TIES, FIGURES, REPORT)

COVARIANCE_STEP_NS: Final = 100_000_000
"""Spacing of the covariances where a trajectory states no correlations."""
CHANGED: Final = (
    f"{TRAJECTORY} was changed after it was written: its rows are taken, with velocities from their differences"
)


@dataclass(frozen=True, slots=True)
class MountSigma:
    """One sigma of an estimated mount.

    Attributes
    ----------
    turn_rad : tuple of float
        About the sensor's axes: right, forward, up.
    position_m : tuple of float, optional
        Of the lever arm in the ins frame: right, forward, up; None where that is not estimated.
    """

    turn_rad: tuple[float, float, float]
    position_m: tuple[float, float, float] | None = None


@dataclass(frozen=True, slots=True)
class Estimate:
    """A trajectory, and all that was estimated with it.

    Attributes
    ----------
    trajectory : Trajectory
        Of the ins frame, with the covariance of its poses.
    mount : Mount
        The one to place points with: the nominal one where the method estimates none.
    sigma_source : str
        What the trajectory's sigmas are, for the reader of quality.json.
    corrections : LaserCorrections
        Of the single lasers, to be added to the manual's table; all zero where none are estimated.
    ties : tuple of ClockTie
        How the lidar's time becomes UTC, for each run of its clock.
    mount_source : str
        Where the mount comes from: "log", a file, or "estimated by adjusted, begun from log".
    mount_sigma : MountSigma, optional
        Where the method states one.
    report : dict
        What else there is to say; stands in quality.json under the method's name. Plain numbers, texts, lists and dicts.
    warning : str
        One sentence where the self-check found something wrong; empty where all is well.
    figures : dict of str to ndarray
        Arrays that the method's pictures are drawn from.
    method : str
        Name of the method that made it.
    note : str
        Why it is this method and not a better one; empty where it is the one that was asked for.
    """

    trajectory: Trajectory
    mount: Mount
    sigma_source: str
    corrections: LaserCorrections = field(default_factory=LaserCorrections)
    ties: tuple[ClockTie, ...] = ()
    mount_source: str = ""
    mount_sigma: MountSigma | None = None
    report: dict[str, Any] = field(default_factory=dict)
    warning: str = ""
    figures: dict[str, npt.NDArray[Any]] = field(default_factory=dict)
    method: str = ""
    note: str = ""


@dataclass(frozen=True, slots=True)
class _Ties:
    """What ties.yaml holds."""

    ties: tuple[ClockTie, ...]


@dataclass(frozen=True, slots=True)
class _Said:
    """What report.json holds."""

    method: str
    note: str
    warning: str
    sigma_source: str
    mount_source: str
    mount_sigma: MountSigma | None
    report: Any


def write_estimate(folder: Path, estimate: Estimate) -> None:
    """Write the files of an estimate into a folder that is there, each aside and then renamed; report.json is the last.

    Raises
    ------
    SourceError
        A file cannot be written.
    """
    (folder / REPORT).unlink(missing_ok=True)  # a folder without it is not whole
    trajectory = estimate.trajectory
    write_trajectory(folder / TRAJECTORY, trajectory)
    _write_arrays(folder / EXACT, _exact(trajectory, _digest(folder / TRAJECTORY)))
    time_ns = covariance_times(trajectory)
    covariance = trajectory.covariance_at(time_ns)
    arrays = {"time_ns": time_ns, "covariance": covariance, "states": np.array(STATES)}
    _write_arrays(folder / COVARIANCE, arrays if trajectory.datum is None else arrays | {"datum": trajectory.datum})
    _write_text(folder / MOUNT, f"# {estimate.mount_source or 'as given'}\n{estimate.mount.yaml()}")
    write_lasers(folder / LASERS, estimate.corrections, "# in firing order; 0: as the manual has it\n")
    _write_text(folder / TIES, config.dump(_Ties(estimate.ties)))
    _write_arrays(folder / FIGURES, estimate.figures)
    said = _Said(
        estimate.method, estimate.note, estimate.warning, estimate.sigma_source, estimate.mount_source,
        estimate.mount_sigma, estimate.report,
    )  # fmt: skip
    _write_text(folder / REPORT, json.dumps(config.to_mapping(said), indent=2) + "\n")


def read_estimate(folder: Path) -> Estimate:
    """Read what `write_estimate` wrote.

    Where trajectory.csv was changed since, its rows are the trajectory, and the estimate's note says so.

    Raises
    ------
    LogError, ConfigError
        A file is missing or cannot be read as what it should be.
    """
    said = _read_report(folder / REPORT)
    trajectory, changed = read_knots(folder)
    return Estimate(
        trajectory,
        load_mount(folder / MOUNT),
        said.sigma_source,
        read_lasers(folder / LASERS),
        config.load(folder / TIES, _Ties).ties,
        said.mount_source,
        said.mount_sigma,
        said.report,
        said.warning,
        read_arrays(folder / FIGURES),
        method=said.method,
        note="; ".join(filter(None, (said.note, CHANGED if changed else ""))),
    )


def is_estimate(folder: Path) -> bool:
    """Whether a folder holds an estimate, and not only a trajectory.csv from elsewhere."""
    return any((folder / name).is_file() for name in (EXACT, COVARIANCE, TIES))


def covariance_times(trajectory: Trajectory) -> npt.NDArray[np.int64]:
    """Times at which covariances are written: those of the correlations, or knots about a tenth of a second apart."""
    if trajectory.correlation is not None:
        return trajectory.correlation.time_ns
    knots = trajectory.time_ns
    slot = (knots - knots[0]) // COVARIANCE_STEP_NS
    chosen = np.append(True, np.diff(slot) > 0)
    chosen[-1] = True
    return np.asarray(knots[chosen])


_OF_TRAJECTORY: Final = {
    "time_ns": ("i8", 0), "position_m": ("f8", 3), "velocity_m_s": ("f8", 3), "quat_local_ins_wxyz": ("f8", 4),
    "rate_rad_s": ("f8", 3), "sigma_position_m": ("f8", 3), "sigma_attitude_rad": ("f8", 3), "covered": ("?", 0),
}  # fmt: skip
"""Arrays of trajectory.npz that have a row for each knot: type and columns, 0 where a row is one number."""


def _exact(trajectory: Trajectory, digest: str) -> dict[str, npt.NDArray[Any]]:
    """What trajectory.npz holds."""
    frame = trajectory.frame
    return {name: getattr(trajectory, name) for name in _OF_TRAJECTORY} | {
        "frame": np.array([frame.latitude_deg, frame.longitude_deg, frame.height_m]),
        "interpolation": np.array(trajectory.interpolation),
        "csv_sha256": np.array(digest),
    }


def read_knots(folder: Path) -> tuple[Trajectory, bool]:
    """The trajectory, and whether trajectory.csv was changed since it was written."""
    path = folder / EXACT
    held = read_arrays(path)
    needed = (*_OF_TRAJECTORY, "frame", "interpolation", "csv_sha256")
    _check(path, all(name in held for name in needed), f"the arrays {', '.join(needed)}")
    rows = len(np.atleast_1d(held["time_ns"]))
    for name, (kind, columns) in _OF_TRAJECTORY.items():
        wanted = (rows, columns) if columns else (rows,)
        _check(path, held[name].shape == wanted and held[name].dtype == np.dtype(kind), f"{name} of shape {wanted}")
    _check(path, rows >= 2 and bool((np.diff(held["time_ns"]) > 0).all()), "two times or more that increase")
    _check(path, held["frame"].shape == (3,) and held["frame"].dtype == np.float64, "frame of shape (3,)")
    _check(path, str(held["interpolation"]) in (SMOOTH, HOLD), f"interpolation {SMOOTH} or {HOLD}")
    frame = LocalFrame(*(float(value) for value in held["frame"]))
    correlation = correlation_of(*read_covariance(folder / COVARIANCE))
    datum = _read_datum(folder / COVARIANCE)
    changed = _digest(folder / TRAJECTORY) != str(held["csv_sha256"])
    if changed:
        rounded = read_trajectory(folder / TRAJECTORY, frame)
        arrays: dict[str, Any] = {name: getattr(rounded, name) for name in _OF_TRAJECTORY}
        return Trajectory(frame, **arrays, correlation=correlation, datum=datum), True
    arrays = {name: held[name] for name in _OF_TRAJECTORY}
    interpolation = str(held["interpolation"])
    return Trajectory(frame, **arrays, interpolation=interpolation, correlation=correlation, datum=datum), False


def read_covariance(path: Path) -> tuple[npt.NDArray[np.int64], Array]:
    """Times [ns], shape (m,), and covariances, shape (m, 6, 6), of a covariance.npz; their order and units are those of `STATES`.

    Raises
    ------
    LogError
        It cannot be read, or holds something else.
    """
    held = read_arrays(path)
    _check(path, "time_ns" in held and "covariance" in held, "the arrays time_ns and covariance")
    time_ns, covariance = held["time_ns"], held["covariance"]
    _check(path, time_ns.ndim == 1 and time_ns.dtype == np.int64 and len(time_ns) > 0, "times as whole numbers")
    _check(path, bool((np.diff(time_ns) > 0).all()), "times that increase")
    wanted = (len(time_ns), SIZE, SIZE)
    _check(path, covariance.shape == wanted and covariance.dtype.kind == "f", f"covariance of shape {wanted}")
    return time_ns, covariance.astype(np.float64)


TIED: Final = ("step", "own", "shared")
"""Arrays of the covariance.npz beside poses that were adjusted together (`positions.fixes.Tied`)."""


def read_tied(path: Path) -> tuple[Array, Array, Array] | None:
    """Steps, shape (m, 6), and covariances, own and shared, shape (m, 6, 6), of a covariance.npz; None where it has none.

    Raises
    ------
    LogError
        It cannot be read, or holds something else.
    """
    held = read_arrays(path)
    if not any(name in held for name in TIED):
        return None
    rows = len(np.atleast_1d(held["time_ns"]))
    found = []
    for name, shape in zip(TIED, ((rows, SIZE), (rows, SIZE, SIZE), (rows, SIZE, SIZE)), strict=True):
        _check(
            path,
            name in held and held[name].shape == shape and held[name].dtype.kind == "f",
            f"{name} of shape {shape}",
        )
        _check(path, bool(np.isfinite(held[name]).all()), f"{name} of numbers")
        found.append(held[name].astype(np.float64))
    return found[0], found[1], found[2]


def _read_datum(path: Path) -> Array | None:
    """What all poses share, shape (6, 6); None where the file does not say."""
    datum = read_arrays(path).get("datum")
    if datum is None:
        return None
    _check(path, datum.shape == (SIZE, SIZE) and datum.dtype.kind == "f", f"datum of shape {(SIZE, SIZE)}")
    _check(path, bool(np.isfinite(datum).all()), "datum of numbers")
    return np.asarray(0.5 * (datum + datum.T), np.float64)


def _read_report(path: Path) -> _Said:
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror}); is the folder an estimate's, and whole?") from None
    except (UnicodeDecodeError, ValueError):
        raise LogError(f"{path}: is no JSON") from None
    return config.from_mapping(tree, _Said, str(path))


def _check(path: Path, holds: bool, expected: str) -> None:
    if not holds:
        raise LogError(f"{path}: is not as it was written; expected {expected}")


def _digest(path: Path) -> str:
    """SHA-256 of a file."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})") from None


def _write_text(path: Path, text: str) -> None:
    with written_aside(path) as aside:
        aside.write_text(text, encoding="utf-8")


def _write_arrays(path: Path, arrays: dict[str, npt.NDArray[Any]]) -> None:
    with written_aside(path) as aside, aside.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
