"""Doors of files that come in beside a flight: what `process` is told with, raw GNSS observations, tables, rasters, bags, manifests.

What comes after reading is left out: it has tests of its own, and takes seconds.
"""

import contextlib
import functools
import gzip
import io
import json
import random
import tempfile
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from unittest import mock

import gnss
import numpy as np
import rasterio
import seeds
from door import Door, Made, spoilt
from rasterio.transform import from_origin
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from flightlog.errors import SwathError
from groundproc.estimation import surveyed
from groundproc.estimation.calibration.compass import read_compass
from groundproc.estimation.dynamic import trims
from groundproc.estimation.method import Given
from groundproc.field import bounded, madeup
from groundproc.steps import trajectory

SECONDS = 4.0
"""Of the flight beside which the files are read."""
LASERS = f"range_m: {[0.01] * 32}\nelevation_deg: {[0.02] * 32}\n".encode()
COMPASS = b"coefficients_deg: [0.1, 0.2, 0.3]\ncovariance_deg2: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\nscatter_deg: 0.5\nruns: 2\nseen: 0.9\n"
MOUNT = seeds.MOUNT + b"gps_position_m: [0.0, 0.1, 0.3]\n"
SURVEY = b"method: adjusted\nheight: msl\nfov_deg: [0, 360]\nmin_range_m: 1.0\nproducts: [cloud.laz]\ncontrol: null\n"
TRIMS = ",".join(trims.COLUMNS).encode() + b"\n" + b"".join(
    b"%d,%d,%.2f,0,0,0,0,0,0.1,0.05,0.04,0.2,0.1,900\n" % (seeds.START_NS + k * 500_000_000, (7 * k) % 360, 3.0 - 2.9 * 0.9**k)
    for k in range(120)
)  # fmt: skip
START_S = madeup.START_NS // 10**9


def poses() -> bytes:
    """Of the flight, with sigmas."""
    head = (
        "utc_ns,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg,sigma_east_m,sigma_north_m,sigma_up_m,"
        "sigma_roll_deg,sigma_pitch_deg,sigma_heading_deg"
    )
    rows = (
        f"{madeup.START_NS - 10**9 + k * 100_000_000},{madeup.LATITUDE_DEG},{madeup.LONGITUDE_DEG},60.0,0,0,3.0,1,1,2,1,1,2"
        for k in range(60)
    )
    return "\n".join([head, *rows, ""]).encode()


def pos() -> bytes:
    """Positions of the flight, as RTKLIB has them."""
    head = "%  GPST latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio\n"
    moments = (datetime.fromtimestamp(START_S + 17 + 0.2 * k, UTC) for k in range(40))
    rows = (
        f"{moment:%Y/%m/%d %H:%M:%S}.{moment.microsecond // 1000:03d} 58.4 15.6 60.0 1 9 0.01 0.01 0.02 0 0 0 0.0 3.0\n"
        for moment in moments
    )
    return (head + "".join(rows)).encode()


def nmea() -> bytes:
    """The same as sentences."""
    out = ""
    for k in range(8):
        moment = datetime.fromtimestamp(START_S - 1 + k, UTC)
        out += seeds.sentence(f"GPGGA,{moment:%H%M%S}.00,5824.000,N,01536.000,E,4,12,0.8,60.0,M,30.0,M,1.0,0001")
        out += seeds.sentence(f"GPRMC,{moment:%H%M%S}.00,A,5824.000,N,01536.000,E,0.1,84.4,{moment:%d%m%y},,,A")
        out += seeds.sentence(f"GPGST,{moment:%H%M%S}.00,1,0.02,0.01,10,0.02,0.02,0.03")
    return out.encode()


CONTROL = b"name,x,y,z,sigma,use\n" + b"".join(b"p%d,%d,6474000,60,0.01,control\n" % (k, 535_060 + k) for k in range(5))
TUM = b"# origin 58.4 15.6 60.0 ellipsoid\n" + b"".join(
    b"%.3f %.2f 0 1 0 0 0 1\n" % (START_S + 0.1 * k, 0.1 * k) for k in range(40)
)
PAIRS = b"name,east_a,north_a,height_a,east_b,north_b,height_b\n" + b"".join(
    b"p%d,%d,20,1,%d.01,20,1.02\n" % (k, k, k) for k in range(8)
)
POLYGON = json.dumps({
    "type": "FeatureCollection",
    "crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32633"}},
    "features": [{
        "type": "Feature", "properties": {"name": "heap"},
        "geometry": {
            "type": "Polygon",
            "coordinates": [[[533_602.0, 6_470_002.0], [533_618.0, 6_470_002.0], [533_618.0, 6_470_018.0], [533_602.0, 6_470_002.0]]],
        },
    }],
}).encode()  # fmt: skip


def _written(write: Callable[[Path], object], name: str) -> bytes:
    """What a writer of files writes."""
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / name)
        return (Path(folder) / name).read_bytes()


@functools.cache
def flight() -> bytes:
    """A log that every stage takes for a flight."""
    return _written(lambda path: madeup.write_flight(path, SECONDS), "f.mcap")


@functools.cache
def observations() -> dict[str, bytes]:
    """Raw observations of a rover and a base, in the forms that receivers write."""
    week, start_s = 2312, 295_200.0
    orbits = gnss.constellation(week, start_s)
    place = gnss.ecef(58.394, 15.574, 80.0)

    def still(tow_s: np.ndarray) -> np.ndarray:
        return np.repeat(place[None], len(tow_s), axis=0)

    seen = gnss.measure(orbits, still, start_s + np.arange(0.0, 12.0), seed=1)
    return {
        "obs": _written(lambda path: gnss.write_observations(path, seen, approximate_m=place), "a.obs"),
        "24o": _written(lambda path: gnss.write_observations(path, seen, version="2.11", approximate_m=place), "a.24o"),
        "nav": _written(lambda path: gnss.write_navigation(path, orbits), "a.nav"),
        "ubx": _written(lambda path: gnss.write_ubx(path, seen), "a.ubx"),
    }


@functools.cache
def raster() -> bytes:
    """A GeoTIFF of heights."""
    heights = np.fromfunction(lambda row, column: 70.0 + 0.3 * row + 0.1 * column, (20, 20)).astype("f4")

    def write(path: Path) -> None:
        with rasterio.open(
            path, "w", driver="GTiff", width=20, height=20, count=1, dtype="float32", crs="EPSG:32633",
            transform=from_origin(533_600.0, 6_470_020.0, 1.0, 1.0), nodata=-9999.0,
        ) as file:  # fmt: skip
            file.write(heights, 1)

    return _written(write, "a.tif")


def _typestore(version: Stores) -> object:
    store = get_typestore(version)
    for text, name in (
        ("builtin_interfaces/Time stamp\nuint8[1206] data\n", "velodyne_msgs/msg/VelodynePacket"),
        ("std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets\n", "velodyne_msgs/msg/VelodyneScan"),
    ):
        store.register(get_types_from_msg(text, name))
    return store


def _scan(store, *seq: int):  # type: ignore[no-untyped-def]  # the types are made while it runs
    time_of = store.types["builtin_interfaces/msg/Time"]
    header, packet, scan = (
        store.types[name]
        for name in ("std_msgs/msg/Header", "velodyne_msgs/msg/VelodynePacket", "velodyne_msgs/msg/VelodyneScan")
    )
    parts = [
        packet(time_of(*divmod(seeds.START_NS + k * seeds.STEP_NS, 10**9)), np.frombuffer(seeds.packet(k), np.uint8))
        for k in range(12)
    ]
    return scan(header(*seq, time_of(*divmod(seeds.START_NS, 10**9)), "velodyne"), parts)


@functools.cache
def bag() -> bytes:
    """A ROS 1 bag with packets of the lidar."""
    store = _typestore(Stores.ROS1_NOETIC)

    def write(path: Path) -> None:
        with rosbag1.Writer(path) as writer:
            connection = writer.add_connection("/velodyne_packets", "velodyne_msgs/msg/VelodyneScan", typestore=store)
            writer.write(connection, seeds.START_NS, store.serialize_ros1(_scan(store, 0), connection.msgtype))

    return _written(write, "a.bag")


def _bag2(storage: rosbag2.StoragePlugin, suffix: str) -> bytes:
    store = _typestore(Stores.ROS2_HUMBLE)
    with tempfile.TemporaryDirectory() as folder:
        with rosbag2.Writer(Path(folder) / "b", version=9, storage_plugin=storage) as writer:
            connection = writer.add_connection("/velodyne_packets", "velodyne_msgs/msg/VelodyneScan", typestore=store)
            writer.write(connection, seeds.START_NS, store.serialize_cdr(_scan(store), connection.msgtype))
        return (Path(folder) / "b" / f"b.{suffix}").read_bytes()


@functools.cache
def db3() -> bytes:
    """A ROS 2 bag in SQLite."""
    return _bag2(rosbag2.StoragePlugin.SQLITE3, "db3")


@functools.cache
def ros_mcap() -> bytes:
    """A ROS 2 bag in MCAP."""
    return _bag2(rosbag2.StoragePlugin.MCAP, "mcap")


def packed(made: Made) -> Made:
    """Spoilt within the gzip file, or the gzip file itself."""

    def make(dice: random.Random) -> bytes:
        whole = gzip.compress(made(dice), 1)
        return whole if dice.random() < 0.5 else seeds.mutated(whole, dice)

    return make


def doors() -> list[Door]:
    """Those of files beside a flight."""
    adjusted = ("process", "{good}/f.mcap", "-o", "{out}", "--method", "adjusted")
    positions = (*adjusted, "--geoid", "30", "--mount", "{good}/m.yaml")
    kinds = tuple(map(spoilt, (poses(), pos(), nmea(), seeds.sbet())))
    placed = ("process", "{good}/f.mcap", "-o", "{out}", "--trajectory", "{file}")
    raw = observations()
    ppk = ("ppk", "{good}/a.obs", "--base", "{good}/b.obs", "--nav", "{good}/a.nav", "-o", "{out}.pos")
    clouds = tuple(spoilt(seeds.cloud(*kind)) for kind in (("laz", 6), ("las", 3)))

    def instead(words: tuple[str, ...], name: str) -> tuple[str, ...]:
        return tuple("{file}" if word == name else word for word in words)

    return [
        Door("process log", "a.mcap", ("process", "{file}", "-o", "{out}"), (spoilt(seeds.log()), seeds.log)),
        Door("process positions", "p.pos", (*positions, "--positions", "{file}"), kinds),
        Door("process poses", "p.csv", (*adjusted, "--poses", "{file}"), (spoilt(poses()),)),
        Door("process trajectory", "p.csv", placed, (spoilt(seeds.trajectory()),)),
        Door("process control", "c.csv", (*adjusted, "--control", "{file}"), (spoilt(CONTROL),)),
        Door("process mount", "m.yaml", (*adjusted, "--mount", "{file}"), (spoilt(MOUNT),)),
        Door("process lasers", "l.yaml", (*adjusted, "--lasers", "{file}"), (spoilt(LASERS),)),
        Door(
            "process compass", "c.yaml",
            ("process", "{good}/f.mcap", "-o", "{out}", "--method", "dynamic", "--compass", "{file}"), (spoilt(COMPASS),),
        ),
        Door("process survey", "s.yaml", ("process", "{good}/f.mcap", "-o", "{out}", "--config", "{file}"), (spoilt(SURVEY),)),
        Door("ppk rover", "r.obs", instead(ppk, "{good}/a.obs"), (spoilt(raw["obs"]), spoilt(raw["24o"]), spoilt(raw["ubx"]))),
        Door("ppk base", "b.obs", instead(ppk, "{good}/b.obs"), (spoilt(raw["obs"]), spoilt(raw["24o"]))),
        Door("ppk navigation", "n.nav", instead(ppk, "{good}/a.nav"), (spoilt(raw["nav"]),)),
        Door("compass", "t.csv", ("compass", "{file}", "-o", "{out}.yaml"), (spoilt(TRIMS),)),
        Door("export cloud", "c.laz", ("export", "{file}", "-o", "{out}.ply"), clouds),
        Door("export trajectory", "t.csv", ("export", "{file}", "-o", "{out}.tum"), (spoilt(seeds.trajectory()),)),
        Door("export poses", "t.txt", ("export", "{file}", "-o", "{out}.csv"), (spoilt(TUM),)),
        Door("assess", "p.csv", ("assess", "{good}/a.laz", "--points", "{file}"), (spoilt(seeds.control()),)),
        Door("assess cloud", "c.las", ("assess", "{file}", "--points", "{good}/c.csv"), clouds),
        Door("assess pairs", "p.csv", ("assess", "--pairs", "{file}"), (spoilt(PAIRS),)),
        Door("contours", "r.tif", ("contours", "{file}", "-o", "{out}.geojson"), (spoilt(raster()),)),
        Door("volume polygons", "p.geojson", ("volume", "{good}/a.laz", "{file}"), (spoilt(POLYGON),)),
        Door("volume base", "r.tif", ("volume", "{good}/a.laz", "{good}/p.geojson", "--base", "{file}"), (spoilt(raster()),)),
        Door("raster", "c.laz", ("raster", "{file}", "--crs", "32633", "-o", "{out}.tif"), clouds),
        Door("hillshade", "r.tif", ("raster", "{file}", "--what", "hillshade", "-o", "{out}.tif"), (spoilt(raster()),)),
        Door("replay", "a.mcap", ("replay", "{file}", "--speed", "max"), (spoilt(seeds.log()),)),
        Door("pull manifest", "m.jsonl", ("pull", "swath@aircraft", "-o", "{out}"), (spoilt(seeds.manifest()),), keeps=True),
        Door("bag", "b.bag", ("import", "--bag", "{file}", "-o", "{out}.mcap"), (spoilt(bag()),)),
        Door("bag db3", "b.db3", ("import", "--bag", "{file}", "-o", "{out}.mcap"), (spoilt(db3()),)),
        Door("bag mcap", "b.mcap", ("import", "--bag", "{file}", "-o", "{out}.mcap"), (spoilt(ros_mcap()),)),
        Door("packed pcap", "a.pcap.gz", ("import", "--pcap", "{file}", "-o", "{out}.mcap"), (packed(spoilt(seeds.pcap())),)),
        Door("packed tlog", "a.tlog.gz", ("import", "--mavlink", "{file}", "-o", "{out}.mcap"), (packed(seeds.tlog),)),
        Door("info recording", "a.pcap", ("info", "{file}"), (spoilt(seeds.pcap()), spoilt(seeds.tlog()), spoilt(seeds.dataflash()))),
    ]  # fmt: skip


def good_files(folder: Path) -> None:
    """What the other files of these commands are."""
    raw = observations()
    for name, data in (
        ("f.mcap", flight()), ("a.obs", raw["obs"]), ("b.obs", raw["obs"]), ("a.nav", raw["nav"]), ("c.csv", seeds.control()),
        ("p.geojson", POLYGON), ("m.yaml", MOUNT),
    ):  # fmt: skip
        seeds.write(folder, name, data)


@contextlib.contextmanager
def readers_only() -> Iterator[None]:
    """In the place of estimates: all that the survey names is read, and that is all."""

    def read(given: Given, progress: object) -> None:
        surveyed.surveyed(given)
        surveyed.surveyed_control(given)
        if given.survey.compass is not None:
            read_compass(Path(given.survey.compass))
        raise SwathError("read")

    with mock.patch.object(trajectory.methods, "estimate", read):
        yield


@contextlib.contextmanager
def aircraft(manifest: Path) -> Iterator[None]:
    """An aircraft whose manifest is a file, and from which nothing else comes."""

    def answer(words: Sequence[str], **limits: object) -> bounded.Done:
        if words[0] != "ssh":
            return bounded.Done(23, b"", "no such file")
        said = io.BytesIO(b'{"armed": false}' if words[-1].startswith("health") else manifest.read_bytes())
        return bounded.Done(0, said.read(), "")

    with mock.patch.object(bounded, "run", answer):
        yield
