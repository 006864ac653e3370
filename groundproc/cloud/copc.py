"""Clouds as COPC 1.0 (copc.io): a LAZ file whose chunks are the nodes of an octree, so that a viewer reads what it shows and no more."""

import contextlib
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, Final

import laspy
import lazrs
import numpy as np
import numpy.typing as npt
from laspy.vlrs.known import LasZipVlr

from flightlog.errors import SourceError
from groundproc.cloud.octree import MOST, CrowdError, Cube, Key, Octree
from groundproc.cloud.spool import Records
from groundproc.machine.readahead import ahead
from groundproc.machine.stopping import heard
from groundproc.machine.system import cores

Bytes = npt.NDArray[np.uint8]

_AT_ONCE: Final = min(max(250_000 * cores(), 250_000), 1_000_000)
"""Points that are handed to the compressor together: its threads share whole nodes, of some ten thousand points each."""
_INFO: Final = struct.Struct("<5d2Q2d88x")
_ENTRY: Final = struct.Struct("<4iQ2i")
_EVLR: Final = struct.Struct("<H16sHQ32s")
_INFO_AT: Final = 375 + 54
"""The info is the first record after the header of LAS 1.4 (COPC 1.0)."""


class CopcBuilder:
    """Gathers records of points, and writes the file when all are known.

    Parameters
    ----------
    header : laspy.LasHeader
        Of LAS 1.4, point format 6 to 8; its totals are set by the caller before `write`.
    folder : Path
        For temporary files.
    """

    def __init__(self, header: laspy.LasHeader, folder: Path) -> None:
        self._header = header
        self._octree = Octree(header.point_format.dtype(), header.scales, folder)
        self._times = [np.inf, -np.inf]

    def add(self, records: Records) -> None:
        """Take records, shape (n,); the array may be used again."""
        if len(records):
            time = records["gps_time"]
            self._times = [min(self._times[0], float(time.min())), max(self._times[1], float(time.max()))]
            self._octree.add(records)

    def write(self, path: Path) -> None:
        """Write the file; the octree is empty then.

        Raises
        ------
        SourceError
            It cannot be written, or the points of one place are too many for a node.
        """
        try:
            with heard(), path.open("wb+") as file:
                self._write(file)
        except OSError as error:
            raise SourceError(f"{path}: cannot be written ({error.strerror or error})") from None
        except lazrs.LazrsError as error:  # what it makes of a full disk
            raise SourceError(f"{path}: cannot be written ({' '.join(str(error).split())})") from None
        except CrowdError as error:
            x, y, z = np.array(error.steps) * self._header.scales + self._header.offsets
            raise SourceError(
                f"{path}: {error.count:,} points of ({x:.3f}, {y:.3f}, {z:.3f}) and around it would be in one node of the octree, expected "
                f"{MOST:,} at most, as readers unpack a node whole: millions lie within a millimetre or two there; is that a sensor that "
                "stood still, or places that are no places? Leave cloud.copc.laz out (products), or leave these points out (times, area)"
            ) from None

    def _write(self, file: BinaryIO) -> None:
        header, cube = self._header, self._octree.cube()
        form = header.point_format
        packer = lazrs.LazVlr.new_for_compression(form.id, form.num_extra_bytes, use_variable_size_chunks=True)
        header.vlrs.insert(0, laspy.VLR("copc", 1, "", bytes(_INFO.size)))
        header.vlrs.append(LasZipVlr(packer.record_data()))
        header.are_points_compressed = True
        header.write_to(file)
        start = file.tell()
        keys, counts = self._compress(file, packer)
        file.seek(start)
        sizes = [size for _, size in lazrs.read_chunk_table(file, packer)]
        at = start + 8  # the place of the chunk table comes first
        offsets = (np.cumsum([0, *sizes[:-1]]) + at).tolist()
        entries = {key: (*key, *rest) for key, *rest in zip(keys, offsets, sizes, counts, strict=True)}
        page = hierarchy(entries)
        file.seek(0, 2)
        header.start_of_first_evlr, header.number_of_evlrs = file.tell(), 1
        file.write(_EVLR.pack(0, b"copc", 1000, len(page), b"EPT hierarchy"))
        root = file.tell()
        file.write(page)
        file.seek(0)
        header.write_to(file, ensure_same_size=True)
        file.seek(_INFO_AT)
        file.write(self._info(cube, root, len(page)))

    def _compress(self, file: BinaryIO, packer: Any) -> tuple[list[Key], list[int]]:
        """Write all nodes, a chunk each; gives their keys and counts in the order of the file."""
        compressor = lazrs.ParLasZipCompressor(file, packer)
        keys: list[Key] = []
        counts: list[int] = []
        with contextlib.closing(ahead(self._batches())) as batches:
            for nodes in batches:
                keys += [key for key, _ in nodes]
                counts += [len(records) // self._header.point_format.size for _, records in nodes]
                compressor.compress_chunks([records for _, records in nodes])
                del nodes  # the next ones take their memory
        compressor.done()
        return keys, counts

    def _batches(self) -> Iterator[list[tuple[Key, Bytes]]]:
        """Nodes and their records, as many at once as keep all threads of the compressor busy."""
        waiting: list[tuple[Key, Bytes]] = []
        points = 0
        for key, records in self._octree.nodes():
            waiting.append((key, records.view(np.uint8)))
            points += len(records)
            if points >= _AT_ONCE:
                yield waiting
                waiting, points = [], 0
        if waiting:
            yield waiting

    def _info(self, cube: Cube, root: int, size: int) -> bytes:
        """The info record."""
        scales, offsets = self._header.scales, self._header.offsets
        half_m = cube.side_m / 2.0
        centre = cube.corner * scales + offsets + half_m
        return _INFO.pack(*centre, half_m, cube.side_m / 128.0, root, size, *self._times)


def hierarchy(entries: dict[Key, tuple[int, ...]]) -> bytes:
    """The page of all nodes; those without points that others descend from are named too."""
    found = dict(entries)
    for key in entries:
        level, x, y, z = key
        while level:
            level, x, y, z = level - 1, x >> 1, y >> 1, z >> 1
            if (level, x, y, z) in found:
                break
            found[level, x, y, z] = (level, x, y, z, 0, 0, 0)
    return b"".join(_ENTRY.pack(*found[key]) for key in sorted(found))
