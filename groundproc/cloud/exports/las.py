"""LAS, not compressed, with every field of the input, in its order."""

from pathlib import Path

from groundproc.cloud.exports import Progress, laz
from groundproc.cloud.reader import Cloud


def write(cloud: Cloud, path: Path, progress: Progress) -> None:
    """See `exports`."""
    laz.write(cloud, path, progress, compressed=False)
