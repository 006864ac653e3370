"""What a file is by its content, and which command takes it: so that a wrong one is told from a damaged one, and its owner how to go on."""

import gzip
import shlex
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from flightlog import dataflash
from flightlog.container import MAGIC
from groundproc.flight.importers import tlog
from groundproc.flight.positions import localposes, rinex
from groundproc.flight.positions.nmea import looks_like_nmea
from groundproc.flight.positions.poses import looks_like_poses
from groundproc.flight.positions.rtklib import looks_like_pos
from groundproc.flight.positions.sbet import looks_like_accuracy, looks_like_sbet

_HEAD: Final = 1 << 16
"""Bytes that tell."""


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of file.

    Attributes
    ----------
    name : str
        One word.
    what : str
        For people, with its article.
    takes : str
        What to do with it; `{}` stands for the file.
    """

    name: str
    what: str
    takes: str = ""

    def sentence(self, path: Path) -> str:
        """What the file is and which command takes it."""
        return f"is {self.what}" + (f"; {self.takes.format(shlex.quote(str(path)))}" if self.takes else "")


LOG: Final = Kind(
    "log", "a flight log", "`swath info {0}` says what it holds, `swath process {0} -o DIR` makes a cloud of it"
)
CAPTURE: Final = Kind("capture", "a packet capture", "`swath import --pcap {} -o LOG.mcap` makes a flight log of it")
TLOG: Final = Kind(
    "tlog",
    "a telemetry log of a ground station",
    "`swath import --mavlink {} -o LOG.mcap` makes a flight log of it, with --pcap CAPTURE of it and the lidar's packets",
)
DATAFLASH: Final = Kind(
    "dataflash",
    "a dataflash log of an autopilot",
    "`swath import --mavlink {} -o LOG.mcap` makes a flight log of it, with --pcap CAPTURE of it and the lidar's packets",
)
MAVLINK: Final = Kind(
    "mavlink", "a MAVLink stream without times", "nothing ties it to a lidar; a .tlog or a .bin is needed"
)
CLOUD: Final = Kind(
    "cloud",
    "a point cloud (LAS or LAZ)",
    "`swath view {0}` shows it, `swath ground {0} -o OUT.laz --dtm DTM.tif` makes a terrain model of it, "
    "`swath adjust {0} -t TRAJECTORY -o DIR` adjusts its strips",
)
SOLUTION: Final = Kind(
    "solution", "a GNSS solution or trajectory", "`swath process LOG --positions {} -o DIR` takes it along"
)
POSES: Final = Kind(
    "poses",
    "a trajectory",
    "`swath process LOG --trajectory {0} -o DIR` places points with it, --positions {0} takes it along",
)
ORIENTATIONS: Final = Kind(
    "orientations", "a table of poses of photographs", "`swath images IMAGES --start {} -o DIR` begins with them"
)
ACCURACY: Final = Kind("accuracy", "the accuracy file of an SBET", "it is read together with the SBET beside it")
OBSERVATIONS: Final = Kind(
    "observations", "a file of raw GNSS observations", "`swath ppk {} --base FILE -o OUT.pos` makes positions of it"
)
NAVIGATION: Final = Kind("navigation", "a file of GNSS ephemerides", "`swath ppk ROVER --base FILE --nav {}` takes it")
TRIMS: Final = Kind("trims", "a table of trims", "`swath compass {} -o compass.yaml` learns a compass from it")
CONTROL: Final = Kind("control", "a table of control points", "`swath process LOG --control {} -o DIR` takes it along")
SCANS: Final = Kind(
    "scans", "a table of a line scanner", "`swath import --scans {} --imu CSV --positions FILE` takes it"
)
IMU: Final = Kind("imu", "a table of an IMU", "`swath import --scans FILE --imu {} --positions FILE` takes it")
TABLE: Final = Kind("table", "a table (CSV)")
MOUNT: Final = Kind("mount", "a mount file", "`swath process LOG --mount {} -o DIR` takes it along")
SURVEY: Final = Kind("survey", "a survey file", "`swath process LOG --config {} -o DIR` takes it along")
YAML: Final = Kind("yaml", "a text with keys and values (YAML)")
JSON: Final = Kind("json", "a JSON file")
BAG: Final = Kind("bag", "a ROS bag", "`swath import --bag {} -o LOG.mcap` makes a flight log of it")
FEATURES: Final = Kind("features", "a GeoPackage", "`swath volume CLOUD {}` measures within its polygons")
GZIP: Final = Kind("gzip", "compressed with gzip", "`gunzip {}` unpacks it")
ARCHIVE: Final = Kind("archive", "an archive (zip, or arrays of numpy)")
PICTURE: Final = Kind("picture", "a picture")
TEXT: Final = Kind("text", "a text file")
EMPTY: Final = Kind("empty", "empty")
PRODUCTS: Final = Kind("products", "a folder of products", "`swath process {}` goes on with it")
FOLDER: Final = Kind("folder", "a folder")

_SQLITE: Final = b"SQLite format 3\x00"
_GEOPACKAGE_AT: Final = 68
"""Where a database says whose it is: GPKG, or GP10 and GP11 of the first versions."""
_MAGICS: Final[tuple[tuple[bytes, Kind], ...]] = (
    (MAGIC, LOG),
    (b"\xd4\xc3\xb2\xa1", CAPTURE),
    (b"\xa1\xb2\xc3\xd4", CAPTURE),
    (b"\x4d\x3c\xb2\xa1", CAPTURE),
    (b"\xa1\xb2\x3c\x4d", CAPTURE),
    (b"\x0a\x0d\x0d\x0a", CAPTURE),
    (b"LASF", CLOUD),
    (b"#ROSBAG", BAG),
    (_SQLITE, BAG),
    (b"PK\x03\x04", ARCHIVE),
    (b"ULog\x01", Kind("ulog", "a log of PX4", "swath reads ArduPilot's logs: .tlog and .bin")),
    (b"\x89PNG", PICTURE),
    (b"\xff\xd8\xff", PICTURE),
    (b"II*\x00", PICTURE),
    (b"MM\x00*", PICTURE),
    (b"ply\n", Kind("ply", "a point cloud (PLY)", "swath reads LAS and LAZ")),
    (b"ply\r\n", Kind("ply", "a point cloud (PLY)", "swath reads LAS and LAZ")),
    (b"ASTM-E57", Kind("e57", "a point cloud (E57)", "swath reads LAS and LAZ")),
    (b"# .PCD", Kind("pcd", "a point cloud (PCD)", "swath reads LAS and LAZ")),
)
_TABLES: Final[tuple[tuple[frozenset[str], Kind], ...]] = (
    (frozenset({"time_ns", "angle_deg"}), SCANS),
    (frozenset({"time_ns", "gyro_x_rad_s"}), IMU),
    (frozenset({"x", "y", "z"}), CONTROL),
)
"""Columns that tell, the more telling first."""
_SURVEY_KEYS: Final = frozenset(("method", "sync", "crs", "height", "fov_deg", "products", "positions", "control"))


def kind_of(path: Path) -> Kind | None:
    """What a file or folder is; None where nothing known tells, or it cannot be read."""
    try:
        if path.is_dir():
            return PRODUCTS if (path / ".swath" / "ledger.json").is_file() else FOLDER
        if not path.is_file():  # a device or a pipe would be drained by looking
            return None
        with path.open("rb") as file:
            head = file.read(_HEAD)
        size = path.stat().st_size
    except (OSError, ValueError):
        return None
    if head[:2] == b"\x1f\x8b":
        return _packed(path)
    return of_head(head, size)


def of_head(head: bytes, size: int) -> Kind | None:
    """What a file is by its first bytes and its size [bytes]."""
    if not head:
        return EMPTY
    if head.startswith(_SQLITE) and head[_GEOPACKAGE_AT : _GEOPACKAGE_AT + 2] == b"GP":
        return FEATURES
    for magic, kind in _MAGICS:
        if head.startswith(magic):
            return kind
    for tells, kind in _tests(head, size):
        if tells():
            return kind
    return _text(head)


def _tests(head: bytes, size: int) -> tuple[tuple[Callable[[], bool], Kind], ...]:
    """What has no magic number is recognised as its reader would."""
    text = "" if b"\x00" in head else head.decode("utf-8-sig", errors="replace")
    return (
        (lambda: dataflash.is_dataflash(head), DATAFLASH),
        (lambda: rinex.kind_of(head) == "navigation", NAVIGATION),
        (lambda: rinex.kind_of(head) != "", OBSERVATIONS),
        (lambda: looks_like_pos(text), SOLUTION),
        (lambda: _trims(text), TRIMS),
        (lambda: {"image", "omega_deg", "phi_deg", "kappa_deg"} <= _columns(text), ORIENTATIONS),
        (lambda: looks_like_poses(text), POSES),
        (lambda: localposes.looks_like(text) != "", SOLUTION),
        (lambda: looks_like_nmea(head), SOLUTION),
        (lambda: not text and looks_like_sbet(head, size), SOLUTION),
        (lambda: not text and looks_like_accuracy(head, size), ACCURACY),
        (lambda: not text and tlog.is_tlog(head), TLOG),
        (lambda: not text and tlog.is_plain_mavlink(head), MAVLINK),
    )


def _packed(path: Path) -> Kind:
    """A gzip file, with what is inside where that is told."""
    try:
        with gzip.open(path) as file:
            inside = of_head(file.read(_HEAD), 0)
    except (OSError, EOFError, zlib.error):
        inside = None
    if inside is None or inside is EMPTY:
        return GZIP
    return Kind(GZIP.name, f"{inside.what}, compressed with gzip", GZIP.takes)


def _columns(text: str) -> frozenset[str]:
    first = text.lstrip().partition("\n")[0].lstrip("#")
    return frozenset(name.strip().lower() for name in first.replace(";", ",").split(","))


def _trims(text: str) -> bool:
    return {"utc_ns", "heading_deg", "yaw_deg"} <= _columns(text)


def _text(head: bytes) -> Kind | None:
    """What kind of text bytes are; None where they are none."""
    try:
        text = head[: _HEAD - 4].decode("utf-8-sig")
    except UnicodeDecodeError:
        return None
    if any(ord(sign) < 32 and sign not in "\t\n\r\f\x1b" for sign in text):
        return None
    columns = _columns(text)
    for names, kind in _TABLES:
        if names <= columns:
            return kind
    if text.lstrip().startswith("{"):
        return JSON
    keys = {
        line.partition(":")[0] for line in text.splitlines() if ":" in line and not line.startswith((" ", "#", "-"))
    }
    if keys:
        return _yaml(keys, text)
    return TABLE if len(columns) > 1 else TEXT


def _yaml(keys: set[str], text: str) -> Kind:
    """Which of our files a text of keys and values is."""
    if "lidar" in keys and "position_m" in text:
        return MOUNT
    if not all(key.strip().isidentifier() for key in keys):
        return TEXT
    return SURVEY if keys & _SURVEY_KEYS else YAML
