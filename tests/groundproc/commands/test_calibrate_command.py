"""What `swath calibrate` says where a flight cannot tell: not significant, with sigma, or one sentence and nothing written."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from flightlog.mount import Mount
from groundproc.cli import main
from groundproc.commands import calibrate as command
from groundproc.estimation.adjustment import adjusted
from groundproc.estimation.calibration.compass import BINS
from groundproc.estimation.calibration.mount import PRIOR, FlightResult, calibrate
from groundproc.estimation.observations.attitudes import COMPASS_PRIOR
from groundproc.field.madeup import write_flight


def flight(value: list[float], sigma: list[float], warning: str = "") -> FlightResult:
    """What a flight says of turn [rad] and lever arm [m], and nothing of the compass."""
    compass = np.diag(np.square(COMPASS_PRIOR))
    return FlightResult(
        "a.mcap", np.array(value), np.diag(np.square(sigma)), 0.0, 1e-3, 0.0, np.zeros(5), compass,
        np.zeros(BINS, np.bool_), None, 30.0, warning,
    )  # fmt: skip


def test_what_lies_within_its_sigmas_is_found_but_not_significant() -> None:
    """A turn of 2 deg known to 0.1 is; one of 0.05 deg is not, nor is a lever arm as vague as before."""
    sigma = [*np.deg2rad([0.1, 0.1, 0.1]), *PRIOR[3:]]
    report = calibrate([flight([*np.deg2rad([2.0, 0.05, -0.05]), 0.3, 0.0, 0.0], sigma)]).report(Mount())
    assert report["found"] == [True, True, True, False, False, False]
    assert report["significant"] == [True, False, False, False, False, False]
    head = command._header(report)
    assert "# not observed, left as they were: lever_x_m, lever_y_m, lever_z_m\n" in head
    assert "# not significant, within 3 sigma of what they were: turn_y_deg, turn_z_deg\n" in head
    assert "not significant" in command._text(report, Path("out"))


@pytest.mark.parametrize(("warning", "torn", "code"), [("", False, 0), ("it has not settled", False, 3), ("", True, 3)])
def test_a_warning_or_a_cut_log_makes_it_doubtful(
    warning: str, torn: bool, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    result = calibrate([flight([0.0] * 6, [1e-3] * 6, warning)])
    assert command._judged(result, torn) == code
    assert capsys.readouterr().err == (f"swath: warning: a.mcap: {warning}\n" if warning else "")


def test_flights_that_contradict_each_other_are_bad(capsys: pytest.CaptureFixture[str]) -> None:
    one = flight([0.0] * 6, [1e-3] * 6)
    other = replace(one, value=np.full(6, 0.05))
    assert command._judged(calibrate([one, other]), torn=False) == 1
    assert "was the mount touched between them?" in capsys.readouterr().err


def test_a_flight_that_is_no_better_than_what_it_began_from_cannot_tell_a_mount(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    blind = SimpleNamespace(
        is_worse=lambda: True, note=lambda: "the lidar saw next to no planes for most of the flight"
    )
    monkeypatch.setattr(adjusted, "adjust_run", lambda *_: blind)
    log = tmp_path / "a.mcap"
    write_flight(log, 3.0)
    assert main(["calibrate", str(log), "-o", str(tmp_path / "out")]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"swath: {log}: cannot tell a mount: the lidar saw next to no planes")
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()
