"""A forward and a backward run over the same observations made into one solution, with sigmas that can be believed.

RTKLIB does this itself (its solution type "combined"), but weighs both runs as if they were independent. They rest on the same
observations: two fixes that agree are one fix, and two that do not agree are no better than their difference.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.constants import NS_PER_S
from groundproc.flight.positions.ellipsoid import ecef_from_geodetic, geodetic_from_ecef, mat_ecef_enu
from groundproc.flight.positions.solution import Quality, Solution

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

_SAME_EPOCH_NS: Final = 2_000_000
WITNESS_WINDOW_NS: Final = 10 * NS_PER_S
_JERK_M_S3: Final = 20.0
"""What a multirotor's acceleration changes by, at most [m/s^3]."""
_LONGEST_STEP_S: Final = 1.05
_DOUBLED: Final = 4.0
"""What doubles a sigma: code has multipath, which its sigma knows nothing of."""
_CHI2_999: Final = 16.266
"""99.9 % of the squared distance in three dimensions, in units of its covariance."""


@dataclass(frozen=True, slots=True)
class Combined:
    """One solution of two, and how often the two agreed.

    Attributes
    ----------
    solution : Solution
    agreed : int
        Epochs that both runs fixed to the same place.
    contradicted : int
        Epochs where fixes of the two, or a fix and the other's float, are not of one place.
    unsupported : int
        Fixes of one run that were too short to be believed alone.
    """

    solution: Solution
    agreed: int
    contradicted: int
    unsupported: int


def combined(forward: Solution, backward: Solution, shortest_fix_s: float) -> Combined:
    """Combine a forward and a backward solution, epoch by epoch.

    - Both fixed, at one place: their mean with the covariance of one; fixed.
    - Both fixed, at two places: the one whose run of fixes lasts at least `shortest_fix_s`, if the other's does not; else their mean with
      their difference as sigma, as float.
    - One fixed: that, if its run of fixes lasts and lies within what the other's float allows; else the float, its covariance grown by
      the difference where a lasting fix contradicts it.
    - Both float: weighted by their covariances, which are grown by as much as the two contradict each other.
    - Otherwise the better kind.

    Parameters
    ----------
    forward, backward : Solution
    shortest_fix_s : float
        A fix of one run alone must last this long [s], without a jump that its velocities do not explain: short ones are often wrong.
    """
    first, second = _pairs(forward, backward)
    alone = np.ones(len(backward), bool)
    alone[second] = False
    merged = _merge(
        forward.rows(first),
        backward.rows(second),
        _lasting(forward, shortest_fix_s)[first],
        _lasting(backward, shortest_fix_s)[second],
    )
    others = np.ones(len(forward), bool)
    others[first] = False
    parts = [merged.solution, forward.rows(others), backward.rows(alone)]
    return dataclasses.replace(merged, solution=_joined(parts))


def refuted(solution: Solution, witness: Solution) -> tuple[Solution, int]:
    """Carrier-phase positions that the code alone contradicts, put to where the code has them; and how many.

    A receiver that slips by whole cycles without noticing it leads a filter of carrier phases astray by tens of metres, with sigmas
    of a few. The code cannot drift: where the difference of the two, averaged over `WITNESS_WINDOW_NS`, is outside 99.9 % of what their
    covariances for one epoch allow, or that of one epoch is twice as far outside, or the filter itself knows less than the code, the
    position becomes the code's, with twice its sigma. Differences of less than some metres pass.

    Parameters
    ----------
    solution : Solution
    witness : Solution
        Of the same observations, from code alone, corrected by the base.
    """
    first, second = _pairs(solution, witness)
    if not len(first):
        return solution, 0
    ours, theirs = solution.rows(first), witness.rows(second)
    d = _towards(ours, theirs)
    c = ours.covariance_m2 + theirs.covariance_m2 + np.eye(3) * 1e-8
    begin = np.searchsorted(ours.time_ns, ours.time_ns - WITNESS_WINDOW_NS // 2)
    end = np.searchsorted(ours.time_ns, ours.time_ns + WITNESS_WINDOW_NS // 2, side="right")
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(d, axis=0)])
    mean = (total[end] - total[begin]) / (end - begin)[:, None]
    apart, at_once = (np.einsum("ni,ni->n", v, np.linalg.solve(c, v[..., None])[..., 0]) for v in (mean, d))
    lost = np.einsum("nii->n", ours.covariance_m2) > _DOUBLED * np.einsum("nii->n", theirs.covariance_m2)
    wrong = ((apart > _CHI2_999) | (at_once > _DOUBLED * _CHI2_999) | lost) & np.isin(
        ours.quality, (Quality.FIX, Quality.FLOAT)
    )
    if not wrong.any():
        return solution, 0
    changed = {name: getattr(solution, name).copy() for name in _REPLACED}
    for name, values in changed.items():
        values[first[wrong]] = getattr(theirs, name)[wrong]
    changed["covariance_m2"][first[wrong]] *= _DOUBLED
    changed["quality"][first[wrong]] = Quality.DGPS
    return dataclasses.replace(solution, **changed), int(wrong.sum())


_REPLACED: Final = ("latitude_deg", "longitude_deg", "height_m", "covariance_m2", "quality")


def _pairs(forward: Solution, backward: Solution) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Rows of both that are of one epoch."""
    place = np.clip(np.searchsorted(backward.time_ns, forward.time_ns), 1, max(len(backward) - 1, 1))
    before, after = place - 1, np.minimum(place, len(backward) - 1)
    step = np.abs(backward.time_ns[before] - forward.time_ns) <= np.abs(backward.time_ns[after] - forward.time_ns)
    nearest = np.where(step, before, after)
    near = np.abs(backward.time_ns[nearest] - forward.time_ns) <= _SAME_EPOCH_NS
    first = np.flatnonzero(near)
    second, kept = np.unique(nearest[near], return_index=True)
    return first[kept], second


def _lasting(solution: Solution, shortest_s: float) -> Mask:
    """Which rows belong to a run of fixes of at least this length, without a jump in it."""
    fixed = solution.quality == Quality.FIX
    begins = fixed & ~np.concatenate([[False], fixed[:-1] & ~_jumps(solution)])
    starts = np.flatnonzero(begins)
    found = np.zeros(len(fixed), bool)
    for start, limit in zip(starts, np.append(starts, len(fixed))[1:], strict=True):
        end = start + int(np.argmin(np.append(fixed[start:limit], False)))
        found[start:end] = solution.time_ns[end - 1] - solution.time_ns[start] >= shortest_s * NS_PER_S
    return found


def _jumps(solution: Solution) -> Mask:
    """Steps between rows, shape (n - 1,), that the velocities of both ends do not explain: other ambiguities.

    Velocities come from Doppler shifts, which know nothing of ambiguities. Steps of over `_LONGEST_STEP_S` cannot be judged.
    """
    none = np.zeros(max(len(solution) - 1, 0), bool)
    velocity, covariance = solution.velocity_m_s, solution.velocity_covariance_m2_s2
    if velocity is None or covariance is None or len(solution) < 2:
        return none
    step_s = np.diff(solution.time_ns)[:, None] / NS_PER_S
    way = _towards(solution.rows(slice(None, -1)), solution.rows(slice(1, None)))
    missed = way - 0.5 * (velocity[1:] + velocity[:-1]) * step_s
    # the mean of two velocities misses what a jerk does between them
    allowed = (_JERK_M_S3 * step_s**3 / 12) ** 2 + 1e-8
    c = solution.covariance_m2[1:] + solution.covariance_m2[:-1]
    c = c + 0.25 * step_s[:, :, None] ** 2 * (covariance[1:] + covariance[:-1]) + np.eye(3) * allowed[:, :, None]
    judged = (step_s[:, 0] <= _LONGEST_STEP_S) & np.isfinite(missed).all(axis=1) & np.isfinite(c).all(axis=(1, 2))
    none[judged] = (
        np.einsum("ni,ni->n", missed[judged], np.linalg.solve(c[judged], missed[judged][..., None])[..., 0]) > _CHI2_999
    )
    return none


def _merge(forward: Solution, backward: Solution, forward_lasts: Mask, backward_lasts: Mask) -> Combined:
    """Two solutions of the same epochs as one."""
    f, b, c, spread, apart = _differences(forward, backward)
    fix_f, fix_b = forward.quality == Quality.FIX, backward.quality == Quality.FIX
    float_f, float_b = forward.quality == Quality.FLOAT, backward.quality == Quality.FLOAT
    agree = apart <= _CHI2_999
    # how far the result lies from the forward position towards the backward one, its covariance and its kind
    n = len(forward)
    share = np.zeros((n, 3, 3))
    covariance, quality = f.copy(), forward.quality.copy()
    one, nothing = np.eye(3), np.zeros((3, 3))

    def put(rows: Mask, shares: Array, covariances: Array, kind: Quality) -> None:
        share[rows] = shares[rows] if shares.ndim == 3 else shares
        covariance[rows] = covariances[rows]
        quality[rows] = kind

    better_b = _rank(backward.quality) < _rank(forward.quality)
    share[better_b], covariance[better_b], quality[better_b] = one, b[better_b], backward.quality[better_b]

    both = fix_f & fix_b
    put(both & agree, 0.5 * one, 0.5 * (f + b), Quality.FIX)
    put(both & ~agree, 0.5 * one, 0.5 * (f + b) + spread, Quality.FLOAT)
    put(both & ~agree & forward_lasts & ~backward_lasts, nothing, f, Quality.FIX)
    put(both & ~agree & ~forward_lasts & backward_lasts, one, b, Quality.FIX)

    for fixed, floating, lasts, at_fix, at_float, of_fix, of_float in (
        (fix_f, float_b, forward_lasts, nothing, one, f, b),
        (fix_b, float_f, backward_lasts, one, nothing, b, f),
    ):
        rows = fixed & floating
        put(rows & ~lasts, at_float, of_float, Quality.FLOAT)
        put(rows & lasts & ~agree, at_float, of_float + spread, Quality.FLOAT)
        put(rows & lasts & agree, at_fix, of_fix, Quality.FIX)

    weighted = np.linalg.solve(c, np.swapaxes(f, -1, -2))  # (f + b)^-1 f, so that the share is its transpose
    grown = np.maximum(apart / 3.0, 1.0)[:, None, None]
    put(float_f & float_b, np.swapaxes(weighted, -1, -2), (f - f @ weighted) * grown, Quality.FLOAT)

    single = (fix_f & float_b & ~forward_lasts) | (fix_b & float_f & ~backward_lasts)
    mixed = ((fix_f & float_b & forward_lasts) | (fix_b & float_f & backward_lasts)) & ~agree
    return Combined(
        _moved(forward, backward, share, covariance, quality),
        agreed=int((both & agree).sum()),
        contradicted=int(((both & ~agree) | mixed).sum()),
        unsupported=int(single.sum()),
    )


def _rank(quality: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Position among the kinds from best to worst, shape (n,)."""
    order = (
        Quality.FIX,
        Quality.FLOAT,
        Quality.DGPS,
        Quality.SBAS,
        Quality.PPP,
        Quality.SINGLE,
        Quality.DEAD_RECKONING,
    )
    ranks = np.full(len(Quality), 255, np.uint8)
    ranks[[int(kind) for kind in order]] = range(len(order))
    return np.asarray(ranks[quality])


def _differences(forward: Solution, backward: Solution) -> tuple[Array, Array, Array, Array, Array]:
    """Covariances of both and their sum, the outer square of their difference, and that in units of the sum; east, north, up."""
    d = _towards(forward, backward)
    f, b = forward.covariance_m2, backward.covariance_m2
    # RTKLIB's digits are 0.1 mm: a covariance of such sigmas may be singular by rounding
    c = f + b + np.eye(3) * 1e-8
    apart = np.einsum("ni,ni->n", d, np.linalg.solve(c, d[..., None])[..., 0])
    return f, b, c, d[:, :, None] * d[:, None, :], apart


def _towards(forward: Solution, backward: Solution) -> Array:
    """East, north, up from forward to backward positions [m], shape (n, 3)."""
    axes = mat_ecef_enu(forward.latitude_deg, forward.longitude_deg)
    return np.asarray(np.einsum("nji,nj->ni", axes, _ecef(backward) - _ecef(forward)))


def _ecef(solution: Solution) -> Array:
    return ecef_from_geodetic(solution.latitude_deg, solution.longitude_deg, solution.height_m)


def _moved(
    forward: Solution, backward: Solution, share: Array, covariance: Array, quality: npt.NDArray[np.uint8]
) -> Solution:
    """The forward solution moved by a share of the way to the backward one."""
    axes = mat_ecef_enu(forward.latitude_deg, forward.longitude_deg)
    way = np.einsum("nij,njk,nk->ni", axes, share, _towards(forward, backward))
    latitude, longitude, height = geodetic_from_ecef(_ecef(forward) + way)
    ratio = forward.ratio
    if ratio is not None and backward.ratio is not None:
        # of the run that the position is of
        ratio = np.where(np.einsum("nii->n", share) > 1.5, backward.ratio, ratio)
    return dataclasses.replace(
        forward,
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=height,
        covariance_m2=covariance,
        quality=quality,
        ratio=ratio,
    )


def _joined(parts: list[Solution]) -> Solution:
    """Solutions of different epochs as one in time order."""
    names: tuple[str, ...] = (
        "time_ns",
        "latitude_deg",
        "longitude_deg",
        "height_m",
        "covariance_m2",
        "quality",
        "satellites",
        "age_s",
        "ratio",
    )
    if all(
        part.velocity_m_s is not None for part in parts
    ):  # of the epoch's Doppler shifts alone: the same in both runs
        names += ("velocity_m_s", "velocity_covariance_m2_s2")
    columns: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    whole = dataclasses.replace(parts[0], **({"velocity_m_s": None, "velocity_covariance_m2_s2": None} | columns))
    return whole.rows(np.argsort(whole.time_ns, kind="stable"))
