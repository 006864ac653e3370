import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

from flightlog import records

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def generate() -> ModuleType:
    spec = importlib.util.spec_from_file_location("generate", DOCS / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("page", ["log-format.md", "dimensions.md", "products.md", "survey.md"])
def test_a_page_is_what_its_table_says_now(generate: ModuleType, page: str) -> None:
    assert (DOCS / page).read_text(encoding="utf-8") == generate.PAGES[page]()


def test_the_page_names_every_topic_type_and_field(generate: ModuleType) -> None:
    page = generate.page()
    for row in records.TABLE:
        assert row.topic in page
        assert row.schema in page
        assert row.about in page
    for name in records.LidarAccount.__dataclass_fields__:
        assert re.search(rf"^(uint32|float32) {name}$", page, re.MULTILINE)


@pytest.mark.parametrize("page", sorted(path.name for path in DOCS.glob("*.md")))
def test_links_between_the_pages_lead_somewhere(page: str) -> None:
    text = (DOCS / page).read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)]+)\)", text):
        if target.startswith("http"):
            continue
        path, _, anchor = target.partition("#")
        linked = DOCS / path if path else DOCS / page
        assert linked.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.+)$", linked.read_text(encoding="utf-8"), re.MULTILINE)
            anchors = [re.sub(r"[^\w\- ]", "", heading).strip().lower().replace(" ", "-") for heading in headings]
            assert anchor in anchors, target
