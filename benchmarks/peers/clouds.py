"""How clouds are written without this project: LAZ by laspy on one thread, COPC by copclib with an octree of numpy."""

from pathlib import Path
from typing import Any, Final

import copclib
import laspy
import numpy as np
import numpy.typing as npt

LEAF: Final = 30_000
"""Points of a node that are not divided further: as ours, so that both write as many nodes."""
_VOXEL_BITS: Final = 7
_DEEPEST: Final = 14


def write_laz(path: Path, header: laspy.LasHeader, records: npt.NDArray[np.void], at_once: int) -> None:
    """Records as LAZ, compressed by one thread of lazrs."""
    with laspy.open(path, mode="w", header=header, laz_backend=laspy.LazBackend.Lazrs, do_compress=True) as out:
        for start in range(0, len(records), at_once):
            some = records[start : start + at_once]
            out.write_points(laspy.PackedPointRecord(some, header.point_format))


def write_copc(path: Path, header: laspy.LasHeader, records: npt.NDArray[np.void]) -> None:
    """Records as COPC: the nodes of `octree`, one call of copclib each."""
    low = np.array([records[axis].min() for axis in "XYZ"], np.int64)
    high = np.array([records[axis].max() for axis in "XYZ"], np.int64)
    side = int((high - low).max()) + 1
    scale, offset = (copclib.Vector3(*map(float, each)) for each in (header.scales, header.offsets))
    config = copclib.CopcConfigWriter(header.point_format.id, scale, offset, "", _extra_bytes(header))
    low_m, high_m = low * header.scales + header.offsets, high * header.scales + header.offsets
    config.las_header.min, config.las_header.max = (copclib.Vector3(*map(float, each)) for each in (low_m, high_m))
    half_m = side * float(header.scales[0]) / 2.0
    info = config.copc_info
    info.center_x, info.center_y, info.center_z = (low_m + half_m).tolist()
    info.halfsize, info.spacing = half_m, half_m / 64.0
    writer = copclib.FileWriter(str(path), config)
    for key, some in octree(records, low, side):
        packed = copclib.VectorChar(np.frombuffer(records[some].tobytes(), np.int8))
        writer.AddNode(copclib.VoxelKey(*key), packed)
    writer.Close()


def octree(
    records: npt.NDArray[np.void], low: npt.NDArray[np.int64], side: int
) -> "list[tuple[tuple[int, int, int, int], npt.NDArray[np.int64]]]":
    """Nodes and the numbers of their points: level by level the first point of each voxel, by np.unique."""
    within = np.stack([records[axis].astype(np.int64) for axis in "XYZ"], axis=1) - low
    found: list[tuple[tuple[int, int, int, int], npt.NDArray[np.int64]]] = []
    left = np.arange(len(records))
    for level in range(_DEEPEST + 1):
        place = within[left] * (1 << level + _VOXEL_BITS) // side
        node = place >> _VOXEL_BITS
        number, inverse, count = np.unique(_keyed(node), return_inverse=True, return_counts=True)[0:3]
        small = count[inverse] <= LEAF if level < _DEEPEST else np.ones(len(left), bool)
        first = np.zeros(len(left), bool)
        first[np.unique(_keyed(place), return_index=True)[1]] = True
        own = np.flatnonzero(small | first)
        own = own[np.argsort(inverse[own], kind="stable")]
        ends = np.searchsorted(inverse[own], np.arange(len(number) + 1))
        for each in range(len(number)):
            some = own[ends[each] : ends[each + 1]]
            if len(some):
                found.append(((level, *map(int, node[some[0]])), left[some]))
        left = left[~(small | first)]
        if not len(left):
            break
    return found


def _keyed(place: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    return place[:, 0] | place[:, 1] << 21 | place[:, 2] << 42


def _extra_bytes(header: laspy.LasHeader) -> Any:
    """As many bytes as there are; what they mean costs nothing."""
    return copclib.EbVlr(int(header.point_format.num_extra_bytes))
