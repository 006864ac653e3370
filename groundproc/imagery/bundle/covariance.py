"""How well things are known after an adjustment: cofactors times sigma0 squared, of poses, cameras and points."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.linalg import LinAlgError, cho_factor, cho_solve, eigh

from flightlog.errors import CoverageError
from groundproc.imagery.bundle.block import CONTROL, Block
from groundproc.imagery.bundle.observed import known_rows, pose_rows
from groundproc.imagery.bundle.schur import point_cofactors
from groundproc.imagery.bundle.solve import Normal, Solved, normal_of
from groundproc.imagery.bundle.unknowns import Unknowns, lens_names
from groundproc.imagery.poses import ImagePoses
from groundproc.imagery.rig import MOUNTING, Spread
from groundproc.imagery.rotations import cross_matrix, mat_of_vector, photogrammetric, turn_by_angles
from groundproc.imagery.site import Site

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

_MOSTLY = 0.5
"""Share of what is not told that makes it a matter of the lens."""
_MOVES = 0.1
_NAMED = 5


class LooseError(CoverageError):
    """Images that nothing holds to the others, the fewer of both."""

    def __init__(self, images: tuple[str, ...]) -> None:
        more = f" and {len(images) - _NAMED} more" if len(images) > _NAMED else ""
        super().__init__(
            f"the block is not determined: {', '.join(images[:_NAMED])}{more} and the others are not held together, as where too few "
            "points are in common or all were taken from one place; leave them out, or give places"
        )
        self.images = images


@dataclass(frozen=True, slots=True)
class Balance:
    """Observations against unknowns.

    Attributes
    ----------
    image_points, pose_rows, point_rows, known_rows : int
        Observations: two for each image point; components of observed poses; coordinates of control and lidar; values of cameras.
    unknowns : int
        Points included; those held for a datum not.
    points : int
    square : float
        Sum of weighted squares.
    """

    image_points: int
    pose_rows: int
    point_rows: int
    known_rows: int
    unknowns: int
    points: int
    square: float

    @property
    def observations(self) -> int:
        """All of them."""
        return self.image_points + self.pose_rows + self.point_rows + self.known_rows

    @property
    def redundancy(self) -> int:
        """Observations beyond what the unknowns need."""
        return self.observations - self.unknowns

    @property
    def sigma0(self) -> float:
        """Of unit weight; not a number without redundancy."""
        return float(np.sqrt(self.square / self.redundancy)) if self.redundancy > 0 else float("nan")


@dataclass(frozen=True, slots=True)
class Cofactors:
    """Inverse of the normal equations at the solution.

    Attributes
    ----------
    matrix : ndarray, shape (n, n)
        Of the reduced system.
    normal : Normal
    """

    matrix: Array
    normal: Normal


def cofactors(solved: Solved) -> Cofactors:
    """Invert.

    Raises
    ------
    CoverageError
        The block is not determined.
    """
    normal = normal_of(solved.block, solved.known, solved.unknowns)
    matrix = normal.matrix
    # unknowns of metres and of coefficients of 1e-12 go together: scaled to ones first
    scale = np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    scaled = matrix / scale[:, None] / scale[None, :]
    try:
        factor = cho_factor(scaled, lower=True)
    except LinAlgError:
        raise _undetermined(solved, scaled) from None
    inverse = cho_solve(factor, np.eye(len(matrix))) / scale[:, None] / scale[None, :]
    return Cofactors((inverse + inverse.T) / 2.0, normal)


def _undetermined(solved: Solved, scaled: Array) -> CoverageError:
    """What moves where the normal equations say nothing."""
    block, unknowns = solved.block, solved.unknowns
    share = np.append(
        np.square(eigh(scaled, subset_by_index=[0, 0])[1][:, 0]), 0.0
    )  # a value that is held has no share
    own = share[unknowns.camera]
    if own.sum() > _MOSTLY:
        camera, place = np.unravel_index(int(own.argmax()), own.shape)
        name = (*lens_names(block, int(camera)), *MOUNTING)[place]
        return CoverageError(
            f"the block is not determined: nothing tells {name} of {block.rig.cameras[camera].name}; leave it out of the rig's estimate, "
            "or give it a sigma"
        )
    station = share[unknowns.station].sum(axis=1)
    moves = (station > _MOVES * station.max())[block.station]
    some = moves if 2 * np.count_nonzero(moves) <= len(moves) else ~moves
    if not some.any():
        return CoverageError(
            "the block is not determined: all of it can be moved or turned as one; expected positions or control points that are not on "
            "one line"
        )
    return LooseError(tuple(name for name, one in zip(block.images, some, strict=True) if one))


def balance(solved: Solved, found: Cofactors) -> Balance:
    """Count."""
    block = solved.block
    priors = block.priors
    stated = np.isfinite(np.diagonal(priors.covariance, axis1=1, axis2=2)) & (priors.weight > 0.0)[:, None]
    points = int(found.normal.kept.determined.sum())
    known = len(known_rows(block, solved.known, solved.unknowns)[2]) + int((solved.unknowns.common >= 0).sum())
    return Balance(
        2 * int((block.measured.weight > 0.0).sum()), int(stated.sum()), int((block.rows.weight > 0.0).sum()), known,
        solved.unknowns.size + 3 * points, points, solved.cost,
    )  # fmt: skip


def of_columns(matrix: Array, columns: npt.NDArray[np.int64]) -> Array:
    """Cofactors of some columns, shape (m, m); zero where one is -1, which stands for a held value."""
    held = columns < 0
    at = np.where(held, 0, columns)
    part = matrix[np.ix_(at, at)] if len(matrix) else np.zeros((len(at), len(at)))
    part = part.copy()
    part[held], part[:, held] = 0.0, 0.0
    return np.asarray(part)


def given_of(matrix: Array, columns: npt.NDArray[np.int64]) -> Array:
    """Cofactors were some columns known, shape (n, n); -1 stands for a held value."""
    own = columns[columns >= 0]
    if not len(own):
        return matrix
    return np.asarray(matrix - matrix[:, own] @ np.linalg.solve(matrix[np.ix_(own, own)], matrix[own]))


@dataclass(frozen=True, slots=True)
class CameraPoses:
    """Poses of cameras in the local frame.

    Attributes
    ----------
    place_m : ndarray, shape (i, 3)
        Projection centres.
    mat_local_camera : ndarray, shape (i, 3, 3)
    covariance : ndarray, shape (i, 6, 6)
        Of place [m] and of a small turn in the local frame [rad].
    """

    place_m: Array
    mat_local_camera: Array
    covariance: Array


def camera_poses(block: Block, unknowns: Unknowns, cofactor: Array, sigma0: float) -> CameraPoses:
    """Where each image was taken from, at its middle row, with boresight and lever arm and how well these are known."""
    place, mats, covariances = [], [], []
    for number in range(len(block.images)):
        camera, station = int(block.camera[number]), int(block.station[number])
        one, stations = block.rig.cameras[camera], block.stations
        since = one.timeshift_s - block.rig.cameras[int(stations.lead[station])].timeshift_s
        mat = stations.mat_local_ins[station] @ mat_of_vector(stations.rate_rad_s[station][None] * since)[0]
        arm = mat @ one.lever_arm_m
        mats.append(mat @ one.mat_cam_ins.T)
        place.append(stations.place_m[station] + since * stations.velocity_m_s[station] + arm)
        columns = np.concatenate([unknowns.station[station], unknowns.camera[camera][-len(MOUNTING) :][:6]])
        by = np.zeros((6, 12))
        by[:3, :3], by[:3, 3:6], by[3:, 3:6] = np.eye(3), -cross_matrix(arm), np.eye(3)
        by[3:, 6:9], by[:3, 9:12] = -mats[-1], mat
        covariances.append(sigma0**2 * by @ of_columns(cofactor, columns) @ by.T)
    return CameraPoses(np.array(place), np.array(mats), np.array(covariances))


def on_map(block: Block, poses: CameraPoses, site: Site, utc_ns: npt.NDArray[np.int64]) -> ImagePoses:
    """The same in the coordinates that people use: against grid east, grid north and up."""
    mat_local_grid = site.mat_local_grid(poses.place_m)
    mat_grid_local = np.swapaxes(mat_local_grid, 1, 2)
    angles = np.stack(photogrammetric(mat_grid_local @ poses.mat_local_camera), axis=1)
    place = poses.covariance[:, :3, :3]
    turned = mat_grid_local @ place @ mat_local_grid
    by_turn = np.linalg.pinv(turn_by_angles(angles[:, 0], angles[:, 1])) @ mat_grid_local
    spread = by_turn @ poses.covariance[:, 3:, 3:] @ np.swapaxes(by_turn, 1, 2)
    sigma_place, sigma_angles = (
        np.sqrt(np.maximum(np.diagonal(one, axis1=1, axis2=2), 0.0)) for one in (turned, spread)
    )
    return ImagePoses(block.images, utc_ns, site.map(poses.place_m), angles, sigma_place, sigma_angles)


def camera_spread(solved: Solved, number: int, cofactor: Array, sigma0: float) -> Spread | None:
    """Covariance of what was estimated of a camera; None where nothing was."""
    names, columns = solved.unknowns.names_of(number, lens_names(solved.block, number))
    return Spread(names, sigma0**2 * of_columns(cofactor, columns)) if names else None


def points_covariance(block: Block, found: Cofactors, sigma0: float) -> Array:
    """Covariance of the points in the local frame, shape (p, 3, 3); not a number where one is not determined."""
    out = np.empty((len(block.points_m), 3, 3))
    point_cofactors(found.normal.system, block.points_m, found.normal.kept, found.matrix, out)
    return np.asarray(sigma0**2 * out)


def traces(solved: Solved, found: Cofactors) -> tuple[float, float]:
    """How many unknowns' worth the observed poses, and the rows of points, determine: traces of their shares of the normal matrix."""
    block = solved.block
    poses = 0.0
    if len(block.priors):
        _, by, columns = pose_rows(block, solved.unknowns)
        for row, own in zip(by, columns, strict=True):
            poses += float(np.trace(row @ of_columns(found.matrix, own) @ row.T))
    rows = block.rows
    if not len(rows):
        return poses, 0.0
    # planes that are off as the poses are tell nothing of where all of it lies
    against = replace(found, matrix=given_of(found.matrix, solved.unknowns.common[1:]))
    cofactor = points_covariance(block, against, 1.0)[rows.point]
    share = np.einsum("mi,mij,mj->m", rows.normal, cofactor, rows.normal) * rows.weight / rows.sigma_m**2
    return poses, float(np.nansum(share))


__all__ = [
    "CONTROL", "Balance", "CameraPoses", "Cofactors", "balance", "camera_poses", "camera_spread", "cofactors", "of_columns",
    "on_map", "points_covariance", "traces",
]  # fmt: skip
