"""Conductors from attachment to attachment, of chains of points."""

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from groundproc.analysis.corridor.catenary import Catenary, fitted
from groundproc.analysis.corridor.poles import Pole

Array = npt.NDArray[np.float64]

FEWEST: Final = 10
"""Points of a conductor."""
SHORTEST_M: Final = 10.0
_LEAST_PIECE: Final = 6
_LEAST_PIECE_M: Final = 5.0
_ROUGH_M: Final = 0.064
"""A chain that deviates by more from one curve may be of two spans ..."""
_BETTER: Final = 3.0
"""... and is, if two curves leave so much less of its squares."""
_TRIALS: Final = 40
_KINK_M: Final = 0.5
"""How well the place of a kink is looked for."""
_DRAWS: Final = 300
_DRAW_M: Final = 30.0
_ON_M: Final = 0.12
_PROMISING: Final = 0.5
_GROWTHS: Final = 6
_SHARP: Final = 0.14
"""Angle [rad] at which points of 3 cm tell the place of a bend better than a pole does."""
_BEYOND_M: Final = 3.0
_TELLING: Final = 0.03
"""Angle [rad] at which the bend tells one pole from another some metres away."""
_ON_POLE_M: Final = 0.3
"""A wire that runs so near to the axis of a pole hangs on it, and not where it crosses another one."""
_RIVAL_M: Final = 3.0
"""Poles that stand nearer to each other along a wire are told apart by what they bear."""
_MIXED_M: Final = (0.1, 0.15)
"""Beyond a bend points of the other wire are taken so far, and as far as they are on both by the sine of the bend."""
_SETTLING: Final = 4
_OWN_M: Final = 0.25
"""Points farther from all curves are of none."""
_NEXT_M: Final = 0.5
"""A curve takes points so far beyond its ends: further on it meets others of its bundle."""
SAME_M: Final = 0.1
"""Curves nearer to each other are one."""
_WORST_M: Final = 0.12
_UNBROKEN_M: Final = 10.0
_JOIN_M: Final = 40.0
"""Gap that a conductor may have."""
_COVERED: Final = 0.5
_BIN_M: Final = 5.0


class _Joint(NamedTuple):
    """A piece that continues another: the gap between them, its number, and the curve of both."""

    gap_m: float
    number: int
    both: Catenary


class _Meeting(NamedTuple):
    """Where the curve of the next span meets that of a wire, how far that is beyond the ends of both, and the angle between them."""

    s_m: float
    beyond_m: float
    turn: float


class _Bearer(NamedTuple):
    """A pole that may bear an end: how far it is along the wire from about where it hangs, its number, its place along it and beside it."""

    away_m: float
    number: int
    s_m: float
    aside_m: float


def conductors(chains: Sequence[Array]) -> list[Catenary]:
    """Wires, one for each conductor and span, from the first of its points to the last.

    Parameters
    ----------
    chains : sequence of ndarray, shape (n, 3)
    """
    pieces = [part for chain in chains for part in cut(chain)]
    whole = settled(joined(pieces))
    return [wire for wire, points in zip(map(fitted, whole), whole, strict=True) if _sound(wire, points)]


def cut(points_m: Array, depth: int = 0) -> list[Array]:
    """A chain in pieces that are one curve each: at a support the curve has a kink, and there two conductors may be joined."""
    if len(points_m) < _LEAST_PIECE:
        return []
    whole = fitted(points_m)
    if depth > 30 or whole.rms_m < _ROUGH_M or whole.length_m < 2.0 * _LEAST_PIECE_M:
        return [points_m]
    s, _, _ = whole.local(points_m)
    order = np.argsort(s)
    points_m, s = points_m[order], s[order]
    place, best = _kink(points_m, s)
    if place and best * _BETTER < _misfit(points_m):
        return cut(points_m[:place], depth + 1) + cut(points_m[place:], depth + 1)
    on = _unbroken(s, _one_of(points_m))
    if _LEAST_PIECE <= on.sum() < len(points_m):
        return cut(points_m[on], depth + 1) + cut(points_m[~on], depth + 1)
    return [points_m]


def _kink(points_m: Array, s: Array) -> tuple[int, float]:
    """Where two curves fit points in order along them best, as the number of the first of the second, and what squares are left then."""
    best, place, where = np.inf, 0, 0.5 * (s[0] + s[-1])
    low, high = s[0] + _LEAST_PIECE_M, s[-1] - _LEAST_PIECE_M
    while True:
        for at in np.linspace(low, high, _TRIALS):
            k = int(np.searchsorted(s, at))
            if _LEAST_PIECE <= k <= len(s) - _LEAST_PIECE:
                cost = _misfit(points_m[:k]) + _misfit(points_m[k:])
                if cost < best:
                    best, place, where = cost, k, at
        step = (high - low) / (_TRIALS - 1)
        if step < _KINK_M:
            return place, best
        low, high = max(where - step, s[0] + _LEAST_PIECE_M), min(where + step, s[-1] - _LEAST_PIECE_M)


def _unbroken(s: Array, on: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Of some points in order the most that have no gap: a wide curve may touch the lowest points of two spans."""
    some = np.flatnonzero(on)
    if not len(some):
        return on
    runs = np.split(some, np.flatnonzero(np.diff(s[some]) > _UNBROKEN_M) + 1)
    chosen = np.zeros_like(on)
    chosen[max(runs, key=len)] = True
    return chosen


def _one_of(points_m: Array) -> npt.NDArray[np.bool_]:
    """Points of the one curve that most of a bundle are on (RANSAC, always by the same chances)."""
    rng = np.random.default_rng(len(points_m))
    best = np.zeros(len(points_m))
    for _ in range(_DRAWS):
        start = int(rng.integers(len(points_m)))
        near = np.flatnonzero(np.hypot(*(points_m[:, :2] - points_m[start, :2]).T) < _DRAW_M)
        three = points_m[rng.choice(near, 3)]
        d = three[2, :2] - three[0, :2]
        length = float(np.hypot(*d))
        if length < _LEAST_PIECE_M:
            continue
        d /= length
        u = (three[:, :2] - three[0, :2]) @ d
        if np.diff(np.sort(u)).min() < 1.0:
            continue
        bend = np.polyfit(u, three[:, 2], 2)
        if bend[0] <= -1e-3:
            continue
        on = _nearness(points_m, three[0, :2], d, bend)
        if on.sum() > _PROMISING * best.sum():
            on = _grown(points_m, on)
            if on.sum() > best.sum():
                best = on
    return np.asarray(best > 0.0)


def _nearness(points_m: Array, origin: Array, way: Array, bend: Array) -> Array:
    """1 on a parabola above a line in plan, falling to 0 where a point is of another curve: one that drifts from wire to wire has less."""
    v = points_m[:, :2] - origin
    off, up = v @ np.array([-way[1], way[0]]), points_m[:, 2] - np.polyval(bend, v @ way)
    return np.asarray(np.maximum(1.0 - (off**2 + up**2) / _ON_M**2, 0.0))


def _grown(points_m: Array, on: Array) -> Array:
    """What lies on the curve through some points, again and again: three of them do not tell it far from themselves."""
    for _ in range(_GROWTHS):
        some = points_m[on > 0.0]
        if len(some) < _LEAST_PIECE:
            return on
        origin = some.mean(axis=0)[:2]
        d = some[:, :2] - origin
        way = np.linalg.eigh(d.T @ d)[1][:, 1]
        more = _nearness(points_m, origin, way, np.polyfit(d @ way, some[:, 2], 2))
        if more.sum() <= on.sum():
            break
        on = more
    return on


def _misfit(points_m: Array) -> float:
    """Sum of squares off a line in plan and a parabola above it, large ones counted less."""
    middle = points_m.mean(axis=0)
    d = points_m - middle
    _, vectors = np.linalg.eigh(d[:, :2].T @ d[:, :2])
    s, off = d[:, :2] @ vectors[:, 1], d[:, :2] @ vectors[:, 0]
    design = np.stack([np.ones_like(s), s, s * s], axis=1)
    up = d[:, 2] - design @ np.linalg.lstsq(design, d[:, 2], rcond=None)[0]
    return float(np.minimum(off**2 + up**2, 0.25).sum())


def joined(pieces: Sequence[Array]) -> list[Array]:
    """Pieces of one conductor put together, where no point was met for some metres between them."""
    left = sorted((each for each in pieces if len(each) >= _LEAST_PIECE), key=len, reverse=True)
    curves = [fitted(each) for each in left]
    boxes = np.array([box_of(each) for each in left]).reshape(-1, 4)
    out = []
    while left:
        points, curve, boxes = left.pop(0), curves.pop(0), boxes[1:]
        # the nearest first: with one of the next span, beyond a piece of its own, a wire may seem to be one wide curve
        while found := min(_continuing(points, curve, left, curves, boxes), key=lambda each: each.gap_m, default=None):
            points, curve = np.concatenate([points, left.pop(found.number)]), found.both
            curves.pop(found.number)
            boxes = np.delete(boxes, found.number, axis=0)
        out.append(points)
    return out


def _continuing(
    points: Array, curve: Catenary, left: list[Array], curves: list[Catenary], boxes: Array
) -> Iterator[_Joint]:
    """The pieces that are of one curve with another."""
    for number in touching(boxes, box_of(points), 2.0 * _JOIN_M).tolist():
        others, other = left[number], curves[number]
        s, off, up = curve.local(others)
        gap = max(s.min() - curve.end_m, curve.start_m - s.max())
        if gap > _JOIN_M:
            continue
        if np.median(np.abs(off)) > 0.4 + 0.01 * gap or np.median(np.abs(up)) > 0.6 + 0.04 * max(gap, 0.0):
            continue
        both = fitted(np.concatenate([points, others]))
        beside = gap < -1.0 - 0.1 * other.length_m
        if beside and max(np.median(_apart(both, each)) for each in (points, others)) > SAME_M:
            continue
        if both.rms_m < 1.3 * max(curve.rms_m, other.rms_m, 0.032):
            yield _Joint(gap, number, both)


def settled(pieces: Sequence[Array]) -> list[Array]:
    """Each point with the curve that it is nearest to: where pieces were cut, and where they hang beside each other, some are with another.

    Curves that lie on each other become one.
    """
    whole = sorted((each for each in pieces if len(each) >= _LEAST_PIECE), key=len, reverse=True)
    for _ in range(_SETTLING):
        curves, boxes = list[Catenary](), np.empty((len(whole), 4))
        for curve, points in zip(map(fitted, whole), whole, strict=True):
            near = touching(boxes[: len(curves)], box_of(points), SAME_M)
            if not any(np.median(_apart(curves[n], points)) < SAME_M for n in near):
                boxes[len(curves)] = box_of(curve.along_plan(_beyond_m(curve)))
                curves.append(curve)
        if not curves:
            return []
        whole = _shared(curves, boxes, np.concatenate(whole))
        whole = sorted((each for each in whole if len(each) >= _LEAST_PIECE), key=len, reverse=True)
    return whole


def _shared(curves: Sequence[Catenary], boxes: Array, pool: Array) -> list[Array]:
    """Points by the curve that each is nearest to; those of none are left out."""
    order = np.argsort(pool[:, 0], kind="stable")
    east = pool[order, 0]
    best, nearest = np.full(len(pool), _OWN_M), np.full(len(pool), -1)
    for number, (curve, (west, south, east_end, north)) in enumerate(zip(curves, boxes.tolist(), strict=False)):
        some = order[np.searchsorted(east, west - _OWN_M) : np.searchsorted(east, east_end + _OWN_M, "right")]
        some = some[(pool[some, 1] >= south - _OWN_M) & (pool[some, 1] <= north + _OWN_M)]
        apart = _apart(curve, pool[some])
        nearer = apart < best[some]
        best[some[nearer]], nearest[some[nearer]] = apart[nearer], number
    order = np.argsort(nearest, kind="stable")
    return np.split(pool[order], np.searchsorted(nearest[order], np.arange(len(curves) + 1)))[1:-1]


def box_of(places_m: Array) -> Array:
    """West, south, east and north of places."""
    return np.concatenate([places_m[:, :2].min(axis=0), places_m[:, :2].max(axis=0)])


def touching(boxes: Array, box: Array, within_m: float) -> npt.NDArray[np.int64]:
    """Numbers of the boxes, shape (n, 4), that come so near to one: a line of many spans is looked at span by span."""
    near = (boxes[:, :2] <= box[2:] + within_m).all(axis=1) & (boxes[:, 2:] >= box[:2] - within_m).all(axis=1)
    return np.flatnonzero(near)


def _beyond_m(wire: Catenary) -> float:
    """How far beyond its ends a curve takes points."""
    return _NEXT_M + 2.0 * wire.length_m / wire.points


def _apart(wire: Catenary, points_m: Array) -> Array:
    """Distances of points from a curve, across it; beyond its ends infinite."""
    s, off, up = wire.local(points_m)
    reach = _beyond_m(wire)
    return np.where((s > wire.start_m - reach) & (s < wire.end_m + reach), np.hypot(off, up), np.inf)


def _sound(wire: Catenary, points_m: Array) -> bool:
    """Long, thin and without a gap over most of its length."""
    if len(points_m) < FEWEST or wire.length_m < SHORTEST_M or wire.rms_m > _WORST_M:
        return False
    s, _, _ = wire.local(points_m)
    bins = np.unique(np.floor((s - wire.start_m) / _BIN_M))
    slope = np.abs(np.diff(wire.height(np.array([wire.start_m, wire.end_m])))[0]) / wire.length_m
    return bool(len(bins) >= _COVERED * wire.length_m / _BIN_M and slope < 1.0)


def attached(wires: Sequence[Catenary], poles: Sequence[Pole]) -> list[Catenary]:
    """Wires as far as where they hang: at a pole beside the end, or where the next span's curve meets its own."""
    ends = [(wire, end, sign) for wire in wires for end, sign in ((wire.start_m, -1.0), (wire.end_m, 1.0))]
    tips = np.array([each.places(1e9) for each in wires]).reshape(-1, 2, 3)
    meetings = [_at_wire(wire, end, sign, wires, tips) for wire, end, sign in ends]
    feet = np.array([(each.x, each.y, each.foot_m) for each in poles]).reshape(-1, 3)
    beside = [
        _beside(wire, end, poles, feet, end if met is None or met.turn < _TELLING else met.s_m)
        for (wire, end, _), met in zip(ends, meetings, strict=True)
    ]
    carried = Counter(min(each).number for each in beside if each)
    found = []
    for (_, end, _), met, each in zip(ends, meetings, beside, strict=True):
        pole = _support(each, carried)
        # at a bend the arms lean, and wires do not end where the pole is
        sharp = met is not None and met.turn > _SHARP and met.beyond_m < _BEYOND_M
        arm = pole is None or pole.aside_m > _ON_POLE_M
        if met is not None and arm and (sharp or pole is None):
            found.append(met.s_m)
        else:
            found.append(end if pole is None else pole.s_m)
    return [
        wire.between(min(start, wire.middle_of - 1.0), max(end, wire.middle_of + 1.0))
        for wire, start, end in zip(wires, found[::2], found[1::2], strict=True)
    ]


def _reach_m(wire: Catenary) -> float:
    """How far from its last point a wire may hang."""
    return 3.0 + 0.12 * wire.length_m


def _beside(wire: Catenary, end: float, poles: Sequence[Pole], feet: Array, about: float) -> list[_Bearer]:
    """Poles that may bear an end, of which it is known about where it hangs."""
    s, off, up = wire.local(feet)
    found = []
    for number in np.flatnonzero(np.abs(s - end) < _reach_m(wire)).tolist():
        pole, aside = poles[number], abs(float(off[number]))
        if aside <= pole.arm_m and -up[number] < pole.height_m + 2.5:
            found.append(_Bearer(abs(float(s[number]) - about), number, float(s[number]), aside))
    return found


def _support(beside: list[_Bearer], carried: Counter[int]) -> _Bearer | None:
    """Of poles near each other the one that most wires end at: a lamp post beside a line's pole may be nearer to one of them."""
    if not beside:
        return None
    some = [each for each in beside if each.away_m < min(beside).away_m + _RIVAL_M]
    return max(some, key=lambda each: (carried[each.number], -each.away_m))


def _at_wire(wire: Catenary, end: float, sign: float, wires: Sequence[Catenary], tips: Array) -> _Meeting | None:
    """Where another curve goes on: that whose own end is nearest, for those beside it in a bundle meet it too, further on.

    Neither goes on beyond that place: a drop from the same pole may cross a conductor in plan before both end.
    """
    reach = _reach_m(wire)
    here = np.append(wire.origin_m + end * wire.along, wire.height(np.array([end]))[0])
    found: _Meeting | None = None
    for number in np.flatnonzero(np.linalg.norm(tips - here, axis=2).min(axis=1) <= reach).tolist():
        other = wires[number]
        if other is wire:
            continue
        s = end + sign * np.linspace(-0.1 * reach, reach, 201)
        places = np.column_stack([wire.origin_m + s[:, None] * wire.along, wire.height(s)])
        along, off, up = other.local(places)
        apart = np.hypot(off, up)
        nearest = int(np.argmin(apart))
        beyond = min(abs(along[nearest] - other.start_m), abs(along[nearest] - other.end_m))
        cost = abs(s[nearest] - end) + float(beyond)
        if apart[nearest] < 0.3 and (found is None or cost < found.beyond_m):
            turn = np.arccos(min(abs(float(wire.tangent(s[nearest]) @ other.tangent(along[nearest]))), 1.0))
            # so far a wire is believed to go on that has points of the other one
            within = _MIXED_M[0] + _MIXED_M[1] / max(np.sin(turn), 1e-3)
            inside = min(along[nearest] - other.start_m, other.end_m - along[nearest])
            if turn > _SHARP and max(sign * (end - s[nearest]), inside) > within:
                continue
            found = _Meeting(float(s[nearest]), cost, float(turn))
    return found
