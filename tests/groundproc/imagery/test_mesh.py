"""Meshes with photographs on them, as other programs read them, against the scene that was photographed."""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import rendered
import trimesh

from groundproc.cli import main

pytestmark = pytest.mark.filterwarnings("ignore:Dataset has no geotransform")

Array = npt.NDArray[np.float64]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mesh")
    rendered.write_block(folder / "images", rendered.shots())
    measured, _ = rendered.points(60.0, 1)
    rendered.write_cloud(folder / "cloud.laz", measured)
    for name in ("m.glb", "m.obj"):
        words = ["--images", str(folder / "images"), "--json", str(folder / f"{name}.json")]
        assert main(["mesh", str(folder / "cloud.laz"), *words, "-o", str(folder / name)]) == 0
    return folder


def sampled(scene: trimesh.Scene, mat_map_file: Array, seed: int) -> tuple[Array, Array, Array]:
    """Places on a mesh, their normals and the colours of its texture there: by another reader."""
    places, normals, colours = [], [], []
    for piece in scene.geometry.values():
        if hasattr(piece.visual.material, "to_simple"):
            piece.visual.material = piece.visual.material.to_simple()
        where, face, colour = trimesh.sample.sample_surface(piece, int(40 * piece.area), sample_color=True, seed=seed)
        places.append(where)
        normals.append(piece.face_normals[face])
        colours.append(np.asarray(colour)[:, :3] / 255.0)
    return np.concatenate(places) @ mat_map_file.T, np.concatenate(normals) @ mat_map_file.T, np.concatenate(colours)


@pytest.mark.parametrize("name", ["m.glb", "m.obj"])
def test_the_texture_shows_the_scene_where_it_is(place: Path, name: str) -> None:
    """Ground, roof and walls; a texel is 8 cm, and where a roof ends the mesh slopes over one cell."""
    told = json.loads((place / f"{name}.json").read_text())
    scene = trimesh.load(place / name, force="scene")
    assert isinstance(scene, trimesh.Scene)
    assert sum(len(piece.faces) for piece in scene.geometry.values()) == told["triangles"]
    assert len(scene.geometry) == told["textures"]
    turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) if name == "m.glb" else np.eye(3)  # y is up there
    xyz, normal, colour = sampled(scene, turn, 3)
    xyz += np.array(told["origin_m"]) - rendered.ORIGIN
    cell = told["cell_m"]
    away = np.maximum(np.abs(xyz[:, 0]) - 5.0, np.abs(xyz[:, 1]) - 4.0)
    roof = (away < -2.0 * cell) & (np.abs(xyz[:, 2] - 8.0) < 0.1)
    ground = (away > 2.0 * cell) & (np.abs(xyz[:, 2]) < 0.1)
    wall = (np.abs(away) < cell) & (xyz[:, 2] > 1.0) & (xyz[:, 2] < 7.0) & (np.abs(normal[:, 2]) < 0.3)
    seen = np.abs(colour - 128.0 / 255.0).max(axis=1) > 0.03
    xyz[ground, 2] = 0.0  # colours jump at 1 cm above the plain, and the points' noise is 1.5 cm
    truth = rendered.colour_at(xyz)
    factor = np.median((colour / truth)[ground & seen])
    for part, least, most in ((ground, 5000, 0.02), (roof, 500, 0.02), (wall, 2000, 0.08)):
        assert part.sum() > least
        assert seen[part].mean() > 0.9
        error = colour[part & seen] / factor - truth[part & seen]
        assert np.sqrt((error**2).mean()) < most


def test_figures_tell_how_it_was_made(place: Path) -> None:
    told = json.loads((place / "m.glb.json").read_text())
    assert told["crs"] == f"EPSG:{rendered.EPSG}"
    assert 0.9 < told["seen"] <= 1.0
    assert 0.0 < told["walls"] < 0.5


def test_the_validator_of_khronos_finds_no_fault(place: Path, tmp_path: Path) -> None:
    """gltf-validator, from npm; where there is no registry this is left out."""
    npm, node = shutil.which("npm"), shutil.which("node")
    if npm is None or node is None:
        pytest.skip("node and npm are not installed: the validator is a program of theirs")
    found = subprocess.run(
        [npm, "install", "--silent", "--prefix", str(tmp_path), "gltf-validator"], check=False, timeout=120
    )
    if found.returncode:
        pytest.skip("gltf-validator cannot be had: no registry of npm packages is in reach")
    script = (
        "const v=require('gltf-validator'),fs=require('fs');"
        "v.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1]))).then(r=>console.log(JSON.stringify(r.issues)))"
    )
    said = subprocess.run(
        [node, "-e", script, str(place / "m.glb")], cwd=tmp_path, capture_output=True, check=True, text=True
    )
    issues = json.loads(said.stdout)
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--cell", "0"], "--cell 0: expected 0.001 to 100 m"),
        (["-o", "m.ply"], "expected"),
        (["--texel", "0.001"], "expected 400,000,000 at most"),
    ],
)
def test_what_cannot_be_is_one_sentence(
    place: Path,
    tmp_path: Path,
    words: list[str],
    sentence: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    given = ["--images", str(place / "images"), "-o", "m.glb", *words]
    assert main(["mesh", str(place / "cloud.laz"), *given]) == 2
    told = capsys.readouterr().err
    assert sentence in told
    assert told.count("\n") == 1
    assert not list(tmp_path.iterdir())
