"""PLY, binary: coordinates and times in double precision, every attribute that the table of dimensions knows, and extra bytes."""

from pathlib import Path
from typing import Any, Final

import numpy as np

from flightlog.errors import SourceError
from groundproc.cloud.dimensions import in_order
from groundproc.cloud.exports import COLOURS, Progress, Theirs, colour_bits
from groundproc.cloud.reader import Cloud, chunks

_NAMES: Final = {
    "i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float", "f8": "double",
}  # fmt: skip


def write(cloud: Cloud, path: Path, progress: Progress) -> None:
    """See `exports`. Colours get 8 bits, as readers of PLY expect; what has steps is written as float."""
    columns = in_order(cloud.columns)
    types = [(name, "<f8") for name in ("x", "y", "z", *(["gps_time"] if cloud.timed else []))]
    types += [(each.name, "|u1" if each.name in COLOURS else each.column.newbyteorder("<").str) for each in columns]
    theirs, shift = Theirs(cloud, [name for name, _ in types]), colour_bits(cloud)
    types += [(name, _held(dtype)) for name, dtype in zip(theirs.names, theirs.types, strict=True)]
    record = np.dtype(types)
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {cloud.points}"]
    lines += [f"property {_NAMES[kind[1:]]} {name}" for name, kind in types]
    if cloud.crs is not None:
        lines.insert(2, f"comment crs {cloud.crs.name}")
    try:
        with path.open("wb") as file:
            file.write(("\n".join([*lines, "end_header"]) + "\n").encode("ascii", "replace"))
            for chunk in chunks(cloud):
                out = np.empty(len(chunk.points), record)
                for axis, name in enumerate("xyz"):
                    out[name] = chunk.points.xyz_m[:, axis]
                if cloud.timed:
                    out["gps_time"] = chunk.record.gps_time
                for each in columns:
                    values = chunk.points[each.name]
                    out[each.name] = values >> shift if each.name in COLOURS else values
                for name, values in zip(theirs.names, theirs.values(chunk), strict=True):
                    out[name] = values
                file.write(out.tobytes())
                progress(len(out))
    except OSError as error:
        raise SourceError(f"{path}: cannot be written ({error.strerror or error})") from None


def _held(dtype: np.dtype[Any]) -> str:
    """The type of a column; PLY has no whole numbers of eight bytes."""
    return dtype.newbyteorder("<").str if dtype.str[1:] in _NAMES else "<f8"
