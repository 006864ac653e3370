"""survey.yaml: what a user chooses about a survey, with what is taken where he does not."""

from dataclasses import dataclass
from typing import Any, Final

from flightlog.config import option
from flightlog.mount import Mount
from groundproc.estimation.dynamic.options import DynamicOptions

METHODS: Final = ("best", "adjusted", "filtered", "dynamic", "ins")


@dataclass(frozen=True, slots=True)
class Survey:
    """The options of `swath process`; on the command line they have the same names."""

    mount: Mount | str | None = option(
        None,
        "how the lidar sits on the airframe: a mount file, looked for beside this one, or what stands in it "
        "(lidar: position_m, yaw_deg, ...); null: as the log has it",
    )
    crs: int | str | None = option(
        None, "EPSG code of the output (32633 or EPSG:32633), projected and in metres; null: UTM zone of the first fix"
    )
    height: str = option("msl", "what heights refer to", choices=("msl", "ellipsoid", "relative"))
    geoid: float | str | None = option(
        None,
        "for height: ellipsoid where the autopilot does not state both heights: the geoid's height above the ellipsoid "
        "there [m], or a grid file that PROJ reads (.gtx, .tif)",
    )
    method: str = option(
        "best",
        "how the trajectory is made; best: adjusted, or where the log does not hold what that needs, filtered or ins, and it says so",
        choices=METHODS,
    )
    causal: bool = option(False, "adjusted: use nothing of the future, as in flight")
    dynamic: DynamicOptions = option(DynamicOptions, "method dynamic: trims once per revolution of the scanner")
    compass: str | None = option(
        None,
        "method dynamic: a compass model to begin with, from `swath calibrate` or `swath compass`, looked for beside this file; "
        "null: none",
    )
    positions: str | None = option(
        None,
        "methods adjusted and filtered: a better GNSS solution or poses (RTKLIB .pos, SBET, NMEA, trajectory.csv), looked for "
        "beside this file; null: none",
    )
    lasers: str | None = option(
        None,
        "corrections of the 32 lasers: a file from `swath calibrate --lasers`, looked for beside this one; estimate: method adjusted "
        "finds them on this flight; null: the manual's table",
    )
    control: str | None = option(
        None,
        "method adjusted: control points and planes (CSV: x, y, z, sigma; name, use, nx, ny, nz, radius) in coordinates and heights of "
        "the output, looked for beside this file; null: none",
    )
    pose_grid_ms: float | None = option(
        None,
        "method ins: one pose for so many milliseconds, as the source did with 10; null: a pose for every firing",
        minimum=1,
        maximum=1000,
    )
    sync: str = option(
        "auto",
        "clock offset from the gyros, from receive times, or gyros with receive times as the fallback",
        choices=("auto", "gyro", "host"),
    )
    products: tuple[Any, ...] | None = option(
        None,
        "what is made, by name: [cloud.laz, trajectory.csv, quality.json], each with its own options where it has some; "
        "null: all of docs/products.md",
    )
    fov_deg: tuple[float, float] = option(
        (255.0, 105.0), "azimuths kept, clockwise from first to second; [0, 360] keeps all", minimum=-360, maximum=360
    )
    min_range_m: float = option(1.0, "nearer returns are dropped [m]", minimum=0, maximum=131)
    max_range_m: float = option(100.0, "farther returns are dropped [m]", minimum=0, maximum=131.07)

    def __post_init__(self) -> None:
        if self.min_range_m > self.max_range_m:
            raise ValueError(f"min_range_m {self.min_range_m} is beyond max_range_m {self.max_range_m}")
