"""A profile across a bank as three straight pieces: what lies above, the face, what lies below; with the covariance of the two edges.

An edge of a bank is where the planes of its sides meet. Distances are those to the nearest piece, across it, so that an upright face, and
one that overhangs, is told as well as a gentle one.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.numerics.robust import MAD_TO_SIGMA

Array = npt.NDArray[np.float64]

FEWEST: Final = 12
"""Points of a piece that is told."""
_MOST: Final = 400
"""Points of a profile: more tell nothing new."""
_GROUP_M: Final = 0.5
"""Residuals within this are of the same stones and tufts, and count as one."""
_LOOSE: Final = np.array([50.0, 50.0, 50.0, 50.0, 1.0, 1.0])
"""Sigmas of the priors: of places [m] none to speak of, of slopes that of land."""
_STARTS: Final = (0.05, 0.4, 1.0)
"""Widths of the face that are tried, in those of the steep cells."""
_ROBUST: Final = 2.0
"""Sigmas from which on a point counts for less."""
_BEYOND_M: Final = 0.4
"""So far beyond an edge there have to be points."""
_ROUNDS: Final = 40


@dataclass(frozen=True, slots=True)
class Profile:
    """Three pieces.

    Attributes
    ----------
    values : ndarray, shape (6,)
        Way s and height z of the upper edge, of the lower edge, slopes dz/ds above and below [m, m, m, m, 1, 1]; s grows downhill.
    covariance : ndarray, shape (6, 6)
    rms_m : float
    reach_m : tuple of float
        First and last way across that has points.
    upper, lower : bool
        Whether there are points enough beyond the edge to tell it.
    """

    values: Array
    covariance: Array
    rms_m: float
    reach_m: tuple[float, float]
    upper: bool
    lower: bool

    @property
    def drop_m(self) -> float:
        """From the upper to the lower edge."""
        return float(self.values[1] - self.values[3])

    @property
    def slope_rad(self) -> float:
        """Of the face; more than a right angle where it overhangs."""
        return float(np.arctan2(self.drop_m, self.values[2] - self.values[0]))

    def heights(self, s: Array) -> Array:
        """Height at ways across, shape (n,)."""
        return heights(self.values, s)

    def sigmas(self) -> tuple[Array, Array]:
        """Sigma across and in height of the upper edge and of the lower one, shape (2,) each."""
        sigma = np.sqrt(np.diag(self.covariance))
        return sigma[:2], sigma[2:4]


def heights(values: Array, s: Array) -> Array:
    """Height of three pieces at ways across, shape (n,): of an overhang that of its edge."""
    s1, z1, s2, z2, above, below = values
    share = np.clip((s - s1) / max(s2 - s1, 1e-6), 0.0, 1.0)
    face = z1 + share * (z2 - z1)
    return np.asarray(face + np.where(s < s1, above * (s - s1), 0.0) + np.where(s > s2, below * (s - s2), 0.0))


def fitted(s: Array, z: Array, width_m: float) -> Profile | None:
    """Fit three pieces to points of a profile; None where no bank is told.

    Parameters
    ----------
    s, z : ndarray, shape (n,)
        Ways downhill from about the middle of the face, and heights.
    width_m : float
        Of the face, about.
    """
    step = max(1, len(s) // _MOST)
    s, z = s[::step], z[::step]
    if len(s) < 2 * FEWEST:
        return None
    s, z = np.ascontiguousarray(s, np.float64), np.ascontiguousarray(z, np.float64)
    scale, found = _scale(s, z), []
    for start in _starts(s, z, width_m):
        try:
            found.append((float(_fit(start, s, z, scale)), start))
        except np.linalg.LinAlgError:
            continue
    return _told(min(found, key=lambda each: each[0])[1], s, z) if found else None


def _starts(s: Array, z: Array, width_m: float) -> list[Array]:
    """Pieces to begin with: the face where the ground falls most within its width."""
    edge = np.arange(s.min(), s.max() + 0.25, 0.25)
    number = np.clip(np.digitize(s, edge) - 1, 0, len(edge) - 1)
    there = np.unique(number)
    middle = np.array([np.median(z[number == each]) for each in there])
    at = edge[there] + 0.125
    beyond = np.interp(at + width_m, at, middle)
    place = float(at[int(np.argmax(middle - beyond))]) + width_m / 2.0
    out = []
    for share in _STARTS:
        half = max(share * width_m, 0.05) / 2.0
        top = float(np.interp(place - width_m / 2.0 - 0.3, at, middle))
        foot = float(np.interp(place + width_m / 2.0 + 0.3, at, middle))
        out.append(np.array([place - half, top, place + half, foot, 0.0, 0.0]))
    return out


def _scale(s: Array, z: Array) -> float:
    """About what points scatter by: of differences between neighbours, of which those across an edge are few."""
    step = np.diff(z[np.argsort(s, kind="stable")])
    return float(max(_ROBUST * MAD_TO_SIGMA * np.median(np.abs(step)) / np.sqrt(2.0), 0.01))


@njit(cache=True, nogil=True)
def _row(p: Any, s: float, z: float, row: Any) -> Any:
    """Signed distance of a point to the nearest piece, its derivatives (6), which piece that is, and how far along.

    The foot of the perpendicular moves with the ends of its piece; across it the distance shrinks by as much.
    """
    best, which, far = np.inf, 0, 0.0
    n_s, n_z = 0.0, 0.0
    for piece in range(3):
        a, b, most = p[0], p[1], np.inf
        if piece == 0:
            u, v = -1.0, -p[4]
        elif piece == 1:
            u, v, most = p[2] - p[0], p[3] - p[1], 1.0
        else:
            a, b, u, v = p[2], p[3], 1.0, p[5]
        square = max(u * u + v * v, 1e-12)
        t = min(max(((s - a) * u + (z - b) * v) / square, 0.0), most)
        off_s, off_z = s - a - t * u, z - b - t * v
        distance = np.sqrt(off_s * off_s + off_z * off_z)
        if distance < best:
            best, which, far = distance, piece, t
            n_s, n_z = off_s, off_z
    if best > 1e-9:
        n_s, n_z = n_s / best, n_z / best
    row[:] = 0.0
    if which == 0:
        row[0], row[1], row[4] = -n_s, -n_z, far * n_z
    elif which == 1:
        row[0], row[1], row[2], row[3] = -(1.0 - far) * n_s, -(1.0 - far) * n_z, -far * n_s, -far * n_z
    else:
        row[2], row[3], row[5] = -n_s, -n_z, -far * n_z
    return best, which, far


@njit(cache=True, nogil=True)
def _cost(p: Any, prior: Any, s: Any, z: Any, scale: float, row: Any) -> Any:
    total = 0.0
    for i in range(len(s)):
        r, _, _ = _row(p, s[i], z[i], row)
        total += np.log1p((r / scale) ** 2)
    for k in range(6):
        total += ((p[k] - prior[k]) / _LOOSE[k]) ** 2
    return total


@njit(cache=True, nogil=True)
def _fit(p: Any, s: Any, z: Any, scale: float) -> Any:
    """Least sum of Cauchy's losses by Levenberg and Marquardt; gives the sum, `p` is changed."""
    prior, row = p.copy(), np.empty(6)
    cost, damping = _cost(p, prior, s, z, scale, row), 1e-3
    for _ in range(_ROUNDS):
        normal, right = np.zeros((6, 6)), np.zeros(6)
        for i in range(len(s)):
            r, _, _ = _row(p, s[i], z[i], row)
            weight = 1.0 / (scale * scale + r * r)
            for k in range(6):
                right[k] -= weight * row[k] * r
                for m in range(6):
                    normal[k, m] += weight * row[k] * row[m]
        for k in range(6):
            normal[k, k] += _LOOSE[k] ** -2.0
            right[k] -= (p[k] - prior[k]) / _LOOSE[k] ** 2
        better = False
        for _ in range(6):
            damped = normal.copy()
            for k in range(6):
                damped[k, k] *= 1.0 + damping
            trial = p + np.linalg.solve(damped, right)
            other = _cost(trial, prior, s, z, scale, row)
            if other < cost:
                better = cost - other > 1e-6 * cost
                p[:], cost, damping = trial, other, max(damping * 0.2, 1e-9)
                break
            damping *= 5.0
        if not better:
            break
    return cost


@njit(cache=True, nogil=True)
def _rows(p: Any, s: Any, z: Any, rows: Any, r: Any, which: Any, far: Any) -> None:
    for i in range(len(s)):
        r[i], which[i], far[i] = _row(p, s[i], z[i], rows[i])


def _told(p: Array, s: Array, z: Array) -> Profile | None:
    """Covariance by groups, and which edges are told."""
    rows, r, far = np.empty((len(s), 6)), np.empty(len(s)), np.empty(len(s))
    which = np.empty(len(s), np.int64)
    _rows(p, s, z, rows, r, which, far)
    scale = float(MAD_TO_SIGMA * np.median(r) + 1e-3)
    weight = 1.0 / (1.0 + (r / (_ROBUST * scale)) ** 2)
    normal = (rows * weight[:, None]).T @ rows + np.diag((scale / _LOOSE) ** 2)
    inverse = np.linalg.inv(normal)
    group = np.floor(s / _GROUP_M).astype(np.int64) * 3 + which
    number = np.unique(group, return_inverse=True)[1].ravel()
    groups = int(number.max()) + 1
    score = np.zeros((groups, 6))
    np.add.at(score, number, rows * (weight * r)[:, None])
    by_groups = inverse @ (score.T @ score) @ inverse * (groups / max(groups - 6, 1))
    by_points = inverse * float(np.sum(weight * r**2) / max(weight.sum() - 6.0, 1.0))
    covariance = by_groups if np.trace(by_groups[:4, :4]) > np.trace(by_points[:4, :4]) else by_points
    enough = [
        int((which == each).sum()) >= FEWEST and float(far[which == each].max(initial=0.0)) > _BEYOND_M
        for each in (0, 2)
    ]
    on_face = int((which == 1).sum()) >= 3 or p[2] - p[0] < 0.1
    if not (on_face and any(enough) and np.isfinite(covariance).all()):
        return None
    return Profile(
        p, np.asarray(covariance, np.float64), float(np.sqrt(np.mean(r**2))), (float(s.min()), float(s.max())), *enough
    )
