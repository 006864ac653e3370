import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flightlog.errors import UsageError
from groundproc.imagery.camera import COEFFICIENTS, Camera

Array = npt.NDArray[np.float64]

CAMERAS = {
    "radtan": Camera(4000, 3000, 3000.0, (1990.0, 1510.0), "radtan", (-0.1, 0.02, 1e-3, -5e-4, 0.003), 1.002),
    "equidistant": Camera(4000, 3000, 1500.0, (1990.0, 1510.0), "equidistant", (0.01, -0.003, 0.001, -0.0002)),
    "brown_photogrammetric": Camera(
        5616, 3744, 3800.0, (2800.0, 1870.0), "brown_photogrammetric", (2.2e-4, -1.9e-7, 1e-5, -2e-5, 1e-11), 1.0, 0.00641
    ),
    "fisheye_polynomial": Camera(
        1280, 960, 1100.0, (640.0, 480.0), "fisheye_polynomial", (0.0, 1.0, 0.02, -0.1), 1.001, 0.0, (1.0, -2.0)
    ),
    "none": Camera(640, 480, 500.0, (320.0, 240.0)),
}  # fmt: skip


def spread(camera: Camera, seed: int, count: int = 300) -> Array:
    return np.random.default_rng(seed).uniform([0, 0], [camera.width_px - 1, camera.height_px - 1], (count, 2))


@pytest.mark.parametrize("model", CAMERAS)
@given(seed=st.integers(0, 2**16))
def test_a_pixel_comes_back_from_its_ray_at_any_distance(model: str, seed: int) -> None:
    camera = CAMERAS[model]
    pixels = spread(camera, seed, 50)
    rays, reached = camera.unproject(pixels)
    back, inside = camera.project(rays * np.random.default_rng(seed).uniform(0.1, 1e4, (50, 1)))
    assert reached.all()
    assert inside.all()
    np.testing.assert_allclose(back, pixels, rtol=0, atol=1e-8)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, rtol=0, atol=1e-12)


def test_opencv_projects_to_the_same_pixels() -> None:
    camera = CAMERAS["radtan"]
    points = camera.unproject(spread(camera, 0))[0] * 7.0
    matrix = np.array([[camera.focal_px, 0, 1990.0], [0, camera.focal_px * camera.aspect, 1510.0], [0, 0, 1.0]])
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(camera.coefficients))
    np.testing.assert_allclose(camera.project(points)[0], theirs[:, 0], rtol=0, atol=1e-8)


def test_opencv_s_fish_eye_projects_to_the_same_pixels() -> None:
    camera = CAMERAS["equidistant"]
    pixels = np.array(camera.centre_px) + np.random.default_rng(0).uniform(-1200, 1200, (300, 2))
    points = camera.unproject(pixels)[0] * 7.0
    matrix = np.array([[camera.focal_px, 0, 1990.0], [0, camera.focal_px, 1510.0], [0, 0, 1.0]])
    theirs, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), matrix, np.array(camera.coefficients)
    )
    ahead = points[:, 2] > 0.1  # theirs does not look past 90 deg
    np.testing.assert_allclose(camera.project(points)[0][ahead], theirs[ahead, 0], rtol=0, atol=1e-8)


@pytest.mark.parametrize("model", CAMERAS)
@given(seed=st.integers(0, 2**16))
def test_derivatives_are_those_of_finite_differences(model: str, seed: int) -> None:
    camera = CAMERAS[model]
    measured = spread(camera, seed, 20)
    points = camera.unproject(measured)[0] * 5.0 + np.random.default_rng(seed).normal(0, 0.01, (20, 3))
    residual, by_point, by_lens, _ = camera.compare(points, measured)
    assert np.abs(residual).max() < 100.0
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        numeric = (camera.compare(points + step, measured)[0] - camera.compare(points - step, measured)[0]) / 2e-6
        np.testing.assert_allclose(by_point[:, :, axis], numeric, rtol=0, atol=2e-6 * np.abs(by_point).max())
    for name, value in camera.values().items():
        step = 1e-5 * abs(value) or 1e-7
        ahead, behind = (
            camera.with_values({name: value + side}).compare(points, measured)[0] for side in (step, -step)
        )
        column = by_lens[:, :, camera.place_of(name)]
        np.testing.assert_allclose(
            column, (ahead - behind) / (2 * step), rtol=0, atol=1e-5 * max(np.abs(column).max(), 1e-3)
        )


def test_what_lies_behind_or_beyond_the_fold_has_no_pixel() -> None:
    camera = Camera(1000, 1000, 500.0, (499.5, 499.5), "radtan", (-0.3,))
    fold = 1.0 / np.sqrt(0.9)
    points = np.array([[0.0, 0.0, -1.0], [fold * 1.01, 0.0, 1.0], [fold * 0.99, 0.0, 1.0]])
    pixels, inside = camera.project(points)
    assert np.isnan(pixels[:2]).all()
    assert inside.tolist() == [False, False, True]


def test_a_fish_eye_sees_past_ninety_degrees() -> None:
    camera = Camera(2000, 2000, 500.0, (999.5, 999.5), "equidistant")
    pixels, inside = camera.project(np.array([[1.0, 0.0, -0.1]]))
    assert inside.all()
    np.testing.assert_allclose(pixels[0, 0], 999.5 + 500.0 * (np.pi / 2 + np.arctan(0.1)))


def test_the_vendor_s_polynomial_is_that_of_its_manual() -> None:
    """u = C rho x / r + D rho y / r + cx with rho = p0 + p1 theta + p2 theta^2 + p3 theta^3, theta = 2 / pi atan(r)."""
    c, d, e, f = 1620.0, 3.0, -2.0, 1618.0
    p = (0.0, 1.0, 0.02, -0.14)
    camera = Camera(
        1280, 960, c * 2 / np.pi, (600.0, 470.0), "fisheye_polynomial", p, f / c, 0.0, (d * 2 / np.pi, e * 2 / np.pi)
    )
    x, y = 0.3, -0.2
    r = np.hypot(x, y)
    theta = 2 / np.pi * np.arctan(r)
    rho = p[0] + p[1] * theta + p[2] * theta**2 + p[3] * theta**3
    expected = (c * rho * x / r + d * rho * y / r + 600.0, e * rho * x / r + f * rho * y / r + 470.0)
    np.testing.assert_allclose(camera.project(np.array([[x, y, 1.0]]))[0][0], expected, rtol=0, atol=1e-9)


def test_corrections_are_applied_to_measured_coordinates_in_millimetres_with_y_up() -> None:
    """The definition in the reports of the Damped Bundle Adjustment Toolbox, model 3."""
    camera = CAMERAS["brown_photogrammetric"]
    k1, k2, p1, p2, k3 = camera.coefficients
    pixel = np.array([4000.0, 600.0])
    x, y = (pixel[0] - 2800.0) * 0.00641, -(pixel[1] - 1870.0) * 0.00641
    r2 = x * x + y * y
    factor = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    right = (
        x * factor + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y,
        y * factor + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y,
    )
    ray = np.array([right[0], -right[1], 3800.0 * 0.00641])
    np.testing.assert_allclose(camera.unproject(pixel[None])[0][0], ray / np.linalg.norm(ray), rtol=0, atol=1e-12)


def test_a_camera_that_cannot_be_is_refused() -> None:
    for wrong, word in (
        ({"model": "omni"}, "omni"),
        ({"coefficients": (1.0,)}, "coefficients"),
        ({"model": "brown_photogrammetric"}, "pixel_mm"),
        ({"focal_px": 0.0}, "focal"),
    ):
        with pytest.raises(UsageError, match=word):
            Camera(**{"width_px": 10, "height_px": 10, "focal_px": 10.0, "centre_px": (4.5, 4.5)} | wrong)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="k4"):
        CAMERAS["radtan"].place_of("k4")


@pytest.mark.parametrize("model", CAMERAS)
def test_values_by_name_make_the_same_camera(model: str) -> None:
    camera = CAMERAS[model]
    again = camera.with_values(camera.values())
    np.testing.assert_array_equal(again.lens(), camera.lens())
    assert set(camera.names) == {"f", "pu", "pv", "aspect", *COEFFICIENTS[model]}
