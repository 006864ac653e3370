"""Loops by slow drift: a path that comes back to a place metres beside where it saw it is laid on what it saw there.

The batch closes what lies within half a metre, since voxels do. A way that was held loosely for minutes, along a street or a bank without
satellites, comes back by metres beside itself, and nothing was ever lost. So each five seconds of the path are compared with what was seen
about there half a minute and longer before. Where both agree as they are, nothing is done. Elsewhere the place of the one on the other is
sought within what the path may have drifted by (`relocation`): a place is taken if it can be no other, and if the next five seconds say the
same. What the path is off is then spread over the way between, most of it where the lidar held it least. The batch does the rest.
"""

from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from flightlog import frames
from groundproc.estimation.observations.planes import places
from groundproc.estimation.odometry.grid import SLICE_NS, STEPS
from groundproc.estimation.odometry.laying import Flags, Laid, Target
from groundproc.estimation.odometry.odometry import Odometry
from groundproc.estimation.odometry.rejoining import ASTRAY_M
from groundproc.estimation.odometry.relocation import FEWEST_ON, LEAST_SHARE, RADIUS_M, SURER, laid, surer
from groundproc.estimation.odometry.spline import Path
from groundproc.estimation.odometry.surfaces import FILLED, GROUND, STANDING, Surfaces, surfaces_of, thinned
from groundproc.estimation.odometry.track import Track
from groundproc.estimation.odometry.voxels import PlaneMap

Array = npt.NDArray[np.float64]

PIECE: Final = 50
"""Slices that are compared as one."""
SINCE: Final = 300
"""Slices after which a place is seen again: half a minute."""
BESIDE: Final = 1
"""Pieces before and behind the nearest one that are compared with, and before the one that is laid."""
NEAR_M: Final = 40.0
"""A piece so near to one of before sees the same."""
DRIFT: Final = 0.005
"""Of the way between, what may be off besides the odometry's sigma, one sigma: it knows nothing of its own false planes."""
DRIFT_RAD_S: Final = np.deg2rad(0.01)
"""The same of the heading, by the second."""
ALIKE_M: Final = 0.3
"""Two searches agree that differ by no more, at the ends of what is compared."""
LEAST_M: Final = 0.2
"""What is less the batch closes by itself."""
MOST_LOOPS: Final = 8
HELD_M: Final = 0.002
"""Sigma of a slice's way where the lidar holds it; where it does not, `unheld_m` of the track, and a metre at most."""
EASED: Final = 10.0
"""Slices over which the way's correction sets in, one sigma: a jump in it would be one in velocity."""


@dataclass(slots=True)
class Loops:
    """What was found of a window.

    Attributes
    ----------
    path : Path
        Laid on itself.
    closed : list of dict
        Of each loop, for the report.
    apart : int
        Pieces that lie beside what was seen there before, and were not found on it.
    """

    path: Path
    closed: list[dict[str, float]] = field(default_factory=list)
    apart: int = 0


def closed_loops(path: Path, track: Track, first: int, last: int) -> Loops:
    """The path of slices `first` to `last` of a track, laid on itself where it comes back to a place."""
    loops = Loops(path)
    while len(loops.closed) < MOST_LOOPS:
        pieces = _Pieces(loops.path, track, first, last)
        loops.apart = 0
        found = pieces.loop(loops)
        if found is None:
            break
        seen, begin, place = found
        shares = _shares(np.array(track.unheld_m[first:last]), seen * PIECE, begin * PIECE)
        loops.path = bent(loops.path, shares, seen * PIECE, begin * PIECE, place)
        loops.closed.append(_told(place, seen, begin))
    return loops


class _Pieces:
    """Five seconds of a path each, with what they hold."""

    def __init__(self, path: Path, track: Track, first: int, last: int) -> None:
        self.count = (last - first) // PIECE
        self.middle_m = path.position_m[:: PIECE * STEPS][: self.count] * 0.5
        self.middle_m = self.middle_m + 0.5 * path.position_m[PIECE * STEPS :: PIECE * STEPS][: self.count]
        self._path, self._track, self._first = path, track, first
        self._made: dict[int, Surfaces] = {}
        step_m = np.linalg.norm(np.diff(path.position_m[::STEPS], axis=0), axis=1)
        self._way_m = np.append(0.0, np.cumsum(step_m))[::PIECE]
        sigma = track.sigma[first:last]
        self._sigma = np.column_stack([sigma[:, 3:6], sigma[:, :3].max(axis=1)])[PIECE // 2 :: PIECE]

    def surfaces(self, number: int) -> Surfaces:
        """What a piece saw, on the axes of the path."""
        if number not in self._made:
            begin = self._first + number * PIECE
            planes = PlaneMap(self._track.voxel_m)
            world = places(self._track.gathered(begin, begin + PIECE), self._path)
            at = 0
            for clusters in self._track.clusters[begin : begin + PIECE]:
                if len(clusters):
                    planes.insert(np.ascontiguousarray(world[at : at + len(clusters)]), clusters, Odometry.MOST)
                at += len(clusters)
            self._made[number] = surfaces_of(planes, self.middle_m[number], RADIUS_M)
        return self._made[number]

    def several(self, first: int, last: int) -> Surfaces:
        """What pieces `first` to `last` saw, both included."""
        parts = [self.surfaces(number) for number in range(max(first, 0), min(last, self.count - 1) + 1)]
        return Surfaces(
            *(np.concatenate([getattr(each, name) for each in parts]) for name in ("place_m", "normal", "kind"))
        )

    def loop(self, loops: Loops) -> tuple[int, int, Laid] | None:
        """The first loop that is not closed: the piece that saw the place before, the one that comes back, and where that lies."""
        last: tuple[int, Laid] | None = None
        for number in range(SINCE // PIECE, self.count):
            seen = self._seen(number)
            if seen is None:
                continue
            mine, theirs = self.several(number - BESIDE, number), self.several(seen - BESIDE, seen + BESIDE)
            # plain walls agree however far along them the path is off: where the odometry knows that it may be, that is no proof
            unsure = self._grown(seen, number)[:3].max() > ASTRAY_M
            as_it_is = _apart(mine, theirs, self.middle_m[number], LEAST_SHARE if not unsure else np.inf)
            if as_it_is is None:
                last = None
                continue
            found = laid(mine, theirs, self.middle_m[number], self._drift(seen, number))
            if found is not None and _is_better(found, as_it_is):
                if last is not None and last[0] == number - 1 and found.off(last[1], 10.0) < ALIKE_M:
                    return seen, number - 1, found
                last = number, found
            else:
                loops.apart += found is None
                last = None
        return None

    def _seen(self, number: int) -> int | None:
        """The piece nearest to one, of those that are long before it; None where all are far off."""
        before = number - SINCE // PIECE + 1
        away = np.linalg.norm(self.middle_m[:before] - self.middle_m[number], axis=1)
        best = int(away.argmin())
        return best if away[best] < NEAR_M + self._drift(best, number)[:2].max() else None

    def _grown(self, seen: int, number: int) -> Array:
        """What of it the odometry states itself."""
        return np.asarray(np.maximum(self._sigma[number], self._sigma[seen]))

    def _drift(self, seen: int, number: int) -> Array:
        """Sigma of east, north, up [m] and heading [rad] of one piece against another."""
        own = DRIFT * (self._way_m[number] - self._way_m[seen])
        turned = DRIFT_RAD_S * (number - seen) * PIECE * SLICE_NS * 1e-9
        return np.asarray(np.hypot(self._grown(seen, number), np.array([own, own, own, turned])))


def _apart(mine: Surfaces, theirs: Surfaces, about_m: Array, enough: float) -> Flags | None:
    """Which points of what stands lie on surfaces as it is; None where such a share of them does, or where too little is seen to say."""
    mine = thinned(mine.near(about_m, RADIUS_M))
    if min((mine.kind != GROUND).sum(), np.isin(theirs.kind, (STANDING, FILLED)).sum()) < FEWEST_ON:
        return None
    on, known = Target(theirs).agreement(mine)
    return None if known.sum() < FEWEST_ON or on.sum() >= enough * known.sum() else on


def _is_better(found: Laid, as_it_is: Flags) -> bool:
    """Whether a place is another one, and far more points speak for it than for that where it lies."""
    stays = replace(found, mat=np.eye(3), shift_m=np.zeros(3))
    return found.off(stays, 10.0) > LEAST_M and surer(found.on, as_it_is) > SURER


def _shares(unheld_m: Array, seen: int, begin: int) -> Array:
    """How much of what a loop is off belongs before each slice boundary, shape (slices + 1,): none to where it was seen, all from there."""
    variance = np.square(np.clip(np.nan_to_num(unheld_m, nan=1.0, posinf=1.0), HELD_M, 1.0))
    variance[: seen + PIECE], variance[begin:] = 0.0, 0.0
    eased = gaussian_filter1d(variance, EASED, mode="constant")
    eased[: seen + PIECE // 2], eased[begin:] = 0.0, 0.0
    grown = np.append(0.0, np.cumsum(eased))
    return np.asarray(grown / grown[-1])


def bent(path: Path, shares: Array, seen: int, begin: int, place: Laid) -> Path:
    """A path whose slices from `begin` on are laid elsewhere as a whole, what lies between them and slice `seen` by its share."""
    share = np.interp(np.arange(len(path.quat)) / STEPS, np.arange(len(shares)), shares)
    turns = Rotation.from_matrix(place.mat).as_rotvec()[None] * share[:, None]
    quat = frames.quat_multiply(frames.quat_exp(turns), path.quat)
    mats = frames.mat_from_quat(frames.quat_exp(turns))
    steps = np.einsum("nij,nj->ni", mats[:-1], np.diff(path.position_m, axis=0))
    way = path.position_m[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    at = begin * STEPS
    way = way + share[:, None] * (place.places(path.position_m[at][None])[0] - way[at])
    return replace(path, quat=quat, position_m=way)


def _told(place: Laid, seen: int, begin: int) -> dict[str, Any]:
    moved = place.places(place.about_m[None])[0] - place.about_m
    second = PIECE * SLICE_NS * 1e-9
    return {
        "seen_s": second * seen,
        "again_s": second * begin,
        "moved_m": float(np.linalg.norm(moved)),
        "turned_deg": float(np.rad2deg(Rotation.from_matrix(place.mat).magnitude())),
        "sigma_m": float(np.sqrt(np.diag(place.covariance)[3:].max())),
        "points": int(place.known.sum()),
        "on_surfaces": int(place.on.sum()),
        "surer_than_elsewhere": place.surer,
    }
