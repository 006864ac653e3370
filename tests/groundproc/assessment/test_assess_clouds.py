"""`swath assess --reference` and `--strips`: clouds of known shift and noise."""

import json
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
import pytest

from groundproc.cli import main

Array = npt.NDArray[np.float64]

NOISE_M = 0.012


def yard(rng: np.random.Generator, per_m2: float = 60.0) -> Array:
    """Undulating ground of 30 m, a house with walls and a roof: all directions are told."""
    ground = np.column_stack([rng.uniform(0, 30, (int(900 * per_m2), 2)), np.zeros(int(900 * per_m2))])
    ground[:, 2] = 0.2 * np.sin(ground[:, 0] / 5.0) + 0.02 * ground[:, 1]
    house = (np.abs(ground[:, 0] - 15.0) < 4.0) & (np.abs(ground[:, 1] - 15.0) < 4.0)
    ground[house, 2] = 4.0 + 0.5 * (4.0 - np.abs(ground[house, 0] - 15.0))
    count = int(8 * 4 * per_m2)
    walls = []
    for axis, at in ((0, 11.0), (0, 19.0), (1, 11.0), (1, 19.0)):
        wall = np.column_stack([rng.uniform(11, 19, count), rng.uniform(11, 19, count), rng.uniform(0.5, 4.0, count)])
        wall[:, axis] = at
        walls.append(wall)
    return np.concatenate([ground, *walls])


def written(path: Path, parts: list[Array], rng: np.random.Generator) -> Path:
    """Each part is a strip; all have noise on every axis."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.0005] * 3, [500_000.0, 6_000_000.0, 0.0]
    las = laspy.LasData(header)
    xyz = np.concatenate(parts)
    las.x, las.y, las.z = (xyz + rng.normal(0, NOISE_M, xyz.shape) + np.array([500_000.0, 6_000_000.0, 50.0])).T
    las.point_source_id = np.repeat(np.arange(1, len(parts) + 1), [len(part) for part in parts]).astype(np.uint16)
    las.write(path)
    return path


def assessed(folder: Path, *words: str | Path) -> dict[str, Any]:
    assert main(["assess", *map(str, words), "--json", str(folder / "told.json"), "--force"]) == 0
    found: dict[str, Any] = json.loads((folder / "told.json").read_text())
    return found


def test_a_shifted_cloud_is_off_by_the_shift_within_its_sigma(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(1)
    shift = np.array([0.03, -0.02, 0.05])
    truth = written(tmp_path / "truth.laz", [yard(rng)], rng)
    moved = written(tmp_path / "moved.laz", [yard(rng) + shift], rng)
    told = assessed(tmp_path, moved, "--reference", truth, "--picture", tmp_path / "d.png")
    found, sigma = np.array(told["shift"]["xyz_m"]), np.array(told["shift"]["sigma_m"])
    assert (sigma < 0.004).all()
    assert (np.abs(found - shift) < 4.0 * sigma + 0.001).all()
    assert told["height"]["mean_m"] == pytest.approx(0.05, abs=0.004)
    assert told["registration"] is None
    assert (tmp_path / "d.png").read_bytes().startswith(b"\x89PNG")
    assert "the whole is off by x +0.0" in capsys.readouterr().out
    laid = assessed(tmp_path, moved, "--reference", truth, "--register")
    assert laid["registration"]["shift_m"] == pytest.approx((-shift).tolist(), abs=0.006)
    assert abs(laid["height"]["mean_m"]) < 0.003
    # what is left is noise, and noise is what is expected: 5 of 100 beyond two sigmas
    assert laid["normal"]["beyond_95"] < 0.12


def test_flat_ground_tells_no_shift_in_plan(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    flat = np.column_stack([rng.uniform(0, 20, (20_000, 2)), np.zeros(20_000)])
    clouds = [
        written(tmp_path / f"{name}.laz", [flat + np.array([0.0, 0.0, up])], rng)
        for name, up in (("a", 0.0), ("b", 0.04))
    ]
    told = assessed(tmp_path, clouds[1], "--reference", clouds[0])
    assert told["shift"]["xyz_m"][2] == pytest.approx(0.04, abs=0.003)
    assert told["plan"]["count"] == 0


def test_strips_are_as_thick_as_their_noise_and_differ_by_their_shift(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Three strips; before, the second is 6 cm high."""
    rng = np.random.default_rng(3)
    parts = [yard(rng, 30.0) for _ in range(3)]
    after = written(tmp_path / "after.laz", parts, rng)
    before = written(tmp_path / "before.laz", [parts[0], parts[1] + np.array([0.0, 0.0, 0.06]), parts[2]], rng)
    told = assessed(tmp_path, after, "--strips", "--before", before, "--picture", tmp_path / "s.png")
    was = told["before"]
    for each in (told, was):
        # undulation of 0.2 m over 31 m bends a plane of a metre by 1 mm
        assert each["within_strips"]["median_m"] == pytest.approx(NOISE_M, rel=0.1)
        assert {one["strip"] for one in each["by_strip"]} == {1, 2, 3}
    assert told["all_strips_together"]["median_m"] == pytest.approx(NOISE_M, rel=0.1)
    # two of three strips at one height, one 6 cm above: a standard deviation of 6 cm sqrt(2) / 3
    assert was["all_strips_together"]["median_m"] == pytest.approx(np.hypot(NOISE_M, 0.06 * np.sqrt(2) / 3), rel=0.15)
    assert told["between_strips"]["height"]["median_abs_m"] < 0.006
    pairs = {tuple(pair["strips"]): pair["median_m"] for pair in was["between_strips"]["pairs"]}
    assert abs(pairs[1, 2]) == pytest.approx(0.06, abs=0.01)
    assert abs(pairs[1, 3]) < 0.01
    assert "before" in capsys.readouterr().out
    assert (tmp_path / "s.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["c.laz", "--strips"], "of one strip"),
        (["c.laz", "--strips", "--mode", "plane"], "--mode: belongs to --points"),
        (["c.laz", "--points", "p.csv", "--register"], "--register: belongs to --reference"),
        (["c.laz", "--reference", "far.laz"], "one place"),
        (["c.laz", "--strips", "--reference", "far.laz"], "expected swath assess"),
    ],
)
def test_what_cannot_be_compared_is_one_sentence(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(4)
    written(tmp_path / "c.laz", [yard(rng, 10.0)], rng)
    written(tmp_path / "far.laz", [yard(rng, 10.0) + np.array([500.0, 0.0, 0.0])], rng)
    assert main(["assess", *words]) in (1, 2)
    told = capsys.readouterr().err
    assert said in told
    assert told.count("\n") == 1
