"""The pages of docs/ as a site: whole, without a warning, without anything from another host."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import pytest

from groundproc.cli import OURS, commands
from groundproc.commands import CHAPTERS
from groundproc.commands.reference import READ_ON

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    done = subprocess.run(
        words, cwd=ROOT, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    return folder


class Loads(HTMLParser):
    """What a page makes a browser fetch."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        fetched = tag in ("img", "script", "iframe", "source", "video", "audio", "embed")
        linked = tag == "link" and (given.get("rel") or "") not in ("canonical", "next", "prev", "alternate")
        self.found += [
            value for value in (given.get("src") if fetched else None, given.get("href") if linked else None) if value
        ]


def pages(site: Path) -> Iterator[Path]:
    yield from sorted(site.rglob("*.html"))


def test_no_page_fetches_anything_from_another_host(site: Path) -> None:
    seen = 0
    for page in pages(site):
        loads = Loads()
        loads.feed(page.read_text(encoding="utf-8"))
        assert [address for address in loads.found if re.match(r"(https?:)?//", address)] == [], page
        seen += len(loads.found)
    assert seen > 100
    for style in site.rglob("*.css"):
        assert not re.search(r"url\([\"']?(https?:)?//", style.read_text(encoding="utf-8")), style


def test_what_a_page_fetches_is_there(site: Path) -> None:
    for page in pages(site):
        loads = Loads()
        loads.feed(page.read_text(encoding="utf-8"))
        for address in loads.found:
            where = address.partition("?")[0].partition("#")[0]
            if where and not where.startswith("data:"):
                assert (site / where.lstrip("/") if where.startswith("/") else page.parent / where).is_file(), (
                    page,
                    address,
                )


def test_every_page_is_in_the_menu() -> None:
    menu = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:\n")[2]
    listed = set(re.findall(r"([\w./-]+\.md)", menu))
    assert listed == {str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md")}


def test_every_command_is_in_a_chapter_and_has_a_page_that_names_it() -> None:
    ours = {name for name, point in commands().items() if point.value.partition(".")[0] in OURS}
    assert sorted(name for some in CHAPTERS.values() for name in some) == sorted(ours)
    assert set(READ_ON) == ours
    for name, page in READ_ON.items():
        assert f"swath {name}" in (DOCS / page.partition("#")[0]).read_text(encoding="utf-8"), (name, page)
