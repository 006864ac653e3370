"""`swath reflectance`: panels and fields get the reflectance that they were made with, at every range and incidence."""

import json
import re
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
import pyogrio
import pyproj
import pytest
import shapely
from strips import ORIGIN, Scene, Strip, Surface, write_cloud

from groundproc.cli import main

Array = npt.NDArray[np.float64]

SOAK = pytest.mark.soak
"""A second strength of what the first has told already: five strips and their echoes each."""
PANELS = {"dark": 0.046, "grey": 0.303, "white": 0.813}


def scene(**options: Any) -> Scene:
    """Three panels on a field, three tilted ones, and two strips at different heights beside them."""
    surfaces = [Surface((0, 0, 0.0), (10, 0, 0), (0, 8, 0), 0.35, per_m2=130, texture=0.2)]
    for i, value in enumerate(PANELS.values()):
        surfaces.append(Surface((-6 + 6 * i, 0, 0.3), (0.6, 0, 0), (0, 0.6, 0), value, 600))
        slope = np.radians(25 + 15 * i)
        surfaces.append(
            Surface((-6 + 6 * i, 6, 1.2), (0.5, 0, 0), (0, 0.5 * np.cos(slope), 0.5 * np.sin(slope)), value, 600)
        )
    strips = [Strip((-25, -20, 12), (2.5, 0, 0), 0, 20), Strip((-25, 25, 40), (2.5, 0, 0), 40, 20)]
    return Scene(surfaces, strips, **options)


def targets(path: Path, epsg: int = 32633, columns: dict[str, list[float]] | None = None, at: float = 0.0) -> Path:
    shapes = [shapely.box(-6 + 6 * i - 0.6 + at, -0.6, -6 + 6 * i + 0.6 + at, 0.6) for i in range(3)]
    shapes = [shapely.transform(each, lambda xy: xy + ORIGIN[:2]) for each in shapes]
    if epsg != 32633:
        to = pyproj.Transformer.from_crs(32633, epsg, always_xy=True)
        shapes = [shapely.transform(each, lambda xy: np.stack(to.transform(*xy.T), axis=1)) for each in shapes]
    columns = columns or {"reflectance": list(PANELS.values())}
    pyogrio.raw.write(
        path, shapely.to_wkb(np.array(shapes, object)), [np.array(list(PANELS), object), *(np.array(v) for v in columns.values())],
        ["id", *columns], geometry_type="Polygon", crs=f"EPSG:{epsg}", driver="GPKG" if path.suffix == ".gpkg" else "GeoJSON",
    )  # fmt: skip
    return path


def run(tmp_path: Path, made: Scene, echoes: dict[str, Any], *options: str, **cloud: Any) -> tuple[Any, dict[str, Any]]:
    path = write_cloud(tmp_path / "a.laz", echoes, **cloud)
    track = made.write_trajectory(tmp_path / "trajectory.csv")
    words = ["reflectance", str(path), "--trajectory", str(track), "-o", str(tmp_path / "out"), *options]
    assert main(words) == 0
    return laspy.read(tmp_path / "out" / "a.laz"), json.loads((tmp_path / "out" / "calibration.json").read_text())


def worst(found: Any, echoes: dict[str, Any], steepest_deg: float = 70.0) -> float:
    """Largest error of a mean over a panel or a cell of a metre of 100 echoes or more, strip by strip."""
    value = np.asarray(found["reflectance"], np.float64)
    cell = np.floor(echoes["xyz"][:, :2]).astype(np.int64)
    cell[echoes["surface"] > 0] = 0
    keys = np.column_stack([echoes["surface"], echoes["strip"], cell])
    fine = np.isfinite(value) & (echoes["cosine"] > np.cos(np.radians(steepest_deg)))
    _, number = np.unique(keys[fine], axis=0, return_inverse=True)
    number = number.ravel()
    count = np.bincount(number)
    error = (np.bincount(number, value[fine]) - np.bincount(number, echoes["rho"][fine])) / count
    assert (count >= 100).sum() > 150
    return float(np.abs(error[count >= 100]).max())


def test_compensated_intensities_become_reflectance(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    made = scene(gains=1.0 + 0.15 * rng.standard_normal(32), response=lambda s, r: 80.0 * s)
    echoes = made.make()
    found, told = run(tmp_path, made, echoes, "--targets", str(targets(tmp_path / "t.geojson", 4326)))
    assert told["intensity"] == "compensated"
    assert len(found) == len(echoes["xyz"])
    np.testing.assert_allclose(found.xyz, echoes["xyz"] + ORIGIN, rtol=0, atol=0.00051)
    assert worst(found, echoes) < 0.02
    gains = made.gains / made.gains.mean()
    for name, each in told["laser_gains"].items():
        assert abs(each["gain"] - gains[int(name)]) < 4 * each["sigma"]
    assert np.isclose(np.mean([each["gain"] for each in told["laser_gains"].values()]), 1.0)
    true = 1.0 / 80.0 / made.gains.mean()
    assert abs(told["c_cal"] - true) < 3 * told["c_cal_sigma"]
    assert told["c_cal_sigma"] < 0.02 * true


def test_noise_and_what_moves_tell_nothing_and_get_a_value_all_the_same(tmp_path: Path) -> None:
    made = scene(response=lambda s, r: 80.0 * s)
    echoes = made.make()
    clean, told = run(tmp_path, made, echoes, "--targets", str(targets(tmp_path / "t.geojson")))
    rng = np.random.default_rng(9)
    few = rng.choice(len(clean), len(clean) // 20, replace=False)
    # what flies and what walks by, bright, above the panels and the field
    dirty = {name: np.concatenate([values, values[few]]) for name, values in echoes.items()}
    dirty["xyz"][len(clean) :, 2] += rng.uniform(0.2, 0.6, len(few))
    dirty["intensity"][len(clean) :] = 60.0
    track, path = tmp_path / "trajectory.csv", write_cloud(tmp_path / "d.laz", dirty)
    las = laspy.read(path)
    las.classification[len(clean) :] = rng.choice([7, 18, 69], len(few))
    las.write(path)
    words = ["reflectance", str(path), "--trajectory", str(track), "--targets", str(tmp_path / "t.geojson")]
    assert main([*words, "-o", str(tmp_path / "dirty")]) == 0
    found = laspy.read(tmp_path / "dirty" / "d.laz")
    assert len(found) == len(dirty["xyz"])
    again = json.loads((tmp_path / "dirty" / "calibration.json").read_text())
    assert again["c_cal"] == pytest.approx(told["c_cal"], rel=1e-3)
    assert again["points"]["on_surface"] == pytest.approx(told["points"]["on_surface"], rel=1e-3)
    rest = np.asarray(found["reflectance"])[: len(clean)]
    np.testing.assert_allclose(rest, clean["reflectance"], rtol=0.02, atol=0.002)
    assert np.isfinite(found["reflectance"][len(clean) :]).mean() > 0.9
    assert main([*words, "-o", str(tmp_path / "all"), "--all-classes"]) == 0
    everything = json.loads((tmp_path / "all" / "calibration.json").read_text())
    assert everything["points"]["on_surface"] != again["points"]["on_surface"]


@pytest.mark.parametrize("visibility", [None, 3.0])
def test_amplitudes_are_freed_of_range_and_air(tmp_path: Path, visibility: float | None) -> None:
    # 3.91 / 3 km (905 / 550)^-(0.585 x 3^(1/3))
    per_m = 0.0 if visibility is None else 3.91 / 3.0 * (905 / 550) ** -(0.585 * 3 ** (1 / 3)) / 1e3
    made = scene(response=lambda s, r: 2e7 * s / r**2 * np.exp(-2 * per_m * r), noise_m=0.02)
    echoes = made.make(2)
    options = [] if visibility is None else ["--visibility-km", "3"]
    found, told = run(tmp_path, made, echoes, "--targets", str(targets(tmp_path / "t.gpkg")), *options, laser=False)
    assert told["intensity"] == "amplitude"
    assert worst(found, echoes) < 0.02
    assert abs(told["c_cal"] * 2e7 - 1.0) < 3 * told["c_cal_sigma"] * 2e7
    field = [each for each in told["strips"] if each["patches"]]
    for each in field:
        assert abs(each["reflectance_percent"]) < 0.2 * abs(each["raw_percent"])


def defocused(range_m: Any, lost: float, near_m: float) -> Any:
    """Share of the light that a receiver out of focus near by still gets: a law of another kind than the steps that are fitted."""
    return 1.0 - lost * np.exp(-((range_m / near_m) ** 2))


@pytest.mark.parametrize(("lost", "near_m"), [(0.45, 6.0), pytest.param(0.25, 12.0, marks=SOAK)])
def test_what_a_sensor_loses_near_by_is_found_from_strips_that_overlap(
    tmp_path: Path, lost: float, near_m: float
) -> None:
    rng = np.random.default_rng(8)
    made = scene(
        gains=1.0 + 0.1 * rng.standard_normal(32),
        response=lambda s, r: 80.0 * s * defocused(r, lost, near_m),
        noise_m=0.02,
    )
    made.strips = [
        Strip((-25.0, y, height), (2.5, 0, 0), 40.0 * n, 20)
        for n, (y, height) in enumerate([(-2, 4.0), (3, 7.0), (-6, 12.0), (10, 20.0), (0, 35.0)])
    ]
    echoes = made.make(9)
    found, told = run(tmp_path, made, echoes, "--targets", str(targets(tmp_path / "t.gpkg")))
    raw = echoes["intensity"] / echoes["cosine"]
    few = (echoes["range"] < 0.7 * near_m) & (echoes["surface"] == 0) & (echoes["cosine"] > 0.5)
    assert np.median(raw[few] / echoes["rho"][few]) < 0.9 * 80.0
    assert len(told["range_gains"]) > 5
    for each in told["range_gains"]:
        true = defocused(each["range_m"], lost, near_m)
        assert abs(each["gain"] - true) < max(4 * each["sigma"], 0.03), each
    assert worst(found, echoes) < 0.02


def test_a_sensor_that_takes_out_the_range_gets_no_gain_by_range(tmp_path: Path) -> None:
    made = scene(response=lambda s, r: 80.0 * s)
    _, told = run(tmp_path, made, made.make(11), "--targets", str(targets(tmp_path / "t.gpkg")))
    assert told["range_gains"] == []


def test_reflectance_by_incidence_is_interpolated(tmp_path: Path) -> None:
    made = scene(response=lambda s, r: 80.0 * s)
    for surface in made.surfaces:
        surface.exponent = 1.4
    echoes = made.make(3)
    angles = range(0, 90, 15)
    columns = {
        f"reflectance_{a}": [v * max(np.cos(np.radians(a)), 0.1) ** 0.4 for v in PANELS.values()] for a in angles
    }
    _, told = run(tmp_path, made, echoes, "--targets", str(targets(tmp_path / "t.gpkg", columns=columns)))
    assert abs(told["c_cal"] * 80.0 - 1.0) < 0.01


def test_retro_reflectors_and_saturation_have_none(tmp_path: Path) -> None:
    made = scene(response=lambda s, r: 80.0 * s, speckle=0.05)
    echoes = made.make(4)
    echoes["intensity"][::50] = 180
    found, told = run(tmp_path, made, echoes)
    value = np.asarray(found["reflectance"])
    assert np.isnan(value[::50]).all()
    assert np.isfinite(np.delete(value, np.s_[::50])).all()
    assert told["relative"]
    assert told["c_cal"] == 0.01
    assert told["c_cal_sigma"] is None


def test_laser_powers_of_firmware_1_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = scene()
    echoes = made.make(5)
    signal = echoes["rho"] * echoes["cosine"] / echoes["range"] ** 2
    rank = np.log(signal / signal.max()) / np.log(signal.min() / signal.max())
    echoes["intensity"] = np.rint(10 * rank)
    path = write_cloud(tmp_path / "a.laz", echoes)
    track = made.write_trajectory(tmp_path / "t.csv")
    assert main(["reflectance", str(path), "-t", str(track), "-o", str(tmp_path / "out")]) == 1
    assert "firmware 1" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_what_cannot_be_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = scene()
    echoes = {name: values[::20] for name, values in made.make(6).items()}
    track = made.write_trajectory(tmp_path / "t.csv")
    later = tmp_path / "later.csv"
    rows = track.read_text().splitlines()
    later.write_text(
        "\n".join([rows[0], *(f"{int(r.split(',', 1)[0]) + 10**12},{r.split(',', 1)[1]}" for r in rows[1:])])
    )
    good = write_cloud(tmp_path / "good.laz", echoes)
    dark = write_cloud(tmp_path / "dark.laz", {**echoes, "intensity": 0 * echoes["intensity"]})
    placeless = write_cloud(tmp_path / "placeless.laz", echoes, epsg=None)
    far = str(targets(tmp_path / "far.gpkg", at=500.0))
    for words, expected in (
        ([good, "-t", later], "have no pose|no pose"),
        ([dark, "-t", track], "have no intensity"),
        ([placeless, "-t", track], "states no CRS"),
        ([good, "-t", track, "--targets", far], "lie outside of the clouds"),
        ([good], "give the trajectory with --trajectory"),
        ([good, "-t", track, "--visibility-km", "0.1"], "visibility 0.1 km"),
        ([good, "-t", track, "--intensity", "volts"], "--intensity volts"),
        ([good, "-t", track, "--geoid", "-2000"], "heights those of the cloud|would have been"),
    ):
        out = tmp_path / "out"
        assert main(["reflectance", *map(str, words), "-o", str(out)]) in (1, 2), expected
        told = capsys.readouterr().err.strip()
        assert "\n" not in told
        assert re.search(expected, told), told
        assert not out.exists()


def wood(exponent: float, seed: int = 7) -> tuple[Scene, dict[str, Any]]:
    """Leaves between 1 and 7 m, as dark at a slant as the exponent says, from two strips on either side; by a law without range."""
    made = Scene([], [Strip((-32, -40, 38), (0, 4, 0), 0, 20), Strip((32, -40, 38), (0, 4, 0), 40, 20)])
    rng = np.random.default_rng(seed)
    parts = []
    for number, strip in enumerate(made.strips):
        count = 80_000
        place = rng.uniform((-30, -30, 1), (30, 30, 7), (count, 3))
        time_s = strip.begin_s + rng.uniform(0, strip.seconds, count)
        away = strip.at(time_s) - place
        range_m = np.linalg.norm(away, axis=1)
        rho = 0.3 + 0.1 * np.sin(place[:, 0] / 3.0) * np.cos(place[:, 1] / 4.0)
        strength = 80.0 * rho * (away[:, 2] / range_m) ** exponent * (1.0 + 0.3 * rng.standard_normal(count))
        parts.append(
            {
                "xyz": place, "time_s": time_s, "laser": rng.integers(0, 32, count), "range": range_m, "rho": rho,
                "strip": np.full(count, number), "intensity": np.clip(np.rint(strength), 0, 100),
            }
        )  # fmt: skip
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    order = np.argsort(whole["time_s"], kind="stable")
    return made, {name: values[order] for name, values in whole.items()}


@pytest.mark.parametrize("exponent", [0.8, pytest.param(-0.5, marks=SOAK), 0.0])
def test_strips_of_a_wood_agree_from_border_to_border(tmp_path: Path, exponent: float) -> None:
    made, echoes = wood(exponent)
    found, told = run(tmp_path, made, echoes, "--intensity", "compensated")
    leaves = told["leaves"]
    if exponent == 0.0:
        assert leaves == {"exponent": 0.0, "sigma": 0.0}
    else:
        assert abs(leaves["exponent"] - exponent) < 4.0 * leaves["sigma"] < 0.05
    value, x = np.asarray(found["reflectance"], np.float64), echoes["xyz"][:, 0]
    raw = echoes["intensity"]
    border = np.digitize(x, (-20.0, 20.0))

    def trend(values: Array) -> float:
        level = np.array([[values[(border == b) & (echoes["strip"] == s)].mean() for b in (0, 2)] for s in (0, 1)])
        ratio = level[0] / level[1]
        return float(np.log(ratio[0] / ratio[1]))

    # 13 000 echoes of 40 % in each of four means: a sigma of 0.7 %
    assert abs(trend(value)) < 0.03
    if exponent:
        assert abs(trend(raw)) > 0.2
    for each in told["strips"]:
        assert abs(each["reflectance_cells_percent"]) < 1.3 * each["reflectance_expected_percent"]
