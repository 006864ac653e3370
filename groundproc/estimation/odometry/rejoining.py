"""A path that was lost and comes back: what follows makes a map of its own, until its place on the old map is found.

While the lidar sees next to nothing, or nothing that observes the motion, inertial sensors carry the path, and after
some seconds it may be metres off. Planes metres away are not matched, or wrong ones are. So a new map begins there.
Once the lidar holds the path again, the place of the new map on the old one is sought (`relocation`), within the sigma
that the path then has, and again as the map grows. Two searches in a row have to agree. Then the new piece is laid on
the old map as a whole, both maps become one, and the error of the path is spread over the stretch between.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from flightlog import frames
from groundproc.estimation.odometry.grid import SLICE_NS
from groundproc.estimation.odometry.laying import Laid
from groundproc.estimation.odometry.matching import TELLS_M
from groundproc.estimation.odometry.odometry import Odometry
from groundproc.estimation.odometry.relocation import RADIUS_M, laid
from groundproc.estimation.odometry.slices import CLUSTER_DTYPE
from groundproc.estimation.odometry.state import GRAVITY, POSITION, ROTATION
from groundproc.estimation.odometry.surfaces import Surfaces, surfaces_of
from groundproc.estimation.odometry.track import Track
from groundproc.estimation.odometry.voxels import COUNT, MEAN, SCATTER, PlaneMap

Array = npt.NDArray[np.float64]

LOOSE: Final = 5
"""Slices on end that do not hold the path, after which it may have gone astray."""
FEWEST_SEEN: Final = 50
"""Clusters that find something in the map, below which a slice does not hold the path."""
SETTLED: Final = 5
"""Slices that hold the path by which a stretch that does not is over: fewer are a glint on water."""
WORTH: Final = 30
"""Slices that hold the path in a piece whose map is worth being sought: three seconds."""
ASTRAY_M: Final = 0.3
"""Sigma of a place beyond which the map's own planes may not be met any more."""
AGAIN: Final = 5
AGAIN_M: Final = 8.0
"""A new piece is sought after so many slices, and again when it is twice as old or has gone so far; after a find, so many slices later."""
ALIKE_M: Final = 0.3
"""Two searches agree that differ by no more, at the ends of what is compared."""
KEPT: Final = 3
"""Maps that are kept for a piece to be found on: the last ones."""
MERGED: Final = 10_000
"""Voxels that are put into a map at once."""


@dataclass(slots=True, eq=False)
class Before:
    """A map of before, not found again yet.

    Attributes
    ----------
    planes : PlaneMap
    begin, end : int
        First slice of the stretch after which the path may lie elsewhere, and first of the piece after it; as the watch counts them.
    sigma : ndarray, shape (4,)
        How well the place of what came after is known on it: east, north, up [m], heading [rad].
    found : Laid, optional
        Where the last search has it.
    """

    planes: PlaneMap
    begin: int
    end: int
    sigma: Array
    found: Laid | None = None


class Rejoining:
    """Watches a path, and joins its pieces.

    Parameters
    ----------
    in_time : bool
        Whether poses are stated as they come: what was flown before a piece is found then stays as it was stated.

    Attributes
    ----------
    lost : list of Before
        Maps that the present piece has not been found on.
    left : int
        Pieces that were given up.
    """

    def __init__(self, in_time: bool) -> None:
        self.lost: list[Before] = []
        self.left = 0
        self._in_time = in_time
        self._count, self._loose, self._held = 0, 0, 0
        self._tried_m, self._next = np.zeros(3), 0

    def note(self, odometry: Odometry, matched: int, next_unheld_m: float) -> None:
        """Count a slice by what it told: a new map begins where the path may have gone astray.

        Parameters
        ----------
        odometry : Odometry
            After the slice.
        matched : int
            Clusters that found something in the map.
        next_unheld_m : float
            Sigma of the direction that it told least of but one: a single missing direction is left to inertial sensors, along a street.
        """
        self._count += 1
        if matched >= FEWEST_SEEN and next_unheld_m <= TELLS_M:
            if self.lost and not self._held:
                self.lost[-1].end = self._count - 2
                self._tried_m, self._next = odometry.state.position_m.copy(), self._count + AGAIN
            self._held, self._loose = self._held + 1, 0
            return
        self._loose += 1
        if self.lost and self._held < SETTLED:
            self._held = 0
        now = _sigma(odometry)
        if self.lost and not self._held:
            # still on the way to where the lidar tells something again
            self.lost[-1].sigma = np.maximum(self.lost[-1].sigma, now)
        elif self._loose >= LOOSE and self._held >= WORTH and now[:3].max() > ASTRAY_M:
            begin = self._count - self._loose
            lost = [*self.lost, Before(odometry.planes, begin, self._count, now)]
            self.left += max(len(lost) - KEPT, 0)
            self.lost = lost[-KEPT:]
            odometry.planes = PlaneMap(odometry.voxel_m)
            self._held = 0

    def sigma(self) -> Array:
        """What attitude [rad] and place [m] of the present piece may be off besides what its own map says, shape (6,)."""
        out = np.zeros(6)
        if self.lost and self._held:
            out[2], out[3:] = self.lost[-1].sigma[3], self.lost[-1].sigma[:3]
        return out

    def forget(self) -> None:
        """The odometry begins anew elsewhere: nothing of before is sought any more."""
        self.left += len(self.lost)
        self.lost, self._loose, self._held = [], 0, 0

    def after(self, odometry: Odometry, track: Track) -> Laid | None:
        """Seek the present piece on the maps of before, where it is time to; the track and the filter are laid where it was found."""
        if not self.lost or not self._held:
            return None
        place = odometry.state.position_m
        far = float(np.linalg.norm(place - self._tried_m)) > AGAIN_M and self._held >= 2 * AGAIN
        if self._count < self._next and not far:
            return None
        self._tried_m = place.copy()
        mine = surfaces_of(odometry.planes, place, RADIUS_M)
        sigma = np.zeros(4)
        for before in reversed(self.lost):
            sigma = np.hypot(sigma, before.sigma)
            found = _sought(before, mine, place.copy(), sigma)
            if found is not None:
                self._join(before, found, odometry, track)
                return found
        age = self._count - self.lost[-1].end
        self._next = self._count + (AGAIN if any(each.found for each in self.lost) else max(age, AGAIN))
        return None

    def _join(self, before: Before, found: Laid, odometry: Odometry, track: Track) -> None:
        """Lay the present piece on a map, and go on with both as one."""
        moved = found.places(found.about_m[None])[0] - found.about_m
        track.rejoined.append(
            {
                "lost_s": SLICE_NS * 1e-9 * (before.end - before.begin),
                "again_after_s": SLICE_NS * 1e-9 * (self._count - before.end),
                "moved_m": float(np.linalg.norm(moved)),
                "turned_deg": float(np.rad2deg(Rotation.from_matrix(found.mat).magnitude())),
                "sigma_m": float(np.sqrt(np.diag(found.covariance)[3:].max())),
                "points": int(found.known.sum()),
                "on_surfaces": int(found.on.sum()),
                "surer_than_elsewhere": found.surer,
            }
        )
        laid_state(odometry, found)
        if not self._in_time:
            offset, stretch = len(track) - self._count, self.lost[-1]
            laid_track(track, stretch.begin + offset, stretch.end + offset, found)
        planes, odometry.planes = odometry.planes, before.planes
        if odometry.planes.voxel_m != odometry.voxel_m:
            odometry.planes = PlaneMap(odometry.voxel_m)
            merge(before.planes, odometry.planes)
        merge(planes, odometry.planes, found)
        # pieces between the two stay where they are
        number = self.lost.index(before)
        self.left += len(self.lost) - number - 1
        self.lost = self.lost[:number]
        for each in self.lost:
            each.found = None


def _sought(before: Before, mine: Surfaces, about_m: Array, sigma: Array) -> Laid | None:
    """Where a piece lies on a map, once two searches agree."""
    theirs = surfaces_of(before.planes, about_m, 2.0 * RADIUS_M)
    found, last = laid(mine, theirs, about_m, sigma), before.found
    before.found = found
    return found if found is not None and last is not None and found.off(last, 10.0) < ALIKE_M else None


def _sigma(odometry: Odometry) -> Array:
    """How well place [m] and heading [rad] are known on the map, shape (4,)."""
    spread, up = odometry.state.covariance, frames.mat_from_quat(odometry.state.quat[None])[0][2]
    variance = np.append(np.diag(spread[POSITION, POSITION]), up @ spread[ROTATION, ROTATION] @ up)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def laid_state(odometry: Odometry, found: Laid) -> None:
    """A filter on the axes of the map that it was found on."""
    state = odometry.state
    state.position_m[:] = found.places(state.position_m[None])[0]
    state.quat[:] = _turned(state.quat[None], found.mat)[0]
    state.velocity_m_s[:] = found.mat @ state.velocity_m_s
    state.gravity_m_s2[:] = found.mat @ state.gravity_m_s2
    into = np.eye(len(state.covariance))
    for part in (POSITION, slice(POSITION.stop, POSITION.stop + 3), GRAVITY):
        into[part, part] = found.mat
    state.covariance = into @ state.covariance @ into.T
    state.covariance[POSITION, POSITION] += found.covariance[3:, 3:]


def laid_track(track: Track, last: int, begin: int, found: Laid) -> None:
    """Poses and clusters of a piece from slice `begin` on laid as a whole, and what lies between it and slice `last` by its share."""
    span = max(begin - last, 1)
    turn = Rotation.from_matrix(found.mat)
    move = found.places(track.position_m[begin][None])[0] - track.position_m[begin]
    for k in range(last + 1, len(track.quat)):
        if k >= begin:
            mat = found.mat
            track.position_m[k] = found.places(track.position_m[k][None])[0]
        else:
            share = (k - last) / span
            mat = Rotation.from_rotvec(share * turn.as_rotvec()).as_matrix()
            # an error of velocity grows with time, one of force with its square
            track.position_m[k] = track.position_m[k] + share**2 * move
        track.quat[k] = _turned(track.quat[k][None], mat)[0]
    for k in range(last, len(track)):
        mat = found.mat if k >= begin else Rotation.from_rotvec((k - last) / span * turn.as_rotvec()).as_matrix()
        track.velocity_m_s[k] = mat @ track.velocity_m_s[k]
        quats = track.quats[k]
        if quats is not None:
            track.quats[k] = _turned(quats, mat)
        if k >= begin and len(track.clusters[k]):
            clusters = track.clusters[k].copy()
            clusters["scatter"] = turned_scatter(clusters["scatter"].astype(np.float64), mat)
            track.clusters[k] = clusters


def merge(planes: PlaneMap, into: PlaneMap, found: Laid | None = None) -> None:
    """Put a map into another, that it was found on."""
    rows = planes.voxels[: planes.count]
    clusters = np.zeros(len(rows), CLUSTER_DTYPE)
    clusters["count"] = rows[:, COUNT]
    place, scatter = rows[:, MEAN : MEAN + 3], rows[:, SCATTER : SCATTER + 6]
    clusters["scatter"] = scatter if found is None else turned_scatter(scatter, found.mat)
    place = place if found is None else found.places(place)
    for first in range(0, len(rows), MERGED):
        part = slice(first, first + MERGED)
        into.insert(place[part].copy(), clusters[part], Odometry.MOST)


def turned_scatter(scatter: Array, mat: Array) -> Array:
    """Second moments xx xy xz yy yz zz on turned axes, shape (n, 6)."""
    full = scatter[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    turned = mat @ full @ mat.T
    return np.asarray(turned.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]])


def _turned(quat: Array, mat: Array) -> Array:
    """Attitudes turned as a whole, shape (n, 4)."""
    turn = frames.quat_from_mat(mat[None])
    return np.asarray(frames.quat_multiply(np.repeat(turn, len(quat), axis=0), quat))
