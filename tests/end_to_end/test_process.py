"""`swath process` from flight log to cloud, against the simulation's truth, laspy and pyproj."""

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
import pyproj
import pytest
import rasterio
from pymavlink.dialects.v20 import ardupilotmega as dialect
from scipy.spatial.transform import Rotation, Slerp

from flightlog import records
from flightlog.logfile import LogReader
from flightlog.logwriter import LogWriter
from groundproc.cli import main
from groundproc.trajectory.estimate import FILES

Array = npt.NDArray[np.float64]
PRODUCTS = {"cloud.laz", "quality.json", *FILES}
PICTURES = {"cloud_height.png", "cloud_intensity.png"}
LEDGER = ".swath"
RANGE_NOISE_M = 0.015
"""What the simulation puts into every range (1 sigma)."""
LEAP_S = 18
COMPLETE = (0, 3)
"""Exit codes with which the products are there; some flights here are too short, still or broken for a good verdict."""


@dataclass
class Processed:
    """Products of one run."""

    folder: Path

    @property
    def cloud(self) -> laspy.LasData:
        return laspy.read(self.folder / "cloud.laz")

    @property
    def quality(self) -> dict[str, Any]:
        content: dict[str, Any] = json.loads((self.folder / "quality.json").read_text())
        return content

    @property
    def trajectory(self) -> npt.NDArray[np.void]:
        return np.asarray(np.genfromtxt(self.folder / "trajectory.csv", delimiter=",", names=True, dtype=None))


def test_without_a_wish_all_products_are_made_and_agree(still_flight: Any, tmp_path: Path) -> None:
    assert main(["process", str(still_flight.log), "--method", "ins", "-o", str(tmp_path / "out")]) in COMPLETE
    made = Processed(tmp_path / "out")
    assert {path.name for path in made.folder.iterdir()} == PRODUCTS | PICTURES | {LEDGER} | {
        "cloud.copc.laz", "dsm.tif", "intensity.tif", "density.tif", "hillshade.tif", "trajectory.gpkg", "report.html",
    }  # fmt: skip
    cloud, octree = made.cloud, laspy.read(made.folder / "cloud.copc.laz")
    order = np.lexsort((cloud["laser"], cloud.gps_time)), np.lexsort((octree["laser"], octree.gps_time))
    np.testing.assert_array_equal(cloud.xyz[order[0]], octree.xyz[order[1]])
    with rasterio.open(made.folder / "density.tif") as density, rasterio.open(made.folder / "dsm.tif") as heights:
        # noise and what moves are no surface: they are in the cloud with their classes, and in no raster
        surface = ~np.isin(cloud.classification, (7, 18, 69))
        assert surface.mean() > 0.99
        assert density.read(1).sum() * 0.25**2 == surface.sum()
        assert heights.transform == density.transform
        # the file's points are rounded to millimetres
        assert heights.read(1, masked=True).max() == pytest.approx(np.asarray(cloud.z)[surface].max(), abs=6e-4)


def process(folder: Path, *words: Any, method: str = "ins") -> Processed:
    """Products by the autopilot's own solution where nothing else is said: these tests are about the chain, not about the verdict."""
    told = [str(word) for word in words]
    if "--products" not in told:
        told += ["--products", "cloud.laz, adjustment.png"]
    assert main(["process", *told, "--method", method, "-o", str(folder)]) in COMPLETE
    assert {path.name for path in folder.iterdir()} - {"adjustment.png"} - PICTURES == PRODUCTS | {LEDGER}
    return Processed(folder)


def points_of(cloud: laspy.LasData) -> Array:
    return np.stack([np.asarray(cloud.x), np.asarray(cloud.y), np.asarray(cloud.z)], axis=1)


def rewritten(source: Path, target: Path, keep: Callable[[Any], bool]) -> Path:
    """A copy of a log with the messages that are to be kept."""
    with LogReader(source) as reader, target.open("wb") as stream:
        writer = LogWriter(stream, metadata={}, attachments=dict(reader.attachments))
        for message in reader.messages():
            if keep(message):
                writer.write(message.topic, message.log_time_ns, bytes(message.data))
        writer.finish()
    return target


@pytest.fixture(scope="module")
def flown(gps_flight: Any, tmp_path_factory: pytest.TempPathFactory) -> Processed:
    """The flight with all errors, and the autopilot's own solution."""
    made = process(tmp_path_factory.mktemp("flown"), gps_flight.log, "--products", "cloud.laz, pictures")
    assert all((made.folder / name).is_file() for name in PICTURES)
    return made


@pytest.fixture(scope="module")
def short_log(gps_flight: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its seconds 6 to 10, for what does not need the gyros."""
    with LogReader(gps_flight.log) as reader:
        start_ns = reader.start_ns
    path = tmp_path_factory.mktemp("short") / "short.mcap"
    return rewritten(gps_flight.log, path, lambda m: 6e9 <= m.log_time_ns - start_ns < 10e9)


@pytest.fixture(scope="module")
def short(short_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Processed:
    return process(tmp_path_factory.mktemp("short_run"), short_log, "--sync", "host")


# Truth ----------------------------------------------------------------------------------------------------------------


def local_m(points: Array, epsg: int, truth: dict[str, Any]) -> Array:
    """Projected coordinates in the simulation's own frame, by PROJ and the textbook."""
    origin = truth["local_origin"]
    lon, lat = pyproj.Transformer.from_crs(epsg, 4326, always_xy=True).transform(points[:, 0], points[:, 1])
    ecef = pyproj.Transformer.from_crs(4979, 4978, always_xy=True)
    sea_m = origin["undulation_m"]
    place = np.stack(ecef.transform(lon, lat, points[:, 2] + sea_m), axis=1)
    start = ecef.transform(origin["longitude_deg"], origin["latitude_deg"], origin["height_msl_m"] + sea_m)
    phi, lam = np.deg2rad([origin["latitude_deg"], origin["longitude_deg"]])
    east = [-np.sin(lam), np.cos(lam), 0.0]
    north = [-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)]
    up = [np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)]
    return np.asarray((place - np.array(start)) @ np.array([east, north, up]).T)


def lidar_m(poses: npt.NDArray[np.void], unix_s: Array) -> Array:
    """True place of the lidar, 16 cm below the INS, at Unix times [s since the first pose]."""
    seconds = (poses["utc_ns"] - poses["utc_ns"][0]) * 1e-9
    path = np.stack([np.interp(unix_s, seconds, poses[f"{n}_m"]) for n in ("east", "north", "up")], axis=1)
    angles = np.stack([-poses["heading_deg"], poses["pitch_deg"], poses["roll_deg"]], axis=1)
    attitude = Slerp(seconds, Rotation.from_euler("ZXY", angles, degrees=True))
    return path + attitude(np.clip(unix_s, seconds[0], seconds[-1])).apply([0.0, 0.0, -0.16])


def test_with_true_poses_the_cloud_lies_on_the_true_surfaces(gps_flight: Any, tmp_path: Path) -> None:
    """The scene is a plane of ground at 0 and a plane wall at 20 m north; what a range misses them by is its own noise.

    Into the 15 mm come half a range step (0.6 mm), rounding to millimetres (0.3), and at up to 25 m and 45 deg of incidence the azimuth's
    0.005 deg (0.004 of encoder noise, 0.01 of step): 25 m x 0.09 mrad x tan 45 = 2.2 mm. Together 15.2; 15.75 are allowed. Left out
    are shots whose 2.8 mrad may touch the foot, the top or the ends of the wall.
    """
    made = process(tmp_path / "out", gps_flight.log, "--trajectory", gps_flight.poses_file, method="best")
    cloud = made.cloud
    unix_s = np.asarray(cloud.gps_time) + 1e9 - LEAP_S + 315_964_800 - gps_flight.poses["utc_ns"][0] * 1e-9
    points, lidar = local_m(points_of(cloud), 32633, gps_flight.truth), lidar_m(gps_flight.poses, unix_s)
    ray = points - lidar
    reach = np.linalg.norm(ray, axis=1)
    near = (reach < 25.0) & (reach > 2.0)
    # the wall is 35 m away: the azimuth's part grows to 4 mm, all together to 15.5
    in_sight = (reach < 45.0) & (reach > 2.0)
    on_ground = near & (np.abs(points[:, 2]) < 0.3) & (points[:, 1] < 19.5) & (-ray[:, 2] / reach > np.cos(np.pi / 4))
    ground_m = reach[on_ground] * (1.0 - lidar[on_ground, 2] / -ray[on_ground, 2])
    inside = (np.abs(points[:, 0]) < 29.5) & (points[:, 2] > 0.5) & (points[:, 2] < 7.5)
    on_wall = in_sight & inside & (np.abs(points[:, 1] - 20.0) < 0.3) & (ray[:, 1] / reach > np.cos(np.pi / 4))
    wall_m = reach[on_wall] * (1.0 - (20.0 - lidar[on_wall, 1]) / ray[on_wall, 1])
    # so many tell the ground's rms to 0.4 % and its mean to 0.08 mm
    for missed_m, least in ((ground_m, 40_000), (wall_m, 1_000)):
        assert len(missed_m) > least
        assert np.sqrt(np.mean(missed_m**2)) <= 1.05 * RANGE_NOISE_M
        # no surface is displaced: the mean of so many is their common error, the local frame's scale at sea level included (0.2 mm)
        assert abs(missed_m.mean()) < 0.0005
    # and the range stated with a point is its distance from the true lidar
    assert np.abs(np.asarray(cloud["range"]) - reach)[near].max() < 0.003
    assert np.isnan(made.trajectory["sigma_up_m"]).all()


def test_with_perfect_instruments_the_trajectory_is_the_truth(perfect_flight: Any, tmp_path: Path) -> None:
    """Positions come to 1e-7 deg (11 mm), attitudes at 25 Hz of a motion of up to 3 Hz; both on stamps cut to milliseconds."""
    made = process(tmp_path / "out", perfect_flight.log)
    truth, found = perfect_flight.poses, made.trajectory
    when = (found["utc_ns"] - truth["utc_ns"][0]) * 1e-9
    inside = (when > 0.5) & (when < 14.0)
    when = when[inside]
    seconds = (truth["utc_ns"] - truth["utc_ns"][0]) * 1e-9
    metres = np.deg2rad(1.0) * 6_371_000.0 * np.array([1.0, np.cos(np.deg2rad(58.394))])
    for name, scale in (("latitude_deg", metres[0]), ("longitude_deg", metres[1]), ("height_m", 1.0)):
        assert np.abs(found[name][inside] - np.interp(when, seconds, truth[name])).max() * scale < 0.05, name

    def attitude(table: npt.NDArray[np.void]) -> Rotation:
        return Rotation.from_euler(
            "ZXY", np.stack([-table["heading_deg"], table["pitch_deg"], table["roll_deg"]], axis=1), degrees=True
        )

    away = (Slerp(seconds, attitude(truth))(when).inv() * attitude(found[inside])).magnitude()
    assert np.rad2deg(np.sqrt(np.mean(away**2))) < 0.05
    assert np.rad2deg(away.max()) < 0.2


def test_with_real_instruments_the_trajectory_is_off_by_their_errors(gps_flight: Any, flown: Processed) -> None:
    """Position 2 m, height 1.5 m and 0.3 m, tilt 0.5 deg, compass up to 8 x 1.3 + 1.5 and 1 deg: four sigma of each."""
    truth, found = gps_flight.poses, flown.trajectory
    when, seconds = ((t["utc_ns"] - truth["utc_ns"][0]) * 1e-9 for t in (found, truth))
    away = {}
    for name in ("latitude_deg", "longitude_deg", "height_m", "roll_deg", "pitch_deg", "heading_deg"):
        values = np.rad2deg(np.unwrap(np.deg2rad(truth[name]))) if name == "heading_deg" else truth[name]
        away[name] = found[name] - np.interp(when, seconds, values)
    away["heading_deg"] = (away["heading_deg"] + 180.0) % 360.0 - 180.0
    assert np.abs(away["latitude_deg"]).max() * 111_200 < 8.0
    assert np.abs(away["longitude_deg"]).max() * 58_300 < 8.0
    assert np.abs(away["height_m"]).max() < 6.5
    assert np.abs(away["roll_deg"]).max() < 2.2
    assert np.abs(away["pitch_deg"]).max() < 2.2
    assert np.abs(away["heading_deg"]).max() < 16.0
    assert away["roll_deg"].std() < 1.0
    # the stated sigma is of that size too
    assert 0.5 < np.median(found["sigma_east_m"]) < 10.0


# The files ------------------------------------------------------------------------------------------------------------


def test_the_cloud_is_las_1_4_with_all_that_was_measured(gps_flight: Any, flown: Processed) -> None:
    cloud = flown.cloud
    assert (str(cloud.header.version), cloud.header.point_format.id) == ("1.4", 6)
    assert cloud.header.global_encoding.wkt
    assert cloud.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    crs = cloud.header.parse_crs()
    assert crs is not None
    assert [part.to_epsg() for part in crs.sub_crs_list] == [32633, 5773]
    extra = {"laser", "range", "incidence", "mixed", "sigma_h", "sigma_v"}
    assert set(cloud.point_format.extra_dimension_names) == extra
    assert np.asarray(cloud["laser"]).max() == 31
    assert 1.0 <= np.asarray(cloud["range"]).min() <= np.asarray(cloud["range"]).max() <= 100.0
    assert set(np.asarray(cloud.return_number).tolist()) == set(np.asarray(cloud.number_of_returns).tolist()) == {1}
    assert len(np.unique(cloud.intensity)) > 20
    # adjusted standard GPS time of a flight from 10:17:03 UTC: 18 leap seconds ahead of UTC
    start_s = gps_flight.truth["clocks"]["utc"]["start_ns"] * 1e-9 - 315_964_800 + LEAP_S - 1e9
    times = np.asarray(cloud.gps_time) - start_s
    assert 0.0 <= times.min() < 0.2
    assert 15.0 < times.max() <= 16.0
    assert (np.diff(times) > -0.001).all()


def test_the_report_accounts_for_every_shot(flown: Processed) -> None:
    quality = flown.quality
    assert set(quality) >= {
        "software", "inputs", "config", "mount", "local_frame", "crs", "height", "sync", "legs", "autopilot", "trajectory", "lidar",
        "points",
    }  # fmt: skip
    assert quality["points"]["written"] == flown.cloud.header.point_count
    dropped = quality["points"]["shots_dropped"]
    assert set(dropped) == {"no_pose", "outside_fov", "no_return", "out_of_range", "impossible"}
    assert quality["lidar"]["packets"] * 384 == quality["points"]["written"] + sum(dropped.values())
    # the window of 210 deg: five twelfths of the circle are left out, airframe and all
    assert dropped["outside_fov"] / (quality["lidar"]["packets"] * 384) == pytest.approx(150 / 360, abs=0.02)
    assert quality["mount"]["source"] == "log"
    assert quality["config"]["sync"] == "auto"
    assert quality["legs"][0]["utc"]["source"] == "gprmc"
    assert quality["inputs"][0]["truncated"] is False


def test_the_sync_of_the_report_is_the_true_one(
    gps_flight: Any, plain_flight: Any, flown: Processed, tmp_path: Path
) -> None:
    plain = process(tmp_path / "plain", plain_flight.log)
    for flight, made in ((gps_flight, flown), (plain_flight, plain)):
        sync = made.quality["sync"]
        assert sync["method"] == "gyro"
        assert abs(sync["offset_s"] - flight.offset_s(sync["at_lidar_s"])) < 4 * sync["sigma_s"]
        assert sync["sigma_s"] < 0.005
    # the lidar has no GPS there: SYSTEM_TIME tells UTC, to a millisecond, and the gyros the rest
    truth = plain_flight.truth["clocks"]
    times_s = np.asarray(plain.cloud.gps_time) + 1e9 + 315_964_800 - LEAP_S - truth["utc"]["start_ns"] * 1e-9
    with LogReader(plain_flight.log) as reader:
        from groundproc.flight import load

        first = next(load.lidar_batches([reader])).packets["data"][0]
    sent_s = (int(first["stamp_us"]) * 1e-6 - truth["lidar"]["start_ns"] * 1e-9) / (
        1 + truth["lidar"]["drift_ppm"] * 1e-6
    )
    # the first point is some firings after the first packet's stamp: the time past it is one of the sensor's own times
    past_us = (times_s[0] - sent_s) * 1e6
    assert past_us > -3_000
    assert plain.quality["legs"][0]["utc"]["source"] == "system_time"


def test_a_flight_recorded_as_the_original_was_gives_the_same_cloud(
    gps_flight: Any, flown: Processed, tmp_path: Path
) -> None:
    """pcap of the ground computer and tlog of the ground station, imported."""
    log = tmp_path / "imported.mcap"
    words = ["import", "--pcap", str(gps_flight.capture), "--mavlink", str(gps_flight.telemetry), "-o", str(log)]
    assert main(words) == 0
    made = process(tmp_path / "out", log)
    ours, theirs = flown.cloud, made.cloud
    assert ours.header.point_count == theirs.header.point_count
    assert np.abs(np.asarray(ours.gps_time) - np.asarray(theirs.gps_time)).max() < 1e-6
    for name in ("intensity", "laser", "range"):
        assert (np.asarray(ours[name]) == np.asarray(theirs[name])).all()
    np.testing.assert_allclose(points_of(ours), points_of(theirs), rtol=0, atol=0.0011)
    assert made.quality["mount"]["source"] == "firmware_config/mount.yaml"


def test_two_parts_of_a_flight_give_the_cloud_of_the_whole(gps_flight: Any, flown: Processed, tmp_path: Path) -> None:
    with LogReader(gps_flight.log) as reader:
        middle_ns = (reader.start_ns + reader.end_ns) // 2
    first = rewritten(gps_flight.log, tmp_path / "a.mcap", lambda m: m.log_time_ns < middle_ns)
    second = rewritten(gps_flight.log, tmp_path / "b.mcap", lambda m: m.log_time_ns >= middle_ns)
    made = process(tmp_path / "out", second, first)
    assert len(made.quality["inputs"]) == 2
    assert made.cloud.header.point_count == flown.cloud.header.point_count
    np.testing.assert_allclose(points_of(made.cloud), points_of(flown.cloud), rtol=0, atol=0.0011)


# Options --------------------------------------------------------------------------------------------------------------


def test_heights_are_of_the_kind_asked_for(short: Processed, short_log: Path, gps_flight: Any, tmp_path: Path) -> None:
    sea = points_of(short.cloud)
    assert "mean sea level" in short.quality["height"]["meaning"]
    relative = process(tmp_path / "relative", short_log, "--sync", "host", "--height", "relative")
    # home of the simulation lies 61.3 m above the sea
    np.testing.assert_allclose(
        points_of(relative.cloud)[:, 2] + gps_flight.truth["local_origin"]["height_msl_m"],
        sea[:, 2],
        rtol=0,
        atol=0.004,
    )
    above = process(tmp_path / "ellipsoid", short_log, "--sync", "host", "--height", "ellipsoid", "--geoid", "29.354")
    np.testing.assert_allclose(points_of(above.cloud)[:, 2] - 29.354, sea[:, 2], rtol=0, atol=0.004)
    for made, said in ((relative, "home"), (above, "ellipsoid")):
        assert said in made.quality["height"]["meaning"]
        crs = made.cloud.header.parse_crs()
        assert crs is not None
        assert crs.to_epsg(min_confidence=20) == 32633  # no claim about a height reference that is none


def test_another_crs_moves_the_coordinates_and_nothing_else(short: Processed, short_log: Path, tmp_path: Path) -> None:
    made = process(tmp_path / "out", short_log, "--sync", "host", "--epsg", 3009)
    crs = made.cloud.header.parse_crs()
    assert crs is not None
    assert crs.sub_crs_list[0].to_epsg(min_confidence=20) == 3009
    utm, sweref = points_of(short.cloud), points_of(made.cloud)
    expected = np.stack(
        pyproj.Transformer.from_crs(32633, 3009, always_xy=True).transform(utm[:, 0], utm[:, 1]), axis=1
    )
    np.testing.assert_allclose(sweref[:, :2], expected, rtol=0, atol=0.0015)  # two roundings to a millimetre
    assert (sweref[:, 2] == utm[:, 2]).all()


def test_the_sources_pose_grid_can_be_chosen(short: Processed, short_log: Path, tmp_path: Path) -> None:
    """One pose for 10 ms: at 4 m/s and 30 deg/s and up to 30 m that is some centimetres at most, and not nothing."""
    made = process(tmp_path / "out", short_log, "--sync", "host", "--pose-grid", "10ms")
    assert made.quality["config"]["pose_grid_ms"] == 10.0
    # the two trajectories end at different points of the 10 ms grid
    common, ours, theirs = np.intersect1d(
        np.asarray(made.cloud.gps_time), np.asarray(short.cloud.gps_time), return_indices=True
    )
    assert len(common) > 0.99 * len(short.cloud.points)
    away = np.linalg.norm(points_of(made.cloud)[ours] - points_of(short.cloud)[theirs], axis=1)
    reach = np.asarray(made.cloud["range"])[ours]
    assert 0.002 < np.median(away[reach < 30.0]) < 0.10
    assert away[reach < 15.0].max() < 0.2


def test_the_survey_file_goes_before_the_log_and_the_command_line_before_both(
    short: Processed, short_log: Path, tmp_path: Path
) -> None:
    survey = tmp_path / "survey.yaml"
    survey.write_text(
        "mount: {lidar: {pitch_deg: -20, position_m: [0, 0, 0.84]}}\nsync: gyro\nfov_deg: [0, 90]\nmin_range_m: 5\n"
    )
    made = process(tmp_path / "out", short_log, "--config", survey, "--sync", "host", "--fov", "all")
    config = made.quality["config"]
    assert (config["sync"], config["fov_deg"], config["min_range_m"]) == ("host", [0.0, 360.0], 5.0)
    assert made.quality["mount"]["source"] == "survey"
    assert np.asarray(made.cloud["range"]).min() >= 5.0
    # a lever arm of a metre more lifts everything by some 0.99 m
    common, ours, theirs = np.intersect1d(
        np.asarray(made.cloud.gps_time), np.asarray(short.cloud.gps_time), return_indices=True
    )
    assert len(common) > 10_000
    lifted = points_of(made.cloud)[ours, 2] - points_of(short.cloud)[theirs, 2]
    assert np.median(lifted) == pytest.approx(1.0, abs=0.03)


def test_dual_returns_are_numbered(dual_flight: Any, tmp_path: Path) -> None:
    made = process(tmp_path / "out", dual_flight.log)
    cloud = made.cloud
    number, of = np.asarray(cloud.return_number), np.asarray(cloud.number_of_returns)
    assert set(zip(number.tolist(), of.tolist(), strict=True)) == {(1, 1), (1, 2), (2, 2)}
    assert np.count_nonzero(number == 2) == np.count_nonzero((number == 1) & (of == 2))
    second = np.flatnonzero(number == 2)
    assert (np.asarray(cloud.gps_time)[second] == np.asarray(cloud.gps_time)[second - 1]).all()
    assert (np.asarray(cloud["laser"])[second] == np.asarray(cloud["laser"])[second - 1]).all()
    assert (np.asarray(cloud["range"])[second] >= np.asarray(cloud["range"])[second - 1]).all()
    # too short for the gyros: receive times, and it says so
    assert made.quality["sync"]["method"] == "host"
    assert "because" in made.quality["sync"]["note"]


def test_a_sensor_that_stands_still_is_placed_by_receive_times(
    still_flight: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = process(tmp_path / "out", still_flight.log)
    assert made.quality["sync"]["method"] == "host"
    assert "no motion" in made.quality["sync"]["note"]
    assert "no motion" in capsys.readouterr().out
    assert main(["process", str(still_flight.log), "--sync", "gyro", "-o", str(tmp_path / "not")]) == 1
    assert "no motion" in capsys.readouterr().err


def test_a_reboot_in_flight_leaves_a_gap_and_no_step(rebooted_flight: Any, tmp_path: Path) -> None:
    made = process(tmp_path / "out", rebooted_flight.log)
    quality = made.quality
    assert quality["autopilot"]["boots"] == 2
    assert len(quality["legs"]) == 2
    start_s, end_s = rebooted_flight.truth["reboot_s"]
    assert quality["trajectory"]["gaps_s"] == pytest.approx(end_s - start_s, abs=0.5)
    when = (made.trajectory["utc_ns"] - rebooted_flight.truth["clocks"]["utc"]["start_ns"]) * 1e-9
    assert not ((when > start_s + 0.1) & (when < end_s - 0.1)).any()
    assert (np.diff(when) > 0).all()
    cloud_s = (
        np.asarray(made.cloud.gps_time)
        + 1e9
        + 315_964_800
        - LEAP_S
        - rebooted_flight.truth["clocks"]["utc"]["start_ns"] * 1e-9
    )
    assert not ((cloud_s > start_s + 0.1) & (cloud_s < end_s - 0.1)).any()
    assert (cloud_s < start_s).any()
    assert (cloud_s > end_s).any()
    assert quality["points"]["shots_dropped"]["no_pose"] > 0


def test_a_boot_that_never_had_a_fix_leaves_a_gap(
    rebooted_flight: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before the reboot all places are zero, as on the bench without GPS; without the second boot nothing is left to fly by."""
    log, first_only = tmp_path / "cold.mcap", tmp_path / "first.mcap"
    sender = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    boot_ms = 10**9

    def cold(data: bytes) -> bytes:
        nonlocal boot_ms
        message = dialect.MAVLink(None).decode(bytearray(data))
        if message.get_type() == "ATTITUDE":
            boot_ms = message.time_boot_ms
        if boot_ms > 60_000 and message.get_type() == "GLOBAL_POSITION_INT":
            message.lat = message.lon = 0
        return bytes(message.pack(sender))

    with LogReader(rebooted_flight.log) as reader, log.open("wb") as stream, first_only.open("wb") as other:
        writers = [LogWriter(f, metadata={}, attachments=dict(reader.attachments)) for f in (stream, other)]
        reboot_ns = reader.start_ns + round(rebooted_flight.truth["reboot_s"][0] * 1e9)
        for message in reader.messages():
            data = bytes(message.data)
            if "mavlink" in message.topic:
                chunks = [(t, cold(chunk)) for t, chunk in records.decode_raw(data)]
                data = records.encode_raw(message.log_time_ns, chunks, "ins")
            for writer in writers[: 2 if message.log_time_ns < reboot_ns else 1]:
                writer.write(message.topic, message.log_time_ns, data)
        for writer in writers:
            writer.finish()
    made = process(tmp_path / "out", log)
    assert [leg["position_from"] for leg in made.quality["legs"]] == [None, "GLOBAL_POSITION_INT"]
    assert [leg["attitude_from"] for leg in made.quality["legs"]] == ["ATTITUDE", "ATTITUDE"]
    when = (made.trajectory["utc_ns"] - rebooted_flight.truth["clocks"]["utc"]["start_ns"]) * 1e-9
    assert when.min() > rebooted_flight.truth["reboot_s"][1] - 0.1
    assert made.quality["points"]["shots_dropped"]["no_pose"] > 100_000
    assert "never had a fix" in refused(capsys, tmp_path / "not", first_only)


def test_a_log_that_a_power_cut_ended_is_processed_as_far_as_it_goes(
    gps_flight: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = gps_flight.log.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(content[: len(content) * 9 // 10])
    made = process(tmp_path / "out", cut)
    assert made.quality["inputs"][0]["truncated"] is True
    assert made.quality["verdict"] == "doubtful"
    said = capsys.readouterr().out.splitlines()[-1]
    assert said.startswith("verdict: doubtful: ")
    assert "cut.mcap is cut off" in said
    assert "`swath recover cut.mcap`" in said
    assert made.quality["points"]["written"] > 100_000
    assert (made.trajectory["utc_ns"][-1] - made.trajectory["utc_ns"][0]) * 1e-9 > 10.0


# Which method ----------------------------------------------------------------------------------------------------------


def without_imu(source: Path, target: Path) -> Path:
    """A copy of a log without inertial data: neither the lidar's nor the autopilot's, whose attitude comes three times as rarely."""
    seen = 0

    def kept(data: bytes) -> bool:
        nonlocal seen
        name = dialect.MAVLink(None).decode(bytearray(data)).get_type()
        seen += name == "ATTITUDE"
        return name not in ("RAW_IMU", "SCALED_IMU", "HIGHRES_IMU") and (name != "ATTITUDE" or seen % 3 == 0)

    with LogReader(source) as reader, target.open("wb") as stream:
        writer = LogWriter(stream, metadata={}, attachments=dict(reader.attachments))
        for message in reader.messages():
            data = bytes(message.data)
            if message.topic == "/velodyne_position":
                continue
            if "mavlink" in message.topic:
                chunks = [(t, chunk) for t, chunk in records.decode_raw(data) if kept(bytes(chunk))]
                data = records.encode_raw(message.log_time_ns, chunks, "ins")
            writer.write(message.topic, message.log_time_ns, data)
        writer.finish()
    return target


def test_the_best_method_is_the_adjustment(judged_flight: Any, tmp_path: Path) -> None:
    made = process(tmp_path / "out", judged_flight.log, method="best")
    assert made.quality["trajectory"]["method"] == "adjusted"
    assert made.quality["trajectory"]["note"] == ""
    assert made.quality["config"]["method"] == "best"
    assert "estimated" in made.quality["adjusted"]
    assert (tmp_path / "out" / "adjustment.png").is_file()


def test_without_a_gyro_the_best_is_less_and_it_says_so(
    gps_flight: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = without_imu(gps_flight.log, tmp_path / "a.mcap")
    made = process(tmp_path / "out", log, "--sync", "host", method="best")
    track = made.quality["trajectory"]
    assert track["method"] in ("filtered", "ins")
    assert "not adjusted, because no gyro of 20 Hz" in track["note"]
    assert track["note"] in capsys.readouterr().out
    # it is what that method makes when asked for, and nothing in between
    asked = process(tmp_path / "asked", log, "--sync", "host", method=track["method"])
    assert asked.quality["trajectory"]["note"] == ""
    np.testing.assert_array_equal(points_of(asked.cloud), points_of(made.cloud))
    # who asks for the adjustment does not get something else
    assert "no gyro of 20 Hz" in refused(capsys, tmp_path / "not", log, "--sync", "host", "--method", "adjusted")
    assert "no gyro of 20 Hz" in refused(capsys, tmp_path / "not", log, "--sync", "host", "--causal")


# What is wrong is said in one sentence ----------------------------------------------------------------------------------


def refused(capsys: pytest.CaptureFixture[str], folder: Path, *words: Any, code: int = 1) -> str:
    """The sentence of a run that fails, and leaves nothing behind."""
    capsys.readouterr()
    assert main(["process", *(str(word) for word in words), "-o", str(folder)]) == code
    said = capsys.readouterr().err.strip()
    assert said.startswith("swath: ")
    assert "\n" not in said
    assert "Traceback" not in said
    assert not folder.is_dir() or not list(folder.iterdir())
    return said


def test_a_log_without_lidar_is_refused(short_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = rewritten(short_log, tmp_path / "a.mcap", lambda m: "velodyne" not in m.topic)
    assert "no lidar packets" in refused(capsys, tmp_path / "out", log)


def test_a_log_with_position_packets_alone_is_refused(
    short_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = rewritten(short_log, tmp_path / "a.mcap", lambda m: m.topic not in ("/velodyne_packets", "/lidar_account"))
    assert "lidar packets" in refused(capsys, tmp_path / "out", log)


def test_a_log_without_autopilot_is_refused(
    short_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = rewritten(short_log, tmp_path / "a.mcap", lambda m: "mavlink" not in m.topic)
    assert "no MAVLink" in refused(capsys, tmp_path / "out", log)


def test_what_is_no_log_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "notes.mcap").write_text("these are notes of the flight\n" * 50)
    assert "notes.mcap" in refused(capsys, tmp_path / "out", tmp_path / "notes.mcap")
    (tmp_path / "empty.mcap").write_bytes(b"")
    assert "empty.mcap" in refused(capsys, tmp_path / "out", tmp_path / "empty.mcap")
    assert "none.mcap" in refused(capsys, tmp_path / "out", tmp_path / "none.mcap")
    assert str(tmp_path) in refused(capsys, tmp_path / "out", tmp_path)


def test_a_folder_that_cannot_be_written_is_refused(
    short_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("a file where a folder should be\n")
    said = refused(capsys, tmp_path / "file" / "out", short_log)
    assert str(tmp_path / "file") in said
    assert (tmp_path / "file").read_text().startswith("a file")


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["--epsg", "4326"], 1, "EPSG:4326"),
        (["--epsg", "999999"], 1, "EPSG:999999"),
        (["--crs", "32610"], 1, "EPSG:32633"),
        (["--crs-anyway"], 2, "but no crs"),
        (["--geoid", "30"], 2, "geoid: 30 given, but nothing uses it"),
        (["--height", "ellipsoid"], 1, "--geoid"),
        (["--height", "ellipsoid", "--geoid", "nowhere.gtx"], 1, "nowhere.gtx"),
        (["--pose-grid", "10s"], 2, "10s"),
        (["--pose-grid", "10ms"], 2, "only method ins"),
        (["--method", "ins", "--causal"], 2, "only method adjusted"),
        (["--method", "ins", "--positions", "nowhere.pos"], 2, "only method adjusted or filtered"),
        (["--causal", "--positions", "nowhere.pos"], 2, "nothing that is known after the flight only"),
        (["--compass", "nowhere.yaml"], 2, "only method dynamic"),
        (["--fov", "wide"], 2, "wide"),
        (["--sync", "gyro"], 1, "gyro"),
        (["--trajectory", "nowhere.csv"], 1, "nowhere.csv"),
        (["--trajectory", ".", "--causal"], 2, "causal: True given, but nothing uses it"),
        (["--trajectory", ".", "--positions", "nowhere.pos"], 2, "positions: nowhere.pos given, but nothing uses it"),
        (["--config", "nowhere.yaml"], 2, "nowhere.yaml"),
        (["--mount", "nowhere.yaml"], 2, "nowhere.yaml"),
    ],
)
def test_a_wish_that_cannot_be_met_is_refused(
    short_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], code: int, said: str
) -> None:
    sync = [] if "--sync" in words else ["--sync", "host"]
    assert said in refused(capsys, tmp_path / "out", short_log, *sync, *words, code=code)


def test_an_unknown_key_of_the_survey_is_refused_by_name(
    short_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "survey.yaml").write_text("heigth: relative\n")
    said = refused(capsys, tmp_path / "out", short_log, "--config", tmp_path / "survey.yaml", code=2)
    assert "heigth" in said
    assert "survey.yaml" in said


def test_parts_that_overlap_are_not_of_one_flight(
    short_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "copy.mcap").write_bytes(short_log.read_bytes())
    assert "overlap" in refused(capsys, tmp_path / "out", short_log, tmp_path / "copy.mcap", code=2)


def test_poses_of_another_day_place_nothing(
    short_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = tmp_path / "poses.csv"
    rows = [f"{1_700_000_000_000_000_000 + i * 10_000_000},58.394,15.574,70,0,0,0" for i in range(100)]
    poses.write_text(
        "utc_ns,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg\n" + "\n".join(rows) + "\n"
    )
    assert "covers" in refused(capsys, tmp_path / "out", short_log, "--sync", "host", "--trajectory", poses)


def test_the_command_itself_ends_with_one_sentence_and_its_code(tmp_path: Path) -> None:
    (tmp_path / "notes.mcap").write_text("no log\n")
    command = [
        str(Path(sys.executable).with_name("swath")),
        "process",
        str(tmp_path / "notes.mcap"),
        "-o",
        str(tmp_path / "out"),
    ]
    run = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert run.returncode == 1
    assert run.stdout == ""
    assert len(run.stderr.strip().splitlines()) == 1
