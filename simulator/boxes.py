"""Boxes that move, and the rays that meet them: kernels."""

import numba as nb
import numpy as np
import numpy.typing as npt


@nb.njit(cache=True, nogil=True, inline="always")
def _passes(
    origin: npt.NDArray[np.float32],
    direction: npt.NDArray[np.float32],
    place: npt.NDArray[np.float64],
    sphere: npt.NDArray[np.float64],
    reach_m: float,
) -> bool:
    """Whether a beam, its footprint included, comes near a sphere that stands above a place."""
    x, y, z = place[0] - origin[0], place[1] - origin[1], place[2] + sphere[0] - origin[2]
    along = x * direction[0] + y * direction[1] + z * direction[2]
    away2 = x * x + y * y + z * z
    radius = sphere[1] + 0.011 * abs(along)  # half of the widest footprint there is
    return bool(-radius < along < reach_m + radius and away2 - along * along < radius * radius)


@nb.njit(cache=True, nogil=True, inline="always")
def _enter(
    o: npt.NDArray[np.float64], d: npt.NDArray[np.float64], box: npt.NDArray[np.float64], reach_m: float
) -> tuple[float, int]:
    """Distance at which a ray enters a box, and the axis of the face; -1 where it does not."""
    enter, leave, face = 0.0, reach_m, -1
    for axis in range(3):
        if abs(d[axis]) < 1e-12:
            if o[axis] < box[axis] or o[axis] > box[axis + 3]:
                return 0.0, -1
            continue
        one, two = (box[axis] - o[axis]) / d[axis], (box[axis + 3] - o[axis]) / d[axis]
        if min(one, two) > enter:
            enter, face = min(one, two), axis
        leave = min(leave, max(one, two))
    return (enter, face) if enter <= leave else (0.0, -1)


@nb.njit(cache=True, nogil=True, inline="always")
def _away(origin: npt.NDArray[np.float32], direction: npt.NDArray[np.float32], plane: npt.NDArray[np.float64]) -> float:
    """Distance to a plane along a ray."""
    top, slope = plane[3], 0.0
    for i in range(3):
        top -= plane[i] * np.float64(origin[i])
        slope += plane[i] * np.float64(direction[i])
    return top / slope if abs(slope) > 1e-9 else np.inf


@nb.njit(cache=True, nogil=True)
def _nearest(
    origin: npt.NDArray[np.float32],
    direction: npt.NDArray[np.float32],
    place: npt.NDArray[np.float64],
    boxes: npt.NDArray[np.float64],
    reach_m: float,
) -> tuple[float, int, int]:
    """Distance, box and axis of the face that a ray meets first of a thing at a place; box -1 for none."""
    o, d = np.empty(3), np.empty(3)
    sine, cosine = place[3], place[4]
    # heading turns clockwise: right is (cos, -sin), forward is (sin, cos)
    east, north = origin[0] - place[0], origin[1] - place[1]
    o[0], forward, o[2] = cosine * east - sine * north, sine * east + cosine * north, origin[2] - place[2]
    d[0] = cosine * direction[0] - sine * direction[1]
    d[1] = sine * direction[0] + cosine * direction[1]
    d[2] = direction[2]
    best_m, best, best_face = reach_m, -1, -1
    for b in range(len(boxes)):
        o[1] = forward - boxes[b, 6] * place[5]
        enter_m, face = _enter(o, d, boxes[b], reach_m)
        if face >= 0 and enter_m < best_m:
            best_m, best, best_face = enter_m, b, face
    return best_m, best, best_face


@nb.njit(cache=True, nogil=True)
def meet_boxes(
    firing: npt.NDArray[np.intp],
    rays: int,
    origins: npt.NDArray[np.float32],
    directions: npt.NDArray[np.float32],
    places: npt.NDArray[np.float64],
    near: npt.NDArray[np.intp],
    spheres: npt.NDArray[np.float64],
    first: npt.NDArray[np.int64],
    boxes: npt.NDArray[np.float64],
    opaque: npt.NDArray[np.int32],
    planes: npt.NDArray[np.float64],
    reach_m: float,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int32]]:
    """See `Traffic.meet`; places: east, north, up, sine and cosine of the heading, swing, shape (firings, things, 6)."""
    found, found_box = np.empty((len(origins), 4)), np.empty(len(origins), np.int32)
    count, triangles = 0, len(planes)
    for shot in range(len(firing)):
        for thing in near:
            place = places[firing[shot], thing]
            if not _passes(origins[shot * rays], directions[shot * rays], place, spheres[thing], reach_m):
                continue
            own = boxes[first[thing] : first[thing + 1]]
            for ray in range(shot * rays, (shot + 1) * rays):
                distance_m, box, face = _nearest(origins[ray], directions[ray], place, own, reach_m)
                if box < 0:
                    continue
                behind = opaque[ray]
                if behind >= 0:
                    plane = planes[behind] if behind < triangles else found[behind - triangles]
                    if _away(origins[ray], directions[ray], plane) < distance_m:
                        continue
                row = found[count]
                row[0] = place[4] if face == 0 else place[3] if face == 1 else 0.0
                row[1] = -place[3] if face == 0 else place[4] if face == 1 else 0.0
                row[2] = 1.0 if face == 2 else 0.0
                row[3] = 0.0
                for i in range(3):
                    row[3] += row[i] * (np.float64(origins[ray, i]) + distance_m * np.float64(directions[ray, i]))
                found_box[count] = first[thing] + box
                opaque[ray] = triangles + count
                count += 1
    return found[:count].copy(), found_box[:count].copy()
