"""Control points among the clusters of strips: what is known of the surface from elsewhere."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from flightlog.errors import CaptureError
from groundproc.flight import control
from groundproc.strips.clusters import CLUSTER
from groundproc.strips.rows import CONTROL

Array = npt.NDArray[np.float64]


def read_control(path: Path) -> Array:
    """Places on the surface in map coordinates with their sigma [m], shape (n, 4): those to be used, planes at five places each.

    Raises
    ------
    CaptureError
        See `groundproc.control.read_control`; or none of them is to be used.
    """
    found = control.table(control.read_control(path))
    if not len(found):
        raise CaptureError(f"{path}: holds check points only, expected points that may be used")
    return found


def as_clusters(control: Array, origin_m: Array, time_ns: int) -> npt.NDArray[np.void]:
    """Control points as clusters that nothing moves."""
    out = np.zeros(len(control), CLUSTER)
    out["time_ns"], out["place"], out["count"], out["strip"] = time_ns, control[:, :3] - origin_m, 1, CONTROL
    out["quat"][:, 0] = 1.0
    return out
