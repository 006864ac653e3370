"""What is known of a block before anything is matched: images, cameras, times, poses and where it lies."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import CaptureError, CoverageError, UsageError
from groundproc.cloud import reader
from groundproc.geodesy import utm_epsg
from groundproc.imagery import assembly, flown, located
from groundproc.imagery.assembly import Known
from groundproc.imagery.exifrig import rig_of
from groundproc.imagery.exposures import of_flight
from groundproc.imagery.imports import load_rig
from groundproc.imagery.lasting import Lasting
from groundproc.imagery.logged import trajectory_of
from groundproc.imagery.measurements import rows_of
from groundproc.imagery.photos import Picture, files_of, look
from groundproc.imagery.poses import NO_TIME, ImagePoses, read_poses
from groundproc.imagery.rig import Rig
from groundproc.imagery.site import Site, cartesian, georeferenced, in_frame
from groundproc.imagery.tables import Control, Marks, read_control, read_marks
from groundproc.imagery.times import Timed, by_camera, times_of
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Progress = Callable[[str, int], None]

MOUNTING_SIGMA: Final = {"boresight_deg": 2.0, "lever_arm_m": 0.03, "timeshift_s": 0.2}
"""What a mounting is taken to be known to where the rig states nothing: a bracket, a tape measure, a camera set by hand."""


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
    positions, geoid : Path; float or str; optional
        Better positions for the trajectory of the log, and how their heights become the log's.
    hybrid : str
        What is handed back to the smoother: "gained" or "true" (`hybrid`).
    every_s : float
        At most one pose in so many seconds; 0 for every image.
    noted : tuple of Path
        Logs of the flight that a trajectory is of: exposures that its autopilot noted there.
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
    positions: Path | None = None
    geoid: float | str | None = None
    hybrid: str = "gained"
    every_s: float = 0.0
    noted: tuple[Path, ...] = ()


@dataclass(slots=True)
class Session:
    """What is known as the work goes on.

    Attributes
    ----------
    names : list of str
        Images.
    pictures : list of Picture
        Of each; none where only tables are given.
    camera : ndarray of int64, shape (i,)
    time_ns : ndarray of int64, shape (i,)
        Stamps, before the rig's shift.
    rig : Rig
    marks : list of Marks
    control : Control, optional
    start : ImagePoses, optional
    trajectory : Trajectory, optional
    late_sigma_s : float
        By how much its attitudes may be later than its places.
    own_cloud : bool
        The cloud lies in the folder of the trajectory, which it was made with.
    site : Site
    whole : bool
        Stamps are the images' own, and cut off to whole seconds.
    timed : Timed, optional
        By which events times were found.
    lasting : Lasting
        How the trajectory's errors hang together.
    warnings : list of str
    left_out : dict
        Images that are not in the block, and why.
    """

    names: list[str]
    pictures: list[Picture]
    camera: Ints
    time_ns: Ints
    rig: Rig
    marks: list[Marks] = field(default_factory=list)
    control: Control | None = None
    start: ImagePoses | None = None
    trajectory: Trajectory | None = None
    late_sigma_s: float = 0.0
    own_cloud: bool = False
    site: Site = field(default_factory=lambda: cartesian(np.zeros((1, 3))))
    whole: bool = False
    timed: Timed | None = None
    lasting: Lasting = field(default_factory=Lasting)
    warnings: list[str] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)

    def keep(self, kept: npt.NDArray[np.bool_], why: str) -> None:
        """Leave images out, and say why."""
        if kept.all():
            return
        self.left_out |= {name: why for name, keep in zip(self.names, kept, strict=True) if not keep}
        self.names = [name for name, keep in zip(self.names, kept, strict=True) if keep]
        if self.pictures:
            self.pictures = [one for one, keep in zip(self.pictures, kept, strict=True) if keep]
        self.camera, self.time_ns = self.camera[kept], self.time_ns[kept]
        if not self.names:
            name, reason = next(iter(self.left_out.items()))
            raise CoverageError(f"none of the images is of use; {name}: {reason}")


def begin(task: Task, progress: Progress) -> Session:
    """Read all that is given.

    Raises
    ------
    SwathError
        Something cannot be read.
    """
    tables = [path for path in (task.image_points, task.marks) if path is not None]
    marks = [read_marks(path) for path in tables]
    control = None if task.control is None else read_control(task.control)
    start = None if task.start is None else read_poses(task.start)
    pictures: list[Picture] = []
    left_out: dict[str, str] = {}
    for found in look(files_of(task.images)) if task.images else ():
        if isinstance(found, Picture):
            pictures.append(found)
        else:
            left_out[found[0]] = found[1]
        progress("looked at", 1)
    if task.images and not pictures:
        name, reason = next(iter(left_out.items()))
        raise CoverageError(f"none of the images is of use; {name}: {reason}")
    session = _with_cameras(task, pictures, marks, start)
    session.left_out = left_out | session.left_out
    session.marks, session.control, session.start = marks, control, start
    _timed(session, task, progress)
    session.site = _site(session, task)
    return session


def _with_cameras(task: Task, pictures: list[Picture], marks: list[Marks], start: ImagePoses | None) -> Session:
    """Images and the camera of each."""
    if pictures:
        names = [one.name for one in pictures]
    else:
        listed = marks[0].image if marks else ()
        names = list(dict.fromkeys([*(start.images if start is not None else ()), *listed]))
    stamps = np.array([one.exif_ns for one in pictures] or [NO_TIME] * len(names), np.int64)
    if task.rig is None:
        if not pictures:
            raise UsageError("--rig is missing: image points alone do not say what camera took them")
        rig, numbers, notes = rig_of(pictures)
        return Session(names, pictures, np.array(numbers, np.int64), stamps, rig, warnings=notes)
    rig = load_rig(task.rig)
    sizes: list[tuple[int, int] | None] = [(one.width_px, one.height_px) for one in pictures]
    sizes = sizes or [None] * len(names)
    found = [rig.camera_of(name, size) for name, size in zip(names, sizes, strict=True)]
    camera = np.array([-1 if number is None else number for number in found], np.int64)
    session = Session(names, pictures, camera, stamps, rig)
    own = {name for one in rig.cameras for name in one.images}
    taking = next(
        (t for n, z in zip(names, sizes, strict=True) if n not in own and len(t := rig.taking(n, z)) > 1), None
    )
    if taking is not None:
        alike = ", ".join(rig.cameras[number].name for number in taking)
        session.warnings.append(
            f"{task.rig}: {alike} could each have taken the images, which count as those of the first; state image_prefix of each"
        )
    session.keep(camera >= 0, "no camera of the rig has an image_prefix that fits")
    if pictures:
        _check_sizes(session)
    return session


def _check_sizes(session: Session) -> None:
    """Leave out pictures of another size than their camera has."""
    for number, one in enumerate(session.rig.cameras):
        own = np.flatnonzero(session.camera == number)
        wrong = [
            n for n in own.tolist()
            if (session.pictures[n].width_px, session.pictures[n].height_px) != (one.camera.width_px, one.camera.height_px)
        ]  # fmt: skip
        if wrong:
            kept = np.ones(len(session.names), np.bool_)
            kept[wrong] = False
            size = f"{session.pictures[wrong[0]].width_px} x {session.pictures[wrong[0]].height_px}"
            expected = f"{one.camera.width_px} x {one.camera.height_px} of {one.name}"
            session.keep(kept, f"is {size} px, expected the {expected}")


def _timed(session: Session, task: Task, progress: Progress) -> None:
    """Times of images, and the trajectory that they lie on."""
    if session.start is not None and not session.pictures:
        rows = rows_of(session.start.images, session.names)
        at = np.array([rows.get(name, -1) for name in session.names])
        session.time_ns = np.where(at >= 0, session.start.utc_ns[at], NO_TIME)
    timed = _noted_times(session, task)
    if timed is not None:
        _take(session, timed)
    if task.log is not None:
        session.trajectory = trajectory_of(task.log, task.positions, task.geoid, progress)
        session.late_sigma_s = flown.LATE_SIGMA_S
    elif task.trajectory is not None:
        session.trajectory, session.late_sigma_s = flown.load_trajectory(task.trajectory)
        folder = task.trajectory if task.trajectory.is_dir() else task.trajectory.parent
        session.own_cloud = task.cloud is not None and task.cloud.absolute().parent == folder.absolute()
    if session.trajectory is None:
        return
    if timed is None:
        offset_ns = flown.whole_offset_ns(session.trajectory, session.time_ns)
        if offset_ns:
            hours = -offset_ns / 3.6e12
            session.warnings.append(f"the cameras' clocks show local time, {hours:+g} h from UTC: taken off")
            session.time_ns = np.where(session.time_ns == NO_TIME, NO_TIME, session.time_ns + offset_ns)
    # events that lie on whole seconds were triggered there; a picture's own clock cuts off what is below
    session.whole = timed is None and flown.whole_seconds(session.time_ns)
    if session.whole:
        session.warnings.append(
            "the times of the images are whole seconds: their places along the flight count for half a second's way; give --times, or a "
            "log that notes exposures, to know better"
        )
    session.keep(session.time_ns != NO_TIME, "has no time (EXIF, --times), and so no place on the trajectory")
    session.rig = with_sigmas(session.rig)


def _noted_times(session: Session, task: Task) -> Timed | None:
    """Times of `--times`, else what the log of the flight noted of exposures; None: the images' own clocks."""
    if task.times is not None:
        return times_of(task.times, session.names, session.time_ns, session.camera)
    logs = task.noted if task.log is None else (task.log,)
    if not session.pictures:
        return None
    noted = of_flight(logs)
    if noted is None:
        return None
    try:
        return by_camera(noted, session.time_ns, session.camera, ", ".join(log.name for log in logs))
    except CaptureError as error:
        session.warnings.append(f"{error}; the images' own clocks are used")
        return None


def _take(session: Session, timed: Timed) -> None:
    """Times found, and what is to be said of them."""
    session.time_ns = timed.utc_ns
    session.timed = timed
    if "intervals" in timed.note:
        session.warnings.append(timed.note)
    if timed.own.any():
        named = [name for name, own in zip(session.names, timed.own.tolist(), strict=True) if own]
        session.warnings.append(f"images without an event, placed by their own clock: {names_listed(named)}")


def with_sigmas(rig: Rig) -> Rig:
    """The rig with prior sigmas of mounting and clock where it states none."""
    return Rig(tuple(replace(one, sigma=MOUNTING_SIGMA | dict(one.sigma)) for one in rig.cameras))


def _site(session: Session, task: Task) -> Site:
    """Where the block lies: in the trajectory's frame, about its control or first poses, or where EXIF puts it."""
    epsg = task.crs or _cloud_crs(task.cloud)
    if session.trajectory is not None:
        frame = session.trajectory.frame
        return in_frame(frame, epsg or utm_epsg(frame.latitude_deg, frame.longitude_deg))
    places = [given.place_m for given in (session.control, session.start) if given is not None]
    if task.image_points is None:
        found = located.site_of(session.pictures, epsg)
        if found is not None:
            return found
    if not places:
        return cartesian(np.zeros((1, 3)))
    return cartesian(np.concatenate(places)) if epsg is None else georeferenced(epsg, np.concatenate(places))


def _cloud_crs(cloud: Path | None) -> str | None:
    """The EPSG code that a cloud states for its plan."""
    if cloud is None:
        return None
    horizontal = reader.look(cloud).horizontal
    code = None if horizontal is None else horizontal.to_epsg()
    return None if code is None else str(code)


def known_of(session: Session) -> Known:
    """Poses before the adjustment."""
    if session.trajectory is not None:
        known, covered = flown.stations_of(
            session.trajectory, session.rig, session.camera, session.time_ns, session.whole
        )
        if not covered.all():
            session.keep(covered, "was taken outside of the trajectory")
            known, _ = flown.stations_of(
                session.trajectory, session.rig, session.camera, session.time_ns, session.whole
            )
        return known
    if (
        session.pictures
        and any(one.fix is not None for one in session.pictures)
        and session.site.projection is not None
    ):
        known = located.known_of(session.pictures, session.rig, session.camera, session.site)
        return known if session.start is None else replace(_started(session), priors=known.priors)
    return assembly.unknown_poses(len(session.names), session.camera) if session.start is None else _started(session)


def _started(session: Session) -> Known:
    """Poses that are given to begin with."""
    start = session.start
    assert start is not None
    rows = rows_of(start.images, session.names)
    posed = np.array([name in rows for name in session.names])
    at = np.array([rows.get(name, 0) for name in session.names])
    place = session.site.local(start.place_m[at])
    mat: Array = session.site.mat_local_grid(place) @ start.mat_grid_camera()[at]
    return assembly.from_camera_poses(session.rig, session.camera, posed, place, mat)


def names_listed(names: Sequence[str], most: int = 5) -> str:
    """Some names, and how many there are beside them."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
