"""A lens that is not what the rig says: one sentence, whichever way round; none where it is."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from imageblock import disturbed, fly, true_camera, write_block

from groundproc.cli import main
from groundproc.imagery.camera import Camera
from groundproc.imagery.lensdoubt import worst_ring

FISHEYE = Camera(1600, 1200, 1000.0, (801.3, 597.2), "equidistant", (-0.01, 0.002, 0.0, 0.0))
CENTRAL = Camera(1600, 1200, 1000.0, (801.3, 597.2), "radtan", (-0.05, 0.02))
BELIEVED = {
    "fish-eye as Brown": (FISHEYE, replace(CENTRAL, coefficients=(0.0, 0.0))),
    "Brown as fish-eye": (CENTRAL, replace(FISHEYE, coefficients=(0.0, 0.0, 0.0, 0.0))),
    "right": (FISHEYE, replace(FISHEYE, focal_px=1003.0)),
}


# an adjustment each: one that is wrong and one that is right in the quick suite
@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=pytest.mark.soak if case == "fish-eye as Brown" else ()) for case in BELIEVED]
)
def test_a_wrong_lens_model_is_named_with_its_remedy(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lens, believed = BELIEVED[case]
    truth = true_camera(camera=lens)
    flown = fly(truth, per_strip=4, seed=5, points=400)
    trajectory = disturbed(flown, 8, np.array([0.02, 0.02, 0.03]), np.array([0.05, 0.05, 0.1]))
    guess = replace(
        truth, camera=believed, estimate=("f",), sigma={"boresight_deg": 0.2, "timeshift_s": 0.01, "f": 10.0}
    )
    write_block(flown, tmp_path, guess, trajectory, 0.3, 12)
    files = ("points.csv", "rig.yaml", "trajectory.csv", "times.csv")
    options = ("--image-points", "--rig", "--trajectory", "--times")
    words = [word for name, file in zip(options, files, strict=True) for word in (name, str(tmp_path / file))]
    assert main(["images", *words, "-o", str(tmp_path / "out")]) in (0, 3)
    told = json.loads((tmp_path / "out" / "bundle.json").read_text())
    said = [warning for warning in told["warnings"] if "along the radius" in warning]
    assert len(said) == (case != "right")
    for sentence in said:
        other = "equidistant (a fish-eye)" if case == "fish-eye as Brown" else "radtan"
        assert f"try distortion_model {other}" in sentence
        assert sentence in capsys.readouterr().err


def test_noise_and_wrong_matches_alone_are_no_reason_to_doubt() -> None:
    rng = np.random.default_rng(0)
    pixel = rng.uniform([0, 0], [1600, 1200], (4000, 2))
    residual = rng.normal(0, 0.4, (4000, 2))
    residual[::10] += rng.normal(0, 30.0, (400, 2))
    assert worst_ring(true_camera(), pixel, residual) is None
