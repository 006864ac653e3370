"""Several clouds in one file: every point as it was, with attributes more, in the order of the clouds."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import laspy
import numpy as np
import numpy.typing as npt

from groundproc.cloud.layout import Layout
from groundproc.cloud.reader import Cloud
from groundproc.cloud.storing import begun, ended, storing


class Merger:
    """Writes one LAZ file in the layout that the clouds have together.

    Use as a context manager; the caller writes aside.

    Parameters
    ----------
    clouds : sequence of Cloud
        Of one CRS, the first's.
    path : Path
    added : iterable of str
        Attributes of the table that every `write` gives.

    Raises
    ------
    CaptureError
        Extra bytes of one name are of different types or steps.
    SourceError
        The file cannot be written.
    """

    def __init__(self, clouds: Sequence[Cloud], path: Path, added: Iterable[str]) -> None:
        self._path, self._layout = path, Layout(clouds, added)
        self._records: Sequence[laspy.VLR] = ()
        self._las = begun(path, self._layout.header())

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        ended(self._las, self._path, error is not None, self._records)

    def close_with(self, records: Sequence[laspy.VLR]) -> None:
        """What is to stand behind the points when all is written."""
        self._records = records

    def write(
        self, record: Any, columns: Mapping[str, npt.NDArray[Any]], xyz_m: npt.NDArray[np.float64] | None = None
    ) -> None:
        """Append points of one of the clouds: as for `Layout.laid`."""
        laid = self._layout.laid(record, columns, xyz_m)
        with storing(self._path):
            self._las.write_points(laid)
