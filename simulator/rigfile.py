"""rig.yaml, in Kalibr's terms: a camera as it is believed to be, or as it is."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from simulator.cameras import Camera
from simulator.optics import EQUIDISTANT
from simulator.textures import BANDS, TEMPERATURE

Array = npt.NDArray[np.float64]

KELVIN: Final = 273.15
KELVIN_STEP: Final = 0.01
"""Of a number of a thermal image."""


def entry(camera: Camera, believed: bool, several: bool) -> dict[str, Any]:
    """A camera of rig.yaml."""
    o = camera.options
    lens, mat = (camera.believed, camera.believed_mat) if believed else (camera.lens, camera.mat_cam_ins)
    place = np.array(o.position_m) if believed else camera.position_m
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = mat, -mat @ place
    coefficients = [*lens.coefficients, *[0.0] * (4 - len(lens.coefficients))]
    entry: dict[str, Any] = {
        "camera_model": "pinhole",
        "intrinsics": [lens.focal_px, lens.focal_px, *lens.centre_px],
        "distortion_model": lens.model,
        "distortion_coeffs": [float(value) for value in coefficients],
        "resolution": [o.width_px, o.height_px],
        "T_cam_imu": transform.tolist(),
        "timeshift_cam_imu": 0.0 if believed else -o.clock_offset_s,
        "line_delay_s": o.line_delay_s * (o.line_delay_known if believed else 1.0),
        "bands": list(o.bands),
        "vignetting": list(o.vignetting),
    }
    if o.bands == (BANDS[TEMPERATURE],):
        entry["response"] = {"scale": KELVIN_STEP, "offset": -KELVIN}
    else:
        entry["response"] = o.transfer
        if o.black_level:
            entry["black_level"] = o.black_level * (255.0 if len(o.bands) == 3 else 65535.0)
    if several:
        entry["image_prefix"] = f"{camera.name}_"
    if believed:
        free = ["f", "pu", "pv", "k1", "k2"] + (["p1", "p2"] if lens.model != EQUIDISTANT else [])
        entry["estimate"] = free
        entry["sigma"] = {
            "f": max(o.focal_spread_px, 0.1), "pu": max(o.centre_spread_px, 0.1), "pv": max(o.centre_spread_px, 0.1),
            "boresight_deg": max(o.boresight_spread_deg, 0.01), "lever_arm_m": max(o.lever_spread_m, 0.001), "timeshift_s": 0.1,
        }  # fmt: skip
        if o.line_delay_known != 1.0:
            entry["sigma"]["line_delay_s"] = abs(o.line_delay_known - 1.0) * o.line_delay_s
    return entry


def angles_deg(mat: Array) -> list[float]:
    """Rotation vector of a rotation of less than half a turn."""
    sines = 0.5 * np.array([mat[2, 1] - mat[1, 2], mat[0, 2] - mat[2, 0], mat[1, 0] - mat[0, 1]])
    sine = float(np.linalg.norm(sines))
    angle = float(np.arctan2(sine, (np.trace(mat) - 1.0) / 2.0))
    x, y, z = np.degrees(sines * (angle / sine if sine > 0.0 else 1.0))
    return [float(x), float(y), float(z)]
