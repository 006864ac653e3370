"""From what the parts of a beam meet to the echoes that the sensor sees.

A beam has a footprint: it is cast as several rays, one in the middle and six on a ring whose radius gives them the second moment
of a uniform disc. What they meet within 0.6 m of each other makes one echo in between, weighted by strength (FOI-R--4045--SE,
appendix B: two surfaces are told apart from 0.6 m, a pulse of 4 ns); more makes several.
"""

from typing import Any, Final

import numba as nb
import numpy as np
import numpy.typing as npt

RAYS: Final = 7
SEPARATION_M: Final = 0.6
RING: Final = 0.5 * np.sqrt(7.0 / 12.0)
"""Radius of the ring in parts of the footprint's diameter: 6/7 of the light there give the disc's second moment, diameter^2 / 8."""
_GOLDEN: Final = 2.399963229728653

RANGE, STRENGTH, TRIANGLE, MIXED = range(4)
"""Columns of an echo: distance along the beam [m], 0 for none; reflectance as seen, the share of the footprint included; triangle
that gives most of it; 1 where something more than 3 cm off that triangle's plane takes part."""
STRONGEST, SECOND, LAST = range(3)
_OFF_PLANE_M: Final = 0.03


@nb.njit(cache=True, nogil=True)
def aim(
    position_m: npt.NDArray[np.float64],
    mat_local_lidar: npt.NDArray[np.float64],
    azimuth_rad: npt.NDArray[np.float64],
    elevation_rad: npt.NDArray[np.float64],
    laser_share: float,
    footprint_rad: float,
    first_shot: int,
    open_shots: npt.NDArray[np.bool_],
    rays: int,
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Origins and directions of the rays of all open shots, shape (shots * rays, 3) each.

    Parameters
    ----------
    position_m, mat_local_lidar, azimuth_rad : shape (n + 1, 3), (n + 1, 3, 3), (n + 1,)
        Of the lidar and its rotor at the start of each firing and the one after; in between they go straight.
    elevation_rad : shape (32,)
    laser_share : float
        From one laser to the next in parts of a firing.
    footprint_rad : float
        Full divergence.
    first_shot : int
        Running number of the first shot; turns the ring from shot to shot.
    open_shots : shape (n, 32)
        Which shots leave the airframe.
    rays : int
        1 (a line) or RAYS.
    """
    count = 0
    for n in range(open_shots.shape[0]):
        for k in range(open_shots.shape[1]):
            count += open_shots[n, k]
    origins = np.empty((count * rays, 3), np.float32)
    directions = np.empty((count * rays, 3), np.float32)
    mat = np.empty((3, 3))
    at = 0
    for n in range(open_shots.shape[0]):
        for k in range(open_shots.shape[1]):
            if not open_shots[n, k]:
                continue
            share = k * laser_share
            mat[:] = (1.0 - share) * mat_local_lidar[n] + share * mat_local_lidar[n + 1]
            azimuth = (1.0 - share) * azimuth_rad[n] + share * azimuth_rad[n + 1]
            sa, ca = np.sin(azimuth), np.cos(azimuth)
            se, ce = np.sin(elevation_rad[k]), np.cos(elevation_rad[k])
            turn = ((first_shot + n * 32 + k) * _GOLDEN) % (2 * np.pi)
            for r in range(rays):
                across = up = 0.0
                if r > 0:
                    angle = turn + r * np.pi / 3
                    across = RING * footprint_rad * np.cos(angle)
                    up = RING * footprint_rad * np.sin(angle)
                # right = (ca, -sa, 0); upward = (-se sa, -se ca, ce)
                x = ce * sa + across * ca - up * se * sa
                y = ce * ca - across * sa - up * se * ca
                z = se + up * ce
                norm = np.sqrt(x * x + y * y + z * z)
                for i in range(3):
                    origins[at, i] = (1.0 - share) * position_m[n, i] + share * position_m[n + 1, i]
                    directions[at, i] = (mat[i, 0] * x + mat[i, 1] * y + mat[i, 2] * z) / norm
                at += 1
    return origins, directions


@nb.njit(cache=True, nogil=True, inline="always")
def _meet(
    origin: npt.NDArray[np.float32], direction: npt.NDArray[np.float32], plane: npt.NDArray[np.float64]
) -> tuple[float, float]:
    """Distance to a plane and cosine of the angle of incidence."""
    away = slope = 0.0
    for i in range(3):
        away += plane[i] * np.float64(origin[i])
        slope += plane[i] * np.float64(direction[i])
    if abs(slope) < 1e-9:
        return -1.0, 0.0
    return (plane[3] - away) / slope, abs(slope)


@nb.njit(cache=True, nogil=True, inline="always")
def _plane(planes: npt.NDArray[np.float64], moved: npt.NDArray[np.float64], index: int) -> npt.NDArray[np.float64]:
    """Plane of what a ray met: that of a triangle, or of something that moves."""
    met: npt.NDArray[np.float64] = planes[index] if index < len(planes) else moved[index - len(planes)]
    return met


@nb.njit(cache=True, nogil=True)
def form(
    origins: npt.NDArray[np.float32],
    directions: npt.NDArray[np.float32],
    opaque: npt.NDArray[np.int32],
    clear: npt.NDArray[np.int32],
    planes: npt.NDArray[np.float64],
    material: npt.NDArray[np.uint8],
    tables: npt.NDArray[np.float64],
    rays: int,
    flicker: npt.NDArray[np.float64],
    threshold: float,
    max_range_m: float,
    moved: npt.NDArray[np.float64],
    moved_material: npt.NDArray[np.uint8],
) -> npt.NDArray[np.float64]:
    """The strongest, the second strongest and the last echo of each shot, shape (shots, 3, 4): see STRONGEST and RANGE.

    Parameters
    ----------
    origins, directions : shape (shots * rays, 3)
    opaque, clear : shape (shots * rays,)
        Triangle that each ray meets, -1 for none; a pane counts where it is nearer. What moves counts on from the triangles.
    planes : shape (triangles, 4)
    material : shape (triangles,)
    tables : shape (3, materials)
        Reflectance, falloff, transmission.
    flicker : shape (shots, 2)
        Factor on the strength of a shot's first echo and of the others.
    threshold : float
        Least detectable strength divided by the squared range [1/m^2].
    max_range_m : float
    moved, moved_material : shape (k, 4), (k,)
        Planes and materials of what moves, each row at the instant of its ray.
    """
    shots = len(flicker)
    echoes = np.zeros((shots, 3, 4))
    met = np.empty((2 * rays, 2))
    who = np.empty((2 * rays, 2), np.int32)
    for shot in range(shots):
        count: Any = np.int64(0)  # of a constant's own type, what takes it would be compiled twice
        for ray in range(shot * rays, (shot + 1) * rays):
            light = 1.0 / rays
            hit_m, cosine = -1.0, 0.0
            if opaque[ray] >= 0:
                hit_m, cosine = _meet(origins[ray], directions[ray], _plane(planes, moved, opaque[ray]))
            if clear[ray] >= 0:
                pane_m, pane_cosine = _meet(origins[ray], directions[ray], planes[clear[ray]])
                if 0.0 < pane_m <= max_range_m and (opaque[ray] < 0 or pane_m < hit_m):
                    kind = material[clear[ray]]
                    met[count, 0] = pane_m
                    met[count, 1] = light * tables[0, kind] * pane_cosine ** tables[1, kind]
                    who[count, 0], who[count, 1] = clear[ray], ray
                    count += 1
                    light *= tables[2, kind] ** 2
            if 0.0 < hit_m <= max_range_m:
                hit = opaque[ray]
                kind = material[hit] if hit < len(material) else moved_material[hit - len(material)]
                met[count, 0] = hit_m
                met[count, 1] = light * tables[0, kind] * cosine ** tables[1, kind]
                who[count, 0], who[count, 1] = opaque[ray], ray
                count += 1
        if count:
            _cluster(echoes[shot], met, who, count, planes, moved, origins, directions, flicker[shot], threshold)
    return echoes


@nb.njit(cache=True, nogil=True)
def _sort(met: npt.NDArray[np.float64], who: npt.NDArray[np.int32], count: int) -> None:
    """Order the first `count` entries by distance, in place."""
    for i in range(1, count):
        distance, strength = met[i, 0], met[i, 1]
        triangle, ray = who[i, 0], who[i, 1]
        j = i - 1
        while j >= 0 and met[j, 0] > distance:
            met[j + 1, 0], met[j + 1, 1] = met[j, 0], met[j, 1]
            who[j + 1, 0], who[j + 1, 1] = who[j, 0], who[j, 1]
            j -= 1
        met[j + 1, 0], met[j + 1, 1] = distance, strength
        who[j + 1, 0], who[j + 1, 1] = triangle, ray


@nb.njit(cache=True, nogil=True)
def _cluster(
    echo: npt.NDArray[np.float64],
    met: npt.NDArray[np.float64],
    who: npt.NDArray[np.int32],
    count: int,
    planes: npt.NDArray[np.float64],
    moved: npt.NDArray[np.float64],
    origins: npt.NDArray[np.float32],
    directions: npt.NDArray[np.float32],
    flicker: npt.NDArray[np.float64],
    threshold: float,
) -> None:
    """Join what is nearer to its predecessor than the separation; keep the two strongest and the last that are detected."""
    _sort(met, who, count)
    best = second = 0.0
    start = 0
    while start < count:
        end, most = start + 1, start
        total, moment = met[start, 1], met[start, 1] * met[start, 0]
        while end < count and met[end, 0] - met[end - 1, 0] < SEPARATION_M:
            total += met[end, 1]
            moment += met[end, 1] * met[end, 0]
            if met[end, 1] > met[most, 1]:
                most = end
            end += 1
        mixed = 0.0
        plane = _plane(planes, moved, who[most, 0])
        for i in range(start, end):
            expected_m, _ = _meet(origins[who[i, 1]], directions[who[i, 1]], plane)
            if abs(expected_m - met[i, 0]) > _OFF_PLANE_M:
                mixed = 1.0
        seen = total * flicker[0 if start == 0 else 1]
        range_m = moment / total if total > 0 else met[most, 0]
        power = seen / (range_m * range_m)
        if power > threshold:
            echo[LAST, RANGE], echo[LAST, STRENGTH] = range_m, seen
            echo[LAST, TRIANGLE], echo[LAST, MIXED] = who[most, 0], mixed
            if power > best:
                echo[SECOND] = echo[STRONGEST]
                echo[STRONGEST] = echo[LAST]
                second, best = best, power
            elif power > second:
                echo[SECOND] = echo[LAST]
                second = power
        start = end
