"""LAZ, with every field of the input, in its order."""

from pathlib import Path

import numpy as np

from groundproc.cloud.exports import Progress
from groundproc.cloud.reader import Cloud, chunks
from groundproc.cloud.rewriter import Rewriter


def write(cloud: Cloud, path: Path, progress: Progress, compressed: bool = True) -> None:
    """See `exports`."""
    with Rewriter(cloud, path, compressed) as writer:
        for chunk in chunks(cloud, columns=()):
            writer.write(chunk.record, np.zeros((len(chunk.record), 3)))
            progress(len(chunk.record))
