"""`swath ppk` against RTKLIB itself and a rover whose path is known."""

import gzip
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gnss
import numpy as np
import pytest
from scipy import stats

from groundproc.cli import main
from groundproc.flight.positions.ppkoptions import PpkOptions
from groundproc.flight.positions.reading import read_solution
from groundproc.flight.positions.solution import Quality, Solution

pytestmark = pytest.mark.usefixtures("rtklib")
BASE_TEXT = "58.39,15.62,110.0"


def squared(error: Any, solution: Solution) -> Any:
    """Errors in units of their covariances."""
    return np.einsum("ni,nij,nj->n", error, np.linalg.inv(solution.covariance_m2), error)


@pytest.fixture
def run(world: Any, tmp_path: Path) -> Callable[..., Path]:
    """swath ppk on files of the world; the output's path."""

    def call(rover: str, base: str, *words: str, nav: str = "brdc.nav", code: int = 0) -> Path:
        output = tmp_path / "out.pos"
        line = ["ppk", str(world.folder / rover), "--base", str(world.folder / base), "-o", str(output), *words]
        assert main([*line, *(["--nav", str(world.folder / nav)] if nav else [])]) == code
        return output

    return call


@pytest.mark.parametrize("slips_each_s", [0.0, pytest.param(0.01, marks=pytest.mark.soak)])  # five skies each
def test_fixes_are_the_known_path_within_their_sigmas(
    make_world: Callable[..., Any], tmp_path: Path, slips_each_s: float
) -> None:
    # several skies, so that the 95 % are of more than one set of wrong starts
    distances, floats, lengths = [], [], []
    for seed in range(1, 6):
        world = make_world(seed, slips_each_s=slips_each_s)
        output = tmp_path / f"{seed}.pos"
        words = [
            str(world.folder / "rover.obs"),
            "--base",
            str(world.folder / "base.obs"),
            "--nav",
            str(world.folder / "brdc.nav"),
        ]
        assert main(["ppk", *words, "-o", str(output), "--json"]) == 0
        found = read_solution(output)
        assert len(found) == 300
        error, fixed = world.errors_m(found), found.quality == Quality.FIX
        distance = squared(error, found)
        distances.append(distance[fixed])
        floats.append(distance[found.quality == Quality.FLOAT])
        lengths.append(np.linalg.norm(error[fixed], axis=1))
    fixes = np.concatenate(distances)
    assert len(fixes) > 0.6 * 5 * 300
    # three dimensions: of 1000 or more such squares the mean is 3 +- 0.1, if the noise is what RTKLIB is told
    assert fixes.mean() == pytest.approx(3.0, abs=0.5)
    assert np.mean(fixes < stats.chi2.ppf(0.95, 3)) > 0.92
    # one wrong fix, off by a wavelength of 19 cm, would be hundreds
    assert fixes.max() < stats.chi2.isf(1e-8, 3)
    assert np.median(np.concatenate(lengths)) < 0.03
    # errors of floats hang together over a flight: few are independent
    assert np.concatenate(floats).mean() < 3 * 3 if any(map(len, floats)) else True


def test_two_systems_fix_everything_and_centimetres_stay_under_multipath(
    make_world: Callable[..., Any], tmp_path: Path
) -> None:
    lengths, share = [], []
    for seed, multipath in ((1, (0.0, 0.0, 20.0)), (7, (0.5, 0.003, 20.0)), (8, (0.5, 0.003, 20.0))):
        world = make_world(seed, galileo=True, multipath=multipath)
        output = tmp_path / f"{seed}.pos"
        words = [
            str(world.folder / "rover.ubx"),
            "--base",
            str(world.folder / "base.obs"),
            "--nav",
            str(world.folder / "brdc.nav"),
        ]
        assert main(["ppk", *words, "-o", str(output), "--json"]) == 0
        found = read_solution(output)
        fixed = found.quality == Quality.FIX
        share.append(fixed.mean())
        lengths.append(np.linalg.norm(world.errors_m(found)[fixed], axis=1))
    assert share[0] == 1.0
    assert min(share) > 0.3
    # a wrong fix is off by decimetres
    assert np.concatenate(lengths).max() < 0.1


def test_the_summary_says_what_came_of_it(run: Callable[..., Path], capsys: pytest.CaptureFixture[str]) -> None:
    output = run("rover.obs", "base.obs", "--json")
    summary = json.loads(capsys.readouterr().out)
    found = read_solution(output)
    assert summary["rover_epochs"] == summary["positions"] == len(found) == 300
    assert summary["lost_epochs"] == 0
    assert sum(summary["quality"].values()) == pytest.approx(1.0, abs=1e-3)
    assert summary["quality"] == {name: round(share, 4) for name, share in found.shares().items()}
    # the circle of 60 m about 400 m east and 250 m south
    far = np.hypot(400, 250)
    assert summary["baseline_m"]["shortest"] == pytest.approx(far - 60, abs=2)
    assert summary["baseline_m"]["longest"] == pytest.approx(far + 60, abs=2)
    assert summary["sigma_m"]["fix"]["horizontal"] < 0.03
    assert summary["base"]["source"] == "header of its RINEX file"
    run("rover.obs", "base.obs", "--force")
    assert "100.0% fix" in capsys.readouterr().out
    header = output.read_text().split("%  GPST")[0]
    assert "rover.obs" in header
    assert "pos1-dynamics =off" in header
    assert str(output.parent) not in header
    assert sorted(path.name for path in output.parent.iterdir()) == ["out.pos"]


def test_versions_formats_and_base_positions_give_the_same_path(run: Callable[..., Path], world: Any) -> None:
    plain = read_solution(run("rover.obs", "base.obs"))
    ways: list[tuple[tuple[str, ...], str]] = [
        (("rover.ubx", "base.obs"), "brdc.nav"),
        (("rover.obs", "base.24o"), "brdc.24n"),  # the header's place is that of the marker 1.5 m below
        (("rover.ubx", "base.ubx", "--base-position", BASE_TEXT), "brdc.nav"),
    ]
    for words, nav in ways:
        found = read_solution(run(*words, "--force", nav=nav))
        # UBX has phases as doubles and RINEX to a thousandth of a cycle; ambiguities may be fixed an epoch sooner or later
        apart = np.linalg.norm(world.errors_m(found) - world.errors_m(plain), axis=1)
        assert np.median(apart) < 2e-3, words
        assert np.mean(apart < 5e-3) > 0.95, words
    for name in ("rover.obs", "base.obs", "brdc.nav"):
        with (world.folder / name).open("rb") as file, gzip.open(world.folder / f"{name}.gz", "wb") as packed:
            shutil.copyfileobj(file, packed)
    packed_way = read_solution(run("rover.obs.gz", "base.obs.gz", "--force", nav="brdc.nav.gz"))
    np.testing.assert_array_equal(packed_way.latitude_deg, plain.latitude_deg)


def test_a_base_averaged_is_off_in_one_piece_and_said_to_be(
    run: Callable[..., Path], world: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    found = read_solution(run("rover.obs", "unplaced.obs", "--base-average"))
    assert "known to metres only" in capsys.readouterr().out
    error = world.errors_m(found)[found.quality == Quality.FIX]
    assert np.linalg.norm(error.mean(axis=0)) < 20
    assert error.std(axis=0).max() < 0.05


def test_options_reach_rtklib(run: Callable[..., Path], tmp_path: Path) -> None:
    options = tmp_path / "ppk.yaml"
    options.write_text("ratio: 4.5\nsystems: GE\n")
    output = run(
        "rover.obs",
        "base.obs",
        "--config",
        str(options),
        "--ambiguities",
        "off",
        "--elevation-mask",
        "20",
        "--direction",
        "forward",
    )
    text = output.read_text()
    for line in ("pos2-arthres =4.5", "pos1-navsys =9", "pos2-armode =off", "pos1-elmask =20"):
        assert line in text
    found = read_solution(output)
    assert Quality.FIX not in found.quality
    backward = read_solution(run("rover.obs", "base.obs", "--direction", "backward", "--force"))
    assert (np.diff(backward.time_ns) > 0).all()


def test_the_configuration_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    from flightlog import config

    with pytest.raises(SystemExit) as stopped:
        main(["ppk", "--show-config"])
    assert stopped.value.code == 0
    assert config.loads(capsys.readouterr().out, PpkOptions, "shown") == PpkOptions()


@pytest.mark.parametrize(
    ("rover", "base", "words", "nav", "code", "sentence"),
    [
        (
            "rover.obs",
            "unplaced.obs",
            (),
            "brdc.nav",
            1,
            "unplaced.obs: its header states no position; give --base-position",
        ),
        ("rover.obs", "base.ubx", (), "brdc.nav", 1, "base.ubx: a UBX file states no surveyed position"),
        (
            "rover.obs",
            "base.obs",
            (),
            "",
            1,
            "rover.obs: there is no ephemeris; give a RINEX navigation file with --nav",
        ),
        ("rover.obs", "brdc.nav", (), "brdc.nav", 1, "brdc.nav: holds no observations"),
        ("rover.obs", "base.obs", (), "base.obs", 1, "base.obs: holds observations, expected ephemerides"),
        ("rover.obs", "late.obs", (), "brdc.nav", 1, "late.obs: covers 2024-02-07 13:"),
        ("rover.obs", "base.obs", (), "old.nav", 1, "ephemerides of 0 satellites within 2 h"),
        ("rover.obs", "empty.obs", (), "brdc.nav", 1, "empty.obs: holds no observations, expected RINEX epochs"),
        ("none.obs", "base.obs", (), "brdc.nav", 1, "none.obs: no such file; expected raw observations"),
        ("noise.bin", "base.obs", (), "brdc.nav", 1, "noise.bin: is nothing that is known"),
        ("noise.ubx", "base.obs", (), "brdc.nav", 1, "noise.ubx: holds neither observations"),
        ("hatanaka.crx", "base.obs", (), "brdc.nav", 1, "hatanaka.crx: is Hatanaka-compressed RINEX; crx2rnx"),
        ("cut.obs.gz", "base.obs", (), "brdc.nav", 1, "cut.obs.gz: is a damaged gzip file"),
        ("elsewhere.obs", "base.obs", (), "brdc.nav", 1, "RTKLIB found no position"),
        (
            "rover.obs",
            "base.obs",
            ("--base-position", "91,0,0"),
            "brdc.nav",
            2,
            "'91,0,0': expected latitude, longitude",
        ),
        ("rover.obs", "base.obs", ("--base-position", BASE_TEXT, "--base-average"), "brdc.nav", 2, "one of the two"),
        ("rover.obs", "base.obs", ("--elevation-mask", "95"), "brdc.nav", 2, "elevation_mask_deg: 95"),
    ],
)
def test_what_cannot_be_solved_is_one_sentence(
    run: Callable[..., Path],
    world: Any,
    capsys: pytest.CaptureFixture[str],
    rover: str,
    base: str,
    words: tuple[str, ...],
    nav: str,
    code: int,
    sentence: str,
) -> None:
    make_bad_files(world)
    output = run(rover, base, *words, nav=nav, code=code)
    said = capsys.readouterr().err
    assert sentence in said
    assert said.count("\n") == 1
    assert str(output.parent) not in said
    assert not list(output.parent.iterdir())


def make_bad_files(world: Any) -> None:
    folder = world.folder
    text = (folder / "base.obs").read_text()
    (folder / "late.obs").write_text(
        text.replace("> 2024 02 07 12", "> 2024 02 07 13").replace("> 2024 02 07 11", "> 2024 02 07 13")
    )
    (folder / "empty.obs").write_text(text.partition("> ")[0])
    (folder / "old.nav").write_text((folder / "brdc.nav").read_text().replace(" 2024 02 07 ", " 2024 02 06 "))
    (folder / "noise.bin").write_bytes(bytes(range(1, 200)))
    (folder / "noise.ubx").write_bytes(gnss.ubx_frame(0x01, 0x07, bytes(92)) * 5)
    (folder / "hatanaka.crx").write_text(f"{'1.0                 COMPACT RINEX FORMAT':<60}CRINEX VERS   / TYPE\n")
    (folder / "cut.obs.gz").write_bytes(gzip.compress(text.encode())[:500])
    # ranges that fit no place on Earth
    few = "\n".join(
        line[:3] + f"{1000.0:14.3f}" + line[17:] if line.startswith("G") and line[3] == " " else line
        for line in text.split("\n")
    )
    (folder / "elsewhere.obs").write_text(few)


def test_without_rtklib_it_says_what_to_install(
    run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    run("rover.obs", "base.obs", code=1)
    assert "rnx2rtkp: is not installed here; apt install rtklib brings it" in capsys.readouterr().err


def test_an_output_that_cannot_be_written(
    run: Callable[..., Path], world: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "none").write_text("a file where a folder must be")
    run("rover.obs", "base.obs", "-o", str(tmp_path / "none" / "out.pos"), code=1)
    assert "cannot be written" in capsys.readouterr().err
