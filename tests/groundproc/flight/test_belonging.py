"""Which logs are parts of one flight: battery swaps are, and nothing that lies farther apart."""

from dataclasses import replace
from pathlib import Path

import pytest

from flightlog.constants import HOUR_NS
from flightlog.logfile import LogReader
from flightlog.logwriter import LogWriter
from groundproc.cli import main
from groundproc.field.madeup import write_flight
from groundproc.flight.belonging import Part, differences, distance_m, part_of, pause_between_s

NOON_NS = 1_779_270_000 * 10**9
YEAR_NS = 8766 * HOUR_NS
FIRST = Part(Path("a.mcap"), NOON_NS, NOON_NS + HOUR_NS // 3, 0, (58.39, 15.57), 1, "HDL-32E")


def after(hours: float, **changes: object) -> Part:
    """A part that begins so long after the end of the first."""
    start_ns = FIRST.end_ns + round(hours * HOUR_NS)
    return replace(FIRST, path=Path("b.mcap"), start_ns=start_ns, end_ns=start_ns + HOUR_NS // 3, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "other",
    [
        after(0.05),
        after(1.5, place_deg=(58.41, 15.60)),  # after lunch, from the other side of the field
        after(0.2, place_deg=None),
        after(0.2, system=None),
        after(0.2, utc_ns=None),
    ],
)
def test_battery_swaps_are_one_flight(other: Part) -> None:
    assert list(differences(FIRST, other)) == []


@pytest.mark.parametrize(
    ("other", "said"),
    [
        (after(12 * 8766), "12.0 years lie between them"),
        (after(20), "20.0 hours lie between them"),
        (after(0.2, place_deg=(58.39, 15.77)), "12 km apart"),
        (after(0.2, system=2), "vehicles 1 and 2"),
        (after(0.2, lidar="VLP-16"), "HDL-32E and VLP-16"),
    ],
)
def test_what_no_battery_swap_does_makes_two_flights(other: Part, said: str) -> None:
    (why,) = differences(FIRST, other)
    assert said in why


def test_a_computer_that_began_in_1970_after_the_swap_is_judged_by_gnss() -> None:
    """Its log time is 56 years behind; with it goes what GNSS says must be added."""
    other = after(0.1)
    back_ns = 56 * YEAR_NS
    began_1970 = replace(
        other, start_ns=other.start_ns - back_ns, end_ns=other.end_ns - back_ns, utc_ns=(FIRST.utc_ns or 0) + back_ns
    )
    assert pause_between_s(FIRST, began_1970) == pytest.approx(360.0)
    assert list(differences(FIRST, began_1970)) == []


def test_distances_are_those_of_the_ellipsoid() -> None:
    """A degree of latitude at 58 deg is 111.4 km."""
    assert distance_m((58.0, 15.0), (59.0, 15.0)) == pytest.approx(111_400, rel=1e-3)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("madeup") / "a.mcap"
    write_flight(path, 3.0)
    return path


def later(log: Path, path: Path, by_ns: int, attachments: dict[str, bytes] | None = None) -> Path:
    """The same log, its messages later."""
    with LogReader(log) as reader, path.open("wb") as stream:
        kept = reader.attachments if attachments is None else attachments
        writer = LogWriter(stream, metadata={}, attachments=kept)
        for message in reader.messages():
            writer.write(message.topic, message.log_time_ns + by_ns, bytes(message.data))
        writer.finish()
    return path


def test_a_log_tells_vehicle_place_and_lidar(log: Path) -> None:
    with LogReader(log) as reader:
        found = part_of(reader)
    assert found.lidar == "HDL-32E"
    assert found.system == 1
    assert found.place_deg is not None
    assert found.place_deg == pytest.approx((58.39, 15.57), abs=1.0)


@pytest.mark.parametrize("command", [["process", "-o", "out"], ["decode", "-o", "out.laz"], ["init"]])
def test_every_command_that_takes_the_parts_of_a_flight_refuses_two(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, command: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    other = later(log, tmp_path / "b.mcap", 12 * YEAR_NS)
    assert main([*command, str(log), str(other)]) == 2
    said = capsys.readouterr().err
    assert "are not of one flight" in said
    assert f"for log in {log} {other}; do swath process" in said
    assert said.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == {"b.mcap"}


def test_other_mounts_make_two_flights(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mount = "lidar: {position_m: [0.1, 0.0, -0.1], yaw_deg: 0.0, pitch_deg: %s, roll_deg: 0.0}\n"
    one, other = (
        later(log, tmp_path / name, by_ns, {"mount.yaml": (mount % pitch).encode()})
        for name, by_ns, pitch in (("a.mcap", 0, "-20.0"), ("b.mcap", HOUR_NS, "-30.0"))
    )
    assert main(["process", str(one), str(other), "-o", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert "hold different mounts" in said
    assert "for log in" in said
