"""The autopilot's own solution against pymavlink, scipy and pyproj on recordings, and against motions that are known."""

import gzip
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as dialect
from scipy.spatial.transform import Rotation, Slerp

from flightlog.errors import LogError
from flightlog.mavlink import Frame
from flightlog.mount import Mount
from groundproc.estimation import ins, ownsolution
from groundproc.flight import autopilot, timebase
from groundproc.flight.autopilot import Boot
from groundproc.geodesy import LocalFrame
from groundproc.trajectory.trajectory import HOLD, Trajectory

Array = npt.NDArray[np.float64]
TlogFrames = Callable[[str], list[Frame]]
FramesOf = Callable[..., list[Frame]]
HOST_NS = 1_700_000_000_000_000_000
S, MS, HALF = 10**9, 10**6, 500_000


def fly(boot: Boot, height: str = "msl", mount: Mount | None = None, **options: Any) -> Trajectory:
    """The trajectory on the boot clock, in the frame of its first fix."""
    fixes = ownsolution.position_fixes(boot, height)
    frame = LocalFrame(*(float(v[0]) for v in (fixes.latitude_deg, fixes.longitude_deg, fixes.height_m)))
    return ins.ins_trajectory(boot, fixes, frame, lambda t: t, mount or Mount(), **options)


def rotations(quat: Array) -> Rotation:
    return Rotation.from_quat(np.roll(quat, -1, axis=-1))


def of_ned(roll: Any, pitch: Any, yaw: Any) -> Rotation:
    """MAVLink's attitude in ENU and right-forward-up: aerospace ZYX in NED and FRD, both sides turned by the same half turn."""
    half_turn = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    angles = np.stack([np.asarray(v, float) for v in (yaw, pitch, roll)], axis=-1)
    return half_turn * Rotation.from_euler("ZYX", angles) * half_turn


def heartbeat() -> Any:
    return dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)


def position(
    boot_ms: int, lat: float, lon: float, alt_m: float, relative_m: float = 0.0, speed: tuple[int, int, int] = (0, 0, 0)
) -> Any:
    return dialect.MAVLink_global_position_int_message(
        boot_ms, round(lat * 1e7), round(lon * 1e7), round(alt_m * 1e3), round(relative_m * 1e3), *speed, 0
    )


def gps(boot_ms: int, lat: float, lon: float, alt_m: float, fix: int = 3, **more: int) -> Any:
    return dialect.MAVLink_gps_raw_int_message(
        boot_ms * 1000, fix, round(lat * 1e7), round(lon * 1e7), round(alt_m * 1e3), more.pop("eph", 120), more.pop("epv", 65535),
        0, 0, 9, **more,
    )  # fmt: skip


def hover(frames_of: FramesOf, positions: list[Any], seconds: float = 10.0, attitudes: list[Any] | None = None) -> Boot:
    """A boot with level attitudes at 25 Hz and given positions."""
    if attitudes is None:
        attitudes = [
            dialect.MAVLink_attitude_message(round(40 * i), 0, 0, 0, 0, 0, 0) for i in range(round(seconds * 25) + 1)
        ]
    mixed = sorted(
        [*attitudes, *positions], key=lambda m: m.time_boot_ms if hasattr(m, "time_boot_ms") else m.time_usec / 1000
    )
    (boot,) = autopilot.boots(frames_of([(HOST_NS, m) for m in [heartbeat(), *mixed]]))
    return boot


# Recordings -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["copter_flight_2015", "ardusub_2023", "arducopter313_sim"])
def test_the_trajectory_goes_through_every_message(recordings: Path, tlog_frames: TlogFrames, name: str) -> None:
    boot = autopilot.boots(tlog_frames(name))[-1]
    log = mavutil.mavlink_connection(str(recordings / "mavlink" / f"{name}.tlog"), dialect="ardupilotmega")
    theirs: dict[tuple[str, int], Any] = {}
    latest_ms = 0
    while (m := log.recv_match(type=["ATTITUDE", "GLOBAL_POSITION_INT"])) is not None:
        if m.time_boot_ms < latest_ms - 60_000:
            theirs.clear()  # another boot
        latest_ms = m.time_boot_ms
        # ArduCopter 3.1.3 stamps positions with the time of the last fix: of two with one stamp the first is nearer to it
        theirs.setdefault((m.get_type(), m.time_boot_ms), m)
    log.close()
    made = fly(boot)
    for kind in ("ATTITUDE", "GLOBAL_POSITION_INT"):
        stamps = boot.stamps_ns[kind]
        # knots are 10 ms apart: between them a smooth motion is followed, at them the message's own value is met
        poses, covered = made.where_covered(stamps)
        assert covered.mean() > 0.8
        own = [theirs[(kind, int(t // MS))] for t in stamps[covered]]
        if kind == "ATTITUDE":
            expected = of_ned(*(np.array([getattr(m, f) for m in own]) for f in ("roll", "pitch", "yaw")))
            away = np.rad2deg((rotations(poses.quat_local_ins_wxyz[covered]).inv() * expected).magnitude())
            assert np.median(away) < 0.01
            assert np.quantile(away, 0.99) < 0.2
        else:
            lat, lon, alt = (np.array([getattr(m, f) for m in own], float) for f in ("lat", "lon", "alt"))
            expected_m = made.frame.from_geodetic(lat * 1e-7, lon * 1e-7, alt * 1e-3)
            off_m = np.linalg.norm(poses.position_m[covered] - expected_m, axis=1)
            assert np.median(off_m) < 0.002
            assert np.quantile(off_m, 0.99) < 0.05
    assert made.where_covered(np.array([made.time_ns[0] - 1, made.time_ns[-1] + 1]))[1].tolist() == [False, False]


def truth_of_313(recordings: Path) -> tuple[Array, Rotation]:
    with gzip.open(recordings / "mavlink/arducopter313_sim_truth.csv.gz", "rt") as file:
        table = np.genfromtxt(file, delimiter=",")
    kept = np.append(True, np.diff(table[:, 0]) > 0)
    roll, pitch, yaw = np.deg2rad(table[kept, 2:5].T)
    return table[kept, 0], of_ned(roll, pitch, yaw)


def test_on_the_313_recording_the_attitude_follows_the_truth_within_its_lag(
    recordings: Path, tlog_frames: TlogFrames
) -> None:
    """What turns in 0.2 s, against the truth at every lag: the best one is the 4 ms of the recording's card.

    Its AHRS is off by 10 deg and pulls itself back at up to 10 deg/s, so the rates differ by 8 deg/s rms. With some 100 deg/s2 of
    angular acceleration and 2 independent values a second on 3 axes for 130 s the lag is known to 8 / 100 / sqrt(780) = 3 ms; two of
    these are allowed.
    """
    (boot,) = autopilot.boots(tlog_frames("arducopter313_sim"))
    made = fly(boot)
    host_s, truth = truth_of_313(recordings)
    line = timebase.host_line(*boot.host_pairs())
    knots = made.time_ns[::7]
    seconds = np.array([line.host_ns(int(t)) - host_s[0] * 1e9 for t in knots]) * 1e-9
    flying = (seconds > 50) & (seconds < host_s[-1] - host_s[0] - 2)
    knots, seconds = knots[flying], seconds[flying]
    turned = rotations(made.at(knots).quat_local_ins_wxyz).inv() * rotations(
        made.at(knots + 200 * MS).quat_local_ins_wxyz
    )
    path = Slerp(host_s - host_s[0], truth)
    lags_s = np.arange(-0.03, 0.0401, 0.001)
    missed = []
    for lag in lags_s:
        expected = path(seconds - lag).inv() * path(seconds + 0.2 - lag)
        missed.append((expected.inv() * turned).as_rotvec(degrees=True)[:, :2].std())
    best_s = lags_s[np.argmin(missed)]
    assert abs(best_s - 0.004) <= 0.006
    # it follows: what is left is a fifth of the motion
    assert min(missed) < 0.25 * turned.as_rotvec(degrees=True)[:, :2].std()


# Motions that are known -----------------------------------------------------------------------------------------------


def test_before_the_first_fix_the_place_is_zero_and_not_used(frames_of: FramesOf) -> None:
    cold = [position(200 * i, 0.0, 0.0, 0.0) for i in range(10)]
    warm = [position(2000 + 200 * i, 58.394, 15.574, 70.0) for i in range(30)]
    boot = hover(frames_of, cold + warm)
    made = fly(boot)
    assert made.frame.latitude_deg == pytest.approx(58.394)
    assert made.time_ns[0] >= 2000 * MS
    assert np.abs(made.position_m).max() < 0.01
    with pytest.raises(LogError, match="never had a fix"):
        fly(hover(frames_of, cold))


def test_a_log_with_a_gps_and_no_filter_is_flown_by_the_gps(frames_of: FramesOf) -> None:
    """10 m/s to the north; 1 deg of latitude at 58.4 N is 111.4 km."""
    step_deg = 2.0 / 111_392.0
    fixes = [gps(200 * i, 0.0, 0.0, 0.0, fix=1) for i in range(5)]
    fixes += [gps(1000 + 200 * i, 58.394 + step_deg * i, 15.574, 70.0 + 0.1 * i) for i in range(40)]
    made = fly(hover(frames_of, fixes))
    at = made.at(np.array([2 * S + 123 * MS, 6 * S]))
    np.testing.assert_allclose(at.position_m[:, 1], [11.23, 50.0], rtol=0, atol=0.05)
    np.testing.assert_allclose(at.position_m[:, 2], [0.56, 2.5], rtol=0, atol=0.01)
    np.testing.assert_allclose(made.velocity_m_s[100:-100, 1], 10.0, rtol=0, atol=0.1)
    with pytest.raises(LogError, match="no height above home"):
        fly(hover(frames_of, fixes), "relative")
    with pytest.raises(LogError, match="3D fix"):
        fly(hover(frames_of, fixes[:5]))
    with pytest.raises(LogError, match="neither GLOBAL_POSITION_INT nor GPS_RAW_INT"):
        fly(hover(frames_of, []))


def test_heights_are_of_the_kind_asked_for_or_refused(frames_of: FramesOf) -> None:
    places = [position(200 * i, 58.394, 15.574, 70.0, 8.7) for i in range(50)]
    boot = hover(frames_of, places)
    assert fly(boot).frame.height_m == pytest.approx(70.0)
    assert fly(boot, "relative").frame.height_m == pytest.approx(8.7)
    assert ownsolution.position_fixes(boot, "ellipsoid", 29.354).height_m[0] == pytest.approx(99.354)
    with pytest.raises(LogError, match="--geoid"):
        ownsolution.position_fixes(boot, "ellipsoid")
    # MAVLink 2 receivers state both heights
    both = [gps(200 * i, 58.394, 15.574, 70.0, alt_ellipsoid=99_300) for i in range(50)]
    stated = hover(frames_of, places + both)
    assert ownsolution.position_fixes(stated, "ellipsoid").height_m[0] == pytest.approx(99.3)
    # a number from the user goes before
    assert ownsolution.position_fixes(stated, "ellipsoid", 29.0).height_m[0] == pytest.approx(99.0)


def test_position_between_fixes_is_a_curve_with_the_stated_speed(frames_of: FramesOf) -> None:
    """A circle of 30 m radius at 8 m/s with fixes at 3 Hz: a straight line would cut it by v2 dt2 / 8 r = 30 mm."""
    times_ms = [333 * i for i in range(60)]
    turn = 8.0 / 30.0
    frame = LocalFrame(58.394, 15.574, 70.0)

    def circle(seconds: Array) -> Array:
        return np.stack([30 * np.sin(turn * seconds), 30 * np.cos(turn * seconds), 0 * seconds], axis=-1)

    fixes = []
    for ms in times_ms:
        seconds = np.array([(ms + 0.5) * 1e-3])
        lat, lon, alt = (float(v[0]) for v in frame.to_geodetic(circle(seconds)))
        east, north = 8.0 * np.cos(turn * seconds[0]), -8.0 * np.sin(turn * seconds[0])
        fixes.append(position(ms, lat, lon, alt, speed=(round(north * 100), round(east * 100), 0)))
    boot = hover(frames_of, fixes, seconds=20.0)
    places = ownsolution.position_fixes(boot, "msl")
    made = ins.ins_trajectory(boot, places, frame, lambda t: t, Mount())
    seconds = np.linspace(1.0, 19.0, 3000)
    off = made.at((seconds * 1e9).astype(np.int64)).position_m - circle(seconds)
    # 1e-7 deg is 11 mm north and 6 mm east; speeds are to 1 cm/s
    assert np.abs(off).max() < 0.012
    speed = np.gradient(made.at((seconds * 1e9).astype(np.int64)).position_m, seconds, axis=0)
    assert np.abs(np.linalg.norm(speed, axis=1) - 8.0).max() < 0.15


def spinning(rate_deg_s: float, start_deg: float, count: int = 251) -> list[Any]:
    """Level attitudes at 25 Hz that turn right; the stamps are whole milliseconds, cut."""
    found = []
    for i in range(count):
        yaw = np.deg2rad(start_deg + rate_deg_s * (40 * i + 0.5) * 1e-3)
        found.append(
            dialect.MAVLink_attitude_message(
                40 * i, 0, 0, (yaw + np.pi) % (2 * np.pi) - np.pi, 0, 0, np.deg2rad(rate_deg_s)
            )
        )
    return found


@pytest.mark.parametrize("rate_deg_s", [70.0, -70.0])
def test_a_turn_through_north_and_south_is_followed_the_short_way(frames_of: FramesOf, rate_deg_s: float) -> None:
    boot = hover(
        frames_of, [position(200 * i, 58.394, 15.574, 70.0) for i in range(51)], attitudes=spinning(rate_deg_s, 170.0)
    )
    for options, limit_deg in (({}, 1e-3), ({"grid_ns": 10 * MS}, abs(rate_deg_s) * 0.005 + 1e-3)):
        made = fly(boot, **options)
        times = np.arange(S, 9 * S, 1_234_567)
        heading_deg = 170.0 + rate_deg_s * times * 1e-9
        expected = Rotation.from_euler("Z", -heading_deg[:, None], degrees=True)
        away = np.rad2deg((rotations(made.at(times).quat_local_ins_wxyz).inv() * expected).magnitude())
        assert away.max() < limit_deg


def test_the_sources_grid_is_linear_to_10_ms_and_held(frames_of: FramesOf) -> None:
    boot = hover(frames_of, [position(200 * i, 58.394, 15.574, 70.0 + 0.02 * i**2) for i in range(51)])
    made = fly(boot, grid_ns=10 * MS)
    assert made.interpolation == HOLD
    assert set(np.diff(made.time_ns)) == {10 * MS}
    assert (made.time_ns % (10 * MS) == 0).all()
    fixes = ownsolution.position_fixes(boot, "msl")
    expected = np.interp(made.time_ns, fixes.time_ns, fixes.height_m) - made.frame.height_m
    np.testing.assert_allclose(made.position_m[:, 2], expected, rtol=0, atol=1e-5)
    smooth = fly(boot)
    middle = np.array([fixes.time_ns[25] - HALF + 100 * MS])  # a time of the grid
    # 0.02 i^2: halfway between two fixes the line lies 0.02 / 4 above the parabola
    assert made.at(middle).position_m[0, 2] - smooth.at(middle).position_m[0, 2] == pytest.approx(0.005, abs=1e-4)


def test_the_quaternion_message_says_the_same_as_the_angles(frames_of: FramesOf) -> None:
    rng = np.random.default_rng(2)
    angles = rng.uniform([-1, -1, -3], [1, 1, 3], (50, 3))
    plain = [dialect.MAVLink_attitude_message(40 * i, *a, 0, 0, 0) for i, a in enumerate(angles)]
    x, y, z, w = Rotation.from_euler("ZYX", angles[:, ::-1]).as_quat().T
    turned = [
        dialect.MAVLink_attitude_quaternion_message(40 * i, w[i], x[i], y[i], z[i], 0.1, 0.2, 0.3) for i in range(50)
    ]
    other = [dialect.MAVLink_ahrs2_message(*a, 0, 0, 0) for a in angles]
    names = []
    for messages in (plain, turned, [m for i in range(50) for m in (position(40 * i, 58, 15, 0), other[i])]):
        (boot,) = autopilot.boots(frames_of([(HOST_NS, m) for m in [heartbeat(), *messages]]))
        name, times, quat, rate = ownsolution.attitudes(boot)
        names.append(name)
        assert (rotations(quat).inv() * of_ned(*angles.T)).magnitude().max() < 1e-6
        assert times.tolist() == [40 * i * MS + HALF for i in range(50)]
    assert names == ["ATTITUDE", "ATTITUDE_QUATERNION", "AHRS2"]
    assert rate is None
    with pytest.raises(LogError, match="an attitude is needed"):
        ownsolution.attitudes(hover(frames_of, [position(0, 58, 15, 0)], attitudes=[]))


def test_the_lever_arm_of_the_antenna_is_taken_off_where_the_mount_has_one(frames_of: FramesOf) -> None:
    """The antenna 1 m ahead and 0.2 m up; heading east, so the INS is 1 m to its west."""
    east = [dialect.MAVLink_attitude_message(40 * i, 0, 0, np.pi / 2, 0, 0, 0) for i in range(251)]
    boot = hover(frames_of, [position(200 * i, 58.394, 15.574, 70.0) for i in range(51)], attitudes=east)
    made = fly(boot, mount=replace(Mount(), gps_position_m=(0.0, 1.0, 0.2)))
    np.testing.assert_allclose(made.position_m[100], [-1.0, 0.0, -0.2], rtol=0, atol=1e-6)


def test_sigmas_are_what_the_receiver_states_else_its_dilution(frames_of: FramesOf) -> None:
    places = [position(200 * i, 58.394, 15.574, 70.0) for i in range(51)]
    own = fly(hover(frames_of, places + [gps(200 * i, 58.394, 15.574, 70.0, h_acc=800, v_acc=1500) for i in range(51)]))
    np.testing.assert_allclose(own.sigma_position_m, [[0.8, 0.8, 1.5]] * len(own), rtol=0, atol=1e-9)
    dilution = fly(hover(frames_of, places + [gps(200 * i, 58.394, 15.574, 70.0, eph=140, epv=200) for i in range(51)]))
    np.testing.assert_allclose(dilution.sigma_position_m, [[3.5, 3.5, 5.0]] * len(dilution), rtol=0, atol=1e-9)
    assert (fly(hover(frames_of, places)).sigma_position_m > 0).all()


def test_position_and_attitude_that_never_overlap_are_refused(frames_of: FramesOf) -> None:
    late = [position(60_000 + 200 * i, 58.394, 15.574, 70.0) for i in range(20)]
    with pytest.raises(LogError, match="overlap"):
        fly(hover(frames_of, late))


def test_silences_are_not_interpolated_over(frames_of: FramesOf) -> None:
    """Attitude silent for 1.2 s, positions for 3.2 s; half a second of either is bridged."""
    attitudes = [
        m for m in spinning(0.0, 0.0, 501) if not 2000 < m.time_boot_ms < 3200 and not 5000 < m.time_boot_ms < 5500
    ]
    places = [position(200 * i, 58.394, 15.574, 70.0) for i in range(101) if not 10_000 < 200 * i < 13_200]
    made = fly(hover(frames_of, places, attitudes=attitudes))
    asked = {
        1.9: True,
        2.1: False,
        2.6: False,
        3.1: False,
        3.3: True,
        5.2: True,
        9.9: True,
        10.1: False,
        13.1: False,
        13.3: True,
    }
    covered = made.where_covered(np.array([round(t * 1e9) for t in asked]))[1]
    assert covered.tolist() == list(asked.values())


@pytest.mark.parametrize("bad", [range(60, 75), range(10)])
def test_a_glitch_of_400_m_is_left_out_and_said(frames_of: FramesOf, bad: range) -> None:
    north = 400.0 / 111_369.0
    messages = [(HOST_NS, heartbeat())]
    for i in range(150):
        place = 58.4 + north * (i in bad) + i * 1e-6, 15.6, 60.0
        messages.append((HOST_NS + i * 200 * MS, position(1_000 + 200 * i, *place, speed=(56, 0, 0))))
    (boot,) = autopilot.boots(frames_of(messages))
    fixes = ownsolution.position_fixes(boot, "msl")
    assert fixes.left_out == len(bad)
    assert np.ptp(fixes.latitude_deg) < 0.5 * north
    assert f"{len(bad)} positions of GLOBAL_POSITION_INT left out" in fixes.note
    assert "by up to 400 m" in fixes.note


def test_a_shift_of_400_m_that_lasts_is_kept_and_said(frames_of: FramesOf) -> None:
    messages = [(HOST_NS, heartbeat())]
    for i in range(150):
        place = 58.4 + (i >= 75) * 400.0 / 111_369.0, 15.6, 60.0
        messages.append((HOST_NS + i * 200 * MS, position(1_000 + 200 * i, *place)))
    (boot,) = autopilot.boots(frames_of(messages))
    fixes = ownsolution.position_fixes(boot, "msl")
    assert (len(fixes.time_ns), fixes.left_out) == (150, 0)
    assert "shift by 400 m at 15.0 s" in fixes.note
