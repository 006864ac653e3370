"""Cars that drive and people who walk through a scene: boxes, met by each ray where they are at that instant."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d

from flightlog.errors import UsageError
from simulator.boxes import meet_boxes
from simulator.chance import generator
from simulator.config import MovingOptions
from simulator.materials import INDEX

Array = npt.NDArray[np.float64]

_STEP_S: Final = 0.05
_STRIDE_HZ: Final = 0.9


@dataclass(frozen=True, slots=True)
class Tracks:
    """Ways that are open to moving things in a scene: closed polylines at the height of the ground, shape (n, 3) each."""

    cars: tuple[Array, ...] = ()
    people: tuple[Array, ...] = ()


def flat(x_m: Array, _: Array) -> Array:
    """Ground at height 0."""
    return np.zeros_like(x_m)


def over_ground(corners: Sequence[tuple[float, float]], height: Callable[[Array, Array], Array]) -> Array:
    """A closed way over the ground, shape (n, 3): points every 2 m between corners (east, north)."""
    points = []
    for start, end in zip(corners, [*corners[1:], corners[0]], strict=True):
        count = max(int(np.hypot(end[0] - start[0], end[1] - start[1]) / 2.0), 1)
        points.append(np.linspace(start, end, count, endpoint=False))
    x, y = np.concatenate(points).T
    return np.stack([x, y, height(x, y)], axis=1)


@dataclass(frozen=True, slots=True)
class _Kind:
    """What one sort of moving things is like.

    Attributes
    ----------
    boxes : ndarray, shape (b, 7)
        Lower and upper corner (right, forward, up from the middle of the ground below it), and how far it swings forward and back [m].
    material : tuple of str, length b
    speed_m_s : (float, float)
        Slowest and fastest.
    smooth_s : float
        One sigma of the smoothing of corners.
    """

    boxes: Array
    material: tuple[str, ...]
    speed_m_s: tuple[float, float]
    smooth_s: float


_CAR: Final = _Kind(
    np.array([[-0.85, -2.1, 0.25, 0.85, 2.1, 0.8, 0.0], [-0.75, -1.3, 0.8, 0.75, 0.9, 1.42, 0.0]]),
    ("car_paint", "car_paint"),
    (6.0, 9.0),
    0.7,
)
_PERSON: Final = _Kind(
    np.array(
        [
            [-0.17, -0.09, 0.0, -0.02, 0.09, 0.85, 0.22],
            [0.02, -0.09, 0.0, 0.17, 0.09, 0.85, -0.22],
            [-0.23, -0.13, 0.85, 0.23, 0.13, 1.48, 0.0],
            [-0.09, -0.11, 1.5, 0.09, 0.11, 1.75, 0.0],
        ]
    ),
    ("cloth", "cloth", "cloth", "cloth"),
    (1.1, 1.6),
    0.4,
)


@dataclass(frozen=True, slots=True)
class _Way:
    """One round of a track: position (east, north, up) and continuous heading on a grid of time, and where on it one is at time 0."""

    time_s: Array
    values: Array
    start_s: float

    @classmethod
    def along(cls, track: Array, speed_m_s: float, smooth_s: float, share: float) -> "_Way":
        closed = np.concatenate([track, track[:1]])
        at_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
        count = max(round(at_m[-1] / speed_m_s / _STEP_S), 8)
        gone_m = np.arange(count) * (at_m[-1] / count)
        rough = np.stack([np.interp(gone_m, at_m, closed[:, axis]) for axis in range(3)], axis=1)
        smooth = gaussian_filter1d(rough, smooth_s / _STEP_S, axis=0, mode="wrap")
        smooth = np.concatenate([smooth, smooth[:1]])
        ahead = np.roll(smooth[:-1], -1, axis=0) - np.roll(smooth[:-1], 1, axis=0)
        heading = np.unwrap(np.arctan2(ahead[:, 0], ahead[:, 1]))
        heading = np.append(heading, heading[-1] + (heading[0] - heading[-1] + np.pi) % (2 * np.pi) - np.pi)
        period_s = at_m[-1] / speed_m_s
        time_s = np.linspace(0.0, period_s, count + 1)
        return cls(time_s, np.concatenate([smooth, heading[:, None]], axis=1), share * period_s)

    def at(self, time_s: Array) -> Array:
        """East, north, up, heading at true times, shape (n, 4)."""
        phase = (time_s + self.start_s) % self.time_s[-1]
        return np.stack([np.interp(phase, self.time_s, column) for column in self.values.T], axis=1)


class Traffic:
    """All that moves in one simulation.

    Parameters
    ----------
    tracks : Tracks
        Of the scene.
    options : MovingOptions
    seed : int

    Raises
    ------
    UsageError
        The scene has no way for what is asked for.
    """

    def __init__(self, tracks: Tracks, options: MovingOptions, seed: int) -> None:
        self.names: list[str] = []
        self._ways: list[_Way] = []
        kinds: list[_Kind] = []
        for name, plural, count, ways, kind in (
            ("car", "cars", options.cars, tracks.cars, _CAR),
            ("person", "people", options.people, tracks.people, _PERSON),
        ):
            if count and not ways:
                raise UsageError(
                    f"moving: {plural}: {count} found, expected 0, because this scene has no way for {plural}"
                )
            self._ways += _spread(count, ways, kind, generator(seed, f"moving {plural}"))
            kinds += [kind] * count
            self.names += [f"moving {name} {i}" for i in range(count)]
        counts = [len(kind.boxes) for kind in kinds]
        self._boxes = np.concatenate([np.zeros((0, 7)), *(kind.boxes for kind in kinds)])
        self._first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        self._spheres = np.array([_sphere(kind.boxes) for kind in kinds]).reshape(-1, 2)
        self.owner = np.repeat(np.arange(len(kinds)), counts)
        """Which of `names` each box belongs to."""
        self.material = np.array([INDEX[m] for kind in kinds for m in kind.material], np.uint8)
        """Of each box."""

    def __len__(self) -> int:
        return len(self._ways)

    def poses(self, time_s: Array) -> Array:
        """East, north, up and heading of everything at true times, shape (n, things, 4)."""
        return np.stack([way.at(time_s) for way in self._ways], axis=1)

    def meet(
        self,
        time_s: Array,
        firing: npt.NDArray[np.intp],
        origins: npt.NDArray[np.float32],
        directions: npt.NDArray[np.float32],
        opaque: npt.NDArray[np.int32],
        planes: Array,
        reach_m: float,
    ) -> tuple[Array, npt.NDArray[np.int32]]:
        """Put moving things in the way of rays.

        Parameters
        ----------
        time_s : shape (n,)
            True times of the firings.
        firing : shape (shots,)
            Firing of each shot.
        origins, directions : shape (shots * rays, 3)
        opaque : shape (shots * rays,)
            Triangle that each ray meets; where a box is nearer, it becomes the number of triangles plus a row of what is returned.
        planes : shape (triangles, 4)
        reach_m : float
            Nothing beyond matters.

        Returns
        -------
        planes : ndarray, shape (k, 4)
            Plane of the face that is met, in the local frame at that instant.
        box : ndarray of int32, shape (k,)
        """
        if not len(origins):
            return np.zeros((0, 4)), np.zeros(0, np.int32)
        poses = self.poses(time_s)
        middle = origins[len(origins) // 2].astype(np.float64)
        # nothing here is longer than 5 m; half a piece of motion goes on top
        near = np.linalg.norm(poses[:, :, :3] - middle, axis=2).min(axis=0) < reach_m + 10.0
        # feet go to and fro by a fixed stride: they slip a little
        swing = np.sin(2 * np.pi * _STRIDE_HZ * time_s[:, None] + np.arange(len(self)))
        return meet_boxes(
            np.ascontiguousarray(firing),
            len(origins) // len(firing),
            origins,
            directions,
            np.concatenate(
                [poses[:, :, :3], np.sin(poses[:, :, 3:]), np.cos(poses[:, :, 3:]), swing[..., None]], axis=2
            ),
            np.flatnonzero(near),
            self._spheres,
            self._first,
            self._boxes,
            opaque,
            planes,
            reach_m,
        )


def _sphere(boxes: Array) -> tuple[float, float]:
    """Height of the centre of a sphere round all boxes, and its radius, the swing included."""
    corners = np.concatenate([boxes[:, :3], boxes[:, 3:6]])
    middle = float(corners[:, 2].mean())
    reach = np.abs(corners) + np.abs(np.tile(boxes[:, 6:], (2, 1))) * [0, 1, 0]
    reach[:, 2] = np.abs(corners[:, 2] - middle)
    return middle, float(np.linalg.norm(reach, axis=1).max())


def _spread(count: int, tracks: Sequence[Array], kind: _Kind, rng: np.random.Generator) -> list[_Way]:
    """Things in turn on each track, at even distances and one speed there, so that none runs into another."""
    ways: list[_Way] = []
    speeds = rng.uniform(*kind.speed_m_s, len(tracks))
    starts = rng.random(len(tracks))
    for i in range(count):
        track = i % len(tracks)
        there = -(-(count - track) // len(tracks))
        share = (starts[track] + (i // len(tracks)) / there) % 1.0
        ways.append(_Way.along(tracks[track], float(speeds[track]), kind.smooth_s, float(share)))
    return ways
