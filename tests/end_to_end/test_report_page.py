"""The report in a real browser, without a network: nothing is asked for, nothing complained of, and what is measured is right."""

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from browser import PROGRAM, Page, browser

from groundproc.cli import main

pytestmark = pytest.mark.skipif(PROGRAM is None, reason="no Chromium here")

PRODUCTS = "cloud.copc.laz,dsm.tif,hillshade.tif,density.tif,report.html"


@pytest.fixture(scope="module")
def folder(still_flight: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Products of a flight whose log has a name that would like to be part of the page."""
    base = tmp_path_factory.mktemp("page")
    log = base / "<img src=x onerror=alert(1)>.mcap"
    shutil.copy(still_flight.log, log)
    assert main(["process", str(log), "--method", "ins", "--products", PRODUCTS, "-o", str(base / "out")]) in (0, 3)
    return base / "out"


@pytest.fixture(scope="module")
def page(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("browser")) as page:
        page.looks(1100, 800)
        page.open((folder / "report.html").as_uri())
        page.until("window.swathViewer && swathViewer.ready && swathViewer.drawn > 0")
        yield page


def middle(page: Page) -> tuple[float, float, float, float]:
    """Place and size of the cloud's picture in the window."""
    page.run("document.getElementById('viewer').scrollIntoView({block: 'center'})")
    left, top, width, height = page.run(
        "(() => { const b = swathViewer.canvas.getBoundingClientRect(); return [b.left, b.top, b.width, b.height]; })()"
    )
    return left, top, width, height


def settled(page: Page) -> None:
    page.until("!swathViewer.dirty && !swathViewer.coarse")


def on_screen(page: Page, count: int, seed: int) -> list[tuple[float, float]]:
    """Places in the window of some points of the cloud that lie well within the picture."""
    left, top, width, height = middle(page)
    places = page.run(
        """(() => { const v = swathViewer, view = v.view, found = [];
        for (const chunk of v.renderer.chunks.values()) for (let i = 0; i < chunk.count; i += 7) {
          const p = v.project(view, [0, 1, 2].map(k => chunk.places[3 * i + k])); if (p) found.push(p); } return found; })()"""
    )
    inner = [(x, y) for x, y, _ in places if 300 < x < width - 80 and 60 < y < height - 80]
    rng = np.random.default_rng(seed)
    return [(left + inner[k][0], top + inner[k][1]) for k in rng.choice(len(inner), count, replace=False)]


def test_it_shows_the_cloud_and_asks_nobody_for_anything(page: Page, folder: Path) -> None:
    assert page.said == []
    assert page.asked[0] == (folder / "report.html").as_uri()
    assert all(address.startswith("data:") for address in page.asked[1:])
    with laspy.open(folder / "cloud.copc.laz") as cloud:
        assert page.run("swathViewer.drawn") == cloud.header.point_count
    assert page.run("document.querySelector('header p').textContent") == "<img src=x onerror=alert(1)>.mcap"
    left, top, width, height = middle(page)
    settled(page)
    pixels = page.pixels()[int(top) + 60 : int(top + height) - 60, int(left) + 260 : int(left + width) - 60].astype(int)
    coloured = np.ptp(pixels, axis=2) > 60
    assert coloured.mean() > 0.02
    assert len(np.unique(pixels[coloured] // 32, axis=0)) > 5


def test_a_measured_distance_is_that_of_two_points_of_the_cloud(page: Page, folder: Path) -> None:
    places = on_screen(page, 2, 1)
    page.press(".tools button:nth-child(3)")
    assert page.run("swathViewer.mode") == "distance"
    middle(page)
    for place in places:
        page.click(*place)
    taken = np.array(page.run("swathViewer.taken.map(p => p.map((v, i) => v + swathViewer.scene.origin[i]))"))
    assert taken.shape == (2, 3)
    whole = laspy.read(folder / "cloud.copc.laz")
    known = {tuple(each) for each in np.rint(whole.xyz * 1000).astype(int).tolist()}
    # single precision from an origin near by: a tenth of a millimetre
    assert {tuple(each) for each in np.rint(taken * 1000).astype(int).tolist()} <= known
    rows = dict(
        page.run(
            "[...document.querySelectorAll('.results tr')].map(r => [r.cells[0].textContent, r.cells[1].textContent])"
        )
    )
    step = taken[1] - taken[0]
    assert metres(rows["in space"]) == pytest.approx(np.linalg.norm(step), abs=0.0051)
    assert metres(rows["in plan"]) == pytest.approx(np.hypot(*step[:2]), abs=0.0051)
    assert metres(rows["height difference"]) == pytest.approx(step[2], abs=0.0051)
    left, top, _, _ = middle(page)
    for place, point in zip(
        places, page.run("swathViewer.taken.map(p => swathViewer.project(swathViewer.view, p))"), strict=True
    ):
        assert np.hypot(place[0] - left - point[0], place[1] - top - point[1]) < 4.0
    page.press(".tools button:nth-child(6)")


def metres(text: str) -> float:
    found = re.fullmatch(r"([+−]?)([\d.]+) m²?", text)
    assert found is not None, text
    return float(found[2]) * (-1 if found[1] == "−" else 1)


def test_an_area_is_that_of_its_corners(page: Page) -> None:
    page.press(".tools button:nth-child(2)")  # from above
    places = on_screen(page, 3, 2)
    page.press(".tools button:nth-child(4)")
    middle(page)
    for place in places:
        page.click(*place)
    a, b, c = np.array(page.run("swathViewer.taken"))
    rows = dict(
        page.run(
            "[...document.querySelectorAll('.results tr')].map(r => [r.cells[0].textContent, r.cells[1].textContent])"
        )
    )
    cross = np.cross(b - a, c - a)
    assert metres(rows["in plan"]) == pytest.approx(abs(cross[2]) / 2, abs=0.0051)
    assert metres(rows["along its plane"]) == pytest.approx(np.linalg.norm(cross) / 2, abs=0.0051)
    page.press(".tools button:nth-child(6)")


def test_a_section_shows_what_lies_along_its_line(page: Page) -> None:
    places = on_screen(page, 2, 3)
    page.press(".tools button:nth-child(5)")
    middle(page)
    for place in places:
        page.click(*place)
    settled(page)
    slab = page.run(
        "({a: swathViewer.slab.a, b: swathViewer.slab.b, half: swathViewer.slab.half, ortho: swathViewer.camera.ortho})"
    )
    assert slab["ortho"]
    left = page.run("swathViewer.project(swathViewer.view, swathViewer.slab.a)")
    right = page.run("swathViewer.project(swathViewer.view, swathViewer.slab.b)")
    per_pixel = page.run("swathViewer.view.perPixel")
    length = np.hypot(slab["b"][0] - slab["a"][0], slab["b"][1] - slab["a"][1])
    assert abs(right[0] - left[0]) * per_pixel == pytest.approx(length, rel=1e-6)  # to scale
    assert (left[1] - right[1]) * per_pixel == pytest.approx(slab["b"][2] - slab["a"][2], abs=1e-6 * length)
    page.run("swathViewer.uncut()")
    assert page.run("swathViewer.camera.ortho") is False


def test_every_attribute_and_map_can_be_chosen_light_or_dark_large_or_small(page: Page) -> None:
    for name in page.run("swathViewer.shades.map(each => each.name)"):
        page.run(f"swathViewer.shade({name!r})")
        settled(page)
        assert page.run("document.querySelector('.legend').children.length") > 0
    for button in range(1, page.run("document.querySelectorAll('.choose button').length") + 1):
        page.press(f".choose button:nth-child({button})")
        assert page.run("document.querySelectorAll('figure.chosen').length") == 1
    for width, dark in ((400, True), (1100, False)):
        page.looks(width, 800, dark=dark, phone=width == 400)
        settled(page)
        assert page.run("document.documentElement.scrollWidth <= innerWidth") is True
        assert page.run("innerWidth") == width
    assert page.said == []


def test_a_section_stands_beside_the_panel(page: Page) -> None:
    page.looks(1100, 800)
    settled(page)
    low, high = page.run("[swathViewer.scene.core[0], swathViewer.scene.core[1]]")
    page.run(f"swathViewer.sheet.open = true; swathViewer.cut({low}, {high})")
    settled(page)
    right_of = page.run("swathViewer.sheet.offsetLeft + swathViewer.sheet.offsetWidth")
    width = page.run("swathViewer.canvas.clientWidth")
    for end in "ab":
        x, y, _ = page.run(f"swathViewer.project(swathViewer.view, swathViewer.slab.{end})")
        assert right_of < x < width
        assert 0 < y < page.run("swathViewer.canvas.clientHeight")
    page.run("swathViewer.uncut()")
    settled(page)


def test_it_is_looked_at_and_measured_in_by_keys(page: Page) -> None:
    page.run("swathViewer.camera.fit(swathViewer.aspect); swathViewer.canvas.focus(); swathViewer.turned()")
    before = page.run("[swathViewer.camera.azimuth, swathViewer.camera.elevation, ...swathViewer.camera.centre]")
    page.key("ArrowLeft", shift=True)
    page.key("ArrowUp", shift=True)
    after = page.run("[swathViewer.camera.azimuth, swathViewer.camera.elevation, ...swathViewer.camera.centre]")
    assert after[0] != before[0]
    assert after[1] != before[1]
    assert after[2:] == before[2:]
    page.key("ArrowLeft")
    assert page.run("[...swathViewer.camera.centre]") != before[2:]
    # from the picture through the panel to the tools, and out of a tool from where it was chosen
    for _ in range(30):
        page.key("Tab")
        if page.run("document.activeElement === swathViewer.keys.area"):
            break
    page.key("Enter")
    assert page.run("swathViewer.mode") == "area"
    page.key("Escape")
    assert page.run("swathViewer.mode") == "look"


@pytest.mark.parametrize(("width", "height"), [(844, 390), (390, 844), (360, 640), (1024, 600)])
def test_beside_the_cloud_there_is_room_for_a_finger_that_scrolls(page: Page, width: int, height: int) -> None:
    page.looks(width, height, phone=width < 1000)
    settled(page)
    assert page.run("document.getElementById('viewer').offsetHeight") <= 0.9 * height
    page.run("swathViewer.sheet.open = true; swathViewer.tool('distance')")
    inside, outside = page.run(
        "['.checks', '.panel'].map(s => document.querySelector(s)).map(e => [e.scrollWidth, e.clientWidth])"
    )
    assert inside[0] <= inside[1]
    assert outside[0] <= outside[1]
    hint, tools, panel = page.run(
        "['.hint', '.tools', '.panel summary'].map(s => document.querySelector(s).getBoundingClientRect())"
        ".map(b => [b.left, b.top, b.right, b.bottom])"
    )
    for other in (tools, panel):
        assert hint[2] <= other[0] or hint[0] >= other[2] or hint[3] <= other[1] or hint[1] >= other[3]
    page.run("swathViewer.tool('clear')")


def contrast(page: Page, selector: str) -> float:
    """Of a text to what is behind it (WCAG 2.2, 1.4.3)."""
    colours = page.run(
        f"(() => {{ const e = document.querySelector({selector!r}); let b = e;"
        " while (getComputedStyle(b).backgroundColor === 'rgba(0, 0, 0, 0)' && b.parentElement) b = b.parentElement;"
        " return [getComputedStyle(e).color, getComputedStyle(b).backgroundColor]; })()"
    )
    light = []
    for colour in colours:
        value = np.array([float(each) for each in re.findall(r"[\d.]+", colour)[:3]]) / 255.0
        linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
        light.append(float(linear @ [0.2126, 0.7152, 0.0722]))
    return (max(light) + 0.05) / (min(light) + 0.05)


@pytest.mark.parametrize("medium", ["screen", "print"])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_words_can_be_read_on_the_screen_and_on_paper(page: Page, medium: str, scheme: str) -> None:
    page.call("Emulation.setEmulatedMedia", media=medium, features=[{"name": "prefers-color-scheme", "value": scheme}])
    for selector in (".verdict p", ".verdict b", ".facts dt", ".facts dd", ".story", "h2", "#losses td"):
        if page.run(f"!!document.querySelector({selector!r})"):
            assert contrast(page, selector) >= 4.5, selector
    page.call("Emulation.setEmulatedMedia", media="", features=[])


def test_it_is_printed_by_one_option(folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "out"
    shutil.copytree(folder, copy)
    assert main(["report", str(copy), "--pdf"]) == 0
    printed = (copy / "report.pdf").read_bytes()
    assert printed.startswith(b"%PDF-")
    assert len(re.findall(rb"/Type\s*/Page\b", printed)) > 2
