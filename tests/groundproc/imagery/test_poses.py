from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Proj

from flightlog.errors import CaptureError, GeodesyError
from groundproc.imagery.poses import NO_TIME, ImagePoses, chosen, read_poses, write_poses
from groundproc.imagery.rotations import mat_world_camera, photogrammetric, turn_by_angles
from groundproc.imagery.site import cartesian, georeferenced

ANGLE = st.floats(-1.5, 1.5)


def test_a_vertical_image_with_its_top_to_the_north_has_angles_of_zero() -> None:
    mat = mat_world_camera(np.zeros(1), np.zeros(1), np.zeros(1))[0]
    np.testing.assert_allclose(mat @ [0, 0, 1], [0, 0, -1])  # looks down
    np.testing.assert_allclose(mat @ [0, -1, 0], [0, 1, 0])  # its upper edge is north


@given(ANGLE, ANGLE, st.floats(-3.1, 3.1))
def test_angles_come_back_from_their_matrix(omega: float, phi: float, kappa: float) -> None:
    given_rad = np.array([[omega, phi, kappa]])
    mat = mat_world_camera(*given_rad.T)
    np.testing.assert_allclose(np.stack(photogrammetric(mat), axis=1), given_rad, rtol=0, atol=1e-9)
    np.testing.assert_allclose(mat[0] @ mat[0].T, np.eye(3), rtol=0, atol=1e-14)


@given(ANGLE, st.floats(-1.2, 1.2), ANGLE)
def test_small_changes_of_angles_turn_about_their_axes(omega: float, phi: float, kappa: float) -> None:
    angles = np.array([[omega, phi, kappa]])
    for axis, step in enumerate(1e-6 * np.eye(3)):
        turned = mat_world_camera(*(angles + step).T) @ np.swapaxes(mat_world_camera(*(angles - step).T), 1, 2)
        odd = (turned[0] - turned[0].T) / 2.0
        vector = np.array([odd[2, 1], odd[0, 2], odd[1, 0]]) / 2e-6
        np.testing.assert_allclose(turn_by_angles(angles[:, 0], angles[:, 1])[0, :, axis], vector, rtol=0, atol=1e-8)


def example() -> ImagePoses:
    sigma = np.array([[0.02, 0.02, 0.03], [np.nan] * 3])
    return ImagePoses(
        ("cam0/a.jpg", 'odd, "name".jpg'), np.array([1_700_000_000_123_456_789, NO_TIME]),
        np.array([[5e5, 6e6, 100.0], [5e5 + 9, 6e6, 101.0]]),
        np.array([[0.01, -0.02, 3.0], [0.0, 0.1, -1.0]]), sigma, np.deg2rad(sigma),
    )  # fmt: skip


def test_poses_are_read_as_they_were_written(tmp_path: Path) -> None:
    write_poses(tmp_path / "poses.csv", example())
    again = read_poses(tmp_path / "poses.csv")
    assert again.images == example().images
    np.testing.assert_array_equal(again.utc_ns, example().utc_ns)
    for name, digits in (("place_m", 1e-5), ("angles_rad", 1e-8), ("sigma_place_m", 1e-8), ("sigma_angles_rad", 1e-10)):
        np.testing.assert_allclose(getattr(again, name), getattr(example(), name), rtol=0, atol=digits)


def test_poses_of_another_program_need_no_times_and_no_sigmas(tmp_path: Path) -> None:
    path = tmp_path / "start.csv"
    path.write_text("image,easting,northing,height,omega_deg,phi_deg,kappa_deg\na.jpg,1,2,3,0,0,90\n")
    poses = read_poses(path)
    assert poses.utc_ns[0] == NO_TIME
    assert np.isnan(poses.sigma_place_m).all()
    assert chosen(poses, ["sub/a.jpg", "b.jpg"]) == {"sub/a.jpg": 0}


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("name,x\na,1\n", "no column image"),
        ("image,easting\na,1\n", "northing is missing"),
        ("image,easting,northing,height,omega_deg,phi_deg,kappa_deg\na,1,2,3,0,0,east\n", "line 2"),
        ("image,easting,northing,height,omega_deg,phi_deg,kappa_deg\n", "no poses"),
        ("image,easting,northing,height,omega_deg,phi_deg,kappa_deg\na,1,2,3,0,0,0\na,1,2,3,0,0,0\n", "more than once"),
    ],
)
def test_what_is_no_table_of_poses_gets_one_sentence(tmp_path: Path, text: str, word: str) -> None:
    (tmp_path / "poses.csv").write_text(text)
    with pytest.raises(CaptureError, match=word):
        read_poses(tmp_path / "poses.csv")


def test_the_grid_s_axes_are_turned_by_the_convergence_that_proj_states() -> None:
    site = georeferenced(32633, np.array([[300_000.0, 6_500_000.0, 50.0]]))
    here = site.local(np.array([[300_400.0, 6_500_300.0, 90.0]]))
    mat = site.mat_local_grid(here)[0]
    latitude, longitude, _ = (float(value[0]) for value in site.projection.frame.to_geodetic(here))  # type: ignore[union-attr]
    convergence = Proj("EPSG:32633").get_factors(longitude, latitude).meridian_convergence
    # seen from true north, grid north lies clockwise by the convergence
    found = np.rad2deg(np.arctan2(mat[0, 1], mat[1, 1]))
    assert abs(abs(found) - abs(convergence)) < 0.01
    assert abs(convergence) > 2.0
    np.testing.assert_allclose(np.linalg.det(mat), 1.0)
    # and the step along it is a step along the coordinates
    step = site.map(here + mat @ [0.0, 10.0, 0.0]) - site.map(here)
    np.testing.assert_allclose(step[0], [0.0, 10.0, 0.0], rtol=0, atol=0.01)


def test_the_frame_is_tangent_and_the_coordinates_come_back() -> None:
    places = np.array([[300_000.0, 6_500_000.0, 50.0], [301_000.0, 6_500_500.0, 80.0]])
    site = georeferenced("EPSG:32633", places)
    np.testing.assert_allclose(site.map(site.local(places)), places, rtol=0, atol=1e-6)
    assert site.epsg == 32633
    # the grid is 0.9998 to 1.0004 of the ground
    ratio = np.linalg.norm(np.diff(site.local(places), axis=0)) / np.linalg.norm(np.diff(places, axis=0))
    assert 0.9995 < ratio < 1.0005
    assert ratio != 1.0
    with pytest.raises(GeodesyError):
        site.local(np.array([[1e12, 1e12, 0.0]]))


def test_without_a_coordinate_system_only_the_origin_is_moved() -> None:
    places = np.array([[1e6, 1e5, 100.0], [1e6 + 10.0, 1e5, 100.0]])
    site = cartesian(places)
    np.testing.assert_allclose(np.diff(site.local(places), axis=0), [[10.0, 0.0, 0.0]])
    assert site.epsg is None
    np.testing.assert_array_equal(site.mat_local_grid(places)[1], np.eye(3))
