"""Words of the command line."""

import pytest

from flightlog.errors import UsageError
from groundproc.commands.values import field_of_view, milliseconds


@pytest.mark.parametrize(
    ("text", "window"),
    [
        ("255-105", (255.0, 105.0)), ("-105:105", (-105.0, 105.0)), ("0-90", (0.0, 90.0)), ("12.5-30.25", (12.5, 30.25)),
        ("-105-105", (-105.0, 105.0)), ("-90:-10", (-90.0, -10.0)), ("all", (0.0, 360.0)), ("0:360", (0.0, 360.0)),
    ],
)  # fmt: skip
def test_a_field_of_view_is_two_azimuths(text: str, window: tuple[float, float]) -> None:
    assert field_of_view(text) == window


@pytest.mark.parametrize(
    "text", ["", "255", "a-b", "1-2-3", "255-", "nan:5", "inf:5", "0:361", "-400:5", "1:2:3", "ALL"]
)
def test_anything_else_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(UsageError, match="255-105"):
        field_of_view(text)


def test_a_duration_is_milliseconds_with_or_without_the_unit() -> None:
    assert milliseconds("10ms") == 10.0
    assert milliseconds("10") == 10.0
    assert milliseconds("2.5 ms") == 2.5


@pytest.mark.parametrize("text", ["", "ms", "0", "0.5ms", "10s", "1001", "nan", "-10ms", "10msms"])
def test_a_duration_that_cannot_be_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="1ms to 1000ms"):
        milliseconds(text)
