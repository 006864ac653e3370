from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import firmware_config
from flightlog import config
from flightlog.errors import ConfigError
from flightlog.mount import LidarMount, Mount, load_mount, parse_mount

SHIPPED = Path(firmware_config.__path__[0]) / "mount.yaml"
lengths = st.floats(-5, 5)
points = st.tuples(lengths, lengths, lengths)
mounts = st.builds(
    Mount,
    lidar=st.builds(
        LidarMount,
        position_m=points,
        yaw_deg=st.floats(-360, 360),
        pitch_deg=st.floats(-180, 180),
        roll_deg=st.floats(-180, 180),
    ),
    gps_position_m=st.none() | points,
)


def test_the_mount_that_is_shipped_is_that_of_the_source_and_the_default() -> None:
    mount = load_mount(SHIPPED)
    assert mount == Mount()
    assert mount.lidar == LidarMount((0.0, 0.0, -0.16), 0.0, -20.0, 0.0)
    assert mount.gps_position_m is None


@given(mounts)
def test_a_mount_written_out_reads_back_equal(mount: Mount) -> None:
    assert parse_mount(mount.yaml(), "mount.yaml") == mount


def test_the_sample_file_is_the_default_mount() -> None:
    assert parse_mount(config.sample(Mount), "sample") == Mount()


@given(mounts)
def test_the_boresight_matrix_is_scipys_zxy_sequence(mount: Mount) -> None:
    angles_deg = [mount.lidar.yaw_deg, mount.lidar.pitch_deg, mount.lidar.roll_deg]
    theirs = Rotation.from_euler("ZXY", angles_deg, degrees=True).as_matrix()
    assert mount.mat_ins_lidar() == pytest.approx(theirs, abs=1e-14)


def test_the_scanner_looks_down_ahead_and_sits_below_the_ins() -> None:
    mount = Mount()
    ahead, below = mount.mat_ins_lidar() @ [0, 1, 0], mount.lidar_position_m()
    assert ahead == pytest.approx([0, np.cos(np.pi / 9), -np.sin(np.pi / 9)])
    assert below.tolist() == [0, 0, -0.16]
    # the lasers from +10.67 to -30.67 deg then look -9.33 to -50.67 deg against the horizon
    for elevation_deg, down_deg in ((10.67, -9.33), (-30.67, -50.67)):
        ray = mount.mat_ins_lidar() @ [0, np.cos(np.deg2rad(elevation_deg)), np.sin(np.deg2rad(elevation_deg))]
        assert np.rad2deg(np.arcsin(ray[2])) == pytest.approx(down_deg)


def test_named_values_make_a_new_mount_and_leave_the_old_one() -> None:
    mount = Mount()
    trimmed = mount.with_lidar(pitch_deg=-19.5)
    assert (mount.lidar.pitch_deg, trimmed.lidar.pitch_deg) == (-20.0, -19.5)
    assert trimmed.lidar.position_m == mount.lidar.position_m


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("lidar: {pitch: -20}", "mount.yaml: lidar: unknown key 'pitch'; known are position_m, yaw_deg, pitch_deg, roll_deg"),
        ("lidar: {pitch_deg: -200}", "mount.yaml: lidar: pitch_deg: -200.0 found, expected -180 to 180"),
        ("lidar: {position_m: [0, 0, -16]}", "mount.yaml: lidar: position_m[2]: -16.0 found, expected -5 to 5"),
        ("gps_position_m: 0.2", "mount.yaml: gps_position_m: 0.2 found, expected a list"),
        ("camera: {}", "mount.yaml: unknown key 'camera'; known are lidar, gps_position_m"),
    ],
)  # fmt: skip
def test_a_wrong_mount_is_refused_in_one_sentence(text: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_mount(text, "mount.yaml")
    assert str(caught.value) == sentence
