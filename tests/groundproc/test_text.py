"""Text files as people bring them: marks, UTF-16, separators, line ends, packing; decimal commas are refused with the reason."""

import gzip
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from flightlog import config
from flightlog.errors import CaptureError, LogError, SwathError
from flightlog.mount import load_mount
from groundproc import geodesy
from groundproc.estimation.dynamic.trims import read_yaw
from groundproc.flight.control import read_control
from groundproc.flight.importers.lines import read_imu, read_lines
from groundproc.flight.positions import rinex
from groundproc.flight.positions.reading import read_solution
from groundproc.flight.positions.sbet import RECORD, read_sbet
from groundproc.text import is_plain, make_plain
from onboard import parameters

TRAJECTORY = (
    "utc_ns,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg\n"
    "1709424000000000000,58.39,15.57,50.5,0,0,90\n"
    "1709424000100000000,58.39,15.5701,50.25,0,0,90\n"
)
POS = (
    "%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)"
    "  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio\n"
    "2024/03/03 00:00:00.000 58.39 15.57 50.5 1 9 .01 .01 .02 0 0 0 0 5\n"
    "2024/03/03 00:00:01.000 58.39 15.5701 50.25 1 9 .01 .01 .02 0 0 0 0 5\n"
)


def sentence(body: str) -> str:
    check = 0
    for character in body:
        check ^= ord(character)
    return f"${body}*{check:02X}\n"


NMEA = "".join(
    sentence(f"GPRMC,10170{i}.00,A,5823.4000,N,01534.2{i}00,E,0.0,0.0,200526,,") +
    sentence(f"GPGGA,10170{i}.00,5823.4000,N,01534.2{i}00,E,4,12,0.8,50.5,M,30.0,M,,")
    for i in range(3)
)  # fmt: skip
CONTROL = "name,x,y,z,sigma\na,1.5,2.25,3.5,0.02\nb,4,5,6,0.02\n"
TRIMS = "utc_ns,heading_deg,yaw_deg,other\n1000,90.5,0.25,1\n2000,91.5,0.5,1\n"
IMU = (
    "time_ns,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2\n"
    "1709424000000000001,0.5,0,0,0,0,9.75\n1709424000010000001,0.25,0,0,0,0,9.75\n"
)
SCANS = "time_ns,angle_deg,range_m,intensity\n" + "".join(
    f"{1709424000000000001 + i * 10**7},{angle},{10.5 + angle},7\n" for i in range(2) for angle in (-1.0, 0.0, 1.0)
)


def solution(path: Path) -> list[object]:
    found = read_solution(path, near_utc_ns=1_779_272_220_000_000_000)
    return [found.time_ns.tolist(), found.latitude_deg.tolist(), found.longitude_deg.tolist(), found.height_m.tolist()]


def as_lists(*arrays: object) -> list[object]:
    return [np.asarray(array).tolist() for array in arrays]


READERS: dict[str, tuple[str, Callable[[Path], list[object]]]] = {
    "poses": (TRAJECTORY, solution),
    "RTKLIB": (POS, solution),
    "NMEA": (NMEA, solution),
    "control": (CONTROL, lambda path: [(p.name, p.place_m.tolist(), p.sigma_m) for p in read_control(path)]),
    "trims": (TRIMS, lambda path: as_lists(*read_yaw(path))),
    "IMU": (IMU, lambda path: as_lists(*read_imu(path))),
    "scans": (SCANS, lambda path: [read_lines(path).tobytes()]),
}
DRESSES: dict[str, Callable[[str], bytes]] = {
    "byte-order mark": lambda text: text.encode("utf-8-sig"),
    "UTF-16": lambda text: text.encode("utf-16"),
    "UTF-16 BE": lambda text: b"\xfe\xff" + text.encode("utf-16-be"),
    "UTF-16 without a mark": lambda text: text.encode("utf-16-le"),
    "CRLF": lambda text: text.replace("\n", "\r\n").encode(),
    "CR": lambda text: text.replace("\n", "\r").encode(),
    "gzip": lambda text: gzip.compress(text.encode()),
    "mark and CRLF": lambda text: text.replace("\n", "\r\n").encode("utf-8-sig"),
}


@pytest.mark.parametrize("dress", list(DRESSES))
@pytest.mark.parametrize("reader", list(READERS))
def test_every_reader_takes_a_text_in_every_dress(reader: str, dress: str, tmp_path: Path) -> None:
    text, read = READERS[reader]
    plain, dressed = tmp_path / "plain.csv", tmp_path / "dressed.csv"
    plain.write_text(text)
    dressed.write_bytes(DRESSES[dress](text))
    assert read(dressed) == read(plain)


TABLES = [name for name in READERS if name not in ("RTKLIB", "NMEA")]


@pytest.mark.parametrize("separator", [";", "\t", "|", " ", ", "])
@pytest.mark.parametrize("reader", TABLES)
def test_tables_may_have_any_usual_separator(reader: str, separator: str, tmp_path: Path) -> None:
    text, read = READERS[reader]
    plain, other = tmp_path / "plain.csv", tmp_path / "other.csv"
    plain.write_text(text)
    other.write_text(("sep=;\n" if separator == ";" else "") + text.replace(",", separator))
    assert read(other) == read(plain)


@pytest.mark.parametrize("reader", TABLES)
def test_names_and_numbers_may_be_quoted(reader: str, tmp_path: Path) -> None:
    text, read = READERS[reader]
    plain, other = tmp_path / "plain.csv", tmp_path / "other.csv"
    plain.write_text(text)
    other.write_text("".join(",".join(f'"{word}"' for word in line.split(",")) + "\n" for line in text.splitlines()))
    assert read(other) == read(plain)


@pytest.mark.parametrize("separator", [";", "\t"])
@pytest.mark.parametrize("reader", [*TABLES, "RTKLIB"])
def test_decimal_commas_are_refused_with_the_reason(reader: str, separator: str, tmp_path: Path) -> None:
    text, read = READERS[reader]
    path = tmp_path / "comma.csv"
    header, _, rows = text.partition("\n")
    if reader != "RTKLIB":
        header, rows = header.replace(",", separator), rows.replace(",", separator)
    path.write_text(f"{header}\n{rows.replace('.', ',')}")
    with pytest.raises(SwathError, match=r"has a decimal comma, expected a decimal point") as caught:
        read(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("reader", ["poses", "control", "trims"])
def test_decimal_commas_between_commas_are_named_as_the_likely_reason(reader: str, tmp_path: Path) -> None:
    text, read = READERS[reader]
    path = tmp_path / "comma.csv"
    header, _, rows = text.partition("\n")
    path.write_text(f"{header}\n{rows.replace('.', ',')}")
    with pytest.raises(SwathError, match=r"line 2: .* are its decimals commas\?"):
        read(path)


def test_the_inputs_with_a_mark_that_failed_once_are_read(cases: Path) -> None:
    poses, positions = solution(cases / "bom/trajectory.csv"), solution(cases / "bom/a.pos")
    assert poses[1] == [58.39, 58.39]
    assert positions[1:] == [[58.39], [15.57], [50.0]]


@pytest.mark.parametrize("dress", [name for name in DRESSES if name != "gzip"])
def test_configurations_and_parameters_are_read_in_every_dress(dress: str, tmp_path: Path) -> None:
    mount, changed = tmp_path / "mount.yaml", tmp_path / "a.param"
    mount.write_bytes(DRESSES[dress]("lidar:\n  pitch_deg: -25\n"))
    assert config.to_mapping(load_mount(mount))["lidar"]["pitch_deg"] == -25
    changed.write_bytes(DRESSES[dress]("SR1_POSITION,5\nSERIAL1_BAUD,57\n"))
    assert {name: each.value for name, each in parameters.load(changed).items()} == {
        "SR1_POSITION": 5,
        "SERIAL1_BAUD": 57,
    }


HEADER = "     3.03           OBSERVATION DATA    G                   RINEX VERSION / TYPE\n"


@pytest.mark.parametrize("dress", list(DRESSES))
def test_rinex_is_made_plain_for_those_who_look_at_columns(dress: str, tmp_path: Path) -> None:
    text = HEADER + " " * 60 + "END OF HEADER\n> 2024 03 03 00 00  0.0000000  0  4\n"
    path, copy = tmp_path / "a.obs", tmp_path / "b.obs"
    path.write_bytes(DRESSES[dress](text))
    assert is_plain(path) == (dress == "CRLF")
    make_plain(path, copy)
    assert copy.read_text() == text
    assert rinex.observations(path).epochs == rinex.observations(copy).epochs == 1


# geoid and SBET ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["geoid, v2.gtx", "plain.gtx"])
def test_a_geoid_is_read_under_any_name(name: str, cases: Path) -> None:
    assert geodesy.undulation(str(cases / "geoid_name" / name), 58.39, 15.57) == pytest.approx(30.5)


@pytest.mark.parametrize("name", ['a "quoted" one.gtx', "it's.gtx", "comma,.gtx", "+proj=x.gtx", "räksmörgås 测.gtx"])
def test_no_character_in_the_path_of_a_geoid_matters(name: str, cases: Path, tmp_path: Path) -> None:
    folder = tmp_path / f"of, {name}"
    folder.mkdir()
    (folder / name).write_bytes((cases / "geoid_name/plain.gtx").read_bytes())
    assert geodesy.undulation(str(folder / name), 58.39, 15.57) == pytest.approx(30.5)


def sbet(latitude_deg: float, longitude_deg: float, unit: float) -> bytes:
    """An SBET of a straight flight north at 10 m/s and 200 Hz; angles times `unit` [rad]."""
    records = np.zeros(1000, RECORD)
    time_s = np.arange(1000) * 0.005
    records["time"] = 100_000.0 + time_s
    records["latitude"] = (np.deg2rad(latitude_deg) + 10.0 * time_s / 6.371e6) * unit
    records["longitude"] = np.deg2rad(longitude_deg) * unit
    records["x_velocity"], records["altitude"] = 10.0, 50.0
    records["platform_heading"] = np.deg2rad(np.linspace(300, 359, 1000)) * unit
    records["roll"] = np.deg2rad(1.0) * unit
    return records.tobytes()


@pytest.mark.parametrize("place", [(58.39, 15.57), (-33.9, 151.2), (0.7, 0.9), (1.2, -1.0)])
def test_an_sbet_in_degrees_is_named_and_one_in_radians_is_read(place: tuple[float, float], tmp_path: Path) -> None:
    path = tmp_path / "s.out"
    path.write_bytes(sbet(*place, 1.0))
    assert read_solution(path, near_utc_ns=1_709_424_000_000_000_000).latitude_deg[0] == pytest.approx(place[0])
    path.write_bytes(sbet(*place, float(np.rad2deg(1.0))))
    for read in (read_solution, read_sbet):
        with pytest.raises(LogError, match=r"latitude and longitude and attitude is in degrees, expected radians"):
            read(path, near_utc_ns=1_709_424_000_000_000_000)


def test_an_sbet_with_its_attitude_alone_in_degrees_is_named(tmp_path: Path) -> None:
    path = tmp_path / "s.out"
    records = np.frombuffer(sbet(58.39, 15.57, 1.0), RECORD).copy()
    for name in ("roll", "pitch", "platform_heading"):
        records[name] = np.rad2deg(records[name])
    path.write_bytes(records.tobytes())
    with pytest.raises(LogError, match=r"its attitude is in degrees"):
        read_solution(path, near_utc_ns=1_709_424_000_000_000_000)


def test_a_table_without_its_column_says_what_it_should_have(tmp_path: Path) -> None:
    path = tmp_path / "c.csv"
    path.write_text("a;b;c\n1;2;3\n")
    with pytest.raises(CaptureError, match="no column x; control has x, y, z, sigma"):
        read_control(path)
