"""How far a filled surface is from ground that was left out, by the distance to what was kept."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt, maximum_filter

from groundproc.raster.fill import fill

Raster = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

SIDES: Final = (1, 3, 9, 25)
"""Sides of the squares left out, in cells: what lies in their middle was filled from 1, 2, 5 and 13 cells away."""
_SHARE: Final = 0.01
"""Of the cells with ground, for each side."""
_MOST: Final = 13
"""Distances in cells that are told apart."""


@dataclass(slots=True)
class HoldOut:
    """Sums of squared differences by distance, over many blocks.

    Attributes
    ----------
    squares_m2 : ndarray, shape (14,)
        By distance to the nearest cell with ground that was kept, in whole cells, rounded up.
    counts : ndarray of int64, shape (14,)
    """

    squares_m2: npt.NDArray[np.float64]
    counts: npt.NDArray[np.int64]

    @classmethod
    def none(cls) -> "HoldOut":
        """Nothing yet."""
        return cls(np.zeros(_MOST + 1), np.zeros(_MOST + 1, np.int64))

    def add(self, residual_m: Raster, ground: Mask, seed: int) -> None:
        """Leave out squares of a block, fill it from the rest, and compare.

        Parameters
        ----------
        residual_m : ndarray, shape (rows, columns)
            Mean height of the ground of a cell above a surface that is known everywhere; NaN without ground.
        ground : ndarray of bool, shape (rows, columns)
            Cells of the block proper.
        seed : int
        """
        if not ground.any():
            return
        rng = np.random.default_rng(seed)
        for side in SIDES:
            out = rng.random(residual_m.shape) < _SHARE / side**2
            if side > 1:
                out = maximum_filter(out, side)
            out &= np.isfinite(residual_m)
            kept = np.isfinite(residual_m) & ~out
            if not out.any() or not kept.any():
                continue
            filled = fill(np.where(kept, residual_m, np.float32(np.nan)))
            away = np.ceil(distance_transform_edt(~kept)).astype(np.int64).clip(0, _MOST)
            judged = out & ground
            difference = (filled - residual_m)[judged].astype(np.float64)
            self.squares_m2 += np.bincount(away[judged], difference**2, _MOST + 1)
            self.counts += np.bincount(away[judged], minlength=_MOST + 1)

    @property
    def rmse_m(self) -> float | None:
        """Of cells whose neighbours were kept; None: nothing was left out."""
        near = slice(1, 3)
        count = int(self.counts[near].sum())
        return float(np.sqrt(self.squares_m2[near].sum() / count)) if count else None

    def by_distance(self, cell_m: float) -> list[dict[str, float]]:
        """Figures of each distance that was met."""
        return [
            {"distance_m": n * cell_m, "rmse_m": float(np.sqrt(square / count)), "cells": int(count)}
            for n, (square, count) in enumerate(zip(self.squares_m2, self.counts, strict=True))
            if count
        ]

    def sigma_m(self, away_cells: npt.NDArray[np.float64], cell_m: float) -> Raster:
        """Sigma of a filled cell so many cells from the nearest ground.

        As measured up to the largest distance that was met often; beyond, it grows with the root of the distance, as of a random walk.
        Never less with more distance. Without any measurement: 0.1 m and a tenth of the distance.
        """
        met = np.flatnonzero(self.counts >= 10)
        if not len(met):
            return np.asarray(0.1 + 0.1 * away_cells * cell_m, np.float32)
        sigma = np.maximum.accumulate(np.sqrt(self.squares_m2[met] / self.counts[met]))
        inside = np.interp(away_cells, met, sigma)
        beyond = sigma[-1] * np.sqrt(np.maximum(away_cells, met[-1]) / met[-1])
        return np.asarray(np.where(away_cells <= met[-1], inside, beyond), np.float32)
