"""Uses that a survey chooses are made of the flight's cloud, each alone, and told in the report."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from flightlog.errors import CoverageError
from groundproc.cli import main
from groundproc.steps.ledger import INSIDE
from groundproc.uses import REGISTRY, chosen

COMPLETE = (0, 3)
PLAIN = ("--method", "ins", "--products", "cloud.laz,report.html")


@pytest.fixture(scope="module")
def made(dual_flight: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """3 s of flight with two uses."""
    out = tmp_path_factory.mktemp("uses") / "out"
    assert run(dual_flight.log, out, "--uses", "ground,trees") in COMPLETE
    return out


@pytest.fixture
def out(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "out"))


def run(log: Path, out: Path, *words: object) -> int:
    return main(["process", str(log), *PLAIN, *map(str, words), "-o", str(out)])


def finished(out: Path) -> dict[str, str]:
    tree = json.loads((out / INSIDE / "ledger.json").read_text())
    return {name: entry["finished"] for name, entry in tree["steps"].items()}


def test_uses_leave_named_files_with_what_they_found(made: Path) -> None:
    folder = made / "uses"
    assert {path.name for path in folder.iterdir()} == {
        "ground.laz", "ground.json", "dtm.tif", "dtm_sigma.tif", "chm.tif", "buildings.geojson", "trees.geojson", "trees.json",
    }  # fmt: skip
    for name in ("ground", "trees"):
        told = json.loads((folder / f"{name}.json").read_text())
        assert told["use"] == name
        assert told["found"]
        assert set(told["files"]) <= {path.name for path in folder.iterdir()}
    assert json.loads((folder / "ground.json").read_text())["figures"]["points"] > 0


def test_the_report_tells_of_them_and_shows_their_rasters(made: Path) -> None:
    page = (made / "report.html").read_text()
    assert '<section id="uses">' in page
    assert 'data-layer="dtm.tif"' in page


def test_only_the_use_whose_option_changed_is_made_again(dual_flight: Any, out: Path, tmp_path: Path) -> None:
    (tmp_path / "survey.yaml").write_text("uses: [ground, {trees: {least_height_m: 5}}]\n")
    before = finished(out)
    assert run(dual_flight.log, out, "--config", tmp_path / "survey.yaml") in COMPLETE
    after = finished(out)
    assert {name for name in after if after[name] != before[name]} == {
        "uses: trees",
        "quality",
        "products: report.html",
    }


def test_a_use_that_is_not_asked_for_any_more_goes(dual_flight: Any, out: Path) -> None:
    assert run(dual_flight.log, out, "--uses", "trees") in COMPLETE
    assert {path.name for path in (out / "uses").iterdir()} == {"trees.geojson", "trees.json"}


def test_a_use_that_fails_keeps_those_before_it_and_is_named(
    dual_flight: Any, out: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from groundproc.uses import trees

    def refuse(*_: object) -> None:
        raise CoverageError("no luck")

    (out / "uses" / "dtm.tif").unlink()
    (out / "uses" / "trees.geojson").unlink()
    monkeypatch.setattr(trees, "make", refuse)
    assert run(dual_flight.log, out, "--uses", "ground,trees") == 1
    assert capsys.readouterr().err.strip().endswith("trees: no luck")
    assert (out / "uses" / "dtm.tif").exists()
    assert not (out / "uses" / "trees.geojson").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--uses", "gold"), "uses: 'gold' found, expected some of ground, "),
        (("--uses", "trees", "--products", "report.html"), "no product holds the points"),
        (("--uses", "trees", "--targets", "t.geojson"), "nothing uses it"),
        (("--uses", "reflectance", "--targets", "t.geojson"), "t.geojson: no such file"),
    ],
)
def test_what_cannot_be_is_refused_before_the_work(
    dual_flight: Any, tmp_path: Path, words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(dual_flight.log, tmp_path / "out", *words) in (1, 2)
    err = capsys.readouterr().err.strip()
    assert said in err
    assert "\n" not in err
    assert not (tmp_path / "out").exists()


def test_every_use_has_options_that_are_told_of_and_a_page() -> None:
    docs = Path(__file__).parents[3] / "docs" / "uses"
    for each in chosen(list(REGISTRY)):
        assert each.options, each.name
        assert (docs / f"{each.name}.md").is_file()


def test_a_product_beside_the_cloud_leaves_the_uses_as_they_are(dual_flight: Any, out: Path) -> None:
    before = finished(out)
    assert (
        run(dual_flight.log, out, "--uses", "ground,trees", "--products", "cloud.laz,dsm.tif,report.html") in COMPLETE
    )
    after = finished(out)
    assert "place: dsm.tif" in after
    assert {name for name in after if name.startswith("uses")} == {name for name in before if name.startswith("uses")}
    assert all(after[name] == before[name] for name in before if name.startswith("uses"))
