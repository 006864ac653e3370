"""Errors that are drawn or set show in what is sent, by the size that truth.json states."""

from dataclasses import replace

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega
from scipy.spatial.transform import Rotation

from simulator.autopilot import Autopilot
from simulator.chance import generator
from simulator.clocks import clocks
from simulator.config import FaultOptions, FlightOptions, InsOptions, MountOptions, Options, perfect
from simulator.faults import arriving
from simulator.flight import Flight
from simulator.geodesy import Origin
from simulator.imu import Triad, Wander
from simulator.ins import Ins
from simulator.scene import scene
from simulator.simulation import Job, Simulation

CALM = FlightOptions(vibration_deg=0.0)


def flown(seconds=30.0, seed=2):
    return Flight(scene("field", seed).route, seconds, CALM, seed)


def believed(time_s, seed=2, faults=None, antenna_m=None, flight=None, **values):
    ins = Ins(flight or flown(), replace(perfect(Options(), "ins").ins, **values), seed, antenna_m, faults)
    return ins, ins.belief(time_s, generator(seed, "test"))


def frd(values):
    return values[:, [1, 0, 2]] * [1, 1, -1]


TIME_S = np.arange(4.0, 29.0, 0.01)


def slope(seen, true):
    return (seen * true).sum(axis=0) / (true * true).sum(axis=0)


def test_a_scale_error_of_one_percent_makes_rates_one_percent_larger():
    flight = flown()
    _, clean = believed(TIME_S, flight=flight)
    _, seen = believed(TIME_S, flight=flight, gyro_scale_fixed=(0.01, -0.02, 0.03), accel_scale_fixed=(0, 0, 0.01))
    assert slope(seen.rates_frd_rad_s, clean.rates_frd_rad_s) == pytest.approx([0.98, 1.01, 1.03], abs=1e-12)
    assert slope(seen.force_frd_m_s2, clean.force_frd_m_s2) == pytest.approx([1.0, 1.0, 1.01], abs=1e-12)


def test_what_is_drawn_is_what_the_matrix_says_and_of_its_size():
    flight = flown()
    _, clean = believed(TIME_S, flight=flight)
    ins, seen = believed(TIME_S, flight=flight, gyro_scale=0.01, gyro_misalignment_deg=0.5, accel_bias_m_s2=0.1)
    assert frd(seen.rates_frd_rad_s) == pytest.approx(frd(clean.rates_frd_rad_s) @ ins.gyros.matrix.T, abs=1e-12)
    bias = frd(seen.force_frd_m_s2 - clean.force_frd_m_s2)
    assert np.ptp(bias, axis=0).max() < 1e-9
    assert bias[0] == pytest.approx(ins.accelerometers.bias, abs=1e-9)
    drawn = [
        Triad.drawn(generator(i, "x"), scale=0.01, scale_fixed=(0, 0, 0), misalignment_deg=0.5, bias=0.1)
        for i in range(200)
    ]
    matrices, biases = np.array([t.matrix for t in drawn]), np.array([t.bias for t in drawn])
    # of 600 numbers the standard deviation is known to 3 %, of 1200 to 2 %; three times that
    assert matrices[:, range(3), range(3)].std() == pytest.approx(0.01, rel=0.09)
    assert np.degrees(matrices[:, ~np.eye(3, dtype=bool)].std()) == pytest.approx(0.5, rel=0.06)
    assert biases.std() == pytest.approx(0.1, rel=0.09)


def test_a_bias_that_wanders_grows_with_the_root_of_time_and_is_stated():
    ends = np.array([Wander(generator(i, "x"), 240.0, 0.1).at(np.array([0.0, 60.0, 240.0])) for i in range(150)])
    assert (ends[:, 0] == 0).all()
    # 450 values: the standard deviation is known to 3.3 %; three times that
    assert ends[:, 1].std() == pytest.approx(0.1, rel=0.1)
    assert ends[:, 2].std() == pytest.approx(0.2, rel=0.1)
    flight = flown()
    _, clean = believed(TIME_S, flight=flight)
    ins, seen = believed(TIME_S, flight=flight, gyro_walk_deg_s=0.1, accel_walk_m_s2=0.02)
    stated = np.degrees(ins.gyro_wander.listed())
    extra = np.degrees(frd(seen.rates_frd_rad_s - clean.rates_frd_rad_s))
    assert extra[TIME_S.searchsorted(20.0)] == pytest.approx(stated[2], abs=1e-3)
    assert np.abs(frd(seen.force_frd_m_s2 - clean.force_frd_m_s2)).max() < 0.1


def test_perfect_takes_all_of_it_out():
    wrong = replace(
        Options(),
        ins=InsOptions(
            gyro_scale=0.01,
            gyro_scale_fixed=(0.1, 0, 0),
            gyro_walk_deg_s=1.0,
            accel_bias_m_s2=1.0,
            position_delay_s=0.2,
        ),
        lidar=replace(Options().lidar, elevation_error_deg=0.1),
        gyros=replace(Options().gyros, scale=0.01, misalignment_deg=1.0, offset_walk_deg_s=1.0),
    )
    assert perfect(wrong) == perfect(Options())


def test_switching_on_an_error_of_the_imu_leaves_the_positions_as_they_were():
    flight = flown()
    ins = [Ins(flight, InsOptions(gyro_scale=s, accel_bias_m_s2=10 * s), 5) for s in (0.0, 0.01)]
    beliefs = [i.belief(TIME_S, generator(5, "test")) for i in ins]
    assert (beliefs[0].position_m == beliefs[1].position_m).all()
    assert (beliefs[0].heading_rad == beliefs[1].heading_rad).all()


def test_positions_are_older_than_attitudes_by_the_delay():
    flight = flown()
    _, seen = believed(TIME_S, flight=flight, position_delay_s=0.2, gyro_delay_s=0.008)
    assert seen.position_m == pytest.approx(flight.poses(TIME_S - 0.208).position_m, abs=1e-9)
    assert seen.velocity_m_s == pytest.approx(flight.velocity_m_s(TIME_S - 0.208), abs=1e-9)
    assert seen.pitch_rad == pytest.approx(flight.poses(TIME_S - 0.008).pitch_rad, abs=1e-12)


def test_positions_are_those_of_the_antenna():
    flight, lever = flown(), (0.1, -0.3, 0.2)
    _, seen = believed(TIME_S, flight=flight, antenna_m=lever)
    poses = flight.poses(TIME_S)
    body = Rotation.from_euler("ZXY", np.stack([-poses.heading_rad, poses.pitch_rad, poses.roll_rad], axis=1))
    assert seen.position_m == pytest.approx(poses.position_m + body.apply(lever), abs=1e-9)
    # the velocity is the slope of the position: central differences over 20 ms of motion up to 3 Hz
    slope_m_s = (seen.position_m[2:] - seen.position_m[:-2]) / 0.02
    assert np.abs(slope_m_s - seen.velocity_m_s[1:-1]).max() < 0.02


def test_an_outage_coasts_by_the_tilt_error_and_comes_back():
    gap = FaultOptions(gnss_gap_at_s=8.0, gnss_gap_s=15.0)
    flight = flown()
    _, seen = believed(TIME_S, flight=flight, faults=gap, tilt_sigma_deg=0.5)
    error = seen.position_m - flight.poses(TIME_S).position_m
    before, inside, after = TIME_S < 7.8, (TIME_S > 9) & (TIME_S < 23), TIME_S > 28.5
    assert np.abs(error[before]).max() < 0.01
    assert np.abs(error[:, 2]).max() < 1e-9  # the barometer does not need a fix
    away = np.linalg.norm(error[inside], axis=1)
    # gravity through half a degree for 15 s: 9.6 m; of a process that wanders, part of that
    assert 1.0 < away.max() < 30.0
    assert np.linalg.norm(error[after], axis=1).max() < 0.5 * away.max()
    # no jump anywhere: within 10 ms it goes no farther than its speed
    steps = np.linalg.norm(np.diff(error, axis=0), axis=1)
    assert steps.max() < 0.01 * (np.linalg.norm(seen.velocity_m_s - flight.velocity_m_s(TIME_S), axis=1).max() + 0.1)


def test_an_accelerometers_bias_alone_drifts_by_half_its_square():
    flight = Flight(scene("panels", 1).route, 30.0, CALM, 1)
    ins, seen = believed(
        np.array([25.0]), flight=flight, faults=FaultOptions(gnss_gap_at_s=5.0, gnss_gap_s=24.0), accel_bias_m_s2=0.1
    )
    drift = seen.position_m[0] - flight.poses(np.array([25.0])).position_m[0]
    # the tripod looks north and is level; 20 s, on a grid of 0.1 s
    assert drift[:2] == pytest.approx(0.5 * ins.accelerometers.bias[:2] * 20.0**2, rel=0.02)


def test_messages_say_that_there_is_no_fix():
    options = replace(perfect(Options(), "ins"), faults=FaultOptions(gnss_gap_at_s=5.0, gnss_gap_s=4.0))
    flight = flown(12.0)
    ins, clock = Ins(flight, options.ins, 2, None, options.faults), clocks(options.clocks)
    frames = list(Autopilot(ins, clock, options, Origin(), 2).between(0.0, 12.0, 0))
    messages = [(f.built_s, ardupilotmega.MAVLink(None).parse_buffer(f.data)[0]) for f in frames]
    raw = [(t, m) for t, m in messages if m.get_type() == "GPS_RAW_INT"]
    for t, m in raw:
        assert (m.fix_type < 3) == (5.0 <= t < 9.0)
    held = {(m.lat, m.lon, m.time_usec) for _, m in raw if m.fix_type < 3}
    assert len(held) == 1
    on = [(m.lat, m.lon) for t, m in messages if m.get_type() == "GLOBAL_POSITION_INT" and 5.0 <= t < 9.0]
    assert len(on) == len(set(on)) > 20


def test_a_levelled_magnetometer_points_where_the_compass_says():
    flight = flown()
    ins, seen = believed(TIME_S, flight=flight, compass_bias_deg=8.0, compass_offset_deg=1.5)
    poses = flight.poses(TIME_S)
    # textbook: undo roll about forward, then pitch about right, in forward right down; heading from what is left
    x, y, z = seen.field_frd_mgauss.T
    across = y * np.cos(poses.roll_rad) - z * np.sin(poses.roll_rad)
    below = y * np.sin(poses.roll_rad) + z * np.cos(poses.roll_rad)
    ahead = x * np.cos(poses.pitch_rad) + below * np.sin(poses.pitch_rad)
    error = np.arctan2(-across, ahead) - poses.heading_rad - ins.compass_error_rad(poses.heading_rad)
    assert np.abs((error + np.pi) % (2 * np.pi) - np.pi).max() < 1e-9
    assert np.linalg.norm(seen.field_frd_mgauss, axis=1) == pytest.approx(np.hypot(160, 480))


def test_positions_may_bear_the_stamp_of_the_last_fix():
    options = perfect(Options(), "ins")
    stamps = {}
    for name in ("built", "fix"):
        asked = replace(options, link=replace(options.link, position_stamp=name, position_hz=25.0))
        flight = flown(6.0)
        frames = Autopilot(Ins(flight, asked.ins, 2), clocks(asked.clocks), asked, Origin(), 2).between(0.0, 6.0, 0)
        messages = [ardupilotmega.MAVLink(None).parse_buffer(f.data)[0] for f in frames]
        stamps[name] = np.array([m.time_boot_ms for m in messages if m.get_type() == "GLOBAL_POSITION_INT"])
    age_ms = stamps["built"] - stamps["fix"]
    # fixes come in five times a second; several positions share one
    assert age_ms.min() >= 0
    assert 100 < age_ms.max() <= 201
    assert len(set(stamps["fix"].tolist())) == pytest.approx(30, abs=2)


def test_the_truth_states_what_was_drawn(tmp_path):
    options = replace(
        Options(),
        mount=MountOptions(
            boresight_spread_deg=1.0, lever_spread_m=0.02, gps_position_m=(0, 0, 0.2), gps_error_m=(0.05, 0, 0)
        ),
        lidar=replace(Options().lidar, elevation_error_deg=0.05, laser_bias_m=0.007),
        gyros=replace(Options().gyros, scale=0.01),
    )
    drawn = []
    for seed in range(1, 6):
        simulation = Simulation(Job("field", 2.0, seed, tmp_path, options))
        truth = simulation.truth()
        assert truth["mount_nominal"]["gps_position_m"] == [0, 0, 0.2]
        assert truth["mount_true"]["gps_position_m"] == pytest.approx([0.05, 0, 0.2])
        off = np.array(
            [
                truth["mount_true"]["lidar"][k] - truth["mount_nominal"]["lidar"][k]
                for k in ("yaw_deg", "pitch_deg", "roll_deg")
            ]
        )
        assert off == pytest.approx(truth["boresight_deg"])
        assert np.abs(truth["lever_m"]).max() <= 0.02
        assert np.diag(truth["lidar_gyro_matrix"]) == pytest.approx([1, 1, 1], abs=0.05)
        assert len(truth["laser_elevation_error_deg"]) == 32
        drawn.append(off)
    assert 0.3 < np.abs(drawn).max() <= 1.0
    assert np.ptp(np.array(drawn), axis=0).min() > 0.1


def test_a_laser_shoots_at_its_own_elevation(simulate):
    options = perfect(Options(), "all")
    options = replace(
        options,
        lidar=replace(options.lidar, elevation_error_deg=0.1, footprint_mrad=0.0, airframe=False),
        mount=MountOptions(),
    )
    recorded = simulate("panels", 1.0, options, points=True)
    points = recorded.points[recorded.points["surface"] == recorded.truth["surfaces"].index("ground")]
    # level, 1.5 m above flat ground: the elevation is that of the true point
    seen = np.degrees(np.arcsin((points["z"] - 1.5) / points["range_m"]))
    # the manual prints multiples of 4/3 deg with two decimals
    nominal = np.array([v for k in range(16) for v in (-92 / 3 + k * 4 / 3, -28 / 3 + k * 4 / 3)])
    for laser in np.unique(points["laser"]):
        found = seen[points["laser"] == laser].mean() - nominal[laser]
        assert found == pytest.approx(recorded.truth["laser_elevation_error_deg"][laser], abs=0.005)


def test_a_lidar_without_cable_sends_neither_kind_of_packet(simulate):
    options = Options()
    options = replace(
        options,
        lidar=replace(options.lidar, dark=True),
        faults=FaultOptions(lidar_gap_at_s=1.0, lidar_gap_s=10.0),
    )
    recorded = simulate("field", 13.0, options)
    for size in (1206, 512):
        arrived = recorded.capture.arrival_s(size)
        assert np.diff(arrived).max() == pytest.approx(10.0, abs=0.02)
        assert np.sort(np.diff(arrived))[-2] < 0.1


def test_a_glitch_moves_positions_and_not_velocities():
    glitch = FaultOptions(
        gnss_glitch_at_s=10.0, gnss_glitch_s=6.0, gnss_glitch_rise_s=2.0, gnss_glitch_m=(30.0, 0.0, -9.0)
    )
    flight = flown()
    _, wrong = believed(TIME_S, faults=glitch, flight=flight)
    _, right = believed(TIME_S, flight=flight)
    off = wrong.position_m - right.position_m
    assert (wrong.velocity_m_s == right.velocity_m_s).all()
    assert off[(TIME_S < 10.0) | (TIME_S > 16.0)] == pytest.approx(0.0, abs=1e-9)
    there = (TIME_S > 12.0) & (TIME_S < 14.0)
    assert off[there] == pytest.approx(np.tile([30.0, 0.0, -9.0], (there.sum(), 1)))
    assert off[np.argmin(np.abs(TIME_S - 11.0))] == pytest.approx([15.0, 0.0, -4.5], abs=0.1)


def test_velocities_of_a_filter_go_along_with_its_glitch_and_the_barometer_does_not():
    glitch = FaultOptions(
        gnss_glitch_at_s=10.0, gnss_glitch_s=6.0, gnss_glitch_rise_s=2.0, gnss_glitch_m=(30.0, 0.0, -9.0),
        gnss_glitch_velocity=True,
    )  # fmt: skip
    flight = flown()
    _, wrong = believed(TIME_S, faults=glitch, flight=flight)
    _, right = believed(TIME_S, flight=flight)
    off = wrong.velocity_m_s - right.velocity_m_s
    rising = (TIME_S > 10.1) & (TIME_S < 11.9)
    assert off[rising] == pytest.approx(np.tile([15.0, 0.0, -4.5], (rising.sum(), 1)))
    assert off[(TIME_S > 12.1) & (TIME_S < 13.9)] == pytest.approx(0.0, abs=1e-9)
    assert wrong.baro_height_m == pytest.approx(right.baro_height_m, abs=1e-9)


def test_so_many_packets_get_lost():
    sent_s = np.arange(20_000) / 1808.0
    kept = arriving(sent_s, FaultOptions(lidar_loss=0.02), generator(1, "test"))
    # 20 000 draws of 0.02: 0.001 is one sigma of their mean
    assert kept.mean() == pytest.approx(0.98, abs=0.004)


def test_multipath_is_bound_to_the_place_and_leaves_heights_and_velocities_alone():
    flight = flown(120.0)
    time_s = np.arange(0.0, 119.0, 0.1)
    _, clean = believed(time_s, flight=flight)
    _, seen = believed(time_s, flight=flight, multipath_m=3.0, multipath_length_m=5.0)
    off = seen.position_m - clean.position_m
    stands = time_s < 1.0  # the route holds for three seconds, and what is read is smoothed
    assert np.ptp(off[stands], axis=0).max() < 0.1 * np.ptp(off, axis=0).max()
    assert 1.0 < off[:, :2].std() < 4.0
    assert not off[:, 2].any()
    assert seen.velocity_m_s == pytest.approx(clean.velocity_m_s)


def test_the_true_mount_of_a_lidar_upside_down_is_one_that_can_be_read_again(tmp_path):
    """Half a turn and one degree more is half a turn less, the other way round."""
    options = replace(Options(), mount=MountOptions(lidar_deg=(0.0, -20.0, 180.0), boresight_deg=(0.0, 0.0, 1.0)))
    truth = Simulation(Job("field", 2.0, 1, tmp_path, options)).truth()
    assert truth["mount_true"]["lidar"]["roll_deg"] == pytest.approx(-179.0)
    assert truth["boresight_deg"] == pytest.approx([0.0, 0.0, 1.0])
