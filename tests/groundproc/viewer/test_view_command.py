"""`swath view` in a real browser: levels of detail, and classes changed by the mouse."""

import contextlib
import http.client
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest
from browser import PROGRAM, Page, browser

from groundproc.cli import main
from groundproc.cloud import exports, reader
from groundproc.cloud.points import Points
from groundproc.cloud.writer import CloudWriter
from groundproc.geodesy import projected_crs
from tests.groundproc.viewer.conftest import ORIGIN_M, ground

Clouds = Callable[[int], tuple[Path, Path]]
needs_browser = pytest.mark.skipif(PROGRAM is None, reason="no Chromium here")
POINTS = 150_000


@contextlib.contextmanager
def viewed(*words: object, before: str = "") -> Iterator[tuple[str, "subprocess.Popen[str]"]]:
    """The command, after some lines of Python, and the address that it names."""
    code = before + "import sys; from groundproc.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "view", *map(str, words), "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**os.environ})
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("look at http://127.0.0.1:"), (line, process.stderr and process.stderr.read())
        yield line.split()[2], process
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(30)
        for pipe in (process.stdout, process.stderr):
            if pipe is not None:
                pipe.close()


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("browser")) as page:
        page.looks(1000, 700)
        yield page


def settled(page: Page) -> None:
    page.until(
        "window.swathViewer && swathViewer.ready && swathViewer.octree.settled && !swathViewer.dirty && !swathViewer.coarse"
    )


@needs_browser
def test_what_is_near_is_shown_in_full_and_what_is_far_is_not(tab: Page, clouds: Clouds) -> None:
    with viewed(clouds(POINTS)[1]) as (address, _):
        tab.open(address)
        settled(tab)
        assert tab.said == []
        assert tab.asked[0] == address
        assert all(each.startswith((address, "data:")) for each in tab.asked)
        # there is room for all of them, but for nodes that are small in the picture
        assert 0.8 * POINTS < tab.run("swathViewer.drawn") <= POINTS
        tab.run("swathViewer.octree.budget = 110000; swathViewer.octree.choose()")
        settled(tab)
        assert 0 < tab.run("swathViewer.drawn") < 0.95 * POINTS
        # near the corner where points are densest: all levels there, and little of the rest
        tab.run(
            "{ const v = swathViewer, low = v.scene.low; v.camera.centre = [low[0] + 12, low[1] + 9, low[2]];"
            " v.camera.distance = 4; v.turned() }"
        )
        settled(tab)
        levels = "Math.max(...[...swathViewer.octree.nodes.values()].filter(n => n.chunk && n.chunk.shown).map(n => n.level))"
        assert tab.run(levels) == tab.run("Math.max(...swathViewer.scene.trees[0].nodes.map(n => n[0]))")
        tab.run("swathViewer.octree.budget = 2e6; swathViewer.octree.choose()")
        settled(tab)
        near = tab.run("swathViewer.drawn")
        tab.run("swathViewer.camera.centre[0] += 500; swathViewer.turned()")
        settled(tab)
        assert tab.run("swathViewer.drawn") == 0
        assert 0 < near < POINTS
        assert tab.said == []


@needs_browser
def test_surfaces_are_closed_wherever_finer_points_are_not_shown(tab: Page, clouds: Clouds) -> None:
    with viewed(clouds(POINTS)[1]) as (address, _):
        tab.open(address)
        settled(tab)
        tab.run(
            "swathViewer.look.dome = false; swathViewer.camera.above(); swathViewer.camera.distance = 60; swathViewer.turned()"
        )
        origin = np.array(tab.run("swathViewer.scene.origin"))
        tab.run("swathViewer.octree.budget = 60000; swathViewer.octree.choose()")
        settled(tab)
        shown = tab.run("[...swathViewer.renderer.chunks.values()].filter(c => c.shown).map(c => [...c.grains])")
        # some parts of the picture are a level or more finer than others
        assert np.max(shown) > 1.9 * np.min(shown)
        # ground by itself: beside the house, from corner to corner of the denser part and beyond
        ends = [ORIGIN_M - origin + np.array(corner) for corner in ((3.0, 3.0, 0.0), (42.0, 57.0, 0.0))]
        (x0, y0, _), (x1, y1, _) = (
            tab.run(f"swathViewer.project(swathViewer.view, {json.dumps(each.tolist())})") for each in ends
        )
        part = tab.pixels()[
            int(max(min(y0, y1), 0)) : int(min(max(y0, y1), 650)), int(max(min(x0, x1), 270)) : int(max(x0, x1))
        ]
        assert part.size > 3 * 40_000
        sky = np.array(tab.run("swathViewer.renderer.theme.below")) * 255
        bare = (abs(part - sky).max(axis=2) < 6).mean()
        assert bare < 0.02, bare


@needs_browser
@pytest.mark.parametrize("overview", [True, False])
def test_tiles_are_shown_as_one_cloud(tab: Page, clouds: Clouds, tmp_path: Path, overview: bool) -> None:
    tiles = tmp_path / "my tiles"
    assert main(["tile", str(clouds(POINTS)[0]), "--size", "30", "-o", str(tiles)]) == 0
    if not overview:  # as other programs write it where none was asked for
        index = json.loads((tiles / "cloud.vpc").read_text())
        for item in index["features"]:
            del item["assets"]["overview"]
        (tiles / "cloud.vpc").write_text(json.dumps(index))
    with viewed(tiles) as (address, _):
        tab.open(address)
        settled(tab)
        assert tab.said == []
        assert tab.run("swathViewer.scene.total") == POINTS
        # where the whole lies in the picture at once, of all points those that are worth it
        tab.run("swathViewer.camera.above(); swathViewer.camera.distance = 70; swathViewer.turned()")
        settled(tab)
        trees = "swathViewer.octree.nodes.values()"
        shown = tab.run(f"[...{trees}].filter(n => n.chunk && n.chunk.shown).map(n => [n.tree, n.count])")
        own = len(list(tiles.glob("5*.copc.laz")))
        assert {tree for tree, _ in shown} == set(range(own + overview))
        assert 0.8 * POINTS < sum(count for tree, count in shown if tree < own) <= POINTS
        # a place of the densest corner is found where laspy has it: by a click on the middle of the picture
        place = laspy.read(clouds(POINTS)[0]).xyz[100]
        origin = np.array(tab.run("swathViewer.scene.origin"))
        tab.run(
            f"{{ const v = swathViewer; v.camera.centre = {(place - origin).tolist()}; v.camera.distance = 3; v.turned() }}"
        )
        settled(tab)
        tab.click(500, 350)
        hit = tab.run("swathViewer.placeOf(swathViewer.picked)")
        assert np.abs(np.array(hit) + origin - place).max() < 0.05
        # from afar the overview stands for them
        tab.run("swathViewer.camera.distance = 5000; swathViewer.turned()")
        settled(tab)
        seen = {*tab.run(f"[...{trees}].filter(n => n.chunk && n.chunk.shown).map(n => n.tree)")}
        assert seen == ({own} if overview else set(range(own)))
        assert tab.said == []


@needs_browser
def test_a_coloured_cloud_is_shown_in_its_colours(tab: Page, tmp_path: Path) -> None:
    points = ground(3000)
    spread = np.linspace(0, 65535, len(points)).astype(np.uint16)
    columns = points.columns | {"red": spread, "green": spread // 2, "blue": 65535 - spread}
    path = tmp_path / "coloured.laz"
    with CloudWriter(path, columns, crs=projected_crs(32633), offset_m=(533_000.0, 6_472_000.0, 0.0)) as writer:
        writer.write(Points(points.time_ns, points.xyz_m, columns))
    with viewed(path) as (address, _):
        tab.open(address)
        settled(tab)
        assert tab.run("swathViewer.chooser.value") == "rgb"
        assert tab.run("swathViewer.look.mode") == 3
        assert tab.said == []


@needs_browser
def test_a_lasso_changes_classes_of_a_copy_and_nothing_else(tab: Page, clouds: Clouds, tmp_path: Path) -> None:
    plain, out = clouds(POINTS)[0], tmp_path / "edited.laz"
    with viewed(plain, "--edited", out) as (address, process):
        tab.open(address)
        settled(tab)
        tab.run("swathViewer.camera.above(); swathViewer.turned()")
        settled(tab)
        tab.run("document.getElementById('to-class').value = '9'")
        tab.press("#lasso")
        assert tab.run("swathViewer.mode") == "lasso"
        # around the house, whose corners are known
        corners = [(42.0, 23.0), (58.0, 23.0), (58.0, 37.0), (42.0, 37.0), (42.0, 30.0)]
        origin = np.array(tab.run("swathViewer.scene.origin"))
        ground = [np.array([533_000.0 + x, 6_472_000.0 + y, 60.0]) - origin for x, y in corners]
        places = [tab.run(f"swathViewer.project(swathViewer.view, {json.dumps(each.tolist())})") for each in ground]
        tab.drag([(x, y) for x, y, _ in places])
        tab.until("swathViewer.editing.edits.length == 1")
        shown = tab.run(
            "[...swathViewer.renderer.chunks.values()].map(c => c.bytes.classification.filter((v, i) => v !== c.original[i]).length)"
            ".reduce((a, b) => a + b, 0)"
        )
        pixels = tab.pixels()
        assert (abs(pixels.astype(int) - [0x4A, 0x90, 0xE2]).max(axis=2) < 40).sum() > 500  # water is blue
        # one more, taken back
        tab.drag([(500, 300), (560, 300), (560, 360)])
        tab.until("swathViewer.editing.edits.length == 2")
        tab.press("#undo")
        tab.until("swathViewer.editing.edits.length == 1")
        loop = np.array(tab.run("swathViewer.editing.edits[0].loop"))
        matrix = np.array(tab.run("swathViewer.editing.edits[0].matrix")).reshape(4, 4).T
        tab.press("#save")
        tab.until("document.getElementById('edit-note').textContent.includes('saved to')")
        assert tab.said == []
    assert process.returncode == 0
    before, after = laspy.read(plain), laspy.read(out)
    for name in before.point_format.dimension_names:
        if name != "classification":
            np.testing.assert_array_equal(before[name], after[name], err_msg=name)
    changed = np.asarray(after.classification) != np.asarray(before.classification)
    assert set(np.asarray(after.classification)[changed].tolist()) == {9}
    # what was seen to change is what changed: single precision may move a point over the line
    assert abs(int(changed.sum()) - shown) <= 3
    # inside and outside by shapely, in the same picture
    from shapely import Polygon, contains_xy

    flat = np.column_stack([before.xyz - origin, np.ones(POINTS)]) @ matrix.T
    inside = contains_xy(Polygon(loop), flat[:, 0] / flat[:, 3], flat[:, 1] / flat[:, 3])
    np.testing.assert_array_equal(changed, inside)
    assert changed.sum() > 1000


@needs_browser
def test_of_two_windows_none_loses_the_loops_of_the_other(tab: Page, clouds: Clouds, tmp_path: Path) -> None:
    plain, out = clouds(POINTS)[0], tmp_path / "edited.laz"
    with viewed(plain, "--edited", out) as (address, _), browser(tmp_path / "second") as other:
        other.looks(1000, 700)
        for page in (tab, other):
            page.open(address)
            settled(page)
            page.run("swathViewer.camera.above(); swathViewer.turned()")
            settled(page)
            page.run("document.getElementById('to-class').value = '9'")
            page.press("#lasso")
        tab.drag([(420, 300), (520, 300), (520, 400)])
        tab.run("swathViewer.editing.sent")
        # two of them, the second before the first is answered, which a slow machine's mouse does not get done
        other.run(
            "swathViewer.onloop([[600, 300], [700, 300], [700, 400]]); swathViewer.onloop([[600, 200], [700, 200], [700, 290]])"
        )
        other.until("document.getElementById('edit-note').textContent.includes('Another window')")
        other.run("swathViewer.editing.sent")
        assert other.run("swathViewer.editing.edits.length") == 1
        assert not out.exists()
        other.drag([(600, 300), (700, 300), (700, 400)])
        other.run("swathViewer.editing.sent")
        loops = other.run("swathViewer.editing.edits.map(each => [each.matrix, each.loop])")
        other.press("#save")
        other.until("document.getElementById('edit-note').textContent.includes('saved to')")
        origin = np.array(other.run("swathViewer.scene.origin"))
        assert len(loops) == 2
    from shapely import Polygon, contains_xy

    before, after = laspy.read(plain), laspy.read(out)
    inside = np.zeros(POINTS, bool)
    for matrix, loop in loops:
        flat = np.column_stack([before.xyz - origin, np.ones(POINTS)]) @ np.array(matrix).reshape(4, 4)
        found = contains_xy(Polygon(loop), flat[:, 0] / flat[:, 3], flat[:, 1] / flat[:, 3])
        assert found.sum() > 100
        inside |= found
    np.testing.assert_array_equal(np.asarray(after.classification) != np.asarray(before.classification), inside)


def posted(address: str, where: str, what: object) -> int:
    """As the page does it; the status of the answer, 0 without one."""
    from urllib.error import HTTPError
    from urllib.request import Request, urlopen

    token = json.loads(re.findall(r'id="scene">(.*?)</script>', urlopen(address).read().decode())[0])["token"]
    try:
        with urlopen(Request(address + where, json.dumps(what).encode(), {"X-Swath-Token": token})) as answer:
            return int(answer.status)
    except HTTPError as error:
        return error.code
    except (OSError, http.client.HTTPException):  # the program ended before it answered
        return 0


@pytest.mark.parametrize("again", [False, True])
def test_an_interrupt_while_saving_leaves_a_whole_file_or_none(clouds: Clouds, tmp_path: Path, again: bool) -> None:
    """Each chunk of the saving program waits for a file to go, so that the interrupt comes in the middle."""
    plain, out, gate = clouds(POINTS)[0], tmp_path / "edited.laz", tmp_path / "gate"
    gate.touch()
    slow = (
        "import time; from pathlib import Path; from groundproc.viewer import edits; real = edits.apply\n"
        f"def apply(*words):\n    while Path({str(gate)!r}).exists() and not Path({str(gate)!r} + '2').exists():"
        " time.sleep(0.02)\n    return real(*words)\n"
        "edits.apply = apply\n"
    )
    loop = {"matrix": np.diag([1e-3, 1e-3, 1e-3, 1.0]).ravel().tolist(), "loop": [[-9, -9], [9, -9], [0, 9]], "to": 9}
    with viewed(plain, "--edited", out, before=slow) as (address, process):
        assert posted(address, "edits", {"version": 0, "edits": [loop]}) == 200
        thread = threading.Thread(target=posted, args=(address, "save", {"version": 1}))
        thread.start()
        deadline = time.monotonic() + 60.0
        while not list(tmp_path.glob(".edited.laz.*.part")) and time.monotonic() < deadline:
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        assert process.stderr is not None
        said = ""
        while "is saved first" not in said:
            said = process.stderr.readline()
            assert said
        if again:
            process.send_signal(signal.SIGINT)
            time.sleep(0.2)
        gate.unlink()
        assert process.wait(60) == (130 if again else 0)
        thread.join()
    if again:
        assert sorted(path.name for path in tmp_path.iterdir()) == []
    else:
        assert set(np.asarray(laspy.read(out).classification).tolist()) == {9}
        assert sorted(path.name for path in tmp_path.iterdir()) == ["edited.laz"]


@needs_browser
def test_classes_of_other_programs_keep_their_numbers(tab: Page, tmp_path: Path) -> None:
    """More of them than have names, none below 20, and one of three points in 200 000 that the first nodes do not hold."""
    rng = np.random.default_rng(3)
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = [0.001] * 3, [533_000.0, 6_472_000.0, 0.0]
    header.add_crs(projected_crs(32633))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = rng.uniform([533_000, 6_472_000, 50], [533_080, 6_472_060, 50.02], (200_000, 3)).T
    classes = rng.integers(20, 120, 200_000).astype(np.uint8)
    classes[[5, 77, 4321]] = 250
    cloud.classification = classes
    cloud.write(str(tmp_path / "fremd ä.laz"))
    with viewed(tmp_path / "fremd ä.laz", "--edited", tmp_path / "x.laz") as (address, _):
        tab.open(address)
        settled(tab)
        tab.run("swathViewer.shade('classification')")
        tab.run("swathViewer.octree.budget = 1e7; swathViewer.camera.above(); swathViewer.octree.choose()")
        settled(tab)
        held = tab.run("[...swathViewer.renderer.chunks.values()].flatMap(c => [...c.bytes.classification])")
        assert len(held) == 200_000
        assert np.bincount(held, minlength=256).tolist() == np.bincount(classes, minlength=256).tolist()
        named = tab.run("[...document.querySelectorAll('.kinds button')].map(each => each.textContent)")
        assert [int(each.split()[0]) for each in named] == np.unique(classes).tolist()
        offered = tab.run("[...document.querySelectorAll('#to-class option')].map(each => +each.value)")
        assert set(np.unique(classes).tolist()) <= set(offered)
        assert offered == sorted(offered)
        assert tab.run("document.getElementById('to-class').value") == "2"
        assert tab.said == []


@needs_browser
def test_loops_that_were_not_saved_are_said(tab: Page, clouds: Clouds, tmp_path: Path) -> None:
    with viewed(clouds(POINTS)[1], "--edited", tmp_path / "x.laz") as (address, process):
        tab.open(address)
        settled(tab)
        tab.press("#lasso")
        tab.drag([(500, 300), (620, 300), (620, 420)])
        tab.until("swathViewer.editing.edits.length == 1")
        tab.run("swathViewer.editing.sent")
        tab.open("about:blank")
        process.send_signal(signal.SIGINT)
        assert process.stderr is not None
        assert "1 loop(s) of the lasso were not saved" in process.stderr.read()
    assert not (tmp_path / "x.laz").exists()


def copc_of_zone_34(folder: Path) -> Path:
    """A COPC in another zone."""
    points = ground(100)
    plain, octree = folder / "east.laz", folder / "east.copc.laz"
    with CloudWriter(plain, points.columns, crs=projected_crs(32634), offset_m=(533_000.0, 6_472_000.0, 0.0)) as writer:
        writer.write(points)
    exports.write(reader.look(plain), octree, octree, lambda done: None)
    return octree


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["{folder}/empty"], "no such file"),
        (["{folder}"], "holds no cloud.copc.laz, cloud.laz or cloud.vpc"),
        (["{folder}/none.vpc"], "no such file"),
        (["{folder}/text.vpc"], "text.vpc: is no virtual point cloud: expected features with an asset for each file"),
        (["{folder}/gone.vpc"], "gone.vpc: lists ./gone.laz, and there is no such file; expected the tiles beside"),
        (["{folder}/far.vpc"], "far.vpc: lists https://example.org/a.copc.laz, expected files of this machine"),
        (["{folder}/plain.vpc"], "degrees.laz: a tile without an index, expected COPC; `swath tile"),
        (["{folder}/zones.vpc"], "coordinates in WGS 84 / UTM zone 33N, but"),
        (["{folder}/far.vpc", "--edited", "{folder}/x.laz"], "classes are changed in one file, and"),
        (["{folder}/none.laz"], "no such file"),
        (["{folder}/degrees.laz"], "degrees.laz: coordinates in WGS 84 are angles, expected a projected CRS"),
        (["{cloud}", "--edited", "{folder}/x.ply"], "ends in .ply, expected a name that ends in .laz or .las"),
        (["{cloud}", "--edited", "{folder}/x.copc.laz"], "`swath export` makes a COPC of it"),
        (["{cloud}", "--edited", "{cloud}"], "is an input and cannot be the output too"),
        (["{cloud}", "--force"], "--force given, but nothing uses it"),
        (["{cloud}", "--port", "70000"], "expected 0 (any free one) to 65535"),
    ],
)
def test_what_cannot_be_viewed_is_one_sentence(
    clouds: Clouds, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str
) -> None:
    with CloudWriter(tmp_path / "degrees.laz", (), crs=pyproj.CRS(4326)) as writer:
        writer.write(Points(np.arange(9) + 10**18, np.zeros((9, 3))))
    (tmp_path / "text.vpc").write_text("{}")
    for name, href in (("gone", "./gone.laz"), ("far", "https://example.org/a.copc.laz"), ("plain", "degrees.laz")):
        items = {"type": "FeatureCollection", "features": [{"assets": {"data": {"href": href}}}]}
        (tmp_path / f"{name}.vpc").write_text(json.dumps(items))
    other = copc_of_zone_34(tmp_path)
    items = [{"assets": {"data": {"href": str(each)}}} for each in (other, clouds(3_000)[1])]
    (tmp_path / "zones.vpc").write_text(json.dumps({"type": "FeatureCollection", "features": items}))
    told = [word.format(folder=tmp_path, cloud=clouds(3_000)[0]) for word in words]
    assert main(["view", *told]) in (1, 2)
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
