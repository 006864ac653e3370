"""What is seen of RINEX files before RTKLIB gets them."""

from pathlib import Path
from typing import Any

import gnss
import numpy as np
import pytest

from flightlog.errors import LogError
from groundproc.flight.positions import rinex


@pytest.mark.parametrize("version", ["2.11", "3.04"])
def test_epochs_place_and_times(tmp_path: Path, world: Any, version: str) -> None:
    path = tmp_path / "a.obs"
    gnss.write_observations(path, world.rover, version=version, approximate_m=world.base_m)
    found = rinex.observations(path)
    assert found.epochs == 300
    assert found.start_ns == np.datetime64("2024-02-07T12:00:00", "ns").astype(np.int64)
    assert found.seconds == pytest.approx(59.8)
    assert found.approximate_m == pytest.approx(tuple(world.base_m), abs=1e-4)
    assert rinex.kind_of(path.read_bytes()) == "observations"


def test_version_2_with_more_than_twelve_satellites_and_events(tmp_path: Path) -> None:
    head = (
        f"{'     2.11           OBSERVATION DATA    M (MIXED)':<60}RINEX VERSION / TYPE\n"
        f"{'     6    C1    L1    D1    S1    P2    L2':<60}# / TYPES OF OBSERV\n{'':<60}END OF HEADER\n"
    )
    names = [f"G{i:02d}" for i in range(1, 15)]
    # fourteen satellites go on in a second line; six types fill two lines each; an event has two lines of comment
    epoch = " 24  2  7 12  0{:3d}.0000000  0 14" + "".join(names[:12]) + "\n" + " " * 32 + "".join(names[12:]) + "\n"
    values = (
        " 24  2  7 12  0  9.0000000  0 14\n" + "\n"
    ) * 14  # what looks like an epoch inside the observations is none
    event = " 24  2  7 12  0  1.5000000  4  2\n" + f"{'said':<60}COMMENT\n" * 2
    path = tmp_path / "a.24o"
    path.write_text(head + epoch.format(1) + values + event + epoch.format(2) + values)
    found = rinex.observations(path)
    assert (found.epochs, found.seconds) == (2, 1.0)
    assert found.approximate_m is None


@pytest.mark.parametrize("version", ["2.11", "3.04"])
def test_ephemerides_are_counted_by_satellite_and_time(tmp_path: Path, version: str) -> None:
    path = tmp_path / "a.nav"
    gnss.write_navigation(path, gnss.constellation(2300, 302_400.0), version=version)
    found = rinex.navigation(path)
    noon = int(np.datetime64("2024-02-07T12:00:00", "ns").astype(np.int64))
    assert len(found.times_ns) == 30
    assert found.satellites_near(noon, noon, 0) == 30
    assert found.satellites_near(noon + 7200 * 10**9, noon + 9000 * 10**9, 7199 * 10**9) == 0
    assert rinex.kind_of(path.read_bytes()) == "navigation"


def test_what_rtklib_cannot_read_is_said(tmp_path: Path) -> None:
    path = tmp_path / "a.obs"
    path.write_text(
        f"{'     4.01           OBSERVATION DATA    M: Mixed':<60}RINEX VERSION / TYPE\n{'':<60}END OF HEADER\n"
    )
    with pytest.raises(LogError, match=r"version 4\.01 found, expected 2 or 3"):
        rinex.observations(path)
    path.write_text(
        f"{'     3.04           OBSERVATION DATA    M: Mixed':<60}RINEX VERSION / TYPE\n{'':<60}END OF HEADER\n"
    )
    with pytest.raises(LogError, match="holds no observations"):
        rinex.observations(path)
    path.write_text(
        f"{'     3.04           NAVIGATION DATA     M: Mixed':<60}RINEX VERSION / TYPE\n{'':<60}END OF HEADER\n"
    )
    with pytest.raises(LogError, match="holds no ephemeris"):
        rinex.navigation(path)


@pytest.mark.parametrize(
    ("head", "kind"),
    [
        (f"{'1.0                 COMPACT RINEX FORMAT':<60}CRINEX VERS   / TYPE\n".encode(), "compact"),
        (f"{'     3.04           METEOROLOGICAL DATA':<60}RINEX VERSION / TYPE\n".encode(), "other_rinex"),
        (b"\xd3\x00\x13" + bytes(20), "rtcm3"),
        (b"$GNGGA,...\r\n" * 5 + b"\xb5\x62\x02\x15" + bytes(50), "ubx"),
        (b"", ""),
        (b"hello", ""),
    ],
)
def test_kinds_are_told_by_content(head: bytes, kind: str) -> None:
    assert rinex.kind_of(head) == kind
