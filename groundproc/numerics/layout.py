"""Arrays as kernels take them: numba compiles a kernel anew for every order in memory, and for what may be written and what may not."""

from typing import TypeVar

import numpy as np
import numpy.typing as npt

Kind = TypeVar("Kind", bound=np.generic)


def to_read(array: npt.NDArray[Kind]) -> npt.NDArray[Kind]:
    """A read-only view in C order, of one type whatever the caller has; a copy only where it lies otherwise."""
    view = np.ascontiguousarray(array).view()
    view.flags.writeable = False
    return view
