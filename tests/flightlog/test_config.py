import math
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from flightlog import config
from flightlog.config import option
from flightlog.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Window:
    start_deg: float = option(255.0, "where it begins [deg]", minimum=0, maximum=360)
    end_deg: float = option(105.0, "where it ends [deg]", minimum=0, maximum=360)


@dataclass(frozen=True, slots=True)
class Recorder:
    window: Window = option(Window, "what is kept")
    mode: str = option("strongest", "which return", choices=("strongest", "last"))
    port: int = option(2368, "UDP port", minimum=1, maximum=65535)
    rate_hz: float = option(10.0, "how often", minimum=0)
    enabled: bool = option(True, "whether at all")
    arm_m: tuple[float, float, float] = option((0.0, 0.0, -0.16), "lever arm [m]", minimum=-5, maximum=5)
    names: tuple[str, ...] = option((), "who")
    device: str | None = option(None, "serial port; null: none")
    limit_m: float | None = option(None, "null: none", maximum=9)
    windows: tuple[Window, ...] = option((Window(1, 2),), "more of them")

    def __post_init__(self) -> None:
        if self.port == 13:
            raise ValueError(f"port {self.port} and rate {self.rate_hz} do not go together")


@dataclass(frozen=True)
class Needs:
    path: str = field()
    size: int = 3


def test_an_empty_file_means_the_defaults(tmp_path: Path) -> None:
    for text in ("", "# nothing\n", "{}", "---\n"):
        (tmp_path / "a.yaml").write_text(text)
        assert config.load(tmp_path / "a.yaml", Recorder) == Recorder()


def test_what_the_file_says_replaces_the_default_and_the_rest_stays() -> None:
    ours = config.loads(
        "window: {start_deg: 10}\narm_m: [1, 2, 3]\ndevice: /dev/ttyS0\nnames: [a, b]", Recorder, "a.yaml"
    )
    assert ours == Recorder(window=Window(10.0, 105.0), arm_m=(1.0, 2.0, 3.0), device="/dev/ttyS0", names=("a", "b"))
    assert isinstance(ours.window.start_deg, float)
    assert isinstance(ours.arm_m, tuple)


def test_null_is_a_value_only_where_it_may_be_one() -> None:
    assert config.loads("device: null\nlimit_m: null", Recorder, "a.yaml") == Recorder()
    with pytest.raises(ConfigError, match=r"^a\.yaml: port: None found, expected a whole number$"):
        config.loads("port: null", Recorder, "a.yaml")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("windw: 1", "a.yaml: unknown key 'windw'; known are window, mode, port, rate_hz, enabled, arm_m, names, device"),
        ("window: {start: 1}", "a.yaml: window: unknown key 'start'; known are start_deg, end_deg"),
        ("1: 2", "a.yaml: unknown key 1"),
        ("window: {start_deg: north}", "a.yaml: window: start_deg: 'north' found, expected a number"),
        ("window: {start_deg: 361}", "a.yaml: window: start_deg: 361.0 found, expected 0 to 360"),
        ("window: 5", "a.yaml: window: 5 found, expected keys and values"),
        ("window:", "a.yaml: window: None found, expected keys and values"),
        ("rate_hz: -1", "a.yaml: rate_hz: -1.0 found, expected at least 0"),
        ("limit_m: 10", "a.yaml: limit_m: 10.0 found, expected at most 9"),
        ("rate_hz: .nan", "a.yaml: rate_hz: nan found, expected a finite number"),
        ("rate_hz: .inf", "a.yaml: rate_hz: inf found, expected a finite number"),
        ("rate_hz: true", "a.yaml: rate_hz: True found, expected a number"),
        ("port: 2.5", "a.yaml: port: 2.5 found, expected a whole number"),
        ("port: yes", "a.yaml: port: True found, expected a whole number"),
        ("port: '2368'", "a.yaml: port: '2368' found, expected a whole number"),
        ("enabled: 1", "a.yaml: enabled: 1 found, expected true or false"),
        ("mode: dual", "a.yaml: mode: 'dual' found, expected one of strongest, last"),
        ("mode: [last]", "a.yaml: mode: ['last'] found, expected a text"),
        ("arm_m: 1", "a.yaml: arm_m: 1 found, expected a list"),
        ("arm_m: [1, 2]", "a.yaml: arm_m: 2 values found, expected 3"),
        ("arm_m: [1, 2, up]", "a.yaml: arm_m[2]: 'up' found, expected a number"),
        ("arm_m: [1, 2, 6]", "a.yaml: arm_m[2]: 6.0 found, expected -5 to 5"),
        ("windows: [{start_deg: 1}, {start_deg: -1}]", "a.yaml: windows[1]: start_deg: -1.0 found, expected 0 to 360"),
        ("port: 13", "a.yaml: port 13 and rate 10.0 do not go together"),
        ("just a text", "a.yaml: 'just a text' found, expected keys and values"),
        ("[1, 2]", "a.yaml: [1, 2] found, expected keys and values"),
        ("port: 1\nport: 2", "a.yaml: is not valid YAML (key 'port' stands there twice"),
        ("window: {start_deg: 1, start_deg: 1}", "a.yaml: is not valid YAML (key 'start_deg' stands there twice"),
        ("port: [1", "a.yaml: is not valid YAML ("),
        ("port: 2024-12-11", "a.yaml: port: '2024-12-11' found, expected a whole number"),
        ("port: 2024-13-45", "a.yaml: port: '2024-13-45' found, expected a whole number"),
        ("port: !!timestamp 2024-13-45", "a.yaml: is not valid YAML ("),
        ("port: !!python/object:os.system x", "a.yaml: is not valid YAML ("),
        ("port: !!int ''", "a.yaml: is not valid YAML ("),
        ("port: " + "9" * 5000, "a.yaml: is not valid YAML ("),
        ("[" * 3000, "a.yaml: is not valid YAML ("),
        ("a: \x00", "a.yaml: is not valid YAML ("),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_in_one_sentence_with_file_and_key(text: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        config.loads(text, Recorder, "a.yaml")
    assert str(caught.value).startswith(sentence)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 2


def test_a_date_stays_the_text_it_is() -> None:
    assert config.loads("device: 2026-05-20T10:17:03Z", Recorder, "a.yaml").device == "2026-05-20T10:17:03Z"


def test_what_only_the_user_can_know_has_no_default() -> None:
    with pytest.raises(ConfigError, match=r"^a\.yaml: path is missing$"):
        config.loads("size: 4", Needs, "a.yaml")
    assert config.loads("path: x", Needs, "a.yaml") == Needs("x")


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.yaml: cannot be read \(No such file or directory\)$"):
        config.load(tmp_path / "none.yaml", Recorder)
    with pytest.raises(ConfigError, match=r"cannot be read \(Is a directory\)$"):
        config.load(tmp_path, Recorder)
    (tmp_path / "binary.yaml").write_bytes(b"\x80\xff\x00\x81")
    with pytest.raises(ConfigError, match=r"binary\.yaml: is not a text file$"):
        config.load(tmp_path / "binary.yaml", Recorder)


def test_the_sample_file_loads_back_to_the_defaults_and_names_every_option() -> None:
    text = config.sample(Recorder)
    assert config.loads(text, Recorder, "sample") == Recorder()
    assert set(yaml.safe_load(text)) == set(Recorder.__dataclass_fields__)
    assert "# UDP port\nport: 2368\n" in text
    assert "window:\n  # where it begins [deg]\n  start_deg: 255.0\n" in text
    assert "# which return (strongest | last)\nmode: strongest\n" in text
    assert "\ndevice: null\n" in text


finite = st.floats(allow_nan=False, allow_infinity=False)
# PyYAML writes NEL and the line separators of Unicode so that it reads spaces back
texts = st.text(st.characters(codec="utf-8", exclude_characters="\x85\u2028\u2029"))
degrees = st.floats(0, 360)
windows = st.builds(Window, degrees, degrees)
recorders = st.builds(
    Recorder,
    window=windows,
    mode=st.sampled_from(["strongest", "last"]),
    port=st.integers(14, 65535),
    rate_hz=st.floats(0, allow_infinity=False),
    enabled=st.booleans(),
    arm_m=st.tuples(*[st.floats(-5, 5)] * 3),
    names=st.lists(texts).map(tuple),
    device=st.none() | texts,
    limit_m=st.none() | st.floats(max_value=9, allow_infinity=False, allow_nan=False),
    windows=st.lists(windows).map(tuple),
)


@given(recorders)
def test_a_configuration_written_out_reads_back_equal(ours: Recorder) -> None:
    assert config.loads(config.dump(ours), Recorder, "dump") == ours
    assert config.from_mapping(config.to_mapping(ours), Recorder, "tree") == ours


trees = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | texts,
    lambda inner: (
        st.lists(inner) | st.dictionaries(st.sampled_from(list(Recorder.__dataclass_fields__)) | texts, inner)
    ),
)


@given(st.dictionaries(st.sampled_from(list(Recorder.__dataclass_fields__)), trees, max_size=4) | trees)
def test_any_tree_is_a_configuration_or_a_config_error(tree: Any) -> None:
    with suppress(ConfigError):
        ours = config.from_mapping(tree, Recorder, "tree")
        assert isinstance(ours, Recorder)
        assert math.isfinite(ours.rate_hz)


@given(st.text() | st.lists(st.sampled_from([*"{}[]:,-?&*!|>'\"%@`#\n \t", "a", "1", "port: ", "<<: "])).map("".join))
def test_any_text_is_a_configuration_or_a_config_error(text: str) -> None:
    with suppress(ConfigError):
        config.loads(text, Recorder, "text")


def test_aliases_are_refused_before_they_grow(cases: Path) -> None:
    with pytest.raises(ConfigError, match=r"an alias \(\*\) stands there") as error:
        config.load(cases / "hostile" / "yaml_alias_bomb.yaml", Recorder)
    assert len(str(error.value)) < 1000


def test_a_byte_order_mark_is_no_key(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_bytes(b"\xef\xbb\xbf" + config.dump(Recorder()).encode())
    assert config.load(path, Recorder) == Recorder()


def test_a_file_that_no_configuration_is_and_a_name_that_none_can_have(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_bytes(b"#" * 2_000_000)
    with pytest.raises(ConfigError, match="is larger than 1024 KiB"):
        config.load(path, Recorder)
    with pytest.raises(ConfigError, match="is no name of a file"):
        config.load("a\0b", Recorder)


@pytest.mark.parametrize("text", ["rate_hz: " + "9" * 400, "rate_hz: .inf", "rate_hz: .nan"])
def test_numbers_beyond_any_float_are_refused(text: str) -> None:
    with pytest.raises(ConfigError) as error:
        config.loads(text, Recorder, "text")
    assert len(str(error.value)) < 300


def test_an_alias_is_refused_with_its_place() -> None:
    with pytest.raises(ConfigError, match=r'an alias \(\*\) stands there.*in "<unicode string>", line 2, column 10'):
        config.loads("port: &a 14\nrate_hz: *a", Recorder, "a.yaml")


def test_an_error_in_a_file_names_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("ports: 1\n")
    with pytest.raises(ConfigError, match=rf"^{path}: unknown key 'ports'"):
        config.load(path, Recorder)


def test_a_file_of_just_a_mebibyte_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    head = b"port: 99\n#"
    path.write_bytes(head + b" " * ((1 << 20) - len(head)))
    assert config.load(path, Recorder).port == 99
    path.write_bytes(head + b" " * ((1 << 20) - len(head) + 1))
    with pytest.raises(ConfigError, match="is larger than 1024 KiB"):
        config.load(path, Recorder)


def test_a_wrong_value_is_repeated_up_to_200_characters() -> None:
    for letters, shown in ((198, "x" * 198 + "' found"), (199, "x" * 199 + "... found")):
        with pytest.raises(ConfigError, match=rf"^a\.yaml: port: '{shown}, expected a whole number$"):
            config.loads(f"port: {'x' * letters}", Recorder, "a.yaml")


def test_options_are_declared_with_meaning_bounds_and_choices_in_the_order_of_the_file() -> None:
    @dataclass(frozen=True)
    class Kit:
        zone: str = option("left", "which side", choices=("left", "right"))
        span_m: tuple[float, float] = option((0.0, 1.0), "from and to [m]", minimum=0, maximum=9)
        gains: tuple[float, ...] = option(tuple(k / 8 for k in range(60)), "of each channel")
        bare: int = 3
        inner: Window = option(Window, "where")

    assert config.sample(Kit).startswith(
        "# which side (left | right)\nzone: left\n# from and to [m]\nspan_m: [0.0, 1.0]\n"
    )
    # the longest option is one line, and one that nobody explained has none above it
    assert config.sample(Kit).splitlines()[5:7] == [f"gains: [{', '.join(str(k / 8) for k in range(60))}]", "bare: 3"]
    assert config.dump(Kit()).startswith("zone: left\nspan_m:\n")
    assert config.loads("", Kit, "a.yaml").inner == Window()
    for text, sentence in (
        ("span_m: [1]", "1 values found, expected 2"), ("span_m: [1, 2, 3]", "3 values found, expected 2"),
        ("zone: up", "'up' found, expected one of left, right"), ("span_m: [1, 10]", r"span_m\[1\]: 10.0 found, expected 0 to 9"),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=sentence):
            config.loads(text, Kit, "a.yaml")
