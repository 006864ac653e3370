"""The report of a flight: all of it from the folder, nothing of it from elsewhere, and no word of a file that becomes part of the page."""

import base64
import gzip
import hashlib
import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

from flightlog.errors import UsageError
from groundproc.cli import main
from groundproc.products import chosen
from groundproc.products.product import Context, draw
from groundproc.reporting import cloudpart, pdf
from groundproc.reporting.flightreport import Subject, compose
from groundproc.steps.place import projection_of
from groundproc.steps.process import remembered
from groundproc.steps.products import digests_of
from groundproc.trajectory.estimate import read_estimate

HOSTILE = "<img src=x onerror=alert(1)>\"'><script>alert(2)</script></script><!--&amp;`${1}`\u2028"


class Elements(HTMLParser):
    """What a page is made of."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []
        self.inside = ""
        self.held: dict[str, str] = {}
        self.feed(text)

    def handle_starttag(self, name: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append((name, dict(attributes)))
        self.inside = (dict(attributes).get("id") or name) if name in ("script", "style") else ""

    def handle_data(self, text: str) -> None:
        if self.inside:
            self.held[self.inside] = self.held.get(self.inside, "") + text
        else:
            self.text.append(text)

    def handle_endtag(self, name: str) -> None:
        self.inside = ""

    def words(self) -> str:
        return " ".join(" ".join(self.text).split())


def quality_of(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "quality.json").read_text())
    return content


def context_of(folder: Path, out: Path, **changed: Any) -> Context:
    request = remembered(folder)
    assert request is not None
    estimate = read_estimate(folder)
    quality = quality_of(folder)
    projection = projection_of(estimate.trajectory.frame, request.survey)
    return replace(Context(out, folder, request.survey, estimate, projection, quality, digests_of(folder)), **changed)


def report(folder: Path, out: Path, options: dict[str, Any], **changed: Any) -> str:
    draw(chosen([{"report.html": options}]), context_of(folder, out, **changed))
    return (out / "report.html").read_text()


@pytest.fixture(scope="module")
def page(processed: Path) -> Elements:
    return Elements((processed / "report.html").read_text())


def test_it_says_what_quality_json_says(page: Elements, processed: Path) -> None:
    quality, words = quality_of(processed), page.words()
    assert {"good": "Good", "doubtful": "Doubtful", "bad": "Bad"}[quality["verdict"]] + " " in words
    for reason in quality["verdict_reasons"]:
        assert " ".join(reason["text"].split()) in words
    assert f"{quality['points']['written']:,}" in words
    assert quality["crs"]["name"] in words
    for number in quality["points"]["shots_dropped"].values():
        assert f"{number:,}" in words
    for name in ("cloud.copc.laz", "dsm.tif", "density.tif", "trajectory.csv", "quality.json"):
        assert hashlib.sha256((processed / name).read_bytes()).hexdigest() in words
    logs = json.loads((processed / ".swath/ledger.json").read_text())["logs"]
    assert hashlib.sha256(Path(logs[0]).read_bytes()).hexdigest() in words


def test_nothing_in_it_comes_from_elsewhere(page: Elements) -> None:
    addresses = [
        value
        for _, attributes in page.tags
        for name, value in attributes.items()
        if name in ("src", "href", "srcset", "action")
    ]
    assert addresses
    assert all(value is not None and value.startswith("data:") for value in addresses)
    assert not [name for name, _ in page.tags if name in ("iframe", "object", "embed", "base", "form")]
    assert not [name for _, attributes in page.tags for name in attributes if name.startswith("on") or name == "style"]
    (policy,) = [a["content"] or "" for _, a in page.tags if a.get("http-equiv") == "Content-Security-Policy"]
    assert policy.startswith("default-src 'none'; ")
    assert "unsafe" not in policy
    assert "http" not in policy
    for name in ("script", "style"):
        digest = base64.b64encode(hashlib.sha256(page.held[name].encode()).digest()).decode()
        assert f"{name}-src 'sha256-{digest}'" in policy
    assert not re.search(r"@import|url\(", page.held["style"])


def test_its_points_are_those_of_the_cloud(page: Elements, processed: Path) -> None:
    scene = json.loads(page.held["scene"])
    raw = gzip.decompress(base64.b64decode(page.held["cloud-data"]))
    count, planes = np.frombuffer(raw, "<u4", 2).tolist()
    whole = laspy.read(processed / "cloud.copc.laz")
    assert count == len(whole)  # few enough for all of them
    bytes_ = np.frombuffer(raw, np.uint8, offset=8)
    parts = bytes_[: 3 * planes * count].reshape(3, planes, count).astype(np.int64)
    zigzag = sum(parts[:, k] << (8 * k) for k in range(planes))
    steps = np.cumsum((zigzag >> 1) ^ -(zigzag & 1), axis=1).T + np.rint(np.array(scene["origin"]) * 1000).astype(int)
    own = np.rint(whole.xyz * 1000).astype(int)
    names = [shade["name"] for shade in scene["shades"]]
    intensity = bytes_[3 * planes * count :].reshape(-1, count)[names.index("intensity")].astype(int)
    intensity = (
        intensity * scene["shades"][names.index("intensity")]["step"] + scene["shades"][names.index("intensity")]["low"]
    )
    told, known = np.column_stack([steps, intensity.astype(int)]), np.column_stack([own, whole.intensity])
    np.testing.assert_array_equal(told[np.lexsort(told.T)], known[np.lexsort(known.T)])


def test_points_read_before_are_taken_unless_the_cloud_is_another_by_then(processed: Path, tmp_path: Path) -> None:
    staged = tmp_path / "staged.laz"
    assert main(["export", str(processed / "cloud.copc.laz"), "-o", str(staged)]) == 0
    before = cloudpart.foreseen(staged, 2000)
    path = staged.rename(tmp_path / "cloud.laz")
    assert cloudpart.read(tmp_path, 2000, before) is before.part
    anew, fewer = cloudpart.read(tmp_path, 2000), cloudpart.read(tmp_path, 1000, before)
    assert anew is not None
    assert fewer is not None
    np.testing.assert_array_equal(anew.points.xyz_m, before.part.points.xyz_m)
    assert len(fewer.points) <= 1000
    with laspy.open(path) as file:
        las = file.read()
    las.classification[:] = 2
    las.write(path)
    changed = cloudpart.read(tmp_path, 2000, before)
    assert changed is not None
    assert (changed.points.columns["classification"] == 2).all()


def test_fewer_points_are_shown_where_the_file_would_be_too_large(processed: Path, tmp_path: Path) -> None:
    subject = Subject(processed, quality_of(processed), read_estimate(processed), [], digests_of(processed))
    large = len(compose(subject, 10**6, 10**8).encode())
    limit = large - len(Elements(compose(subject, 10**6, 10**8)).held["cloud-data"]) // 3
    assert 0.9 * limit < len(compose(subject, 10**6, limit).encode()) <= limit
    few = Elements(report(processed, tmp_path, {"points": 2000}))
    count = np.frombuffer(gzip.decompress(base64.b64decode(few.held["cloud-data"])), "<u4", 1)[0]
    assert 1500 <= count <= 2000
    assert f"{count:,} of " in few.words()


def test_the_same_folder_gives_the_same_bytes(processed: Path, tmp_path: Path) -> None:
    assert report(processed, tmp_path, {}) == (processed / "report.html").read_text()


def hostile(tree: Any, keep: frozenset[str]) -> Any:
    """A tree with words that try to become part of the page, and names of keys that do where they are free."""
    if isinstance(tree, dict):
        return {key: value if key in keep else hostile(value, keep) for key, value in tree.items()}
    if isinstance(tree, list):
        return [hostile(each, keep) for each in tree] + (
            [HOSTILE] if all(isinstance(each, str) for each in tree) else []
        )
    return HOSTILE if isinstance(tree, str) else tree


def test_no_word_of_a_file_becomes_part_of_the_page(processed: Path, tmp_path: Path) -> None:
    quality = quality_of(processed)
    quality["verdict_reasons"] = [{"grade": "bad", "about": "x", "text": "a"}]
    quality["autopilot"]["impossible"][HOSTILE] = 3
    quality["config"][HOSTILE] = {HOSTILE: [HOSTILE]}
    quality["trajectory"]["warning"] = "w"
    seen = {"name": "p", "use": "u", "state": "used", "before_m": 0.1, "after_m": -0.02, "sigma_m": 0.03}
    quality["ins"] = {"control": {
        "points": [seen, {"name": "q", "use": "check", "state": "not seen"}], "note": "n", "rejected": [],
        "used": {"count": 1, "after_rms_m": 0.02, "sigma_m": 0.03}, "check": {"count": 0},
    }}  # fmt: skip
    spoilt = hostile(quality, frozenset({"grade", "method", "left_out"}))
    clean = Elements(report(processed, tmp_path, {"points": 2000}, quality=quality))
    digests = digests_of(processed) | {HOSTILE: HOSTILE}
    found = Elements(report(processed, tmp_path, {"points": 2000}, quality=spoilt, digests=digests))
    assert "alert(1)" in found.words()
    assert {name for name, _ in found.tags} <= {name for name, _ in clean.tags} | {"ul", "li"}
    assert not [name for _, attributes in found.tags for name in attributes if name.startswith("on")]
    assert [name for name, _ in found.tags].count("script") == [name for name, _ in clean.tags].count("script")
    assert "−0.020 m" in clean.words()


def test_a_flight_without_a_cloud_or_rasters_is_told_so(processed: Path, tmp_path: Path) -> None:
    bare, out = tmp_path / "bare", tmp_path / "out"
    shutil.copytree(processed, bare)
    out.mkdir()
    (bare / "cloud.copc.laz").unlink()
    for name in ("dsm.tif", "hillshade.tif", "density.tif"):
        (bare / name).unlink()
    found = Elements(report(bare, out, {}))
    assert "No cloud is shown, because none of the products holds points" in found.words()
    assert "cloud-data" not in found.held


def test_a_report_is_made_again_without_the_logs(processed: Path, tmp_path: Path) -> None:
    folder = tmp_path / "moved"
    shutil.copytree(processed, folder)
    ledger = json.loads((folder / ".swath/ledger.json").read_text())
    for log in ledger["logs"]:
        ledger["files"][log.replace(".mcap", ".gone.mcap")] = ledger["files"].pop(log)
    ledger["logs"] = [log.replace(".mcap", ".gone.mcap") for log in ledger["logs"]]
    (folder / ".swath/ledger.json").write_text(json.dumps(ledger))
    before = (folder / "report.html").read_text()
    assert main(["report", str(folder)]) == 0
    # the log's hash is known by its name, which is another one now
    assert len((folder / "report.html").read_text()) == pytest.approx(len(before), abs=200)


def test_a_report_made_again_is_the_same_and_what_was_changed_is_kept(
    processed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "moved"
    shutil.copytree(processed, folder)
    before = (folder / "report.html").read_text()
    (folder / "report.html").unlink()
    assert main(["report", str(folder)]) == 0
    assert (folder / "report.html").read_text() == before
    assert f"look at {folder / 'report.html'}" in capsys.readouterr().out
    (folder / "report.html").write_text("mine")
    assert main(["report", str(folder)]) == 2
    assert "was changed since it was made here; --force replaces it" in capsys.readouterr().err
    assert (folder / "report.html").read_text() == "mine"
    assert main(["report", str(folder), "--force"]) == 0
    assert (folder / "report.html").read_text() == before
    # and processing goes on from there with nothing to do but what the survey wants
    assert main(["process", str(folder), "--status", "--json"]) == 0
    states = {each["step"]: each["state"] for each in json.loads(capsys.readouterr().out.split("\n", 1)[1])["steps"]}
    assert states["products: report.html"] == "done"


def test_a_folder_without_products_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_printing_without_a_printer_is_one_sentence_and_leaves_the_report_as_it_was(
    processed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "out"
    shutil.copytree(processed, folder)
    before = (folder / "report.html").stat().st_mtime_ns
    monkeypatch.setattr(pdf, "BROWSERS", ("no-such-browser",))
    monkeypatch.setitem(__import__("sys").modules, "weasyprint", None)
    assert main(["report", str(folder), "--pdf"]) == 2
    assert "Chromium (`apt-get install chromium`) or weasyprint (`pip install 'swath[pdf]'`)" in capsys.readouterr().err
    assert (folder / "report.html").stat().st_mtime_ns == before
    assert not (folder / "report.pdf").exists()
    with pytest.raises(UsageError, match="neither is here"):
        pdf.print_pdf(folder / "report.html", folder / "report.pdf")
