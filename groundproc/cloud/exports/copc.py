"""COPC of a cloud of any origin: LAS 1.4 with every field of the input, those of old point formats under their new names."""

from pathlib import Path
from typing import Any, Final

import laspy
import numpy as np

from groundproc.cloud.copc import CopcBuilder
from groundproc.cloud.exports import Progress
from groundproc.cloud.layout import angle_of_rank
from groundproc.cloud.reader import Cloud, chunks, opened

_NEWER: Final = {0: 6, 1: 6, 2: 7, 3: 7, 4: 6, 5: 7, 6: 6, 7: 7, 8: 8, 9: 6, 10: 8}
"""Point formats that COPC allows for those that there are; waveforms are left out."""
_NOT_KEPT: Final = ("copc", "laszip encoded")
_LONGEST: Final = 65535
"""Bytes of a record in front of the points."""
_EXTRA_BYTES, _GEOTIFF = 4, (34735, 34736, 34737)


def write(cloud: Cloud, path: Path, progress: Progress) -> None:
    """See `exports`."""
    header = _header(cloud)
    builder = CopcBuilder(header, path.parent)
    limits = np.array([np.full(3, np.inf), np.full(3, -np.inf)])
    by_return = np.zeros(16, np.int64)
    for chunk in chunks(cloud, columns=()):
        record = laspy.PackedPointRecord.from_point_record(chunk.record, header.point_format)
        if (
            "scan_angle_rank" in chunk.record.point_format.dimension_names
        ):  # of another name and step, which laspy does not carry over
            record["scan_angle"] = angle_of_rank(chunk.record["scan_angle_rank"])
        builder.add(record.array)
        limits[0] = np.minimum(limits[0], chunk.points.xyz_m.min(axis=0))
        limits[1] = np.maximum(limits[1], chunk.points.xyz_m.max(axis=0))
        by_return += np.bincount(np.asarray(record.return_number), minlength=16)
        progress(len(chunk.record))
    header.point_count, header.mins, header.maxs = cloud.points, *limits
    header.number_of_points_by_return[:] = by_return[1:]
    builder.write(path)


def _header(cloud: Cloud) -> laspy.LasHeader:
    """The header of the new file, complete but for its totals."""
    with opened(cloud.path) as reader:
        old = reader.header
        form = laspy.PointFormat(_NEWER[old.point_format.id])
        for extra in old.point_format.extra_dimensions:
            form.dimensions.append(extra)
        header = laspy.LasHeader(version="1.4", point_format=form)
        header.scales, header.offsets = old.scales, old.offsets
        header.file_source_id, header.uuid = old.file_source_id, old.uuid
        header.system_identifier, header.generating_software = old.system_identifier, old.generating_software
        header.creation_date = old.creation_date
        header.global_encoding = old.global_encoding
        header.vlrs.extend(each for each in old.vlrs if _kept(each))
        if old.version.minor >= 4:
            reader.read_evlrs()
            header.vlrs.extend(each for each in reader.evlrs or () if _kept(each) and _short(each))
    header.global_encoding.wkt = True
    if cloud.crs is not None and not any(vlr.record_id == 2112 for vlr in header.vlrs):
        header.add_crs(cloud.crs)
    return header


def _short(record: Any) -> bool:
    """Whether a record from behind the points has room in front of them; behind them COPC has the octree alone."""
    return len(record.record_data_bytes()) <= _LONGEST


def _kept(vlr: Any) -> bool:
    if vlr.user_id in _NOT_KEPT or (vlr.user_id == "LASF_Spec" and vlr.record_id == _EXTRA_BYTES):
        return False
    return not (vlr.user_id == "LASF_Projection" and vlr.record_id in _GEOTIFF)
