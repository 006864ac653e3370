"""Everything that can be chosen about a strip adjustment."""

from dataclasses import dataclass

from flightlog.config import option

AUTO, FREE, HOLD = "auto", "free", "hold"


@dataclass(frozen=True, slots=True)
class StripOptions:
    """Defaults suit clouds of small aircraft: errors of decimetres and tenths of a degree that wander within half a minute."""

    knots_s: float = option(2.0, "spacing of the knots of the correction splines [s]", minimum=0.1, maximum=60)
    position_sigma_m: float = option(
        0.0, "error of the trajectory's positions, one sigma [m]; 0: as the trajectory states, else 0.3",
        minimum=0, maximum=100,
    )  # fmt: skip
    attitude_sigma_deg: float = option(
        0.0, "error of its attitudes, one sigma [deg]; 0: as the trajectory states, else 0.1", minimum=0, maximum=20
    )
    position_time_s: float = option(30.0, "time in which position errors change [s]", minimum=0.5, maximum=1e4)
    attitude_time_s: float = option(30.0, "time in which attitude errors change [s]", minimum=0.5, maximum=1e4)
    boresight: str = option(
        AUTO, "rotation between scanner and trajectory; auto: where strips can tell", choices=(AUTO, FREE, HOLD)
    )
    boresight_sigma_deg: float = option(0.5, "what is known of it, one sigma [deg]", minimum=1e-4, maximum=10)
    lever: str = option(
        AUTO, "offset of the scanner from the trajectory; auto: where strips can tell", choices=(AUTO, FREE, HOLD)
    )
    lever_sigma_m: float = option(0.05, "what is known of it, one sigma [m]", minimum=1e-4, maximum=5)
    lever_arm_m: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0), "scanner in the trajectory's body: right, forward, up [m]", minimum=-10, maximum=10
    )
    voxel_m: float = option(0.0, "edge of the planar patches [m]; 0: by the density of points", minimum=0, maximum=20)
    capture_m: float = option(
        0.0, "largest difference between strips to begin with [m]; 0: by the sigmas above", minimum=0, maximum=50
    )
    gap_s: float = option(2.0, "silence that ends a strip [s]", minimum=0.05, maximum=1e4)
    turn_deg: float = option(45.0, "change of course that ends a strip [deg]", minimum=5, maximum=180)
    clusters: int = option(
        1_000_000, "patches kept; beyond it whole voxels are thinned, so that memory is bounded",
        minimum=1000, maximum=20_000_000,
    )  # fmt: skip
    all_classes: bool = option(False, "patches are made of noise and of what moves too (classes 7, 18 and 69)")
