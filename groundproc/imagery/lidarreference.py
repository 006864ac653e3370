"""Reflectance by the lidar's own: bands of images scaled to the reflectance of its echoes at the same points (905 nm).

Near infrared is nearly the lidar's wavelength: a line is fitted through the reflectance of points, over the light that
images saw of them. Light has little noise and echoes have much, so echoes are averaged in classes of light. Other
bands meet the lidar where the ground is grey: asphalt, concrete, gravel and white paint reflect some 0.95 of it in
red, soil and leaves less, and next to nothing more. So the highest ratio that occurs belongs to grey ground, if the
place has any.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.imagery.radiance import Line
from groundproc.numerics.robust import MAD_TO_SIGMA

Array = npt.NDArray[np.float64]

NEAR: Final = "nir"
GREY: Final = 0.95
"""Of the lidar's reflectance that grey ground has in other bands."""
GREY_SIGMA: Final = 0.07
_GREYEST: Final = 98.0
"""Percentile of the ratio that counts as its highest."""
_CLASSES: Final = 20
_FEWEST: Final = 200
"""Points that a line rests on, at least."""
_DARK: Final = 0.04
"""Reflectance below which ratios are noise."""
_SPAN: Final = 1.5
"""Ratio of bright to dark ground from which on an offset can be told from a gain."""
_BEYOND: Final = 2.5
_ROUNDS: Final = 3
BY: Final = "lidar"


def lines(light: Mapping[str, Array], reflectance: Array) -> dict[str, Line] | None:
    """Lines from the light of points, shape (n,) each, to reflectance; None where too few points have both or none is of near infrared.

    Parameters
    ----------
    light : mapping of str to ndarray
        By band; not a number where no image sees.
    reflectance : ndarray
        The lidar's; not a number where it does not tell.
    """
    there = np.isfinite(reflectance) & np.all([np.isfinite(values) for values in light.values()], axis=0)
    if NEAR not in light or np.count_nonzero(there) < _FEWEST:
        return None
    known, near = reflectance[there], light[NEAR][there]
    found = {NEAR: _line(near, known)}
    told = found[NEAR].gain * near + found[NEAR].offset
    bright = told > _DARK
    for band, values in light.items():
        if band != NEAR:
            highest = float(np.percentile(values[there][bright] / told[bright], _GREYEST)) if bright.any() else 0.0
            if not highest > 0.0:
                return None
            found[band] = Line(GREY / highest, by=BY)
    return found


def _line(light: Array, known: Array) -> Line:
    """Of classes of light; points that lie off, in shadow or on what moved, are left out."""
    chosen = np.ones(len(light), np.bool_)
    gain, offset, rms = 1.0, 0.0, float("nan")
    for _ in range(_ROUNDS):
        x, y, weight = _classes(light[chosen], known[chosen])
        gain, offset = _fitted(x, y, weight)
        off = known - gain * light - offset
        rms = float(MAD_TO_SIGMA * np.median(np.abs(off[chosen])))
        chosen = np.abs(off) <= _BEYOND * max(rms, 1e-6)
    return Line(gain, offset, rms=rms, by=BY)


def _fitted(x: Array, y: Array, weight: Array) -> tuple[float, float]:
    if x.max() < _SPAN * x.min():
        return float((weight * x * y).sum() / (weight * x * x).sum()), 0.0
    gain, offset = np.polyfit(x, y, 1, w=np.sqrt(weight))
    return float(gain), float(offset)


def _classes(light: Array, known: Array) -> tuple[Array, Array, Array]:
    """Mean light, mean reflectance and number of the points of each class of light."""
    edges = np.unique(np.percentile(light, np.linspace(0.0, 100.0, _CLASSES + 1)))
    place = np.clip(np.searchsorted(edges, light, side="right") - 1, 0, max(len(edges) - 2, 0))
    count = np.bincount(place)
    some = count > 0
    mean = [np.bincount(place, values)[some] / count[some] for values in (light, known)]
    return mean[0], mean[1], count[some].astype(np.float64)
