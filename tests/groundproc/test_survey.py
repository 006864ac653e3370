"""survey.yaml and which mount holds."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from flightlog import config
from flightlog.errors import ConfigError
from flightlog.logfile import LogReader
from flightlog.logwriter import LogWriter
from flightlog.mount import LidarMount, Mount
from groundproc.flight.mounting import find_mount
from groundproc.survey import Survey


def survey(tmp_path: Path, text: str) -> Survey:
    (tmp_path / "survey.yaml").write_text(text)
    return config.load(tmp_path / "survey.yaml", Survey)


def test_an_empty_file_is_the_defaults(tmp_path: Path) -> None:
    assert survey(tmp_path, "{}\n") == Survey()


def test_the_sample_is_the_defaults_with_a_word_about_each(tmp_path: Path) -> None:
    text = config.sample(Survey)
    assert survey(tmp_path, text) == Survey()
    for name in Survey.__dataclass_fields__:
        assert name in text


OTHERS: dict[str, object] = {
    "attributes": ["sigma"],
    "times": ["60/480"],
    "mount": {"lidar": {"position_m": [0.01, 0.02, -0.2], "pitch_deg": -30}, "gps_position_m": [0, -0.1, 0.2]},
    "crs": 3006,
    "geoid": "29.35",
    "fov_deg": [0.0, 360.0],
    "pose_grid_ms": 10.0,
    "products": ["cloud.laz"],
    "uses": ["ground"],
}
"""Values of options that are not seen from their defaults and bounds."""


def leaves(made: Any, above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], "dataclasses.Field[Any]", Any]]:
    """Every option, those of sections within too: path of names, field, default."""
    for field in dataclasses.fields(made):
        value = getattr(made, field.name)
        if dataclasses.is_dataclass(value):
            yield from leaves(value, (*above, field.name))
        else:
            yield (*above, field.name), field, value


def other(field: "dataclasses.Field[Any]", default: Any) -> Any:
    """A value of an option that is allowed and not its default."""
    if field.name in OTHERS:
        return OTHERS[field.name]
    if choices := field.metadata["choices"]:
        return next(choice for choice in choices if choice != default)
    if isinstance(default, bool):
        return not default
    if isinstance(default, tuple):
        return list(default[:-1])
    if isinstance(default, int | float):
        low, high = field.metadata["minimum"], field.metadata["maximum"]
        return type(default)((default + high) / 2 if high not in (None, default) else (default + low) / 2)
    return "some-file"


@pytest.mark.parametrize(
    ("path", "field", "default"), [pytest.param(*leaf, id=".".join(leaf[0])) for leaf in leaves(Survey())]
)
def test_every_option_can_be_set(
    tmp_path: Path, path: tuple[str, ...], field: "dataclasses.Field[Any]", default: Any
) -> None:
    value = other(field, default)
    tree: Any = value
    for name in reversed(path):
        tree = {name: tree}
    chosen = survey(tmp_path, yaml.safe_dump(tree))
    found = {names: leaf for names, _, leaf in leaves(chosen) if names[: len(path)] == path}
    assert found != {path: default}
    if path == ("mount",):
        assert chosen.mount == Mount(LidarMount((0.01, 0.02, -0.2), pitch_deg=-30.0), (0.0, -0.1, 0.2))
    else:
        assert found == {path: tuple(value) if isinstance(value, list) else value}
    # and nothing else has changed
    untouched = {names: leaf for names, _, leaf in leaves(Survey()) if names != path}
    assert {names: leaf for names, _, leaf in leaves(chosen) if names[: len(path)] != path} == untouched
    assert config.loads(config.dump(chosen), Survey, "again") == chosen


@pytest.mark.parametrize(
    "line",
    [
        "colour: red", "height: sea", "method: magic", "crs: [1]", "pose_grid_ms: 0", "fov_deg: [1]", "fov_deg: 255-105",
        "min_range_m: -1", "max_range_m: 500", "sync: maybe", "mount: {lidar: {tilt: 3}}",
        "{min_range_m: 60, max_range_m: 50}", "- a\n- b", "geoid: [1]",
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_by_file_and_key(tmp_path: Path, line: str) -> None:
    with pytest.raises(ConfigError) as caught:
        survey(tmp_path, line)
    assert str(tmp_path / "survey.yaml") in str(caught.value)
    assert "\n" not in str(caught.value)


# Mount ----------------------------------------------------------------------------------------------------------------


def log(path: Path, mount: str | None) -> LogReader:
    with path.open("wb") as stream:
        attachments = {} if mount is None else {"mount.yaml": mount.encode()}
        LogWriter(stream, metadata={}, attachments=attachments).finish()
    return LogReader(path)


TILTED = "lidar: {pitch_deg: -35}\n"


def test_the_survey_goes_before_the_log_and_the_log_before_the_default(tmp_path: Path) -> None:
    chosen = Mount().with_lidar(pitch_deg=-10.0)
    with log(tmp_path / "a.mcap", TILTED) as told, log(tmp_path / "b.mcap", None) as silent:
        assert find_mount(chosen, [told]) == (chosen, "survey")
        assert find_mount(None, [told, silent]) == (Mount().with_lidar(pitch_deg=-35.0), "log")
        mount, source = find_mount(None, [silent])
    assert source == "firmware_config/mount.yaml"
    # the airframe of the source: 20 deg forward, 16 cm below the INS
    shipped = yaml.safe_load((Path(__file__).parents[2] / source).read_text())
    assert shipped["lidar"]["pitch_deg"] == mount.lidar.pitch_deg == -20.0
    assert mount.lidar.position_m == (0.0, 0.0, -0.16)


def test_logs_of_one_flight_may_state_the_same_mount_and_not_two(tmp_path: Path) -> None:
    with log(tmp_path / "a.mcap", TILTED) as a, log(tmp_path / "b.mcap", TILTED.replace(":", ": ")) as b:
        assert find_mount(None, [a, b])[1] == "log"
    with log(tmp_path / "a.mcap", TILTED) as a, log(tmp_path / "b.mcap", "lidar: {pitch_deg: -20}\n") as b:
        with pytest.raises(ConfigError, match="different mounts"):
            find_mount(None, [a, b])
        assert find_mount(Mount(), [a, b])[1] == "survey"


def test_a_mount_in_the_log_that_cannot_be_read_is_refused_by_name(tmp_path: Path) -> None:
    with (
        log(tmp_path / "a.mcap", "lidar: {pitch: 3}\n") as a,
        pytest.raises(ConfigError, match=r"a\.mcap: mount\.yaml"),
    ):
        find_mount(None, [a])


def test_a_mount_file_named_in_the_survey_is_read_from_beside_it(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("lidar: {pitch_deg: -33}")
    mount, source = find_mount(str(tmp_path / "mine.yaml"), [])
    assert mount.lidar.pitch_deg == -33.0
    assert source.endswith("mine.yaml")


def test_a_mount_file_that_is_not_there_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="nowhere"):
        find_mount(str(tmp_path / "nowhere.yaml"), [])
