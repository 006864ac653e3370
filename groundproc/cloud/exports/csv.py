"""CSV with a header: coordinates, time where there is one, and every attribute that the table of dimensions knows."""

from pathlib import Path

import numpy as np

from flightlog.errors import SourceError
from groundproc.cloud.dimensions import Dimension, in_order
from groundproc.cloud.exports import Progress
from groundproc.cloud.reader import Cloud, chunks


def write(cloud: Cloud, path: Path, progress: Progress) -> None:
    """See `exports`. Times are those of the file."""
    columns = in_order(cloud.columns)
    names = ["x", "y", "z", *(["gps_time"] if cloud.timed else []), *(each.name for each in columns)]
    formats = ["%.3f"] * 3 + (["%.9f"] if cloud.timed else []) + [_format(each) for each in columns]
    try:
        with path.open("w", encoding="ascii") as file:
            file.write(",".join(names) + "\n")
            for chunk in chunks(cloud):
                parts = [chunk.points.xyz_m]
                if cloud.timed:
                    parts.append(np.asarray(chunk.record.gps_time, np.float64)[:, None])
                parts += [chunk.points[each.name].astype(np.float64)[:, None] for each in columns]
                np.savetxt(file, np.concatenate(parts, axis=1), formats, ",")
                progress(len(chunk.points))
    except OSError as error:
        raise SourceError(f"{path}: cannot be written ({error.strerror or error})") from None


def _format(entry: Dimension) -> str:
    """As many digits as the stored step has."""
    if entry.scale is not None:
        return f"%.{max(0, int(np.ceil(-np.log10(entry.scale))))}f"
    return "%.7g" if entry.stored.kind == "f" else "%d"
