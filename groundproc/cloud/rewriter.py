"""A cloud written anew: same points, attributes, order, header and records, other coordinates."""

import contextlib
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import laspy
import numpy as np
import numpy.typing as npt

from flightlog.errors import CaptureError, SourceError
from groundproc.cloud.reader import Cloud, opened
from groundproc.cloud.storing import storing

Array = npt.NDArray[np.float64]

_INT32: Final = np.iinfo(np.int32)
_NOT_KEPT: Final = ("copc",)


class Rewriter:
    """Writes one file anew, whoever made it: fields that the table of dimensions does not know are kept too.

    Use as a context manager; the caller writes aside.

    Parameters
    ----------
    cloud : Cloud
    path : Path
    compressed : bool
        LAZ; else LAS.

    Raises
    ------
    CaptureError
        The cloud cannot be read.
    SourceError
        The new file cannot be written.
    """

    def __init__(self, cloud: Cloud, path: Path, compressed: bool = True) -> None:
        self.path, self.name = path, cloud.path
        with opened(cloud.path) as reader:
            header = laspy.LasHeader(version=reader.header.version, point_format=reader.header.point_format)
            old = reader.header
            header.scales, header.offsets = old.scales, old.offsets
            header.global_encoding, header.uuid = old.global_encoding, old.uuid
            header.file_source_id = old.file_source_id
            header.system_identifier, header.generating_software = old.system_identifier, old.generating_software
            header.creation_date = old.creation_date
            # the index of a COPC file, which LAZ would not keep true, and records that laspy writes itself
            header.vlrs.extend(v for v in old.vlrs if v.user_id not in _NOT_KEPT and not _is_extra_bytes(v))
            if old.version.minor >= 4:
                reader.read_evlrs()
            self._evlrs = [v for v in (reader.evlrs or []) if v.user_id not in _NOT_KEPT]
        try:
            self._las = laspy.open(
                path, mode="w", header=header, laz_backend=laspy.LazBackend.LazrsParallel, do_compress=compressed
            )
        except OSError as error:
            raise SourceError(f"{path}: cannot be written ({error.strerror})") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None:  # nothing of it is kept: what closing would still write may fail for the same reason
            with contextlib.suppress(OSError):
                self._las.dest.close()
            return
        with storing(self.path):
            if self._evlrs:
                self._las.write_evlrs(laspy.vlrs.vlrlist.VLRList(self._evlrs))
            self._las.close()

    def write(self, record: Any, moved_m: Array) -> Array:
        """Append points moved by so much, shape (n, 3); gives their map coordinates as stored.

        The whole number that a coordinate is stored as changes by the whole number of steps next to the move: no move, no change.
        """
        places = np.empty((len(record), 3))
        for axis, name in enumerate("XYZ"):
            step, origin = float(record.scales[axis]), float(record.offsets[axis])
            stored = np.asarray(record[name], np.int64) + np.rint(moved_m[:, axis] / step).astype(np.int64)
            if len(stored) and not (_INT32.min <= stored.min() and stored.max() <= _INT32.max):
                raise CaptureError(f"{self.name}: a corrected point lies beyond what its scale {step:g} can hold")
            record[name] = stored.astype(np.int32)
            places[:, axis] = stored * step + origin
        with storing(self.path):
            self._las.write_points(record)
        return places


def _is_extra_bytes(record: Any) -> bool:
    return bool(record.user_id == "LASF_Spec" and record.record_id == 4) or record.user_id == "laszip encoded"
