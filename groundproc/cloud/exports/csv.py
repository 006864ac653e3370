"""CSV with a header: coordinates, time where there is one, every attribute that the table of dimensions knows, and extra bytes."""

from pathlib import Path
from typing import Any, Final

import numpy as np

from flightlog.errors import SourceError
from groundproc.cloud.dimensions import in_order
from groundproc.cloud.exports import Progress, Theirs
from groundproc.cloud.reader import Cloud, chunks, opened

_FEWEST_DIGITS: Final = 3
"""Of a coordinate: offsets may have more than the step."""


def write(cloud: Cloud, path: Path, progress: Progress) -> None:
    """See `exports`. Times are those of the file."""
    columns = in_order(cloud.columns)
    names = ["x", "y", "z", *(["gps_time"] if cloud.timed else []), *(each.name for each in columns)]
    with opened(cloud.path) as reader:
        steps = [float(each) for each in reader.header.scales]
    formats = [f"%.{max(_digits(step), _FEWEST_DIGITS)}f" for step in steps] + (["%.9f"] if cloud.timed else [])
    formats += [_format(each.scale, each.stored) for each in columns]
    theirs = Theirs(cloud, names)
    formats += [_format(scale, dtype) for scale, dtype in zip(theirs.scales, theirs.types, strict=True)]
    try:
        with path.open("w", encoding="utf-8") as file:
            file.write(",".join([*names, *theirs.names]) + "\n")
            for chunk in chunks(cloud):
                parts = [chunk.points.xyz_m]
                if cloud.timed:
                    parts.append(np.asarray(chunk.record.gps_time, np.float64)[:, None])
                parts += [chunk.points[each.name].astype(np.float64)[:, None] for each in columns]
                parts += [values.astype(np.float64)[:, None] for values in theirs.values(chunk)]
                np.savetxt(file, np.concatenate(parts, axis=1), formats, ",")
                progress(len(chunk.points))
    except OSError as error:
        raise SourceError(f"{path}: cannot be written ({error.strerror or error})") from None


def _digits(step: float) -> int:
    """Behind the point, so that each step can be told from the next."""
    return max(0, int(np.ceil(-np.log10(abs(step) or 1.0))))


def _format(scale: float | None, stored: np.dtype[Any]) -> str:
    """As many digits as the stored step has."""
    if scale is not None:
        return f"%.{_digits(scale)}f"
    if stored.kind == "f":
        return "%.7g" if stored.itemsize <= 4 else "%.15g"
    return "%d"
