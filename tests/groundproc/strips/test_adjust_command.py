"""`swath adjust` on a town whose every surface is known."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import aerial
import laspy
import numpy as np
import pyproj
import pytest

from groundproc.cli import main
from groundproc.strips import work
from groundproc.strips.correction import Correction

SHORT = [(-40.0, 0.0), (40.0, 0.0), (40.0, 10.0), (-40.0, 10.0)]
"""There and back: enough to adjust, not to judge by."""


def test_strips_that_lay_decimetres_apart_lie_on_each_other(adjusted: Any) -> None:
    assert adjusted.code == 0
    before, after = (adjusted.told["differences"][name] for name in ("before", "after"))
    assert before["height"]["sigma_mad_m"] > 0.1
    assert before["plan"]["sigma_mad_m"] > 0.1
    # patches of some twenty points with 15 mm of noise: what is left is theirs
    assert after["height"]["sigma_mad_m"] < 1.5 * after["expected_sigma_m"]
    assert after["plan"]["sigma_mad_m"] < 0.04
    assert abs(after["height"]["median_m"]) < 0.003
    assert after["normal"]["count"] >= before["normal"]["count"]


def test_boresight_and_lever_arm_are_found_within_three_sigma(adjusted: Any) -> None:
    boresight, lever = adjusted.told["mount"]["boresight_deg"], adjusted.told["mount"]["lever_m"]
    assert boresight["state"] == ["estimated"] * 3
    # over strips at one height hardly anything tells how high the scanner sits: half of what was known before, a hair's breadth
    # beside where it is held; along and across it is known ten times as well
    assert lever["state"][:2] == ["estimated", "estimated"]
    assert lever["sigma"][2] > 0.4 * lever["prior_sigma"]
    assert max(lever["sigma"][:2]) < 0.15 * lever["prior_sigma"]
    error = np.array(boresight["right_forward_up"]) - [0.2, -0.15, 0.25]
    assert (np.abs(error) < 3 * np.array(boresight["sigma"])).all()
    assert (np.array(boresight["sigma"]) < 0.03).all()
    assert (np.abs(lever["right_forward_up"]) < 3 * np.array(lever["sigma"])).all()


def test_the_trajectory_comes_back_true_within_its_sigma(adjusted: Any, wrong_scan: aerial.Scan) -> None:
    found, truth = aerial.read_csv(adjusted.folder / "trajectory.csv"), wrong_scan.flight
    np.testing.assert_allclose(found.time_s, truth.time_s, rtol=0, atol=1e-9)
    before = aerial.aligned(wrong_scan.wrong.place_m, truth.place_m)
    after = aerial.aligned(found.place_m, truth.place_m)
    assert np.sqrt(np.mean(before**2)) > 0.1
    assert np.sqrt(np.mean(after**2)) < 0.02
    table = np.genfromtxt(adjusted.folder / "trajectory.csv", delimiter=",", names=True)
    # what strips cannot tell, where the whole lies and how it leans, is in the sigmas too
    for error, name in zip((found.place_m - truth.place_m).T, ("east", "north", "up"), strict=True):
        assert (np.abs(error) < 3 * table[f"sigma_{name}_m"]).mean() > 0.95
    turn = (found.attitude * truth.attitude.inv()).as_rotvec(degrees=True)
    assert (np.abs(turn[:, 2]) < 3 * table["sigma_heading_deg"]).mean() > 0.95
    assert np.abs(turn - turn.mean(axis=0)).std() < 0.02


def test_the_points_come_back_to_where_they_were_seen(adjusted: Any, wrong_scan: aerial.Scan) -> None:
    cloud = laspy.read(adjusted.folder / "cloud.laz")
    found = np.stack([cloud.x, cloud.y, cloud.z], axis=1)
    before = aerial.aligned(wrong_scan.placed_m, wrong_scan.seen_m)
    after = aerial.aligned(found, wrong_scan.seen_m)
    assert np.sqrt(np.mean(before**2)) > 0.15
    assert np.sqrt(np.mean(after**2)) < 0.025


def test_nothing_but_coordinates_changes(adjusted: Any) -> None:
    old, new = (laspy.read(folder / "cloud.laz") for folder in (adjusted.folder.parent, adjusted.folder))
    assert old.header.point_format.id == new.header.point_format.id == 7
    for name in old.point_format.dimension_names:
        if name not in ("X", "Y", "Z"):
            assert (np.asarray(old[name]) == np.asarray(new[name])).all(), name
    assert (old.header.scales == new.header.scales).all()
    assert (old.header.offsets == new.header.offsets).all()
    assert new.header.parse_crs().to_epsg() == aerial.EPSG
    assert [v.record_data_bytes() for v in new.header.vlrs if v.user_id == "somebody"] == [b"kept"]
    assert new.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    np.testing.assert_allclose(new.header.mins, [new.x.min(), new.y.min(), new.z.min()], rtol=0, atol=1e-6)


def test_noise_and_what_moves_are_moved_along_and_tell_nothing(
    adjusted: Any, wrong_scan: aerial.Scan, tmp_path: Path
) -> None:
    aerial.write_las(tmp_path / "cloud.laz", wrong_scan, wrong_scan.placed_m)
    las = laspy.read(tmp_path / "cloud.laz")
    rng = np.random.default_rng(8)
    # one plate in the air over all of the town, another over one strip
    few = rng.choice(len(las.points), len(las.points) // 10, replace=False)
    junk = las.points[few].copy()
    junk.Z[:] = junk.Z + np.int32(40_000) + (np.arange(len(few)) % 3 * 300).astype(np.int32)
    junk.classification[:] = rng.choice([7, 18, 69], len(few))
    with laspy.open(tmp_path / "cloud.laz", mode="a") as file:
        file.append_points(junk)
    aerial.write_csv(tmp_path / "given.csv", wrong_scan.wrong)
    (tmp_path / "options.yaml").write_text(
        "{position_sigma_m: 0.15, attitude_sigma_deg: 0.05, position_time_s: 15, attitude_time_s: 15}"
    )
    words = ["adjust", str(tmp_path / "cloud.laz"), "-t", str(tmp_path / "given.csv"), "-o", str(tmp_path / "out")]
    assert main([*words, "--config", str(tmp_path / "options.yaml")]) == 0
    told = json.loads((tmp_path / "out" / "adjustment.json").read_text())
    assert told["points"]["no_surface"] == len(few)
    assert told["mount"] == adjusted.told["mount"]
    after, clean = laspy.read(tmp_path / "out" / "cloud.laz"), laspy.read(adjusted.folder / "cloud.laz")
    assert len(after.points) == len(las.points) + len(few)
    np.testing.assert_array_equal(after.xyz[: len(clean.points)], clean.xyz)
    moved = after.xyz[len(clean.points) :] - laspy.read(tmp_path / "cloud.laz").xyz[len(clean.points) :]
    assert np.median(np.linalg.norm(moved, axis=1)) > 0.05


def test_pictures_are_pictures(adjusted: Any) -> None:
    for name in ("differences.png", "corrections.png"):
        assert (adjusted.folder / name).read_bytes().startswith(b"\x89PNG")


def test_a_true_cloud_stays_as_good_as_it_was(
    tmp_path: Path, true_scan: aerial.Scan, adjust: Callable[..., Any]
) -> None:
    outcome = adjust(tmp_path, true_scan)
    assert outcome.code == 0
    told = outcome.told
    before, after = (told["differences"][name]["normal"] for name in ("before", "after"))
    assert after["median_abs_m"] < 1.05 * before["median_abs_m"]
    for name in ("boresight_deg", "lever_m"):
        found = told["mount"][name]
        assert (np.abs(found["right_forward_up"]) < 3 * np.array(found["sigma"])).all()
    cloud = laspy.read(outcome.folder / "cloud.laz")
    moved = aerial.aligned(np.stack([cloud.x, cloud.y, cloud.z], axis=1), true_scan.placed_m)
    assert np.sqrt(np.mean(moved**2)) < 0.01


def test_where_nothing_overlaps_the_points_are_as_they_were(tmp_path: Path, adjust: Callable[..., Any]) -> None:
    scan = aerial.scanned(aerial.flown([(-60, 0), (60, 0)]), aerial.Errors(0.1))
    outcome = adjust(tmp_path, scan)
    assert outcome.code == 0
    assert "nothing to adjust by" in outcome.told["note"]
    assert not outcome.told["adjusted"]
    old, new = (laspy.read(folder / "cloud.laz") for folder in (tmp_path, outcome.folder))
    assert (old.points.array == new.points.array).all()


def test_over_open_water_the_points_are_as_they_were(tmp_path: Path, adjust: Callable[..., Any]) -> None:
    """Waves: no patch of the strips is a plane."""
    scan = aerial.scanned(aerial.flown(), aerial.Errors(), faces=aerial.town()[:1], rate_hz=500)
    scan.placed_m[:, 2] += np.random.default_rng(1).normal(0, 0.5, len(scan.placed_m))
    outcome = adjust(tmp_path, scan)
    assert outcome.code == 0
    assert "nothing to adjust by" in outcome.told["note"]
    old, new = (laspy.read(folder / "cloud.laz") for folder in (tmp_path, outcome.folder))
    assert (old.points.array == new.points.array).all()


def test_what_strips_cannot_tell_is_held(tmp_path: Path, adjust: Callable[..., Any]) -> None:
    """Three passes in one direction and without swaying: the lever arm shifts all of them alike, whatever it is."""
    there = [(-60, 0), (60, 0)]
    once = aerial.flown(there, sway=0.0)
    seconds = once.time_s[-1]
    step = aerial.STEP_S
    time = np.arange(0, 3 * (seconds + 10), step)
    one = np.clip(time % (seconds + 10), 0, seconds)
    place, attitude = once.at(one)
    place[:, 1] += 12 * (time // (seconds + 10))
    scan = aerial.scanned(aerial.Flight(time, place, attitude), aerial.Errors(0.1, 0.02))
    keep = scan.time_s % (seconds + 10) < seconds
    for name in ("time_s", "seen_m", "placed_m"):
        setattr(scan, name, getattr(scan, name)[keep])
    outcome = adjust(tmp_path, scan)
    assert outcome.code == 0
    lever = outcome.told["mount"]["lever_m"]
    assert lever["state"] == ["held"] * 3
    assert lever["right_forward_up"] == [0, 0, 0]
    assert min(lever["sigma"]) > 0.02
    assert outcome.told["strips"]["count"] == 3


def test_control_points_bring_the_whole_to_its_place(
    tmp_path: Path, adjust: Callable[..., Any], true_scan: aerial.Scan
) -> None:
    wrong = aerial.Errors(0.05, 0.02, shift_m=(0.0, 0.0, 0.4))
    scan = aerial.scanned(aerial.flown(), wrong)
    # the slope that all stands on: z = -8 + 16 (x + 400) / 800 + 4 (y + 400) / 800
    rng = np.random.default_rng(4)
    x, y = rng.uniform(-60, 60, 400), rng.uniform(-40, 40, 400)
    z = -8 + 0.02 * (x + 400) + 0.005 * (y + 400)
    eye = np.array([0.0, 0.0, 300.0])
    ray = np.stack([x, y, z], axis=1) - eye
    free = aerial.seen(scan.faces, eye, ray) > 0.999  # not under a house
    points = np.stack([x, y, z], axis=1)[free] + aerial.PLACE
    lines = [f"{e:.3f},{n:.3f},{u:.3f},0.01" for e, n, u in points[:60]]
    (tmp_path / "control.csv").write_text("\n".join(["x,y,z,sigma", *lines]))
    outcome = adjust(tmp_path, scan, "--control", str(tmp_path / "control.csv"), config="{position_sigma_m: 0.3}")
    assert outcome.code == 0
    cloud = laspy.read(outcome.folder / "cloud.laz")
    off = np.asarray(cloud.z) - scan.seen_m[:, 2]
    assert abs(np.median(scan.placed_m[:, 2] - scan.seen_m[:, 2])) > 0.3
    assert abs(np.median(off)) < 0.02


# one more adjustment; in the quick suite: how strips are cut, and stamps of the week (test_strips_parts)
@pytest.mark.soak
def test_several_files_with_seconds_of_the_week_and_their_own_strips(
    tmp_path: Path, wrong_scan: aerial.Scan, adjusted: Any
) -> None:
    """The same points as two files by halves of the flight, stamps of the week, strips by point source id: the same result."""
    aerial.write_csv(tmp_path / "given.csv", wrong_scan.wrong)
    half = len(wrong_scan.time_s) // 2
    for name, chosen in (("a.las", slice(0, half)), ("b.laz", slice(half, None))):
        ids = 1 + (wrong_scan.time_s[chosen] // 17).astype(int)
        aerial.write_las(
            tmp_path / name, wrong_scan, wrong_scan.placed_m, chosen=chosen, week_time=True, source=ids, crs=False
        )
    (tmp_path / "o.yaml").write_text((adjusted.folder.parent / "options.yaml").read_text())
    words = [str(tmp_path / "a.las"), str(tmp_path / "b.laz"), "-t", str(tmp_path / "given.csv"), "-o"]
    assert main(["adjust", *words, str(tmp_path / "out"), "--config", str(tmp_path / "o.yaml"), "--crs", "32633"]) == 0
    told = json.loads((tmp_path / "out" / "adjustment.json").read_text())
    assert told["strips"]["cut_by"].startswith("point source id")
    clouds = [laspy.read(tmp_path / "out" / name) for name in ("a.laz", "b.laz")]
    found = np.concatenate([np.stack([c.x, c.y, c.z], axis=1) for c in clouds])
    once = laspy.read(adjusted.folder / "cloud.laz")
    np.testing.assert_allclose(found, np.stack([once.x, once.y, once.z], axis=1), rtol=0, atol=0.02)
    assert told["points"]["outside_trajectory"] == 0


# in the quick suite: how an SBET is read (trajectory), and that any trajectory that is read is adjusted (here)
@pytest.mark.soak
def test_an_sbet_is_a_trajectory_too(tmp_path: Path, wrong_scan: aerial.Scan, adjusted: Any) -> None:
    flight = wrong_scan.wrong
    lat, lon, convergence = aerial.geodetic(flight.place_m)
    yaw, pitch, roll = flight.attitude.as_euler("ZXY").T
    records = np.zeros((len(lat), 17))
    records[:, 0] = (aerial.START_NS * 1e-9 + aerial.GPS_MINUS_UNIX_S + flight.time_s) % 604_800
    records[:, 1:4] = np.stack([np.deg2rad(lat), np.deg2rad(lon), flight.place_m[:, 2]], axis=1)
    records[:, 7:10] = np.stack([roll, pitch, (-yaw + np.deg2rad(convergence) + np.pi) % (2 * np.pi) - np.pi], axis=1)
    (tmp_path / "sbet_flight.out").write_bytes(records.astype("<f8").tobytes())
    cloud, options = adjusted.folder.parent / "cloud.laz", adjusted.folder.parent / "options.yaml"
    words = [str(cloud), "-t", str(tmp_path / "sbet_flight.out"), "-o", str(tmp_path / "out"), "--config", str(options)]
    assert main(["adjust", *words]) == 0
    one, other = (laspy.read(folder / "cloud.laz") for folder in (adjusted.folder, tmp_path / "out"))
    # positions of trajectory.csv are rounded to a hundredth of a millimetre
    np.testing.assert_allclose(one.xyz, other.xyz, rtol=0, atol=0.0021)


# a scan and an adjustment of its own; in the quick suite: how .pos is read, and adjustments by trajectories with attitude
@pytest.mark.soak
def test_positions_alone_do_for_the_splines(tmp_path: Path, adjust: Callable[..., Any]) -> None:
    """NMEA or .pos has no attitude: the mount is held, errors of position and attitude are still found."""
    scan = aerial.scanned(aerial.flown(), aerial.Errors(0.12, 0.02))
    aerial.write_las(tmp_path / "cloud.laz", scan, scan.placed_m)
    lat, lon, _ = aerial.geodetic(scan.wrong.place_m)
    rows = []
    for i in range(0, len(lat), 20):
        gps_s = aerial.START_NS * 1e-9 + aerial.GPS_MINUS_UNIX_S + scan.wrong.time_s[i]
        week, tow = int(gps_s // 604_800), gps_s % 604_800
        rows.append(
            f"{week} {tow:.3f} {lat[i]:.9f} {lon[i]:.9f} {scan.wrong.place_m[i, 2]:.4f} 1 9 0.1 0.1 0.1 0 0 0 0 0"
        )
    head = "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,ns=# of satellites)\n%  GPST latitude(deg) longitude(deg) height(m) Q ns"
    (tmp_path / "f.pos").write_text(
        f"{head} sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m) age(s) ratio\n" + "\n".join(rows)
    )
    words = [str(tmp_path / "cloud.laz"), "-t", str(tmp_path / "f.pos"), "-o", str(tmp_path / "out")]
    assert main(["adjust", *words]) == 0
    told = json.loads((tmp_path / "out" / "adjustment.json").read_text())
    assert told["mount"]["boresight_deg"]["state"] == ["held"] * 3
    before, after = (told["differences"][name]["normal"]["sigma_mad_m"] for name in ("before", "after"))
    assert after < 0.25 * before


def test_a_worse_result_is_refused_and_leaves_nothing(
    tmp_path: Path, adjust: Callable[..., Any], monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    right = work.adjust

    def worse(*arguments: Any) -> Any:
        made = right(*arguments)
        spoilt = made.correction.coefficients.copy()
        spoilt[::2, 5] += np.linspace(-0.3, 0.3, len(spoilt[::2]))
        old = made.correction
        made.correction = Correction(old.start_ns, old.knots_s, spoilt, old.boresight_rad, old.lever_m, old.shift_m)
        return made

    monkeypatch.setattr(work, "adjust", worse)
    outcome = adjust(tmp_path, aerial.scanned(aerial.flown(SHORT), aerial.Errors(), rate_hz=1500))
    assert outcome.code == 1
    said = capsys.readouterr().err
    assert "self-check" in said
    assert said.count("\n") == 1
    assert not outcome.folder.exists()


@pytest.mark.parametrize(
    ("named", "words", "sentence"),
    [
        ({"point_format": 6, "gps_s": np.zeros(1)}, [], "gps_time is 0 for all points"),
        ({"point_format": 2}, [], "have no gps_time"),
        ({"crs": False}, [], "states no CRS; give it with --crs"),
        ({}, ["--crs", "32610"], "--crs-anyway takes it all the same"),
        ({}, ["--crs", "4326"], "a projected horizontal CRS in metres is needed"),
        ({"gps_s": np.full(1, 1e8)}, [], "lie outside of the trajectory"),
        ({}, ["--control", "nowhere.csv"], "nowhere.csv: no such file"),
    ],
)
def test_what_cannot_be_used_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], named: dict[str, Any], words: list[str], sentence: str
) -> None:
    scan = aerial.scanned(aerial.flown([(-20, 0), (20, 0)]), aerial.Errors(), rate_hz=200)
    cloud, track = tmp_path / "cloud.las", tmp_path / "given.csv"
    if named.get("crs", True) and named.get("point_format", 7) == 2:
        header = laspy.LasHeader(version="1.2", point_format=2)
        flat = laspy.LasData(header)
        flat.x, flat.y, flat.z = scan.placed_m.T - aerial.PLACE[:, None]
        flat.write(cloud)
    else:
        aerial.write_las(cloud, scan, scan.placed_m, **named)
    aerial.write_csv(track, scan.wrong)
    assert main(["adjust", str(cloud), "-t", str(track), "-o", str(tmp_path / "out"), *words]) in (1, 2)
    said = capsys.readouterr().err
    assert sentence in said
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_damaged_and_foreign_files_are_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scan = aerial.scanned(aerial.flown([(-20, 0), (20, 0)]), aerial.Errors(), rate_hz=500)
    cloud, track = tmp_path / "cloud.laz", tmp_path / "given.csv"
    aerial.write_las(cloud, scan, scan.placed_m)
    aerial.write_csv(track, scan.wrong)
    whole = cloud.read_bytes()
    for content in (whole[: len(whole) * 2 // 3], b"no cloud at all", b"", whole[:300]):
        cloud.write_bytes(content)
        assert main(["adjust", str(cloud), "-t", str(track), "-o", str(tmp_path / "out")]) == 1
        said = capsys.readouterr().err
        assert said.startswith(f"swath: {cloud}: ")
        assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_input_is_never_written_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scan = aerial.scanned(aerial.flown([(-20, 0), (20, 0)]), aerial.Errors(), rate_hz=200)
    aerial.write_las(tmp_path / "cloud.laz", scan, scan.placed_m)
    aerial.write_csv(tmp_path / "given.csv", scan.wrong)
    kept = (tmp_path / "cloud.laz").read_bytes()
    words = [str(tmp_path / "cloud.laz"), "-t", str(tmp_path / "given.csv"), "-o", str(tmp_path)]
    assert main(["adjust", *words]) == 2
    assert "is an input" in capsys.readouterr().err
    assert (tmp_path / "cloud.laz").read_bytes() == kept


def test_the_corrected_file_is_of_the_same_crs_for_others(adjusted: Any) -> None:
    crs = laspy.read(adjusted.folder / "cloud.laz").header.parse_crs()
    assert crs.equals(pyproj.CRS.from_epsg(aerial.EPSG))


@pytest.mark.parametrize(
    ("version", "point_format"),
    [
        ("1.2", 1),
        pytest.param("1.3", 3, marks=pytest.mark.soak),  # as 1.2, and the flags of its format as in 1.4
        pytest.param("1.4", 6, marks=pytest.mark.soak),
        ("1.4", 8),
    ],
)
def test_files_of_all_versions_keep_what_they_hold(tmp_path: Path, version: str, point_format: int) -> None:
    """Scaled extra bytes, extended records and odd scales too."""
    scan = aerial.scanned(aerial.flown(SHORT), aerial.Errors(0.1), rate_hz=1500)
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales, header.offsets = np.array([0.01, 0.001, 0.0005]), np.array([500_000.0, 6_400_000.0, 0.0])
    header.add_extra_dim(
        laspy.ExtraBytesParams("range", np.uint16, "range [m]", scales=np.array([0.002]), offsets=np.array([0.0]))
    )
    header.add_crs(pyproj.CRS.from_epsg(aerial.EPSG), keep_compatibility=version != "1.4")
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = scan.placed_m.T
    cloud.gps_time = aerial.START_NS * 1e-9 + aerial.GPS_MINUS_UNIX_S + scan.time_s - 1e9
    cloud["range"] = np.full(len(scan.time_s), 12.34)
    cloud.return_number = np.full(len(scan.time_s), 2, np.uint8)
    cloud.number_of_returns = np.full(len(scan.time_s), 3, np.uint8)
    if version == "1.4":
        cloud.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("somebody", 5, "long record", bytes(range(256)) * 300)])
    cloud.write(tmp_path / "cloud.las")
    aerial.write_csv(tmp_path / "given.csv", scan.wrong)
    words = [str(tmp_path / "cloud.las"), "-t", str(tmp_path / "given.csv"), "-o", str(tmp_path / "out")]
    assert main(["adjust", *words]) == 0
    new = laspy.read(tmp_path / "out" / "cloud.laz")
    assert str(new.header.version) == version
    assert new.header.point_format.id == point_format
    assert not (new.points.array == cloud.points.array).all()  # it was adjusted
    for name in cloud.point_format.dimension_names:
        if name not in ("X", "Y", "Z"):
            assert (np.asarray(cloud[name]) == np.asarray(new[name])).all(), name
    np.testing.assert_allclose(np.asarray(new["range"]), 12.34, rtol=0, atol=1e-9)
    assert new.header.number_of_points_by_return[1] == len(scan.time_s)
    assert new.header.parse_crs().to_epsg() == aerial.EPSG
    if version == "1.4":
        assert [v.record_data for v in new.evlrs if v.user_id == "somebody"] == [bytes(range(256)) * 300]


def test_options_are_listed_and_wrong_ones_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["adjust", "--show-config"]) == 0
    shown = capsys.readouterr().out
    assert "knots_s: 2.0" in shown
    (tmp_path / "all.yaml").write_text(shown)
    (tmp_path / "bad.yaml").write_text("knots_s: 0")
    cloud, track = tmp_path / "cloud.laz", tmp_path / "given.csv"
    scan = aerial.scanned(aerial.flown(SHORT), aerial.Errors(0.1), rate_hz=1500)
    aerial.write_las(cloud, scan, scan.placed_m)
    aerial.write_csv(track, scan.wrong)
    words = [str(cloud), "-t", str(track), "-o", str(tmp_path / "out")]
    assert main(["adjust", *words, "--config", str(tmp_path / "bad.yaml")]) == 2
    assert "knots_s: 0" in capsys.readouterr().err
    assert main(["adjust", *words, "--config", str(tmp_path / "all.yaml"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["adjusted"]
    assert main(["adjust", str(cloud)]) == 2
    assert "-t is missing" in capsys.readouterr().err
