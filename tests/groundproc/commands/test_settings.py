"""The command line is made from the survey's dataclasses: each option once, with the file's meaning."""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

import pytest

from flightlog import config
from flightlog.errors import ConfigError, UsageError
from groundproc.commands.options import add_settings, beside, given_settings
from groundproc.survey import SECTIONS, PlacingSettings, Survey, section
from groundproc.survey.setting import command_of

TYPED = {
    "mount": (["--mount", "m.yaml"], "m.yaml"), "sync": (["--sync", "host"], "host"),
    "gyro_delay_ms": (["--gyro-delay-ms", "4.2"], 4.2),
    "method": (["--method", "ins"], "ins"), "causal": (["--causal"], True), "positions": (["--positions", "a.pos"], "a.pos"),
    "poses": (["--poses", "t.csv"], "t.csv"),
    "control": (["--control", "c.csv"], "c.csv"), "lasers": (["--lasers", "estimate"], "estimate"),
    "compass": (["--compass", "c.yaml"], "c.yaml"), "pose_grid_ms": (["--pose-grid-ms", "10ms"], 10.0),
    "fov_deg": (["--fov-deg=-105:105"], (-105.0, 105.0)), "min_range_m": (["--min-range-m", "2.5"], 2.5),
    "max_range_m": (["--max-range-m", "50"], 50.0), "attributes": (["--attributes", "sigma"], ("sigma",)),
    "boresight_sigma_deg": (["--boresight-sigma-deg", "0.1"], 0.1), "crs": (["--epsg", "EPSG:3006"], "EPSG:3006"),
    "crs_anyway": (["--crs-anyway"], True), "height": (["--height", "relative"], "relative"), "geoid": (["--geoid", "29.35"], "29.35"),
    "products": (["--products", "cloud.laz, pictures"], ("cloud.laz", "pictures")),
    "times": (["--times", "10/60"], ("10/60",)), "area": (["--area", "a.gpkg"], "a.gpkg"),
    "area_keeps": (["--area-keeps", "outside"], "outside"), "without_turns": (["--without-turns"], True),
    "without_ends": (["--without-ends"], True), "images": (["--images", "dcim"], "dcim"), "rig": (["--rig", "r.yaml"], "r.yaml"),
    "image_times": (["--image-times", "t.csv"], "t.csv"), "panels": (["--panels", "p.csv"], "p.csv"),
    "ortho_gsd_m": (["--ortho-gsd-m", "0.1"], 0.1),
    "uses": (["--uses", "ground, trees"], ("ground", "trees")), "targets": (["--targets", "t.gpkg"], "t.gpkg"),
}  # fmt: skip


def parsed(*words: str) -> Survey:
    parser = argparse.ArgumentParser()
    add_settings(parser, SECTIONS)
    return config.from_mapping(given_settings(parser.parse_args(words), SECTIONS), Survey, "command line")


def test_every_option_with_a_word_can_be_typed_and_nothing_typed_is_the_defaults() -> None:
    assert set(TYPED) == {f.name for f in dataclasses.fields(Survey) if command_of(f).words}
    assert parsed() == Survey()
    for name, (words, value) in TYPED.items():
        assert parsed(*words) == dataclasses.replace(Survey(), **{name: value}), name


def test_an_option_is_called_as_its_key_in_the_file_is() -> None:
    """One word for one thing in survey.yaml, on the command line and in messages; a beginning of it is enough to type."""
    for field in dataclasses.fields(Survey):
        words = command_of(field).words
        assert not words or words[0] == "--" + field.name.replace("_", "-")
    assert parsed("--pose-grid", "10ms", "--min-range", "2").pose_grid_ms == 10.0


def test_every_field_belongs_to_one_section_in_their_order() -> None:
    names = [field.name for part in SECTIONS for field in dataclasses.fields(part)]
    assert names == [field.name for field in dataclasses.fields(Survey)]
    assert list(section(Survey(), *SECTIONS)) == names


def test_help_says_what_the_file_says(capsys: pytest.CaptureFixture[str]) -> None:
    parser = argparse.ArgumentParser(formatter_class=lambda prog: argparse.HelpFormatter(prog, width=1000))
    add_settings(parser, SECTIONS)
    text = parser.format_help()
    for field in dataclasses.fields(Survey):
        command = command_of(field)
        if command.words:
            assert command.about in text
            assert field.metadata["about"].startswith(command.about)


@pytest.mark.parametrize(
    ("words", "error", "said"),
    [
        (["--fov", "wide"], UsageError, "--fov"), (["--pose-grid", "10s"], UsageError, "--pose-grid"),
        (["--min-range", "near"], ConfigError, "min_range_m"), (["--max-range", "500"], ConfigError, "max_range_m"),
        (["--min-range", "60", "--max-range", "50"], ConfigError, "beyond"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(words: list[str], error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        parsed(*words)


def test_another_command_may_take_some_with_defaults_of_its_own() -> None:
    parser = argparse.ArgumentParser()
    add_settings(parser, [PlacingSettings], only=("fov_deg", "min_range_m"), defaults={"min_range_m": 0.0})
    text = parser.format_help()
    assert "default: 255-105" in text
    assert "default: 0.0" in text
    assert "--max-range" not in text


def test_files_are_looked_for_beside_the_survey_and_words_are_no_files() -> None:
    tree: dict[str, Any] = {"mount": "mount.yaml", "lasers": "estimate", "compass": None, "control": "/abs/c.csv"}
    beside(tree, Path("/surveys"), tuple(tree), ("estimate",))
    assert tree == {"mount": "/surveys/mount.yaml", "lasers": "estimate", "compass": None, "control": "/abs/c.csv"}
