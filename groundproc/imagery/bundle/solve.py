"""Levenberg and Marquardt's steps from the values given to those that fit best (Nocedal & Wright, 2nd ed., section 10.3)."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from flightlog.errors import CoverageError
from groundproc.imagery import lenses
from groundproc.imagery.bundle.block import Block, Stations
from groundproc.imagery.bundle.observed import add_dense, common_rows, known_rows, pose_rows
from groundproc.imagery.bundle.rows import System, moves_with_poses, residuals, system_of
from groundproc.imagery.bundle.schur import Eliminated, back, nothing_kept, reduce
from groundproc.imagery.bundle.unknowns import Unknowns, lay_out, lens_names
from groundproc.imagery.rig import MOUNTING, Rig, RigCamera
from groundproc.imagery.rotations import mat_of_vector

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

MOST_STEPS = 60
SETTLED = 1e-10
"""Steps end where the sum of squares falls by less than this part."""
_BEHIND = 1e6
"""What a point behind its camera costs [sigma^2]: more than any error."""
_FIRST_DAMPING = 1e-4
_LEAST_DAMPING = 1e-12
_MOST_DAMPING = 1e8


@dataclass(frozen=True, slots=True)
class Solved:
    """A block at its least squares.

    Attributes
    ----------
    block : Block
    unknowns : Unknowns
    known : tuple of RigCamera
        The cameras as they were known before.
    cost : float
        Sum of weighted squares.
    steps : int
    settled : bool
    """

    block: Block
    unknowns: Unknowns
    known: tuple[RigCamera, ...]
    cost: float
    steps: int
    settled: bool


def solve(
    block: Block,
    known: tuple[RigCamera, ...],
    progress: Callable[[int, float], None] | None = None,
    most_steps: int = MOST_STEPS,
    settled_at: float = SETTLED,
) -> Solved:
    """Adjust a block.

    Parameters
    ----------
    block : Block
    known : tuple of RigCamera
        Cameras as known before; their `sigma` are priors.
    progress : callable, optional
        Told the number of each step and the sum of squares.
    most_steps : int
    settled_at : float
        Part of the sum of squares: fewer steps and a larger part will do where weights change anyway.

    Raises
    ------
    CoverageError
        The observations leave something undetermined.
    """
    unknowns = lay_out(block)
    now, damping = cost(block, known, unknowns), _FIRST_DAMPING
    settled, undamped, number = False, False, 0
    for number in range(1, most_steps + 1):
        trial, after, damping = _descend(block, known, unknowns, now, damping)
        if trial is None:
            settled = True
            break
        gained, block, now = now - after, trial, after
        if progress is not None:
            progress(number, now)
        if gained <= settled_at * max(now, 1e-12):
            if undamped or settled_at > SETTLED:
                settled = True
                break
            # what little damping there is holds the soft modes of a block: the bend of a strip costs next to nothing
            damping, undamped = 0.0, True
        else:
            damping = damping / 10.0 if damping > _LEAST_DAMPING else 0.0
    return Solved(block, unknowns, known, now, number, settled)


def _descend(
    block: Block, known: tuple[RigCamera, ...], unknowns: Unknowns, now: float, damping: float
) -> tuple[Block | None, float, float]:
    """A step that does not raise the sum of squares, the sum after it and the damping that it took; None where there is none.

    Raises
    ------
    CoverageError
        However much it is damped, the normal matrix is singular.
    """
    while True:
        normal = normal_of(block, known, unknowns, damping)
        trial = _stepped(block, normal, damping)
        after = np.inf if trial is None else cost(trial, known, unknowns)
        # at the bottom a step changes the sum of squares by its rounding alone: no damping would make it smaller
        if after <= now * (1.0 + SETTLED):
            return trial, after, damping
        damping = max(10.0 * damping, _LEAST_DAMPING)
        if damping > _MOST_DAMPING:
            if trial is None:
                raise CoverageError(_undetermined(block, unknowns, normal.matrix))
            return None, now, damping


@dataclass(frozen=True, slots=True)
class Normal:
    """Reduced normal equations.

    Attributes
    ----------
    system : rows.System
    unknowns : Unknowns
    matrix : ndarray, shape (n, n)
    gradient : ndarray, shape (n,)
    kept : schur.Eliminated
    """

    system: System
    unknowns: Unknowns
    matrix: Array
    gradient: Array
    kept: Eliminated


def normal_of(block: Block, known: tuple[RigCamera, ...], unknowns: Unknowns, damping: float = 0.0) -> Normal:
    """Sum all rows; with damping the points' matrices are raised by it."""
    system = system_of(block, unknowns)
    matrix, gradient = np.zeros((unknowns.size, unknowns.size)), np.zeros(unknowns.size)
    kept = nothing_kept(len(block.points_m))
    reduce(system, block.points_m, damping, matrix, gradient, kept)
    if len(block.priors):
        add_dense(matrix, gradient, *pose_rows(block, unknowns))
        add_dense(matrix, gradient, *common_rows(block, unknowns))
    residual, weight, columns = known_rows(block, known, unknowns)
    matrix[columns, columns] += weight**2
    gradient[columns] += weight * residual
    return Normal(system, unknowns, matrix, gradient, kept)


def _stepped(block: Block, normal: Normal, damping: float) -> Block | None:
    """The block a step on; None where the matrix is singular."""
    matrix = normal.matrix.copy()
    diagonal = np.diag(matrix)
    matrix[np.diag_indices(len(matrix))] += damping * np.maximum(diagonal, 1e-12 * diagonal.max(initial=1.0))
    try:
        factor = cho_factor(matrix, lower=True, overwrite_a=True, check_finite=True)
    except (LinAlgError, ValueError):
        return None
    step = -cho_solve(factor, normal.gradient)
    moved = np.zeros_like(block.points_m)
    back(normal.system, block.points_m, normal.kept, step, moved)
    return moved_by(block, normal.unknowns, step, moved)


def moved_by(block: Block, unknowns: Unknowns, step: Array, points_m: Array) -> Block:
    """The block with its values changed by a step of the reduced system and of the points."""
    pose = np.where(unknowns.station >= 0, step[np.maximum(unknowns.station, 0)], 0.0) if unknowns.size else 0.0
    pose = np.broadcast_to(pose, (len(block.stations), 6))
    stations: Stations = replace(
        block.stations,
        place_m=block.stations.place_m + pose[:, :3],
        mat_local_ins=mat_of_vector(pose[:, 3:]) @ block.stations.mat_local_ins,
    )
    cameras = tuple(_moved_camera(block, unknowns, number, step) for number in range(len(block.rig.cameras)))
    priors = block.priors
    if len(priors):
        later = np.array(
            [new.timeshift_s - old.timeshift_s for new, old in zip(cameras, block.rig.cameras, strict=True)]
        )
        seconds = later[stations.lead[priors.station]][:, None]
        common = np.where(unknowns.common >= 0, step[np.maximum(unknowns.common, 0)], 0.0)
        turned = (seconds + common[0]) * priors.turning_rad_s
        priors = replace(
            priors,
            place_m=priors.place_m + seconds * priors.velocity_m_s,
            mat_local_ins=mat_of_vector(turned) @ priors.mat_local_ins,
            common=replace(
                priors.common,
                late_s=float(priors.common.late_s + common[0]),
                moved=priors.common.moved + common[1:],
            ),
        )
    return replace(block, rig=Rig(cameras), stations=stations, priors=priors, points_m=block.points_m + points_m)


def _moved_camera(block: Block, unknowns: Unknowns, number: int, step: Array) -> RigCamera:
    one = block.rig.cameras[number]
    columns = unknowns.camera[number]
    change = np.where(columns >= 0, step[np.maximum(columns, 0)], 0.0) if unknowns.size else np.zeros(len(columns))
    if not change.any():
        return one
    names = lens_names(block, number)
    values = one.camera.values()
    lens = {name: values[name] + change[place] for place, name in enumerate(names) if name and columns[place] >= 0}
    lens = {name: max(value, 1e-3) if name in ("f", "aspect") else value for name, value in lens.items()}
    mount = dict(zip(MOUNTING, change[lenses.FREE :], strict=True))
    turn = np.array([mount[f"boresight_{axis}"] for axis in "xyz"])
    lever = one.lever_arm_m + np.array([mount[f"lever_{axis}"] for axis in "xyz"])
    mat = mat_of_vector(turn) @ one.mat_cam_ins
    return replace(
        one, camera=one.camera.with_values(lens) if lens else one.camera, mat_cam_ins=mat, origin_cam_m=-mat @ lever,
        timeshift_s=float(one.timeshift_s + mount["timeshift"]), line_delay_s=float(one.line_delay_s + mount["line_delay"]),
    )  # fmt: skip


def image_residuals(block: Block, unknowns: Unknowns) -> tuple[Array, Mask]:
    """Residual of every measurement [px], shape (n, 2), and whether the point is where its camera can see it."""
    residual, reached = np.zeros((len(block.measured), 2)), np.zeros(len(block.measured), np.bool_)
    residuals(system_of(block, unknowns), block.points_m, residual, reached)
    return residual, reached


def row_residuals(block: Block) -> Array:
    """Residual of what is known of points without images [m], shape (m,)."""
    rows, common = block.rows, block.priors.common
    places = block.points_m[rows.point]
    moved = np.where(moves_with_poses(block)[:, None], common.shift_m(places), 0.0)
    return np.asarray(np.einsum("mi,mi->m", rows.normal, places + moved) - rows.target_m)


def cost(block: Block, known: tuple[RigCamera, ...], unknowns: Unknowns) -> float:
    """Sum of weighted squares."""
    residual, reached = image_residuals(block, unknowns)
    square = np.where(reached, np.square(residual).sum(axis=1) / block.measured.sigma_px**2, _BEHIND)
    total = float((block.measured.weight * square).sum())
    total += float((block.rows.weight * np.square(row_residuals(block) / block.rows.sigma_m)).sum())
    if len(block.priors):
        total += float(np.square(pose_rows(block, unknowns)[0]).sum())
        total += float(np.square(common_rows(block, unknowns)[0]).sum())
    return total + float(np.square(known_rows(block, known, unknowns)[0]).sum())


def _undetermined(block: Block, unknowns: Unknowns, matrix: Array) -> str:
    """Which unknown the observations say least about, in words."""
    diagonal = np.diag(matrix)
    worst = int(np.argmin(diagonal))
    station, _ = np.nonzero(unknowns.station == worst)
    if len(station):
        image = block.images[int(np.flatnonzero(block.station == station[0])[0])]
        return f"image {image}: its points do not determine its pose; expected six points or more that other images see too"
    camera, place = (int(found[0]) for found in np.nonzero(unknowns.camera == worst))
    name = (*lens_names(block, camera), *MOUNTING)[place]
    return f"{block.rig.cameras[camera].name}: {name} is not determined by this block; leave it out of estimate, or give it a sigma"
