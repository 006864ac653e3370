"""`swath images` as a whole: what is given is read, tied together, adjusted and written."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import CaptureError, UsageError
from groundproc.imagery import assembly, clockoffset, flown, gate, hybrid, lasting, located, results
from groundproc.imagery.assembly import Assembled, Known
from groundproc.imagery.bundle.block import Block
from groundproc.imagery.bundle.covariance import LooseError
from groundproc.imagery.bundle.screen import Adjusted, adjust
from groundproc.imagery.lensdoubt import lens_doubts
from groundproc.imagery.measurements import Measurements, Tracks, gather, rows_of
from groundproc.imagery.poses import NO_TIME
from groundproc.imagery.rig import Rig, RigCamera
from groundproc.imagery.session import Progress, Session, Task, begin, known_of, names_listed
from groundproc.imagery.surface import Surface, held_to, read_surface
from groundproc.imagery.thinning import completed, renewed, thinned
from groundproc.imagery.ties import Features, features_of, match_all, pairs_of
from groundproc.imagery.tracks import tracks_of
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

_SETTLED_S: Final = 5e-5
"""Shifts of clocks that change less than this need no new poses of the trajectory."""
_MOST_ROUNDS: Final = 5
_MOST_RMS_PX: Final = 3.0
_FEWEST_IMAGES: Final = 3
"""What is left of a block has to be one."""
_FEW_POINTS: Final = 6
"""An image with fewer is hardly placed by them."""


def run(task: Task, progress: Progress) -> dict[str, Any]:
    """Do it; what bundle.json holds.

    Raises
    ------
    SwathError
        What is given cannot be read, or does not make a block.
    """
    if task.image_points is None and not task.images:
        raise UsageError("IMAGES are missing; expected some, or --image-points")
    session = begin(task, progress)
    known = known_of(session)
    surface = None if task.cloud is None else read_surface(task.cloud, session.site, lambda n: progress("cloud", n))
    seen: dict[str, Features | str] = {}
    known, measured = _measured(task, session, known, surface, seen, progress)
    if _set_clocks(session, measured):
        known, measured = _measured(task, session, known_of(session), surface, seen, progress)
    adjusted, told = _made(session, known, measured, surface, progress)
    return _finish(task, session, adjusted, measured, told)


def _made(
    session: Session, known: Known, measured: Measurements, surface: Surface | None, progress: Progress
) -> tuple[Adjusted, dict[str, Any]]:
    """Assembled and adjusted; images that nothing holds to the others are left out, and the rest goes on."""
    made = assembly.assemble(
        session.rig, session.names, session.camera, known, measured, session.site, session.control, ()
    )
    for name in made.unplaced:
        session.left_out.setdefault(name, "too few points in common with the others")
    try:
        found = _adjusted(session, made, measured, surface, progress)
    except LooseError as error:
        if len(made.block.images) - len(error.images) < _FEWEST_IMAGES:
            raise
        session.left_out |= dict.fromkeys(
            error.images, "nothing holds it to the others: too few points, or all from one place"
        )
        loose = np.isin(session.names, error.images)
        held = ~loose[measured.points.image]
        rest = replace(measured, points=measured.points.masked(held), matched=measured.matched[held])
        return _made(session, replace(known, posed=known.posed & ~loose), rest, surface, progress)
    session.warnings += made.notes
    return found


def _measured(
    task: Task,
    session: Session,
    known: Known,
    surface: Surface | None,
    seen: dict[str, Features | str],
    progress: Progress,
) -> tuple[Known, Measurements]:
    """Image points: those given, or what is matched as well."""
    tracks = None
    if task.image_points is None:
        known, tracks = _tied(session, known, surface, seen, progress)
    return known, gather(session.names, session.marks, tracks)


def _set_clocks(session: Session, measured: Measurements) -> bool:
    """Clocks that are off by seconds are set by the rays of common points, and that is said; whether any was."""
    if session.trajectory is None:
        return False
    cameras = list(session.rig.cameras)
    for number, one in enumerate(cameras):
        off_s = clockoffset.found(session.trajectory, one, session.camera == number, session.time_ns, measured)
        if off_s:
            cameras[number] = replace(one, timeshift_s=one.timeshift_s + off_s)
            session.warnings.append(
                f"{one.name}: its clock is off by {off_s:+.2f} s against the trajectory, as common points show; begun from there"
            )
    changed = cameras != list(session.rig.cameras)
    session.rig = Rig(tuple(cameras))
    return changed


def _tied(
    session: Session, known: Known, surface: Surface | None, seen: dict[str, Features | str], progress: Progress
) -> tuple[Known, Tracks]:
    """Match all images; those that cannot be read are left out."""
    features = _features(session, seen, progress)
    lost = np.array([one is None for one in features])
    if lost.any():
        why = {name: session.left_out[name] for name, gone in zip(session.names, lost, strict=True) if gone}
        session.keep(~lost, "")
        session.left_out |= why
        features = [one for one in features if one is not None]
        known = known_of(session)
    ground = surface.ground_m if surface is not None else np.nan
    if surface is None and session.pictures:
        ground = located.ground_of(session.pictures, known.stations.place_m[known.station])
    views = located.views_of(known, session.rig, session.camera, float(ground))
    cameras = [session.rig.cameras[number].camera for number in session.camera]
    pairs = pairs_of(views, cameras)
    matches = list(match_all(features, views, pairs, lambda n: progress("matched", n)))
    if session.trajectory is None and session.start is None:
        known = located.without_attitudes(known)
    return known, tracks_of(features, matches)


def _features(session: Session, seen: dict[str, Features | str], progress: Progress) -> list[Features | None]:
    """Features of each image, None where one cannot be read; what was seen already is there, and what is new is added."""

    def work(number: int) -> Features | str:
        if session.names[number] in seen:
            return seen[session.names[number]]
        picture = session.pictures[number]
        try:
            return features_of(picture.path, session.rig.cameras[session.camera[number]].camera)
        except CaptureError as error:
            return str(error).removeprefix(f"{picture.path}: ")

    found: list[Features | None] = []
    with ThreadPoolExecutor(2) as pool:
        for number, one in enumerate(pool.map(work, range(len(session.pictures)))):
            progress("features", 1)
            seen[session.names[number]] = one
            if isinstance(one, str):
                session.left_out[session.names[number]] = one
            found.append(None if isinstance(one, str) else one)
    return found


def _adjusted(
    session: Session, made: Assembled, measured: Measurements, surface: Surface | None, progress: Progress
) -> tuple[Adjusted, dict[str, Any]]:
    """Adjust in rounds: mounting held, then what held-out views accept of it, with clocks, and the lidar's surface.

    On a trajectory all rounds but the last go by the tie points that tell most.
    """
    matched = measured.matched[made.measured]

    def told(step: int, cost: float) -> None:
        progress("adjusted", 1)

    known = made.block.rig.cameras
    if session.trajectory is None:
        adjusted = adjust(made.block, known, matched, told)
        return (adjusted if surface is None else _on_surface(adjusted, surface, known, matched, told)), {}
    few = thinned(made.block, matched)
    block = replace(made.block, measured=made.block.measured.masked(few))
    adjusted = adjust(block, known, matched[few], told)
    mounting, held_out = gate.accepted(adjusted.solved.block, known)
    block = flown.with_lateness(
        replace(adjusted.solved.block, mounting=mounting), session.late_sigma_s, session.own_cloud
    )
    adjusted = _settled(session, block, known, matched[few], told)
    if surface is not None:
        adjusted = _on_surface(adjusted, surface, known, matched[few], told)
        adjusted = _with_clocks(session, adjusted, known, matched[few], told)
    if not few.all():
        block = completed(adjusted.solved.block, made.block, matched, adjusted.sigma_px)
        adjusted = adjust(block if surface is None else held_to(block, surface), known, matched, told, begun=True)
    block = adjusted.solved.block
    departs = lasting.departures(block, flown.resampled(session.trajectory, block).priors)
    told_of_it = {"held_out": held_out, "lasting": asdict(session.lasting), "trajectory_departs_sigmas": departs}
    return adjusted, told_of_it | results.common_of(adjusted)


def _on_surface(
    adjusted: Adjusted, surface: Surface, known: tuple[RigCamera, ...], matched: Mask, told: Any
) -> Adjusted:
    """Adjusted with tie points held to the lidar's planes, which are taken anew once heights are right."""
    for _ in range(2):
        adjusted = adjust(held_to(adjusted.solved.block, surface), known, matched, told, begun=True)
    return adjusted


def _settled(session: Session, block: Block, known: tuple[RigCamera, ...], matched: Mask, told: Any) -> Adjusted:
    """Adjusted with the trajectory's errors as long as they last: the block is first held loosely, and tells."""
    assert session.trajectory is not None
    session.lasting = lasting.HARDLY
    loose = lasting.applied(block, session.lasting)
    # the mounting is free now: wrong matches get another chance
    adjusted = adjust(renewed(loose), known, matched, told)
    first = _with_clocks(session, adjusted, known, matched, told)
    stated = flown.resampled(session.trajectory, first.solved.block)
    session.lasting = lasting.told_by(first, stated.priors)
    adjusted = adjust(lasting.applied(stated, session.lasting), known, matched, told, begun=True)
    return _with_clocks(session, adjusted, known, matched, told)


def _with_clocks(
    session: Session, adjusted: Adjusted, known: tuple[RigCamera, ...], matched: Mask, told: Any
) -> Adjusted:
    """Observed poses taken anew where the clocks have moved."""
    assert session.trajectory is not None
    before: npt.NDArray[np.float64] | None = None
    for _ in range(_MOST_ROUNDS):
        block = adjusted.solved.block
        now = np.array([*(one.timeshift_s for one in block.rig.cameras), block.priors.common.late_s])
        if np.array_equal(now, [*(one.timeshift_s for one in known), 0.0]) or (
            before is not None and np.abs(now - before).max() < _SETTLED_S
        ):
            break
        before = now
        block = lasting.applied(flown.resampled(session.trajectory, block), session.lasting)
        adjusted = adjust(block, known, matched, told, begun=True)
    return adjusted


def _finish(
    task: Task, session: Session, adjusted: Adjusted, measured: Measurements, more: dict[str, Any]
) -> dict[str, Any]:
    """Write the folder; what bundle.json holds."""
    block = adjusted.solved.block
    rows = rows_of(session.names, block.images)
    stamps = session.time_ns[[rows[name] for name in block.images]]
    shift = np.array([round(one.timeshift_s * 1e9) for one in block.rig.cameras])[block.camera]
    utc_ns = np.where(stamps == NO_TIME, NO_TIME, stamps + shift)
    told = results.figures(adjusted, session.site, measured.names, session.control) | more
    told |= _origins(session)
    session.warnings += doubts_of(told, session, measured) + lens_doubts(adjusted)
    told["left_out"] = session.left_out
    told["warnings"] = session.warnings
    if session.pictures:
        told["images_folder"] = str(session.pictures[0].root)
    poses = results.map_poses(adjusted, session.site, utc_ns)
    results.write_all(task.output, adjusted, session.site, poses, measured.names, told)
    if session.trajectory is not None:
        _hand_back(task, session.trajectory, adjusted)
    return told


def _origins(session: Session) -> dict[str, Any]:
    """Where pictures are, and by what they have times."""
    told: dict[str, Any] = {"images_folder": None, "times": None}
    if session.pictures:
        one = session.pictures[0]
        told["images_folder"] = str(one.path.absolute()).removesuffix(one.name)
    if session.timed is not None:
        offset_s = session.timed.offset_s
        told["times"] = {
            "note": session.timed.note,
            "utc_minus_exif_s": offset_s if np.isfinite(offset_s) else None,
            "by_own_clock": int(session.timed.own.sum()),
        }
    return told


def _hand_back(task: Task, trajectory: Trajectory, adjusted: Adjusted) -> None:
    """Poses for the smoother."""
    block, unknowns = adjusted.solved.block, adjusted.solved.unknowns
    if task.hybrid == hybrid.TRUE:
        poses = hybrid.taken_as_true(block)
    else:
        poses = hybrid.gained(block, unknowns, adjusted.found, results.scale_of(adjusted))
    hybrid.write_gained(task.output / results.HYBRID, hybrid.thinned(poses, task.every_s), trajectory.frame)


def doubts_of(told: dict[str, Any], session: Session, measured: Measurements) -> list[str]:
    """Sentences for who must know."""
    doubts = []
    strangers = [name for name in measured.strangers if name not in session.left_out]
    if strangers:
        doubts.append(f"images of the tables that are not in the block: {names_listed(strangers)}")
    if session.control is not None:
        seen = {one["name"] for one in (*told["control"], *told["check"])}
        lost = [name for name in session.control.name if name not in seen]
        if lost:
            doubts.append(f"surveyed points that no images determine: {names_listed(lost)}")
        if told["control"] and told["datum"] != "observed":
            doubts.append(
                f"{len(told['control'])} control points do not lay the block, expected three or more: {told['datum']}"
            )
    few = [one["image"] for one in told["images"] if one["points"] < _FEW_POINTS]
    if few and session.trajectory is not None:
        doubts.append(
            f"images with fewer than {_FEW_POINTS} points in common with others, placed by the trajectory alone: {names_listed(few)}"
        )
    departs = max(told.get("trajectory_departs_sigmas", {}).values(), default=0.0)
    if max(session.lasting.place, session.lasting.turn) >= max(lasting.SIZES) and departs > lasting.DEPARTS:
        doubts.append(
            f"the trajectory departs from the block by {departs:.1f} times its stated sigmas, expected about one: is the camera model, the "
            "clock or the trajectory the right one?"
        )
    gross = told["counts"]["left_out"]["gross"]
    if gross:
        doubts.append(f"{gross} image points are gross errors and were left out")
    if not told["settled"]:
        doubts.append(f"the adjustment had not settled after {told['steps']} steps")
    rms = told["residual_rms_px"]
    if rms is not None and rms > _MOST_RMS_PX:
        doubts.append(f"residuals of {rms:.1f} px RMS, expected about one: is the camera model the right one?")
    return doubts


__all__ = ["Task", "run"]
