"""The table of control points and planes."""

from pathlib import Path

import numpy as np
import pytest

from flightlog.errors import SwathError
from groundproc.flight.control import ControlPoint, read_control, table


def test_points_checks_and_planes_are_told_apart(tmp_path: Path) -> None:
    (tmp_path / "c.csv").write_text(
        "\ufeffname, x, y, z, sigma, use, nx, ny, nz, radius, remark\n"
        "A,1,2,3,0.02,control,,,,,steps\n"
        ",4,5,6,0.01,CHECK,,,,\n"
        "wall,7,8,9,0.03,,0,2,0,1.5\n\n"
    )
    a, b, wall = read_control(tmp_path / "c.csv")
    assert (a.name, b.name, wall.name) == ("A", "2", "wall")
    assert (a.check, b.check, wall.check) == (False, True, False)
    assert a.normal is None
    assert wall.normal is not None
    np.testing.assert_allclose(wall.normal, [0, 1, 0])
    assert wall.radius_m == 1.5
    # what is used, as places with a sigma: a plane at five of its places
    rows = table((a, b, wall))
    assert rows.shape == (6, 4)
    np.testing.assert_allclose(rows[0], [1, 2, 3, 0.02])


def test_a_plane_is_held_all_over_and_as_well_as_stated() -> None:
    normal = np.array([0.6, 0.0, 0.8])
    plane = ControlPoint("roof", np.array([10.0, 20.0, 5.0]), 0.02, normal=normal, radius_m=2.0)
    spots = plane.spots()
    np.testing.assert_allclose((spots - plane.place_m) @ normal, 0.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(spots[1:] - plane.place_m, axis=1), 2.0)
    np.testing.assert_allclose(spots.mean(axis=0), plane.place_m)
    # independent errors of the spots leave the offset the stated sigma
    assert plane.spot_sigma_m() / np.sqrt(len(spots)) == pytest.approx(0.02)
    assert len(ControlPoint("p", np.zeros(3), 0.02, normal=normal).spots()) == 1


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("P,1,2,3,0.1,perhaps,,,,", "line 2: .*control or check"),
        ("P,1,2,3,-0.1,,,,,", "line 2: .*sigma above 0"),
        ("P,1,2,nan,0.1,,,,,", "line 2: .*sigma above 0"),
        ("P,1,2", "line 2: .*sigma above 0"),
        ("P,1,2,3,0.1,,0,0,0,1", "line 2: .*nx, ny, nz"),
        ("P,1,2,3,0.1,,1,,0,1", "line 2: .*nx, ny, nz"),
        ("P,1,2,3,0.1,,1,0,0,-1", "line 2: .*radius"),
        ("", "holds no points"),
    ],
)
def test_a_bad_line_is_one_sentence(tmp_path: Path, line: str, sentence: str) -> None:
    (tmp_path / "c.csv").write_text(f"name,x,y,z,sigma,use,nx,ny,nz,radius\n{line}\n")
    with pytest.raises(SwathError, match=sentence):
        read_control(tmp_path / "c.csv")


def test_a_file_that_is_not_there_or_has_other_columns_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SwathError, match="cannot be read"):
        read_control(tmp_path / "nowhere.csv")
    (tmp_path / "c.csv").write_text("east,north,up\n1,2,3\n")
    with pytest.raises(SwathError, match="no column x; control has x, y, z, sigma"):
        read_control(tmp_path / "c.csv")
