"""Every command with every wrong kind of file: one sentence that says what it is and which command takes it."""

import gzip
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from groundproc.cli import main
from groundproc.flight.kinds import kind_of


def _tlog() -> bytes:
    link = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    frames = [dialect.MAVLink_attitude_message(i, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0).pack(link) for i in range(9)]
    stamped = [
        (1_779_270_000_000_000 + i * 100_000).to_bytes(8, "big") + bytes(frame) for i, frame in enumerate(frames)
    ]
    return b"".join(stamped)


RINEX = b"     3.04           OBSERVATION DATA    M                   RINEX VERSION / TYPE\n"
POS = b"%  GPST          latitude(deg) longitude(deg)  height(m)   Q  ns\n"
FILES: dict[str, tuple[bytes, str, str]] = {
    "a.pcap": (b"\xd4\xc3\xb2\xa1" + bytes(20), "a packet capture", "swath import --pcap"),
    "a.pcapng": (b"\x0a\x0d\x0d\x0a" + bytes(20), "a packet capture", "swath import --pcap"),
    "a.tlog": (_tlog(), "a telemetry log", "--mavlink"),
    "a.bin": (b"\xa3\x95\x80\x80" + bytes(85), "a dataflash log", "--mavlink"),
    "a.las": (b"LASF" + bytes(371), "a point cloud", "swath ground"),
    "a.bag": (b"#ROSBAG V2.0\n", "a ROS bag", "swath import --bag"),
    "a.obs": (RINEX, "raw GNSS observations", "swath ppk"),
    "a.pos": (POS, "a GNSS solution", "--positions"),
    "trajectory.csv": (b"utc_ns,latitude_deg\n1,2\n", "a trajectory", "--trajectory"),
    "trims.csv": (b"utc_ns,heading_deg,yaw_deg\n1,2,3\n", "a table of trims", "swath compass"),
    "points.csv": (b"name,x,y,z,sigma\n", "a table of control points", "--control"),
    "any.csv": (b"a,b\n1,2\n", "a table (CSV)", ""),
    "mount.yaml": (b"lidar:\n  position_m: [0, 0, 0]\n", "a mount file", "--mount"),
    "survey.yaml": (b"method: best\n", "a survey file", "--config"),
    "quality.json": (b'{"a": 1}', "a JSON file", ""),
    "notes.txt": (b"flown in the morning\n", "a text file", ""),
    "a.png": (b"\x89PNG\r\n\x1a\n", "a picture", ""),
    "a.npz": (b"PK\x03\x04", "an archive", ""),
    "empty.mcap": (b"", "empty", ""),
    "a.pcap.gz": (gzip.compress(b"\xd4\xc3\xb2\xa1" + bytes(20)), "a packet capture, compressed with gzip", "gunzip"),
}
LOGS: dict[str, list[str]] = {
    "info": ["info", "FILE"],
    "process": ["process", "FILE", "-o", "out"],
    "process without -o": ["process", "FILE"],
    "decode": ["decode", "FILE", "-o", "out.laz"],
    "calibrate": ["calibrate", "FILE", "-o", "out"],
    "init": ["init", "FILE"],
    "recover": ["recover", "FILE"],
    "replay": ["replay", "FILE"],
    "live": ["live", "--follow", "FILE", "-o", "out"],
}
"""Commands that take a flight log."""
RECORDINGS = ("a.pcap", "a.pcapng", "a.pcap.gz", "a.tlog", "a.bin", "a.bag")
"""`swath info` says what these hold."""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """All of the files, and the working directory."""
    for name, (content, _, _) in FILES.items():
        (tmp_path / name).write_bytes(content)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The one sentence of a command that does not begin, and leaves nothing."""
    before = sorted(Path().rglob("*"))
    assert main(words) in (1, 2), words
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1, said.err
    assert "Traceback" not in said.err
    assert sorted(Path().rglob("*")) == before
    return said.err


@pytest.mark.parametrize("name", FILES)
def test_a_file_is_known_by_its_content(folder: Path, name: str) -> None:
    (folder / "nameless").write_bytes(FILES[name][0])
    kind = kind_of(folder / "nameless")
    assert kind is not None
    assert FILES[name][1] in kind.sentence(folder / "nameless")


@pytest.mark.parametrize("command", LOGS)
def test_what_takes_a_log_says_of_anything_else_what_it_is_and_who_takes_it(
    folder: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, (_, what, takes) in FILES.items():
        if (command, name) == ("live", "empty.mcap"):  # a log that begins to grow
            continue
        if command == "info" and name in RECORDINGS:
            continue
        said = refused([name if word == "FILE" else word for word in LOGS[command]], capsys)
        assert said.startswith(f"swath: {name}: is ")
        assert what in said
        assert takes in said
        assert "expected a flight log (.mcap)" in said


@pytest.mark.parametrize("command", LOGS)
def test_a_folder_and_a_slip_of_the_finger_are_told(
    folder: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "day").mkdir()
    (folder / "day" / "flight.mcap").write_bytes(b"\x89MCAP0\r\n")
    if command != "process without -o":  # where a folder of products goes on
        said = refused(["day" if word == "FILE" else word for word in LOGS[command]], capsys)
        assert "is a folder; it holds day/flight.mcap" in said
    said = refused(["day/fligth.mcap" if word == "FILE" else word for word in LOGS[command]], capsys)
    assert "day/fligth.mcap: no such file; there is day/flight.mcap" in said


@pytest.mark.parametrize(
    ("words", "wrong", "said"),
    [
        (["adjust", "FILE", "-t", "trajectory.csv", "-o", "out"], "a.pcap", "expected LAS or LAZ files"),
        (["adjust", "a.las", "-t", "FILE", "-o", "out"], "a.pcap", "expected an RTKLIB .pos"),
        (["adjust", "a.las", "-t", "trajectory.csv", "-o", "out", "--control", "FILE"], "a.png", "control points"),
        (["adjust", "a.las", "-t", "trajectory.csv", "-o", "out", "--config", "FILE"], "a.png", "options as YAML"),
        (["raster", "FILE", "-o", "r.tif"], "a.pcap", "expected a cloud"),
        (["export", "FILE", "-o", "c.ply"], "trajectory.csv", "expected a cloud"),
        (["assess", "FILE", "--points", "points.csv"], "a.tlog", "expected a cloud"),
        (["volume", "FILE", "p.gpkg"], "a.bin", "expected a cloud"),
        (["contours", "FILE", "-o", "c.gpkg"], "a.las", "expected a raster"),
        (["ppk", "FILE", "--base", "a.obs", "-o", "o.pos"], "a.tlog", "expected raw observations"),
        (["ppk", "a.obs", "--base", "FILE", "-o", "o.pos"], "a.las", "expected raw observations"),
        (["compass", "FILE", "-o", "c.yaml"], "a.las", "expected the trims.csv"),
        (["import", "--pcap", "FILE", "-o", "o.mcap"], "a.las", "expected captures"),
        (["import", "--pcap", "FILE", "-o", "o.mcap"], "a.tlog", "a telemetry log"),
        (["import", "--pcap", "a.pcap", "--mavlink", "FILE", "-o", "o.mcap"], "a.las", "expected recordings of the autopilot"),
        (["import", "--pcap", "a.pcap", "--mount", "FILE", "-o", "o.mcap"], "a.png", "expected a mount file"),
        (["process", "l.mcap", "-o", "out", "--config", "FILE"], "a.las", "expected a survey file"),
        (["process", "l.mcap", "-o", "out", "--mount", "FILE"], "a.las", "expected a mount file"),
        (["process", "l.mcap", "-o", "out", "--positions", "FILE"], "a.obs", "swath ppk"),
        (["process", "l.mcap", "-o", "out", "--control", "FILE"], "a.las", "control points"),
        (["process", "l.mcap", "-o", "out", "--lasers", "FILE"], "a.png", "swath calibrate"),
        (["process", "l.mcap", "-o", "out", "--trajectory", "FILE"], "a.pos", "--positions"),
    ],
)  # fmt: skip
def test_every_option_that_takes_a_file_tells_what_else_it_is(
    folder: Path, words: list[str], wrong: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "l.mcap").write_bytes(b"\x89MCAP0\r\n")
    found = refused([wrong if word == "FILE" else word for word in words], capsys)
    assert found.startswith(f"swath: {wrong}: is ")
    assert said in found


def test_prose_with_colons_is_no_survey(folder: Path) -> None:
    (folder / "prose").write_text("Dear pilot: read this\nmethod: take off\n")
    kind = kind_of(folder / "prose")
    assert kind is not None
    assert kind.name == "text"


def test_a_device_or_a_pipe_is_not_looked_into(tmp_path: Path) -> None:
    assert kind_of(Path("/dev/zero")) is None
