"""`swath init`: a survey.yaml that says what the log tells, and can be used as it is."""

from pathlib import Path
from typing import Any

import pytest

from flightlog import config
from groundproc.cli import main
from groundproc.survey import Survey


def test_it_writes_a_commented_survey_with_what_the_log_tells(
    gps_flight: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "survey.yaml"
    assert main(["init", str(gps_flight.log), "-o", str(path)]) == 0
    text = path.read_text()
    # the simulation flies at 58.394 N, 15.574 E: UTM zone 33
    assert config.load(path, Survey) == Survey(crs=32633)
    for said in (
        "UTM zone 33N", "58.39", "this log holds a mount", "by gyro, sigma", "method adjusted can be used", str(gps_flight.log),
    ):  # fmt: skip
        assert said in text, said
    assert max(map(len, text.splitlines())) < 120
    # a file that is there is somebody's work
    path.write_text("mine")
    assert main(["init", str(gps_flight.log), "-o", str(path)]) == 2
    assert "--force" in capsys.readouterr().err
    assert path.read_text() == "mine"
    assert main(["init", str(gps_flight.log), "-o", str(path), "--force"]) == 0
    assert path.read_text() == text
    assert main(["init", str(gps_flight.log)]) == 0
    assert capsys.readouterr().out == text


def test_a_short_flight_without_gyros_says_why(dual_flight: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["init", str(dual_flight.log)]) == 0
    assert "by host" in capsys.readouterr().out
