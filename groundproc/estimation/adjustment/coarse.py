"""The adjustment on a coarse path: the slow bends, which the fine preconditioner does not know.

A bend over seconds moves path and planes together, so the lidar hardly resists it. A preconditioner that takes the
planes for fixed makes it stiff. Conjugate gradients then need hundreds of steps; if they stop early, the bends are
missing from the solution and from every draw of the posterior. So the same least-squares problem is also solved
exactly (Galerkin) for paths that move as rigid bodies at nodes some seconds apart, linearly in between. Both solutions
are added: a two-level additive Schwarz preconditioner whose coarse space contains the rigid motions, as that of
smoothed aggregation does (Vanek, Mandel, Brezina 1996).
"""

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from flightlog import frames
from groundproc.estimation.observations.planes import Rows
from groundproc.estimation.odometry.grid import STEPS
from groundproc.estimation.odometry.spline import Path
from groundproc.numerics import splines
from groundproc.numerics.parts import at_once
from groundproc.numerics.planeproducts import RowArrays, solved_plane

Array = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]

EVERY: Final = 16
"""Coefficients from node to node, at least: 1.6 s."""
MOST_NODES: Final = 160
"""Nodes at most, further apart on a long path: their dense matrix, six unknowns a node, is factored in every step."""
LEAST_SHARE: Final = 1e-3
"""Of all that is known of a direction."""
COARSE_PARTS: Final = 4
"""Pieces that the voxels are shared out in between cores, each with a matrix of its own."""


class NodeArrays(NamedTuple):
    """`Nodes` as kernels take them; the fields stand there."""

    every: int
    mats: Array
    position_m: Array
    centre_m: Array


@dataclass(slots=True)
class Nodes:
    """Where the nodes stand, and what a motion of theirs does to the path.

    Attributes
    ----------
    every : int
        Coefficients from node to node.
    mats : ndarray, shape (coefficients, 3, 3)
    position_m : ndarray, shape (coefficients, 3)
        Coefficients of splines that go through attitudes (local from sensor) and positions of the path.
    centre_m : ndarray, shape (nodes, 3)
        About which each node turns.
    """

    every: int
    mats: Array
    position_m: Array
    centre_m: Array

    @property
    def arrays(self) -> NodeArrays:
        """What the kernels take."""
        return NodeArrays(self.every, self.mats, self.position_m, self.centre_m)

    @classmethod
    def of(cls, path: Path) -> "Nodes":
        """Nodes for a path."""
        count = path.intervals + 3
        every = max(EVERY, -(-count // MOST_NODES))
        nodes = -(-(count - 1) // every) + 1
        position = splines.through(path.position_m[::STEPS])
        mats = splines.through(frames.mat_from_quat(path.quat[::STEPS]))
        return cls(every, mats, position, position[np.minimum(np.arange(nodes) * every, count - 1)])

    def prolongation(self) -> sparse.csr_matrix:
        """From turns about local axes and shifts of the nodes to the spline's coefficients, shape (6 coefficients, 6 nodes)."""
        count = len(self.mats)
        first = np.minimum(np.arange(count) // self.every, len(self.centre_m) - 2)
        second = np.arange(count) / self.every - first
        blocks, rows, columns = [], [], []
        for node, share in ((first, 1.0 - second), (first + 1, second)):
            block = np.zeros((count, 6, 6))
            block[:, :3, :3] = np.swapaxes(self.mats, 1, 2)
            block[:, 3:, 3:] = np.eye(3)
            arm = self.position_m - self.centre_m[node]
            block[:, 3:, :3] = np.cross(np.eye(3), arm[:, None]).swapaxes(1, 2)
            blocks.append(block * share[:, None, None])
            row, column = np.meshgrid(np.arange(6), np.arange(6), indexing="ij")
            rows.append(6 * np.arange(count)[:, None, None] + row)
            columns.append(6 * node[:, None, None] + column)
        return sparse.csr_matrix(
            (np.ravel(blocks), (np.ravel(rows), np.ravel(columns))), shape=(6 * count, 6 * len(self.centre_m))
        )

    def rigid(self, prolongation: sparse.csr_matrix) -> Array:
        """Coefficients of a turn about each local axis through the origin, and of a shift along each, shape (6 coefficients, 6)."""
        count = len(self.centre_m)
        motion = np.tile(np.eye(6), (count, 1, 1))
        motion[:, 3:, :3] = np.cross(np.eye(3), self.centre_m[:, None]).swapaxes(1, 2)
        return np.asarray(prolongation @ motion.reshape(6 * count, 6))


@dataclass(slots=True)
class Coarse:
    """The factored problem between nodes.

    Attributes
    ----------
    rigid : ndarray, shape (6 coefficients, 6)
        What a turn about local axes through the origin, and a shift, of the whole path are in coefficients.
    prolongation : csr_matrix, shape (unknowns, 6 nodes + globals)
        From motions of nodes to coefficients; the globals are themselves.
    factor : tuple
        Cholesky factor of the normal matrix between nodes.
    """

    rigid: Array
    prolongation: sparse.csr_matrix
    factor: Any

    @property
    def nodes(self) -> int:
        """How many there are."""
        globals_ = self.prolongation.shape[0] - self.rigid.shape[0]
        return int(self.prolongation.shape[1] - globals_) // 6

    def solve(self, right: Array) -> Array:
        """The best coarse solution, shape as `right`: (unknowns,) or (unknowns, m)."""
        return np.asarray(self.prolongation @ cho_solve(self.factor, self.prolongation.T @ right, check_finite=False))

    def spread_by(self, rows: sparse.csr_matrix) -> Array:
        """Columns, shape (unknowns, k): the sum of their outer products is the covariance by errors of size one of some rows.

        Directions of which the rows say less than `LEAST_SHARE` are left out; there are a few dozen others.
        """
        between = rows @ self.prolongation
        half = solve_triangular(self.factor[0], (between.T @ between).toarray(), trans="T", lower=self.factor[1])
        shares, axes = np.linalg.eigh(solve_triangular(self.factor[0], half.T, trans="T", lower=self.factor[1]))
        kept = shares > LEAST_SHARE
        columns = solve_triangular(self.factor[0], axes[:, kept] * np.sqrt(shares[kept]), lower=self.factor[1])
        return np.asarray(self.prolongation @ columns)


def coarse_of(rows: Rows, deflation: float, normal: sparse.csr_matrix, path: Path) -> Coarse:
    """Reduce the lidar's rows, their information divided by `deflation`, and the normal matrix of everything else to nodes."""
    nodes = Nodes.of(path)
    inner = nodes.prolongation()
    globals_ = sparse.identity(normal.shape[0] - inner.shape[0])
    prolongation = sparse.block_diag([inner, globals_], format="csr")
    matrix = (prolongation.T @ normal @ prolongation).toarray()
    size = inner.shape[1]
    matrix[:size, :size] += lidar_between(rows, nodes) / deflation
    if rows.more:
        further = slice(size, size + len(rows.corner))
        border = inner.T @ rows.border.T / deflation
        matrix[:size, further] += border
        matrix[further, :size] += border.T
        matrix[further, further] += rows.corner / deflation
    return Coarse(nodes.rigid(inner), sparse.csr_matrix(prolongation), cho_factor(matrix, check_finite=False))


def lidar_between(rows: Rows, nodes: Nodes) -> Array:
    """The lidar's normal matrix between nodes, shape (6 nodes, 6 nodes)."""
    count = len(nodes.centre_m)
    upper = np.zeros((COARSE_PARTS, count, count, 6, 6))
    arrays, places, voxels = rows.arrays, nodes.arrays, len(rows.first) - 1

    def reduce(part: int) -> None:
        some = voxels * part // COARSE_PARTS, voxels * (part + 1) // COARSE_PARTS
        _reduce(arrays, places, some, upper[part])

    at_once(reduce, COARSE_PARTS)
    upper[0] += upper[1:].sum(axis=0)
    square = upper[0].transpose(0, 2, 1, 3).reshape(6 * count, 6 * count)
    return np.asarray(np.triu(square) + np.triu(square, 1).T)


@njit(cache=True, nogil=True, fastmath=True)
def _reduce(rows: RowArrays, nodes: NodeArrays, voxels: tuple[int, int], out: Array) -> None:
    """Blocks on and above the diagonal, of the voxels from a first one to before a last one: shape (nodes, nodes, 6, 6)."""
    first, knot, weights, jacobian = rows.first, rows.knot, rows.weights, rows.jacobian
    plane, weight, inverse = rows.plane, rows.weight, rows.inverse
    count_nodes = len(out)
    slot, touched = np.full(count_nodes, -1), np.empty(count_nodes, np.int64)
    sums, solved, by = np.empty((count_nodes, 3, 6)), np.empty((3, 6)), np.empty((3, 6))
    for v in range(voxels[0], voxels[1]):
        count = 0
        for i in range(first[v], first[v + 1]):
            if weight[i] == 0.0:
                continue
            node = knot[i] // nodes.every
            last = _by_nodes(knot[i], node, weights[i], jacobian[i], nodes, by)
            for a in range(last + 1):
                if slot[node + a] < 0:
                    slot[node + a], touched[count] = count, node + a
                    sums[count] = 0.0
                    count += 1
                _add_row(weight[i], by[a : last + 1], plane[i], sums[slot[node + a]], out[node + a, node + a :])
        _without_planes(touched[:count], sums, inverse[v], solved, out)
        for a in range(count):
            slot[touched[a]] = -1


@njit(cache=True, nogil=True, inline="always", fastmath=True)
def _add_row(weight: float, by: Array, plane: Singles, sums: Array, blocks: Array) -> None:
    """A row's part by its first node, by[0], in the sums of its voxel, and in the blocks of that node and those after it."""
    for c in range(6):
        y = weight * by[0, c]
        sums[0, c] += y
        sums[1, c] += y * plane[0]
        sums[2, c] += y * plane[1]
        for b in range(len(by)):
            for d in range(6):
                blocks[b, c, d] += y * by[b, d]


@njit(cache=True, nogil=True, inline="always", fastmath=True)
def _by_nodes(knot: int, node: int, weights: Singles, jacobian: Singles, nodes: NodeArrays, by: Array) -> int:
    """A row by the motions of the nodes from `node` on, shape (3, 6); the number of the last that counts."""
    mats, position, centre = nodes.mats, nodes.position_m, nodes.centre_m
    by[:] = 0.0
    last = 1
    nx, ny, nz = jacobian[3], jacobian[4], jacobian[5]
    for j in range(4):
        at = knot + j
        m, p = mats[at], position[at]
        tx = m[0, 0] * jacobian[0] + m[0, 1] * jacobian[1] + m[0, 2] * jacobian[2]
        ty = m[1, 0] * jacobian[0] + m[1, 1] * jacobian[1] + m[1, 2] * jacobian[2]
        tz = m[2, 0] * jacobian[0] + m[2, 1] * jacobian[1] + m[2, 2] * jacobian[2]
        g = at / nodes.every - node
        here = min(int(g), len(centre) - 2 - node)
        for a in range(here, here + 2):
            share = weights[j] * (1.0 - abs(g - a))
            if share == 0.0:
                continue
            last = max(last, a)
            c = centre[node + a]
            dx, dy, dz = p[0] - c[0], p[1] - c[1], p[2] - c[2]
            by[a, 0] += share * (tx + dy * nz - dz * ny)
            by[a, 1] += share * (ty + dz * nx - dx * nz)
            by[a, 2] += share * (tz + dx * ny - dy * nx)
            by[a, 3] += share * nx
            by[a, 4] += share * ny
            by[a, 5] += share * nz
    return last


@njit(cache=True, nogil=True, inline="always", fastmath=True)
def _without_planes(touched: Ints, sums: Array, inverse: Array, solved: Array, out: Array) -> None:
    """Take what the best plane of a voxel takes up off the blocks of the nodes that it touches."""
    for a in range(len(touched)):
        s = sums[a]
        for c in range(6):
            solved[0, c], solved[1, c], solved[2, c] = solved_plane(inverse, s[0, c], s[1, c], s[2, c])
        for b in range(len(touched)):
            if touched[b] >= touched[a]:
                block, other = out[touched[a], touched[b]], sums[b]
                for c in range(6):
                    for d in range(6):
                        block[c, d] -= (
                            solved[0, c] * other[0, d] + solved[1, c] * other[1, d] + solved[2, c] * other[2, d]
                        )
