"""Is a camera's lens model the right one? A wrong one leaves residuals that point along the radius, alike all around the picture."""

from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.imagery.bundle.screen import Adjusted
from groundproc.imagery.bundle.solve import image_residuals
from groundproc.imagery.rig import RigCamera
from groundproc.numerics import robust

Array = npt.NDArray[np.float64]

RINGS: Final = 8
"""Of as many image points each, from the middle of the picture to its corners."""
LEAST_POINTS: Final = 25
"""In a ring."""
CERTAIN: Final = 6.0
"""Sigmas of a ring's median from zero."""
SHARE: Final = 0.5
"""Of what is usual for a residual: less does no harm."""
LEAST_PX: Final = 0.15
_MEDIAN: Final = 1.2533
"""Sigma of a median over that of a mean."""
FISHEYES: Final = ("equidistant", "fisheye_polynomial")


def lens_doubts(adjusted: Adjusted) -> list[str]:
    """A sentence for each camera whose residuals its lens model does not explain; what was left out as wrong counts too."""
    block = adjusted.solved.block
    residual, reached = image_residuals(block, adjusted.solved.unknowns)
    of_camera = block.camera[block.measured.image]
    seen = np.bincount(block.measured.point[block.measured.weight > 0.0], minlength=len(block.points_m))
    good = reached & (seen[block.measured.point] > 1)
    doubts = []
    for number, one in enumerate(block.rig.cameras):
        own = good & (of_camera == number)
        found = worst_ring(one, block.measured.pixel[own], residual[own])
        if found is not None:
            doubts.append(_sentence(one, *found))
    return doubts


def worst_ring(one: RigCamera, pixel: Array, residual: Array) -> tuple[float, float] | None:
    """Radius [px] and median radial residual [px] of the ring where it is largest; None where no two rings show any.

    Parameters
    ----------
    one : RigCamera
    pixel, residual : ndarray, shape (n, 2)
    """
    if len(pixel) < RINGS * LEAST_POINTS:
        return None
    arm = pixel - np.array(one.camera.centre_px)
    radius = np.linalg.norm(arm, axis=1)
    outwards = np.einsum("ni,ni->n", residual, arm) / np.maximum(radius, 1.0)
    rings = np.array_split(np.argsort(radius, kind="stable"), RINGS)
    middle = np.array([np.median(outwards[ring]) for ring in rings])
    usual = np.array([robust.sigma(outwards[ring], float(at)) for ring, at in zip(rings, middle, strict=True)])
    sigma = _MEDIAN * usual / np.sqrt([len(ring) for ring in rings])
    shown = (np.abs(middle) > CERTAIN * sigma) & (np.abs(middle) > np.maximum(SHARE * np.median(usual), LEAST_PX))
    if shown.sum() < 2:
        return None
    worst = int(np.argmax(np.where(shown, np.abs(middle), 0.0)))
    return float(np.median(radius[rings[worst]])), float(middle[worst])


def _sentence(one: RigCamera, radius_px: float, off_px: float) -> str:
    """What is wrong, where, and what to do."""
    model = one.camera.model
    other = "radtan" if model in FISHEYES else "equidistant (a fish-eye)"
    free = ", ".join(one.estimate) or "nothing"
    return (
        f"{one.name}: residuals point along the radius, by {off_px:+.1f} px at {radius_px:.0f} px from the middle: {model} with {free} "
        f"estimated is not its lens; expected none: try distortion_model {other}, or more coefficients in estimate"
    )
