"""`swath images` as a whole: what is given is read, put together, adjusted and written."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from flightlog.errors import CoverageError, UsageError
from groundproc.imagery import assembly, results
from groundproc.imagery.bundle.screen import Adjusted, adjust
from groundproc.imagery.imports import load_rig
from groundproc.imagery.measurements import Measurements, gather, rows_of
from groundproc.imagery.poses import NO_TIME, ImagePoses, read_poses
from groundproc.imagery.rig import Rig
from groundproc.imagery.site import Site, cartesian, georeferenced
from groundproc.imagery.tables import Control, read_control, read_marks

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Progress = Callable[[str, float], None]


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for.

    Attributes
    ----------
    output : Path
    images : tuple of Path
        Pictures and folders of them.
    log, trajectory, rig, cloud, control, image_points, marks, start, times : Path, optional
    crs : str, optional
    """

    output: Path
    images: tuple[Path, ...] = ()
    log: Path | None = None
    trajectory: Path | None = None
    rig: Path | None = None
    cloud: Path | None = None
    control: Path | None = None
    image_points: Path | None = None
    marks: Path | None = None
    start: Path | None = None
    times: Path | None = None
    crs: str | None = None


@dataclass(slots=True)
class Session:
    """What is known as the work goes on.

    Attributes
    ----------
    names : list of str
        Images.
    camera : ndarray of int64
    utc_ns : ndarray of int64
    rig : Rig
    warnings : list of str
    left_out : dict
        Images that are not in the block, and why.
    """

    names: list[str]
    camera: Ints
    utc_ns: Ints
    rig: Rig
    warnings: list[str] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)


def run(task: Task, progress: Progress) -> dict[str, Any]:
    """Do it; what bundle.json holds.

    Raises
    ------
    SwathError
        What is given cannot be read, or does not make a block.
    """
    if task.image_points is None:
        raise UsageError("image points: expected --image-points")
    marks = [read_marks(path) for path in (task.image_points, task.marks) if path is not None]
    control = None if task.control is None else read_control(task.control)
    start = None if task.start is None else read_poses(task.start)
    if task.rig is None:
        raise UsageError("--rig is missing: image points alone do not say what camera took them")
    rig = load_rig(task.rig)
    names = list(dict.fromkeys([*(start.images if start is not None else ()), *marks[0].image]))
    session = _cameras(rig, names)
    site = _site(task, start, control)
    measured = gather(session.names, marks, None)
    known = _known(session, start, site)
    made = assembly.assemble(session.rig, session.names, session.camera, known, measured, site, control, ())
    progress("adjusted", 0.0)
    adjusted = adjust(
        made.block, made.block.rig.cameras, measured.matched[made.measured], lambda n, cost: progress("adjusted", n)
    )
    session.warnings += made.notes
    for name in made.unplaced:
        session.left_out[name] = "too few points in common with others"
    return _finish(task, session, site, adjusted, measured, control)


def _cameras(rig: Rig, names: list[str]) -> Session:
    """Which camera took which image; images that none took are left out."""
    numbers = [rig.camera_of(name) for name in names]
    session = Session(
        [name for name, number in zip(names, numbers, strict=True) if number is not None],
        np.array([number for number in numbers if number is not None], np.int64), np.empty(0, np.int64), rig,
    )  # fmt: skip
    session.utc_ns = np.full(len(session.names), NO_TIME)
    for name, number in zip(names, numbers, strict=True):
        if number is None:
            session.left_out[name] = "no camera of the rig has a prefix that fits"
    if not session.names:
        raise CoverageError(f"none of {len(names)} images fits an image_prefix of the rig, such as {names[0]}")
    return session


def _site(task: Task, start: ImagePoses | None, control: Control | None) -> Site:
    """Where the block lies."""
    places = [given.place_m for given in (control, start) if given is not None]
    if not places:
        return cartesian(np.zeros((1, 3)))
    every = np.concatenate(places)
    return cartesian(every) if task.crs is None else georeferenced(task.crs, every)


def _known(session: Session, start: ImagePoses | None, site: Site) -> assembly.Known:
    """Poses that are given to begin with."""
    if start is None:
        return assembly.unknown_poses(len(session.names), session.camera)
    rows = rows_of(start.images, session.names)
    posed = np.array([name in rows for name in session.names])
    at = np.array([rows.get(name, 0) for name in session.names])
    place = site.local(start.place_m[at])
    mat = site.mat_local_grid(place) @ start.mat_grid_camera()[at]
    session.utc_ns = np.where(posed, start.utc_ns[at], session.utc_ns)
    return assembly.from_camera_poses(session.rig, session.camera, posed, place, mat)


def _finish(
    task: Task, session: Session, site: Site, adjusted: Adjusted, measured: Measurements, control: Control | None
) -> dict[str, Any]:
    """Write the folder; what bundle.json holds."""
    block = adjusted.solved.block
    rows = rows_of(session.names, block.images)
    utc_ns = session.utc_ns[[rows[name] for name in block.images]]
    told = results.figures(adjusted, site, measured.names, control)
    session.warnings += _doubts(told, measured, control)
    told["left_out"] = session.left_out
    told["warnings"] = session.warnings
    poses = results.map_poses(adjusted, site, utc_ns)
    results.write_all(task.output, adjusted, site, poses, measured.names, told)
    return told


def _doubts(told: dict[str, Any], measured: Measurements, control: Control | None) -> list[str]:
    """Sentences for who must know."""
    doubts = []
    if measured.strangers:
        named = ", ".join(measured.strangers[:5])
        doubts.append(f"{len(measured.strangers)} images of the table of image points are not in the block: {named}")
    if control is not None:
        seen = {one["name"] for one in (*told["control"], *told["check"])}
        lost = [name for name in control.name if name not in seen]
        if lost:
            doubts.append(f"{len(lost)} surveyed points are not determined by images: {', '.join(lost[:5])}")
        if told["control"] and told["datum"] != "observed":
            doubts.append(
                "fewer than three control points: the block is a free network, and they were not enough to lay it"
            )
    gross = told["counts"]["left_out"]["gross"]
    if gross:
        doubts.append(f"{gross} image points are gross errors and were left out")
    if not told["settled"]:
        doubts.append(f"the adjustment had not settled after {told['steps']} steps")
    return doubts


__all__ = ["Session", "Task", "replace", "run"]
