"""Where to go: corner points and speeds; and the smooth position and heading that come of them."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d

Array = npt.NDArray[np.float64]

STEP_S = 0.01
"""Step of the grid on which a route is laid out [s]."""


@dataclass(frozen=True, slots=True)
class Route:
    """Corner points and how to go through them.

    Attributes
    ----------
    points_m : tuple of (east, north, up)
        The first is where it starts; after the last it goes on with `loop_from`.
    speed_m_s : float
    loop_from : int
        Index of the point that follows the last one; -1: it stays at the last point.
    hold_s : float
        Standing still at the first point, so that the start is gentle [s].
    smooth_s : float
        One sigma of the smoothing of positions [s]: corners become turns, starts become gentle.
    heading_deg : float or None
        A fixed heading; None: along the course.
    kind : str
        copter: leans into its acceleration. car: stays level on its springs. tripod: does not move at all.
    """

    points_m: tuple[tuple[float, float, float], ...]
    speed_m_s: float = 4.0
    loop_from: int = 1
    hold_s: float = 3.0
    smooth_s: float = 1.0
    heading_deg: float | None = None
    kind: str = "copter"


def eights(
    first_m: tuple[float, float], second_m: tuple[float, float], radius_m: float, heights_m: tuple[float, float]
) -> tuple[tuple[float, float, float], ...]:
    """Corner points of a figure eight round two centres: one lobe to the left, the other to the right.

    Parameters
    ----------
    first_m, second_m : (east, north)
        Centres; the eight crosses itself half-way between them.
    radius_m : float
        Of the lobes.
    heights_m : (float, float)
        Lowest and highest; each is reached once in a lobe.
    """
    angle = np.arange(15.0, 360.0, 30.0)
    across = np.degrees(np.arctan2(second_m[1] - first_m[1], second_m[0] - first_m[0]))
    middle, swing = (heights_m[0] + heights_m[1]) / 2, (heights_m[1] - heights_m[0]) / 2
    points = []
    for centre, start, sense in ((first_m, across, -1.0), (second_m, across + 180.0, 1.0)):
        turn = np.radians(start + sense * angle)
        north, east = centre[1] + radius_m * np.sin(turn), centre[0] + radius_m * np.cos(turn)
        up = middle + swing * np.sin(np.radians(angle))
        points += list(zip(east.tolist(), north.tolist(), up.tolist(), strict=True))
    return tuple(points)


def _corners(route: Route, length_m: float) -> Array:
    """Points in the order of visiting, far enough for a length."""
    points = [np.array(p, np.float64) for p in route.points_m]
    order, total, following = [points[0]], 0.0, 1
    while total < length_m and len(points) > 1:
        if following >= len(points):
            if route.loop_from < 0:
                break
            following = route.loop_from
        total += float(np.linalg.norm(points[following] - order[-1]))
        order.append(points[following])
        following += 1
    return np.array(order)


def lay_out(route: Route, duration_s: float) -> tuple[Array, Array, Array]:
    """Smooth positions and headings on a regular grid.

    Returns
    -------
    time_s : ndarray, shape (n,)
        From some seconds before 0 to some after the duration, step `STEP_S`.
    position_m : ndarray, shape (n, 3)
    heading_rad : ndarray, shape (n,)
        Continuous: goes on beyond a full turn.
    """
    margin_s = 6.0 * route.smooth_s + 2.0
    time_s: Array = np.asarray(
        np.arange(-round(margin_s / STEP_S), round((duration_s + margin_s) / STEP_S) + 1) * STEP_S, np.float64
    )
    gone_m = np.clip(time_s - route.hold_s, 0.0, None) * route.speed_m_s
    corners = _corners(route, gone_m[-1] + 1.0)
    legs = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    at_m = np.concatenate([[0.0], np.cumsum(legs)])
    rough = np.stack([np.interp(gone_m, at_m, corners[:, axis]) for axis in range(3)], axis=1)
    sigma = route.smooth_s / STEP_S
    position_m = gaussian_filter1d(rough, sigma, axis=0, mode="nearest", truncate=6.0)
    if route.heading_deg is not None or len(corners) < 2:
        heading = np.full(len(time_s), np.radians(route.heading_deg or 0.0))
        return time_s, position_m, heading
    flat = np.diff(corners[:, :2], axis=0)
    moving = np.hypot(flat[:, 0], flat[:, 1]) > 1e-6
    course = np.arctan2(flat[:, 0], flat[:, 1])
    course = course[np.maximum.accumulate(np.where(moving, np.arange(len(course)), np.argmax(moving)))]
    leg = np.clip(np.searchsorted(at_m, gone_m, side="right") - 1, 0, len(course) - 1)
    heading = gaussian_filter1d(np.unwrap(course)[leg], 0.9 * sigma, mode="nearest", truncate=6.0)
    return time_s, position_m, heading
