"""Panels of known reflectance, seen by a sensor whose noise, offsets and blindness are known."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from flightlog import config
from flightlog.mount import Mount
from groundproc.cli import main
from groundproc.sensors.velodyne import RANGING
from groundproc.verification.aimed import Aimed
from groundproc.verification.judge import judge
from groundproc.verification.measure import measure
from groundproc.verification.panels import Panel, Sheet

NOISE_M = 0.015
FOOTPRINT_RAD = 2.79e-3


@pytest.fixture(scope="module")
def panels(tmp_path_factory: pytest.TempPathFactory, still_flight: Any) -> Path:
    """All panels of the simulated stand, and the step, as a user would state them."""
    from simulator.scene import scene

    world = scene("panels", still_flight.truth["seed"]).world
    mount = config.from_mapping(still_flight.truth["mount_true"], Mount, "truth")
    sensor = np.array([0.0, 0.0, 1.5]) + mount.lidar_position_m()
    listed = []
    for number, name in enumerate(world.names):
        corners = world.triangles_m[world.surface == number].reshape(-1, 3)
        middle = mount.mat_ins_lidar().T @ ((corners.min(axis=0) + corners.max(axis=0)) / 2 - sensor)
        if name.startswith("panel_") or name == "step front":
            share = 30.3 if name == "step front" else float(name.split("_")[1].split(" ")[0])
            listed.append({
                "name": name, "reflectance": share / 100, "azimuth_deg": float(np.rad2deg(np.arctan2(middle[0], middle[1]))),
                "distance_m": round(float(np.hypot(*middle[:2])), 2), "up_m": float(middle[2]), "surveyed": True,
            })  # fmt: skip
    path = tmp_path_factory.mktemp("panels") / "panels.yaml"
    path.write_text(yaml.safe_dump({"panels": listed}))
    return path


@pytest.fixture(scope="module")
def found(still_flight: Any, panels: Path) -> dict[str, Any]:
    """What the command says of it."""
    out = panels.with_name("found.json")
    picture = panels.with_name("found.png")
    code = main([
        "verify-sensor", str(still_flight.log), "--panels", str(panels), "--json", str(out), "--plot", str(picture)
    ])  # fmt: skip
    assert code in (0, 3)
    assert picture.stat().st_size > 20_000
    tree: dict[str, Any] = json.loads(out.read_text())
    tree["by_name"] = {each["name"]: each for each in tree["panels"]}
    return tree


def test_the_scatter_of_ranges_is_that_of_the_sensor(found: dict[str, Any]) -> None:
    bright = [each for each in found["panels"] if each["reflectance"] > 0.2 and each["echoes"] >= 30]
    assert len(bright) > 10
    ratio = [(each["range_sigma_m"] - NOISE_M) / each["range_sigma_sigma_m"] for each in bright]
    # offsets of lasers of some millimetres, and steps of 2 mm, add to the scatter of all lasers together
    assert np.median([each["range_sigma_m"] for each in bright]) == pytest.approx(NOISE_M, rel=0.2)
    for each in bright:
        for laser in each["lasers"]:
            if laser["echoes"] >= 30:
                assert abs(laser["range_sigma_m"] - NOISE_M) < 4.0 * laser["range_sigma_sigma_m"] + 0.001
    assert np.isfinite(ratio).all()


def test_intensity_is_the_reflectance_in_percent(found: dict[str, Any]) -> None:
    for each in found["panels"]:
        if each["echoes"] >= 30 and each["reflectance"] > 0.2 and each["name"] != "step front":
            assert each["intensity"] == pytest.approx(100 * each["reflectance"], rel=0.12), each["name"]


def test_a_dark_panel_is_seen_to_21_m_and_no_further(found: dict[str, Any]) -> None:
    for distance in (5, 10, 15, 20):
        assert found["by_name"][f"panel_4.6 at {distance} m"]["detected"] > 0.5
    for distance in (30, 40, 50, 60):
        each = found["by_name"][f"panel_4.6 at {distance} m"]
        assert each["shots"] > 0
        assert each["detected"] < 0.05


def test_bright_panels_answer_every_shot(found: dict[str, Any]) -> None:
    for name, each in found["by_name"].items():
        if name.startswith("panel_81.3") and each["shots"]:
            assert each["detected"] > 0.98, name


def test_distances_are_right_to_what_lasers_are_off(found: dict[str, Any], still_flight: Any) -> None:
    bias = np.array(still_flight.truth["laser_bias_m"])
    for each in found["panels"]:
        if each["echoes"] >= 50 and each["reflectance"] > 0.2:
            off = each["distance_m"] - each["stated_distance_m"]
            assert abs(off) < np.abs(bias).max() + 0.01, each["name"]


def test_a_step_within_the_footprint_makes_mixed_echoes(found: dict[str, Any]) -> None:
    step = found["by_name"]["step front"]
    assert step["rim_echoes"] > 10
    assert step["mixed_echoes"] > 0.2 * step["rim_echoes"]
    alone = found["by_name"]["panel_81.3 at 10 m"]
    assert alone["mixed_echoes"] <= 0.05 * max(alone["rim_echoes"], 20)


# On arrays -----------------------------------------------------------------------------------------------------------


def shots(
    panel: Panel, noise_m: float = 0.01, tilt: float = 0.0, offsets: tuple[float, ...] = (0.0, 0.0, 0.0), n: int = 600
) -> Aimed:
    """Three lasers at a panel that stands alone, some turns of them."""
    rng = np.random.default_rng(4)
    width = np.arctan(0.9 / panel.distance_m)
    azimuth = np.tile(np.deg2rad(panel.azimuth_deg) + np.linspace(-width, width, n), 3)
    elevation = np.repeat(np.arctan2(np.array([-0.3, 0.0, 0.3]), panel.distance_m), n)
    direction = np.stack(
        [np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)], axis=1
    )
    facing = panel.middle_m / panel.distance_m
    right = np.array([facing[1], -facing[0], 0.0])
    normal = facing + tilt * right
    range_m = panel.distance_m / (direction @ normal)
    inside = np.abs((direction * range_m[:, None]) @ right) < 0.5
    laser = np.repeat(np.arange(3), n)
    range_m = range_m + noise_m * rng.standard_normal(3 * n) + np.array(offsets)[laser]
    range_m[~inside] = np.nan
    return Aimed(direction, range_m, np.full(3 * n, 30.0), laser.astype(np.uint8), np.zeros(3 * n, bool))


def test_a_tilted_panel_off_its_place_scatters_no_more() -> None:
    panel = Panel(reflectance=0.3, azimuth_deg=20.0, distance_m=10.0)
    stated = Panel(reflectance=0.3, azimuth_deg=21.0, distance_m=10.15)  # 17 cm beside, 15 cm off
    found = measure(stated, shots(panel, 0.01, tilt=0.1), RANGING)
    assert found.whole.sigma_m == pytest.approx(0.01, abs=4 * found.whole.sigma_of_sigma_m)
    assert found.distance_m == pytest.approx(10.0 / np.hypot(1.0, 0.1), abs=0.003)
    assert found.whole.detected == 1.0


def test_a_laser_that_is_off_is_told_from_the_others_and_judged() -> None:
    panel = Panel(reflectance=0.3, azimuth_deg=-40.0, distance_m=12.0)
    found = measure(panel, shots(panel, 0.008, offsets=(0.0, 0.06, 0.0)), RANGING)
    off = [row.off_m for row in found.lasers]
    assert off[1] - (off[0] + off[2]) / 2 == pytest.approx(0.06, abs=0.003)
    judged = judge([found], Sheet())
    assert {each.where for each in judged.broken if "mean" in each.about} >= {f"{panel.title}, laser 1"}
    assert judge([measure(panel, shots(panel, 0.008), RANGING)], Sheet()).grade == "good"


def test_a_sensor_noisier_than_its_sheet_is_doubtful() -> None:
    panel = Panel(reflectance=0.3, distance_m=20.0)
    judged = judge([measure(panel, shots(panel, 0.035), RANGING)], Sheet())
    assert judged.grade == "doubtful"
    assert any("scatter" in each.about for each in judged.broken)


# Bad input -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("panels: []\n", "no panels found"),
        ("panels: [{reflectance: 30.3}]\n", "reflectance: 30.3 found, expected 0.001 to 1"),
        ("panels: [{distance_m: 10}, {distance_m: 10}]\n", "two panels are called"),
        ("panels: [{up_m: 90, distance_m: 20}]\n", "no shot of"),
    ],
)
def test_bad_lists_of_panels_are_one_sentence(
    still_flight: Any, tmp_path: Path, text: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "p.yaml"
    path.write_text(text)
    assert main(
        ["verify-sensor", str(still_flight.log), "--panels", str(path), "--json", str(tmp_path / "j.json")]
    ) in (1, 2)
    err = capsys.readouterr().err.strip()
    assert said in err
    assert "\n" not in err
    assert not (tmp_path / "j.json").exists()


def test_a_panel_that_is_elsewhere_is_said_to_be_and_nothing_judged_is_no_pass(
    still_flight: Any, panels: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (wrong,) = (each for each in yaml.safe_load(panels.read_text())["panels"] if each["name"] == "panel_4.6 at 10 m")
    wrong["distance_m"] += 2.0
    (tmp_path / "p.yaml").write_text(yaml.safe_dump({"panels": [wrong]}))
    assert main(["verify-sensor", str(still_flight.log), "--panels", str(tmp_path / "p.yaml")]) == 3
    out = capsys.readouterr()
    assert "panel_4.6 at 10 m: most shots at it come back from 5.0 m; expected it at 12 m" in out.err
    assert "no promise could be judged" in out.err
    assert "0 of 0 promises kept" in out.out
