"""PLY, binary: coordinates in double precision and every attribute that the table of dimensions knows."""

from pathlib import Path
from typing import Final

import numpy as np

from flightlog.errors import SourceError
from groundproc.cloud.dimensions import in_order
from groundproc.cloud.exports import Progress
from groundproc.cloud.reader import Cloud, chunks

_NAMES: Final = {
    "i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float", "f8": "double",
}  # fmt: skip
_COLOURS: Final = ("red", "green", "blue")


def write(cloud: Cloud, path: Path, progress: Progress) -> None:
    """See `exports`. Colours get 8 bits, as readers of PLY expect; what has steps is written as float."""
    columns = in_order(cloud.columns)
    types = [(axis, "<f8") for axis in "xyz"]
    types += [(each.name, "|u1" if each.name in _COLOURS else each.column.newbyteorder("<").str) for each in columns]
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
                for each in columns:
                    values = chunk.points[each.name]
                    out[each.name] = values >> 8 if each.name in _COLOURS else values
                file.write(out.tobytes())
                progress(len(out))
    except OSError as error:
        raise SourceError(f"{path}: cannot be written ({error.strerror or error})") from None
