"""A picture of a section: height over the way along it, coloured by any attribute."""

from pathlib import Path
from typing import Final

import numpy as np

from flightlog.errors import UsageError
from groundproc.cloud import reader
from groundproc.cloud.metres import metres_of
from groundproc.files import written_aside

_MOST: Final = 300_000
"""Points that are drawn."""


def check_colour(cloud: reader.Cloud, colour: str) -> None:
    """See that points of a section have an attribute, before one is cut.

    Raises
    ------
    UsageError
    """
    known = ("z", *dict.fromkeys([*cloud.columns, "along"]))
    if colour not in known:
        raise UsageError(f"--colour {colour}: expected one of {', '.join(known)}")


def draw(cloud_path: Path, picture: Path, colour: str) -> None:
    """Draw a cloud that `section` wrote: way and height in metres, whatever the unit of its CRS."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    cloud = reader.look(cloud_path)
    metres = metres_of(cloud)
    step = max(1, -(-cloud.points // _MOST))
    along, height, value = [], [], []
    for chunk in reader.chunks(cloud, columns=("along", colour) if colour != "z" else ("along",)):
        along.append(chunk.points["along"][::step])
        height.append(metres.of(chunk.points.xyz_m)[::step, 2])
        value.append(height[-1] if colour == "z" else chunk.points[colour][::step].astype(np.float64))
    x, z, c = np.concatenate(along), np.concatenate(height), np.concatenate(value)
    long, high = float(np.ptp(x)), float(np.ptp(z))
    wide = float(np.clip(10.0 * long / max(long, 2.0 * high, 1e-9), 6.0, 10.0))
    figure, axes = plt.subplots(figsize=(wide, 4.5))
    drawn = axes.scatter(x, z, c=c, s=1.0, cmap="viridis")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("along the line [m]")
    axes.set_ylabel("height [m]")
    figure.colorbar(drawn, ax=axes, label=colour)
    figure.tight_layout()
    with written_aside(picture) as aside:
        figure.savefig(aside, format="png", dpi=110)
    plt.close(figure)
