"""trajectory.csv: the trajectory of the INS origin."""

from groundproc.products.product import Context
from groundproc.trajectory.table import write_trajectory


def write(context: Context) -> None:
    """Write every knot."""
    write_trajectory(context.folder / "trajectory.csv", context.estimate.trajectory)
