"""lasers.yaml: what is to be added to the manual's table, written and read."""

from pathlib import Path

import numpy as np
import pytest

from flightlog.errors import ConfigError
from flightlog.hdl32e import ELEVATION_DEG, LASERS
from groundproc.sensors.hdl32e import LIDAR
from groundproc.sensors.lasers import LaserCorrections, read_lasers, write_lasers


def test_a_file_is_read_as_it_was_written(tmp_path: Path) -> None:
    numbers = np.random.default_rng(6).normal(size=(2, LASERS)).round(3)
    made = LaserCorrections(tuple((numbers[0] / 100).tolist()), tuple((numbers[1] / 10).tolist()))
    path = tmp_path / "lasers.yaml"
    write_lasers(path, made, "# of one sensor\n")
    assert path.read_text().startswith("# of one sensor\n")
    assert read_lasers(path) == made
    table = read_lasers(path).table(LIDAR.lasers)
    np.testing.assert_allclose(np.rad2deg(table.elevation_rad), np.array(ELEVATION_DEG) + made.elevation_deg)
    np.testing.assert_allclose(table.range_offset_m, made.range_m)
    for text, message in (
        ("range_m: [0.1, 0.2]", "range_m has 2 numbers, expected 32"),
        (f"range_m: {[0.0] * 31 + [3.0]}", r"range_m\[31\]: 3.0 found, expected -0.5 to 0.5"),
        ("ranges: []", "unknown key 'ranges'"),
    ):
        path.write_text(text)
        with pytest.raises(ConfigError, match=message):
            read_lasers(path).table(LIDAR.lasers, str(path))


def test_no_corrections_leave_the_table_as_the_manual_has_it() -> None:
    table = LaserCorrections().table(LIDAR.lasers)
    np.testing.assert_array_equal(table.elevation_rad, LIDAR.lasers.elevation_rad)
    assert not table.range_offset_m.any()
    assert len(table) == LASERS


@pytest.mark.parametrize("name", ["range_m", "elevation_deg", "sigma_range_m", "sigma_elevation_deg"])
def test_each_list_has_a_number_for_each_laser_or_none(name: str) -> None:
    with pytest.raises(ConfigError, match=rf"^lasers: {name} has 31 numbers, expected 32: one for each laser$"):
        LaserCorrections(**{name: (0.0,) * 31}).table(LIDAR.lasers)


def test_what_stands_above_the_values_may_be_any_text(tmp_path: Path) -> None:
    path = tmp_path / "lasers.yaml"
    write_lasers(path, LaserCorrections(), "# Gerät 高度\n")
    assert path.read_bytes().startswith("# Gerät 高度\n".encode())
    write_lasers(path, LaserCorrections())
    assert path.read_text().startswith("range_m: []\n")
    assert [each.name for each in tmp_path.iterdir()] == ["lasers.yaml"]
