"""Parameter files, and parameters over MAVLink with a stand-in autopilot on a real pseudo terminal."""

import contextlib
import importlib.util
import io
import os
import random
import select
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink import mavparm

from flightlog.errors import ConfigError, SourceError, SwathError, UsageError
from flightlog.mavlink import FrameParser, decode
from onboard import parameter_link
from onboard.cli import main
from onboard.config import LinkConfig, StreamsConfig
from onboard.parameter_link import ParameterLink
from onboard.parameters import FILES, Difference, Parameter, as_single, compare, generation, parse, shipped
from onboard.requester import _STREAMS


def _standin() -> ModuleType:
    spec = importlib.util.spec_from_file_location("standin_autopilot", Path(__file__).with_name("standin_autopilot.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


STANDIN = _standin()
UINT8, INT16, INT32, REAL32 = STANDIN.UINT8, STANDIN.INT16, STANDIN.INT32, STANDIN.REAL32


# Files ----------------------------------------------------------------------------------------------------------------


def test_both_ways_of_writing_a_line_are_read_with_the_reason_behind() -> None:
    text = "# head\n\nSR0_EXTRA1,50  # attitude\nCOMPASS_DEC 0.1\nA , 1e2\t#  x # y\n"
    assert parse(text, "x.param") == {
        "SR0_EXTRA1": Parameter("SR0_EXTRA1", 50.0, "attitude"),
        "COMPASS_DEC": Parameter("COMPASS_DEC", as_single(0.1), ""),
        "A": Parameter("A", 100.0, "x # y"),
    }


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("A,1\nA 1", "x, line 2: A stands there twice"),
        ("A", "x, line 1: 'A' found, expected NAME,VALUE"),
        ("A,1,2", "x, line 1: 'A,1,2' found, expected NAME,VALUE"),
        ("a,1", "x, line 1: 'a,1' found"),
        ("A2345678901234567,1", "found, expected NAME,VALUE"),
        ("A,one", "x, line 1: 'one' found, expected a number"),
        ("A,nan", "'nan' found, expected a number"),
        ("A,1e39", "'1e39' found, expected a number"),
    ],
)
def test_a_wrong_line_is_one_sentence_with_its_place(text: str, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        parse(text, "x")


@settings(deadline=None)
@given(st.text())
def test_any_text_is_parameters_or_a_named_error(text: str) -> None:
    with contextlib.suppress(SwathError):
        parse(text, "x")


@pytest.mark.parametrize("board", FILES)
def test_the_shipped_files_give_a_reason_for_every_value(board: tuple[str, str]) -> None:
    parameters = shipped(*board)
    assert len(parameters) >= 15
    assert [p.name for p in parameters.values() if not p.reason] == []


@pytest.mark.parametrize("board", FILES)
def test_pymavlink_reads_the_shipped_files_alike(board: tuple[str, str]) -> None:
    import importlib.resources

    with importlib.resources.as_file(importlib.resources.files("firmware_config").joinpath(FILES[board])) as path:
        witness = mavparm.MAVParmDict()
        assert witness.load(str(path), check=False)
    assert {name: as_single(value) for name, value in dict(witness).items()} == {
        name: parameter.value for name, parameter in shipped(*board).items()
    }


@pytest.mark.parametrize("generation", ["3.1.3", "4"])
def test_the_measuring_boards_streams_are_those_that_swathd_asks_for(generation: str) -> None:
    names = {1: "RAW_SENS", 2: "EXT_STAT", 6: "POSITION", 10: "EXTRA1", 11: "EXTRA2", 12: "EXTRA3"}
    parameters = shipped("ins", generation)
    for option, stream, _ in _STREAMS:
        for port in (0, 1):
            assert parameters[f"SR{port}_{names[stream]}"].value == getattr(StreamsConfig(), option)


def test_a_real_autopilot_4_has_every_parameter_of_the_file_for_it(recordings: Path) -> None:
    """An ArduSub 4.1, whose libraries are Copter's; the only name it lacks is of a copter's own."""
    found = _recorded(recordings / "mavlink" / "ardusub_2023.tlog")
    assert generation(found) == "4"
    for board in ("ins", "fc"):
        assert [name for name in shipped(board, "4") if name not in found] == []


def test_a_real_copter_of_2015_has_the_stream_parameters_of_the_old_file(recordings: Path) -> None:
    found = _recorded(recordings / "mavlink" / "copter_flight_2015.tlog")
    missing = [name for name in shipped("ins", "3.1.3") if name not in found]
    assert missing == ["INS_MPU6K_FILTER"]  # renamed in between


def _recorded(path: Path) -> dict[str, float]:
    messages = [decode(f) for f in FrameParser().feed(0, path.read_bytes()) if f.known and f.message_id == 22]
    return {message.param_id: message.param_value for message in messages if message is not None}


def test_what_is_equal_in_single_precision_is_equal() -> None:
    wanted = parse("A,0.1\nB,16777217\nC,3 # why\nD,1", "x")
    found = {"A": 0.10000000149011612, "B": 16777216.0, "C": 4.0}
    differences = compare(wanted, found)
    assert differences == [Difference("C", 3.0, 4.0, "why"), Difference("D", 1.0, None)]
    assert list(map(str, differences)) == ["C: 4 found, 3 wanted (why)", "D: not there, 1 wanted"]


# The link -------------------------------------------------------------------------------------------------------------


@pytest.fixture
def autopilot(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Any]]:
    monkeypatch.setattr(parameter_link, "_WAIT_S", 0.25)
    made = []

    def make(parameters: dict[str, list[Any]], **how: object) -> Any:
        made.append(STANDIN.StandinAutopilot(parameters, **how))
        return made[-1]

    yield make
    for each in made:
        each.close()


def small() -> dict[str, list[Any]]:
    return {
        "A": [1, UINT8],
        "B": [-300, INT16],
        "C": [176126, INT32],
        "D_SIXTEEN_LETTER": [0.1, REAL32],
        "E": [5, UINT8],
    }


@pytest.mark.parametrize("version", [1, 2])
def test_parameters_are_read_by_name_in_the_autopilots_version(autopilot: Callable[..., Any], version: int) -> None:
    board = autopilot(small(), version=version)
    with ParameterLink(LinkConfig(board.device)) as link:
        assert link.find_autopilot() == (7, 1)
        assert link.read(["A", "B", "C", "D_SIXTEEN_LETTER"]) == {
            "A": 1.0, "B": -300.0, "C": 176126.0, "D_SIXTEEN_LETTER": as_single(0.1),
        }  # fmt: skip
    assert board.heard == {"PARAM_REQUEST_READ": 4}


def test_half_of_all_frames_may_be_lost_and_everything_is_read_and_set(autopilot: Callable[..., Any]) -> None:
    chance = random.Random(3)
    board = autopilot({f"P{i}": [i, INT32] for i in range(40)}, lose=lambda n: chance.random() < 0.3)
    with ParameterLink(LinkConfig(board.device)) as link:
        assert link.read_all() == {f"P{i}": float(i) for i in sorted(range(40), key=str)}
        wanted = parse("P3,33\nP4,44\nP5,5", "x")
        differences = compare(wanted, link.read(wanted))
        assert [difference.name for difference in differences] == ["P3", "P4"]
        link.apply(differences)
        assert link.counts.repeated > 0
    assert board.lost > 10
    assert (board.parameters["P3"], board.parameters["P4"]) == ([33, INT32], [44, INT32])
    assert {name for name, _, _ in board.sets} == {"P3", "P4"}


def test_what_is_asked_again_is_counted_and_what_is_not_there_not_asked_for_ever(
    autopilot: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parameter_link, "_TRIES", 8)
    board = autopilot(small())
    with ParameterLink(LinkConfig(board.device)) as link:
        assert link.read(["A", "NOT_THERE"]) == {"A": 1.0}
        asked = board.heard["PARAM_REQUEST_READ"]
        assert asked < 2 + 7  # not in all eight tries
        assert link.counts.repeated == asked - 2
        assert set(link.read_all()) == set(small())
        before = board.heard["PARAM_REQUEST_READ"] - 2
        assert link.counts.repeated == before
        assert link.counts.sent == sum(board.heard.values())
        monkeypatch.setattr(parameter_link, "_TRIES", 3)
        board.lose = lambda n: True
        link._until(lambda: False, 1.0)  # what was still on its way is heard
        with pytest.raises(SourceError, match=": all parameters did not come in 3 tries"):
            link.read_all()
        assert link.counts.repeated == before + 3


def test_a_set_is_sent_with_the_parameters_own_type_as_a_number(autopilot: Callable[..., Any]) -> None:
    board = autopilot(small(), version=2)
    with ParameterLink(LinkConfig(board.device)) as link:
        wanted = parse("B,-7\nC,958\nD_SIXTEEN_LETTER,0.25", "x")
        told: list[Difference] = []
        link.apply(compare(wanted, link.read(wanted)), told.append)
    assert board.sets == [("B", -7.0, INT16), ("C", 958.0, INT32), ("D_SIXTEEN_LETTER", 0.25, REAL32)]
    assert [difference.name for difference in told] == ["B", "C", "D_SIXTEEN_LETTER"]


def test_a_value_that_the_type_cannot_hold_is_refused_before_anything_is_set(autopilot: Callable[..., Any]) -> None:
    board = autopilot(small())
    with ParameterLink(LinkConfig(board.device)) as link:
        for text, sentence in [
            ("B,2\nA,0.5", "A: 0.5 wanted, but it holds whole numbers of 0 to 255"),
            ("B,2\nA,256", "A: 256 wanted"),
            ("B,2\nB,40000".replace("B,2\n", ""), "B: 40000 wanted, but it holds whole numbers of -32768 to 32767"),
        ]:
            wanted = parse(text, "x")
            with pytest.raises(UsageError, match=sentence):
                link.apply(compare(wanted, link.read(wanted)))
    assert board.sets == []


def test_an_armed_autopilot_is_never_set(autopilot: Callable[..., Any]) -> None:
    board = autopilot(small())
    board.armed = True
    with (
        ParameterLink(LinkConfig(board.device)) as link,
        pytest.raises(UsageError, match="is armed; parameters are set only while it is disarmed"),
    ):
        link.apply([Difference("A", 2.0, 1.0)])
    assert board.sets == []


def test_arming_in_between_ends_it(autopilot: Callable[..., Any]) -> None:
    board = autopilot(small(), arm_after_sets=1)
    with (
        ParameterLink(LinkConfig(board.device)) as link,
        pytest.raises(UsageError, match="the autopilot is armed"),
    ):
        link.apply([Difference("A", 2.0, 1.0), Difference("E", 6.0, 5.0)])
    assert [name for name, _, _ in board.sets] == ["A"]
    assert board.parameters["E"] == [5, UINT8]


def test_what_was_heard_three_seconds_ago_is_no_word_on_whether_it_is_armed(
    autopilot: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Armed meanwhile, and then nothing at all is heard: both times what it said before counts for nothing."""
    board = autopilot(small())
    with ParameterLink(LinkConfig(board.device)) as link:
        link.refuse_if_armed()
        board.armed = True
        link._heartbeat_ns -= 3 * 10**9  # as if that long had passed
        with pytest.raises(UsageError, match="is armed; parameters are set only while it is disarmed"):
            link.refuse_if_armed()
        board.armed = False
        before = link._heartbeat_ns
        link._until(lambda: link._heartbeat_ns > before and link._life.armed(link._heartbeat_ns) is False, 90.0)
        assert link._life.armed(link._heartbeat_ns) is False
        board.mute = True
        link._until(lambda: False, 0.6)  # what it has said is read
        monkeypatch.setattr(parameter_link, "_HEARTBEAT_S", 0.6)
        link.refuse_if_armed()  # that is less than a second old: good enough
        link._heartbeat_ns -= 3 * 10**9
        with pytest.raises(UsageError, match="is not heard any more; parameters are set only while it is"):
            link.refuse_if_armed()


def test_a_parameter_that_keeps_its_value_is_told_of(
    autopilot: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parameter_link, "_TRIES", 2)
    board = autopilot(small(), stubborn=("A",))
    with (
        ParameterLink(LinkConfig(board.device)) as link,
        pytest.raises(SourceError, match="A was set to 2 2 times, the autopilot keeps 1"),
    ):
        link.apply([Difference("A", 2.0, 1.0)])


def test_a_link_by_udp_does_as_well(autopilot: Callable[..., Any], free_port: int) -> None:
    """As a MAVLink router hands it on: its bytes come from a port that answers go back to."""
    board = autopilot(small(), version=2)
    device, end = os.open(board.device, os.O_RDWR | os.O_NOCTTY), threading.Event()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:

        def route() -> None:
            sock.setblocking(False)
            while not end.is_set():
                for ready in select.select([device, sock], [], [], 0.05)[0]:
                    if ready is sock:
                        with contextlib.suppress(ConnectionRefusedError):
                            os.write(device, sock.recv(65536))
                    else:
                        sock.sendto(os.read(device, 4096), ("127.0.0.1", free_port))

        router = threading.Thread(target=route)
        router.start()
        try:
            with ParameterLink(LinkConfig(f"udp:127.0.0.1:{free_port}")) as link:
                wanted = parse("A,9\nE,5", "x")
                link.apply(compare(wanted, link.read(wanted)))
        finally:
            end.set()
            router.join()
            os.close(device)
    assert board.parameters["A"] == [9, UINT8]


def test_silence_is_one_sentence(tmp_path: Path, free_port: int) -> None:
    with (
        ParameterLink(LinkConfig(f"udp:127.0.0.1:{free_port}")) as link,
        pytest.raises(SourceError, match=r"no autopilot was heard within 0\.2 s"),
    ):
        link.find_autopilot(0.2)
    with pytest.raises(SourceError, match="cannot be opened"):
        ParameterLink(LinkConfig(str(tmp_path / "nothing")))


# The command ----------------------------------------------------------------------------------------------------------


def test_show_and_apply_bring_a_board_of_2014_to_the_shipped_parameters(
    autopilot: Callable[..., Any], capsys: pytest.CaptureFixture[str]
) -> None:
    wanted = shipped("ins", "3.1.3")
    parameters = {name: [0, REAL32 if "DEC" in name else INT16] for name in wanted}
    del parameters["TELEM_DELAY"]
    board = autopilot(parameters)
    words = ["parameters", "show", "--device", board.device]
    assert main(words) == 1
    out = capsys.readouterr().out
    assert "SR0_EXTRA1: 0 found, 50 wanted (USB. ATTITUDE" in out
    assert "TELEM_DELAY: not there, 0 wanted" in out
    assert board.sets == []
    words[1] = "apply"
    assert main([*words, "--yes"]) == 1  # one is not there
    assert {name: value for name, (value, _) in board.parameters.items()} == {
        name: parameter.value for name, parameter in wanted.items() if name != "TELEM_DELAY"
    }
    board.parameters["TELEM_DELAY"] = [0, UINT8]
    capsys.readouterr()
    assert main(words) == 0
    assert f"all {len(wanted)} parameters are as wanted" in capsys.readouterr().out


def test_files_of_ones_own_go_before_the_shipped_and_nothing_is_set_without_a_yes(
    autopilot: Callable[..., Any],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    board = autopilot(small())
    first, second = tmp_path / "1.param", tmp_path / "2.param"
    first.write_text("A,3\nE,6")
    second.write_text("A,1")
    words = ["--device", board.device, "--file", str(first), "--file", str(second)]
    assert main(["parameters", "apply", *words]) == 2
    answer = capsys.readouterr()
    assert answer.out == "E: 5 found, 6 wanted\n"
    assert "nothing was changed: say --yes to set 1 parameters" in answer.err
    assert board.sets == []
    board.armed = True
    assert main(["parameters", "apply", "--yes", *words]) == 2
    assert "is armed" in capsys.readouterr().err
    assert main(["parameters", "show", "--all", "--device", board.device]) == 0
    listed = parse(capsys.readouterr().out, "list")
    assert {name: p.value for name, p in listed.items()} == {n: as_single(v) for n, (v, _) in small().items()}
    assert main(["parameters", "show", "--device", board.device]) == 2
    assert "its firmware is neither ArduCopter 3.1.3 nor ArduPilot 4" in capsys.readouterr().err


def test_a_count_that_no_autopilot_has_is_one_sentence(autopilot: Callable[..., Any]) -> None:
    board = autopilot({"A_B": [1.0, REAL32]})
    board.count = 65_535
    expected = "says that it has 65535 parameters, expected 5000 at most"
    with ParameterLink(LinkConfig(board.device)) as link, pytest.raises(SourceError, match=expected):
        link.read_all()


def test_asking_ends_where_nobody_answers(autopilot: Callable[..., Any]) -> None:
    board = autopilot({"A_B": [1.0, REAL32]})
    board.count = 4_000
    with ParameterLink(LinkConfig(board.device)) as link:
        with pytest.raises(SourceError, match="3999 parameters did not come"):
            link.read_all()
        assert board.heard["PARAM_REQUEST_READ"] < 100


def test_names_that_are_none_are_left_out_and_counted(autopilot: Callable[..., Any]) -> None:
    board = autopilot({"A_B": [1.0, REAL32], "X\x1b[2J": [2.0, REAL32], "Y,9\nZ": [3.0, REAL32]})
    with ParameterLink(LinkConfig(board.device)) as link:
        assert link.read_all() == {"A_B": 1.0}
        assert link.counts.bad_names == 2
