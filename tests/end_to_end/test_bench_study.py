"""The study's table: which promises a flight misses, and that a run that is broken off leaves what it had."""

import json
from pathlib import Path
from typing import Any

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
MOUNT = {"lidar": {"position_m": [0.0, 0.0, -0.16], "yaw_deg": 0.0, "pitch_deg": 0.0, "roll_deg": 0.0}}
UNIT = [[1.02, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.99]]
TRUTH = {
    "scene": "field", "duration_s": 40.0, "mavlink_hz": {"raw_imu": 100.0}, "mount_nominal": MOUNT,
    "ins_gyro_matrix": UNIT, "lidar_gyro_matrix": UNIT,
}  # fmt: skip


@pytest.fixture(autouse=True)
def with_benchmarks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))


def judged(ate_m: float, mean_m: float, **report: Any) -> dict[str, Any]:
    return {
        "ate_m": ate_m, "rotation_rms_deg": 0.02, "cloud_floor_ratio": 1.05, "time_error_ms": -0.05,
        "absolute_mean_error_m": [0.0, mean_m, 0.0], "boresight_error_deg": [0.0, -0.3, 0.05], "lever_error_m": [0.01, 0.0, 0.0],
        "position_within_2_sigma": 0.99, "attitude_within_2_sigma": 0.9, "report": report,
        "tie": {"offset_error_ms": 0.3, "drift_error_ppm": 1.0, "sigma_drift_ppm": 2.0},
    }  # fmt: skip


ESTIMATED = {
    "ins.turn_deg": {"value": [0.0] * 3, "sigma": [0.2] * 3},
    "ins.lever_m": {"value": [0.0] * 3, "sigma": [0.002, 0.002, 0.002], "held": [False, False, True]},
    "ins.delay_s": {"value": [-0.0002], "sigma": [0.00005]},
    "ins.scale": {"value": [0.021, 0.0, -0.01], "sigma": [0.001] * 3},
}


def test_what_is_missed_and_what_is_not() -> None:
    import study

    ins = judged(2.0, 1.0)
    figures = study.measured(judged(0.012, 1.5, estimated=ESTIMATED), ins, TRUTH)
    assert figures["boresight_z"] == pytest.approx(1.5)
    assert figures["lever_z"] == pytest.approx(5.0)
    assert figures["delay_z"] == pytest.approx(2.0)  # 0.3 ms late, of which 0.2 were found
    assert figures["scale_z"] == pytest.approx(1.0)
    assert study.missed(figures) == [
        "trajectory [mm]", "boresight [deg]", "lever / sigma", "attitude beyond 2 sigma", "mean error / that of the fixes",
    ]  # fmt: skip
    slow = study.measured(judged(0.012, 0.9), ins, TRUTH | {"mavlink_hz": {"raw_imu": 25.0}})
    assert study.missed(slow) == ["attitude beyond 2 sigma"]
    assert study.missed(study.measured({"error": "lost"}, ins, TRUTH)) == ["no trajectory"]


def test_a_run_that_is_broken_off_leaves_its_table(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    import study

    def simulated(folder: Path, flight: str, seconds: float, seed: int, points: bool, *more: str) -> None:
        if seed == 22:
            raise KeyboardInterrupt
        folder.mkdir()
        (folder / "truth.json").write_text(json.dumps(TRUTH))

    monkeypatch.setattr(study, "simulate", simulated)
    monkeypatch.setattr(study, "run", lambda name, *_: judged(2.0 if name == "ins" else 0.02, 0.5))
    with pytest.raises(KeyboardInterrupt):
        study.main(["--only", "fast 2", "--out", str(tmp_path), "--methods", "ins,adjusted"])
    (name,) = json.loads((tmp_path / "study.json").read_text())
    assert name == "fast 21"
    assert "| fast 21 | **20.0** |" in (tmp_path / "study.md").read_text()
