"""How near the ground's surface a point is ground."""

import numpy as np
import numpy.typing as npt

from groundproc.analysis.terrain.settings import Settings

Raster = npt.NDArray[np.float32]


def reach_of(height_m: Raster, settings: Settings) -> Raster:
    """Points within this of a surface, up or down, are ground [m]: the steeper it is, the less sure its height within a cell."""
    return np.float32(settings.height_m) + np.float32(settings.slack) * slope_of(height_m, settings.cell_m)


def slope_of(height_m: Raster, cell_m: float) -> Raster:
    """Rise over run of a raster of heights."""
    if min(height_m.shape) < 2:
        return np.zeros_like(height_m)
    down, right = np.gradient(height_m, np.float32(cell_m))
    return np.asarray(np.hypot(down, right), np.float32)
