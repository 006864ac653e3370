"""Control points: what is known of the surface from elsewhere."""

from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import CaptureError
from groundproc.strips.clusters import CLUSTER
from groundproc.strips.rows import CONTROL

Array = npt.NDArray[np.float64]

COLUMNS: Final = ("x", "y", "z", "sigma")


def read_control(path: Path) -> Array:
    """Points on the surface in map coordinates with their sigma [m], shape (n, 4); the first line names the columns x, y, z, sigma.

    Raises
    ------
    CaptureError
        It cannot be read, or a line is not four numbers, the last above 0.
    """
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror})") from None
    names = [word.strip().lower() for word in lines[0].split(",")] if lines else []
    if not set(COLUMNS) <= set(names):
        raise CaptureError(f"{path}: the first line has no column {', '.join(n for n in COLUMNS if n not in names)}")
    places = [names.index(name) for name in COLUMNS]
    found = []
    for number, line in enumerate(lines[1:], 2):
        words = line.split(",")
        if not line.strip():
            continue
        try:
            row = [float(words[place]) for place in places]
        except (ValueError, IndexError):
            row = [np.nan]
        if not np.isfinite(row).all() or row[3] <= 0:
            raise CaptureError(f"{path}: line {number}: {line.strip()!r} found, expected x, y, z and a sigma above 0")
        found.append(row)
    if not found:
        raise CaptureError(f"{path}: holds no points")
    return np.array(found)


def as_clusters(control: Array, origin_m: Array, time_ns: int) -> npt.NDArray[np.void]:
    """Control points as clusters that nothing moves."""
    out = np.zeros(len(control), CLUSTER)
    out["time_ns"], out["place"], out["count"], out["strip"] = time_ns, control[:, :3] - origin_m, 1, CONTROL
    out["quat"][:, 0] = 1.0
    return out
