"""How strips of one flight agree where they overlap, before and after."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.numerics.robust import MAD_TO_SIGMA
from groundproc.radiometry.patches import Seen

Array = npt.NDArray[np.float64]

_FEWEST: Final = 5
"""Single echoes of a strip in a patch."""


def agreement(seen: Seen) -> list[dict[str, Any]]:
    """By how much each strip is brighter than the others in patches that they share [percent].

    `..._percent` is the median of the patches, `..._cells_percent` how far single patches are off, the median, and
    `..._expected_percent` how far their echoes' own scatter lets expect. `raw` is as measured, `reflectance` as written, of all single
    echoes; `surface` as written, of those from surfaces alone, whose incidence is known.
    """
    whole, surfaces = _by_strip(seen, np.ones(len(seen.patch), np.bool_)), _by_strip(seen, ~seen.leaf)
    told = []
    for strip in np.unique(whole[0][:, 1]):
        raw, of_all, on_surface = (
            _against(*rows, strip, column) for rows, column in ((whole, 0), (whole, 1), (surfaces, 1))
        )
        one: dict[str, Any] = {"strip": int(strip), "patches": len(of_all[0]), "surface_patches": len(on_surface[0])}
        for name, (off, sigma) in (("raw", raw), ("reflectance", of_all), ("surface", on_surface)):
            one[f"{name}_percent"] = _rounded(off)
            one[f"{name}_cells_percent"] = _rounded(np.abs(off))
            if name != "raw":
                one[f"{name}_expected_percent"] = _rounded(sigma / MAD_TO_SIGMA)
        told.append(one)
    return told


def _rounded(values: Array) -> float | None:
    return round(100.0 * float(np.median(values)), 3) if len(values) else None


def _by_strip(seen: Seen, chosen: npt.NDArray[np.bool_]) -> tuple[npt.NDArray[np.int64], Array, Array]:
    """Patch and strip, shape (n, 2); mean as measured and freed, shape (n, 2); variance of the freed mean, shape (n,)."""
    keys, number = np.unique(np.column_stack([seen.patch[chosen], seen.strip[chosen]]), axis=0, return_inverse=True)
    number = number.ravel()
    count, raw, freed, squares = (
        np.bincount(number, values[chosen].astype(np.float64), len(keys))
        for values in (seen.count, seen.raw, seen.freed, seen.squares)
    )
    many = count >= _FEWEST
    mean = np.column_stack([raw, freed])[many] / count[many, None]
    scatter = np.maximum(squares[many] / count[many] - mean[:, 1] ** 2, 0.0)
    return keys[many], mean, scatter / (count[many] - 1.0)


def _against(keys: npt.NDArray[np.int64], mean: Array, variance: Array, strip: int, column: int) -> tuple[Array, Array]:
    """Ratio less 1 of a strip to the mean of the others, and its sigma, in each patch that it shares, shape (m,) each."""
    patch = np.unique(keys[:, 0], return_inverse=True)[1].ravel()
    value = mean[:, column]
    others = np.bincount(patch)[patch] - 1
    own = (keys[:, 1] == strip) & (others > 0)
    total, spread = np.bincount(patch, value), np.bincount(patch, variance)
    level = (total[patch] - value)[own] / others[own]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = value[own] / level
        far = (spread[patch] - variance)[own] / (others[own] * level) ** 2
        sigma = ratio * np.sqrt(variance[own] / value[own] ** 2 + far)
    good = np.isfinite(ratio) & np.isfinite(sigma)
    return ratio[good] - 1.0, sigma[good]
