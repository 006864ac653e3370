"""survey.yaml: what a user chooses about a survey. One dataclass a step, all of them together in `Survey`.

The keys of the file are flat. On the command line the options have the names that stand here beside them.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from flightlog import config
from flightlog.mount import Mount
from groundproc.survey.dynamic import DynamicOptions
from groundproc.survey.methods import METHODS
from groundproc.survey.setting import sample_lines, setting

HEIGHTS: Final = ("msl", "ellipsoid", "relative")
BESIDE: Final = "a file looked for beside this one"


@dataclass(frozen=True)
class MountSettings:
    """Mount: how the lidar sits on the airframe."""

    mount: Mount | str | None = setting(
        None,
        "how the lidar sits on the airframe: a mount file",
        words=("--mount",),
        metavar="FILE",
        reads="file",
        absent="as the log has it",
        in_file="looked for beside this one, or what stands in it (lidar: position_m, yaw_deg, ...)",
    )


@dataclass(frozen=True)
class ClockSettings:
    """Clocks: how lidar and autopilot are put on one time scale."""

    sync: str = setting(
        "auto",
        "how the clocks are tied: by the gyros, by receive times (host), or by receive times where the gyros cannot tell (auto)",
        words=("--sync",),
        choices=("auto", "gyro", "host"),
    )
    gyro_delay_ms: float = setting(
        0.0,
        "how late the readings of the lidar's gyro are against its returns, as an earlier flight of the same unit found it: lidar.delay_s "
        "in its quality.json [ms]",
        words=("--gyro-delay-ms",),
        metavar="MS",
        minimum=-50,
        maximum=50,
    )


@dataclass(frozen=True)
class TrajectorySettings:
    """Trajectory: how the poses are estimated, and from what beside the log."""

    method: str = setting(
        "best",
        "how the trajectory is made; best: adjusted, or filtered or ins where the log does not hold what that needs",
        words=("--method",),
        choices=("best", *METHODS),
    )
    causal: bool = setting(False, "method adjusted: use nothing of the future, as in flight", words=("--causal",))
    positions: str | None = setting(
        None,
        "methods adjusted and filtered: a better GNSS solution or poses (RTKLIB .pos, SBET, NMEA, trajectory.csv)",
        words=("--positions",),
        metavar="FILE",
        reads="file",
        absent="none",
        in_file=BESIDE,
    )
    poses: str | None = setting(
        None,
        "methods adjusted and filtered: poses of images or of another program, beside positions; a table like trajectory.csv, and the "
        "covariance.npz that lies beside it",
        words=("--poses",),
        metavar="CSV",
        reads="file",
        absent="none",
        in_file=BESIDE,
    )
    control: str | None = setting(
        None,
        "method adjusted: control points and planes (CSV: x, y, z, sigma; name, use, nx, ny, nz, radius) in coordinates and heights of "
        "the output",
        words=("--control",),
        metavar="CSV",
        reads="file",
        absent="none",
        in_file=BESIDE,
    )
    lasers: str | None = setting(
        None,
        "corrections of the single lasers: a file from `swath calibrate --lasers`; or estimate, to have method adjusted find them on "
        "this flight",
        words=("--lasers",),
        metavar="FILE",
        reads="file",
        absent="the manual's table",
        in_file=BESIDE,
    )
    compass: str | None = setting(
        None,
        "method dynamic: a compass model to begin with, from `swath calibrate` or `swath compass`",
        words=("--compass",),
        metavar="FILE",
        reads="file",
        absent="none",
        in_file=BESIDE,
    )
    pose_grid_ms: float | None = setting(
        None,
        "method ins: one pose for so many milliseconds, as the source did with 10",
        words=("--pose-grid-ms",),
        metavar="MS",
        reads="milliseconds",
        absent="a pose for every firing",
        minimum=1,
        maximum=1000,
    )
    dynamic: DynamicOptions = setting(
        DynamicOptions, "method dynamic: trims of the trajectory, once per revolution of the scanner"
    )


@dataclass(frozen=True)
class PlacingSettings:
    """Points: which returns are used, for the cloud and for the trajectory that is estimated from them."""

    fov_deg: tuple[float, float] = setting(
        (255.0, 105.0),
        "azimuths kept, clockwise from first to second, in degrees; 0 and 360 keep all",
        words=("--fov-deg",),
        metavar="A-B",
        reads="azimuths",
        minimum=-360,
        maximum=360,
    )
    min_range_m: float = setting(
        1.0, "nearer returns are dropped [m]", words=("--min-range-m",), metavar="M", minimum=0, maximum=131
    )
    max_range_m: float = setting(
        100.0, "farther returns are dropped [m]", words=("--max-range-m",), metavar="M", minimum=0, maximum=131.07
    )

    def __post_init__(self) -> None:
        if self.min_range_m > self.max_range_m:
            raise ValueError(f"min_range_m {self.min_range_m} is beyond max_range_m {self.max_range_m}")


@dataclass(frozen=True)
class AttributeSettings:
    """Attributes: what is said of each point beside its place."""

    attributes: tuple[str, ...] | None = setting(
        None,
        "what is found out of each point: scan_angle, incidence, sigma, classes, strip; see docs/attributes.md",
        words=("--attributes",),
        metavar="NAMES",
        reads="names",
        absent="all",
        in_file="a list; [] for none",
    )
    boresight_sigma_deg: float = setting(
        0.5,
        "how well the angles of a mount that is not estimated are known, one sigma; it is in the sigma of points",
        words=("--boresight-sigma-deg",),
        metavar="DEG",
        minimum=0,
        maximum=20,
    )


@dataclass(frozen=True)
class TrimSettings:
    """Trim: which part of the flight goes into the products; what is left out is counted.

    What is left out still tells of what is around it.
    """

    times: tuple[str, ...] | None = setting(
        None,
        "spans of time kept, START/END: seconds of the flight (60/480) or UTC (2026-05-01T10:02:00Z/2026-05-01T10:09:30Z); an end may be "
        "left open (60/)",
        words=("--times",),
        metavar="SPANS",
        reads="names",
        absent="all of it",
        in_file="a list",
    )
    area: str | None = setting(
        None,
        "polygons on the map (GeoPackage or GeoJSON, in any CRS that they state)",
        words=("--area",),
        metavar="FILE",
        reads="file",
        absent="none",
        in_file=BESIDE,
    )
    area_keeps: str = setting(
        "inside",
        "what of the points is kept where there is an area",
        words=("--area-keeps",),
        choices=("inside", "outside"),
    )
    without_turns: bool = setting(
        False, "leave out turns: what changes the course by 45 deg or more within 6 s", words=("--without-turns",)
    )
    without_ends: bool = setting(
        False,
        "leave out take-off and landing: before the first and after the last steady flight",
        words=("--without-ends",),
    )


@dataclass(frozen=True)
class ImageSettings:
    """Images: photographs of the flight, which give the cloud colours, an ortho mosaic and a vegetation index."""

    images: str | None = setting(
        None,
        "photographs of the flight: a folder, looked through with all below it",
        words=("--images",),
        metavar="DIR",
        reads="file",
        absent="none",
        in_file="a folder looked for beside this file",
    )
    rig: str | None = setting(
        None,
        "cameras and how they sit on the aircraft: rig.yaml (Kalibr), cameras.txt (COLMAP) or camera_models.json (OpenSfM)",
        words=("--rig",),
        metavar="FILE",
        reads="file",
        absent="as the photographs state",
        in_file=BESIDE,
    )
    image_times: str | None = setting(
        None,
        "which image when: .MRK, or a CSV with image,utc_ns",
        words=("--image-times",),
        metavar="FILE",
        reads="file",
        absent="as the logs note exposures, else as the photographs state",
        in_file=BESIDE,
    )
    panels: str | None = setting(
        None,
        "surfaces of known reflectance, for the vegetation index: CSV with name,x,y,z,radius,red,green,blue,nir",
        words=("--panels",),
        metavar="CSV",
        reads="file",
        absent="the irradiance that pictures state, else the index is reported as not calibrated",
        in_file=BESIDE,
    )
    ortho_gsd_m: float = setting(
        0.05,
        "size of a pixel of ortho.tif and ndvi.tif [m]",
        words=("--ortho-gsd-m",),
        metavar="M",
        minimum=0.001,
        maximum=100,
    )


@dataclass(frozen=True)
class OutputSettings:
    """Output: which products, and their coordinates and heights."""

    crs: int | str | None = setting(
        None,
        "EPSG code of the output (32633 or EPSG:32633), projected and in metres",
        words=("--crs", "--epsg"),
        metavar="EPSG",
        absent="UTM zone of the first fix",
    )
    crs_anyway: bool = setting(
        False, "take the CRS where it is not made for the place of the flight", words=("--crs-anyway",)
    )
    height: str = setting("msl", "what heights refer to", words=("--height",), choices=HEIGHTS)
    geoid: float | str | None = setting(
        None,
        "for height ellipsoid, where the autopilot does not state both heights: the geoid's height above the ellipsoid there [m], or a "
        "grid file that PROJ reads (.gtx, .tif)",
        words=("--geoid",),
        metavar="N",
        absent="none",
    )
    products: tuple[Any, ...] | None = setting(
        None,
        "what is made beside trajectory.csv and quality.json, by name: cloud.laz,pictures",
        words=("--products",),
        metavar="NAMES",
        reads="names",
        absent="all of docs/products.md that are made by default",
        in_file="a list; a name with options of its own is a mapping: [cloud.laz, {NAME: {OPTION: VALUE}}]",
    )


@dataclass(frozen=True)
class UseSettings:
    """Uses: what people fly for, made of the finished cloud."""

    uses: tuple[Any, ...] | None = setting(
        None,
        "what is made of the cloud, by name, such as ground,wires: see docs/uses/processing.md",
        words=("--uses",),
        metavar="NAMES",
        reads="names",
        absent="nothing",
        in_file="a list; a name with options of its own is a mapping: [ground, {NAME: {OPTION: VALUE}}]",
    )
    targets: str | None = setting(
        None,
        "use reflectance: polygons of known reflectance (.geojson, .gpkg), as `swath reflectance` takes them",
        words=("--targets",),
        metavar="FILE",
        reads="file",
        absent="reflectance is relative",
        in_file=BESIDE,
    )


@dataclass(frozen=True)
class Survey(
    UseSettings,
    OutputSettings,
    ImageSettings,
    TrimSettings,
    AttributeSettings,
    PlacingSettings,
    TrajectorySettings,
    ClockSettings,
    MountSettings,
):
    """All that can be chosen: the options of `swath process`."""


SECTIONS: Final = (
    MountSettings,
    ClockSettings,
    TrajectorySettings,
    PlacingSettings,
    AttributeSettings,
    TrimSettings,
    ImageSettings,
    OutputSettings,
    UseSettings,
)
"""In the order of the flight from log to products."""
FILES: Final = (
    "mount", "positions", "poses", "control", "lasers", "compass", "area", "images", "rig", "image_times", "panels", "targets"
)  # fmt: skip
"""Options that name a file or a folder, looked for beside survey.yaml."""


def section(survey: Survey, *chosen: type[Any]) -> dict[str, Any]:
    """The settings of some sections as plain values by name."""
    names = [field.name for part in chosen for field in dataclasses.fields(part)]
    return {name: config.to_mapping(getattr(survey, name)) for name in names}


def sample(survey: Survey, notes: Mapping[str, Sequence[str]], head: str = "") -> str:
    """A commented survey.yaml.

    Parameters
    ----------
    survey : Survey
        Values to write.
    notes : mapping of str to sequence of str
        What this flight has to do with an option, by its name.
    head : str
        Lines of comment above all.
    """
    lines = [f"# {line}".rstrip() for line in head.splitlines()]
    for part in SECTIONS:
        assert part.__doc__ is not None
        lines += ["", f"# --- {part.__doc__.splitlines()[0]}"]
        for field in dataclasses.fields(part):
            lines += sample_lines(survey, field, notes.get(field.name, ()))
    return "\n".join(lines).lstrip("\n") + "\n"
