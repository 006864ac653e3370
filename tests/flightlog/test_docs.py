import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest
from mcap.reader import make_reader
from mcap_ros2._vendor.rosidl_adapter.parser import parse_message_string

from flightlog import records
from flightlog.logwriter import LogWriter

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def generate() -> ModuleType:
    spec = importlib.util.spec_from_file_location("generate", DOCS / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    "page", ["log-format.md", "dimensions.md", "products.md", "survey.md", "methods/observations.md"]
)
def test_a_page_is_what_its_table_says_now(generate: ModuleType, page: str) -> None:
    assert (DOCS / page).read_text(encoding="utf-8") == generate.PAGES[page]()


Fields = list[tuple[str, str, str]]
"""Name, type as ROS 2 writes it, and the unit that the comment ahead of it gives; empty: none."""


def documented() -> dict[str, tuple[str, Fields, dict[str, Fields]]]:
    """Of each topic of the committed page, read as a reader would: its type, its fields, and those of the types within."""
    text = (DOCS / "log-format.md").read_text(encoding="utf-8").partition("## Topics")[2].partition("\n## ")[0]
    found = {}
    for section in text.split("\n### ")[1:]:
        topic, _, body = section.partition("\n")
        blocks = re.findall(r"^(?:with )?`([^`\n]+)`\n\n```\n(.*?)\n```$", body, re.MULTILINE | re.DOTALL)
        (schema, fields), *others = [(name, fields_of(block)) for name, block in blocks]
        found[topic] = schema, fields, dict(others)
    return found


def fields_of(block: str) -> Fields:
    fields, comment = [], ""
    for line in block.splitlines():
        if line.startswith("#"):
            comment = f"{comment} {line.removeprefix('#').strip()}".strip()
        else:
            kind, name = line.split()
            unit = re.search(r"\[(.+?)\]", comment)
            fields.append((name, kind, unit[1] if unit else ""))
            comment = ""
    return fields


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[str, str]]:
    """Type and definition by topic, as the mcap library reads them from a log with one message of each topic."""
    path = tmp_path_factory.mktemp("docs") / "all.mcap"
    with path.open("wb") as stream:
        writer = LogWriter(stream, metadata={}, attachments={})
        for row in records.TABLE:
            writer.write(row.topic + "ins" * row.topic.endswith("/"), 1, b"\0\1\0\0")
        writer.finish()
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
    return {
        channel.topic: (summary.schemas[channel.schema_id].name, summary.schemas[channel.schema_id].data.decode())
        for channel in summary.channels.values()
    }


def test_the_page_says_what_others_read_in_a_log(recorded: dict[str, tuple[str, str]]) -> None:
    """Names, types, order and units of the committed page against a log as the parsers of mcap and mcap_ros2 see it."""
    page = documented()
    assert {topic.replace("NAME", "ins") for topic in page} == set(recorded)
    for topic, (schema, fields, others) in page.items():
        name, definition = recorded[topic.replace("NAME", "ins")]
        assert schema == name
        messages = dict(each.split("\n", 1) for each in definition.split("=" * 80 + "\nMSG: ")[1:])
        messages[schema] = definition.partition("=" * 80)[0]
        for each, expected in {schema: fields, **others}.items():
            package = each.partition("/")[0]
            parsed = parse_message_string(package, each.rpartition("/")[2], messages[each])
            assert expected == [
                (field.name, str(field.type).removeprefix(f"{package}/"), field.annotations.get("unit", ""))
                for field in parsed.fields
            ], each
        # every type within is on the page too, but the two that ROS 2 brings
        assert set(messages) - {schema} - {"std_msgs/Header", "builtin_interfaces/Time"} == set(others)


def test_every_quantity_of_the_page_has_its_unit() -> None:
    """What ends in _ns, _deg or _ppm is in that, by its own comment or by that of the first of several that stand together."""
    units = {"ns": "ns", "deg": "deg", "ppm": "1e-6"}
    for _, fields, others in documented().values():
        for each in (fields, *others.values()):
            last = ""
            for name, _, unit in each:
                last = unit or last
                if (ending := name.rpartition("_")[2]) in units:
                    assert last == units[ending], name


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
