"""trims.csv: what the dynamic calibration found, a row for each revolution."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from groundproc.estimation.dynamic.trims import COLUMNS
from groundproc.products.product import Context


def write(context: Context) -> None:
    """Write the estimate's trims; nothing where there are none."""
    if "trims.time_ns" in context.estimate.figures:
        write_trims(context.aside("trims.csv"), context.estimate.figures)


def write_trims(path: Path, figures: Mapping[str, npt.NDArray[Any]]) -> None:
    """Write the trims of `Trims.figures`, angles in degrees."""
    trims = {name.removeprefix("trims."): values for name, values in figures.items()}
    rows = np.column_stack(
        [
            np.rad2deg(trims["heading_rad"]) % 360.0,
            np.rad2deg(trims["yaw_rad"]),
            trims["altitude_m"],
            np.rad2deg(trims["pitch_rad"]),
            np.rad2deg(trims["roll_rad"]),
            trims["x_m"],
            trims["y_m"],
            np.rad2deg(trims["course_rad"]),
            trims["ground_m"],
            trims["plan_m"],
        ]
    )
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.write(",".join(COLUMNS) + "\n")
        for stamp, row, pixels in zip(trims["time_ns"].tolist(), rows.tolist(), trims["pixels"].tolist(), strict=True):
            file.write(f"{stamp},{','.join(f'{value:.4f}' for value in row)},{pixels}\n")
