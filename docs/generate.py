"""Writes the pages that are tables of the programs, so that page and programs cannot differ.

log-format.md is made from flightlog/records.py, dimensions.md from groundproc/cloud/dimensions.py, products.md from the registry of
groundproc/products, uses/processing.md from that of groundproc/uses, survey.md from the dataclasses of groundproc/survey, the table in
methods/observations.md from the registry of groundproc/estimation/observations, commands.md from the parsers of the commands.
health.schema.json is made from onboard/health.py, soak.md from the marks in tests/.
Run it after a change of these: python docs/generate.py
"""

import dataclasses
import importlib
import json
import re
import sys
import textwrap
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final

from flightlog.records import FORMAT_VERSION, TABLE, RecordType
from groundproc import products, uses
from groundproc.cloud import dimensions
from groundproc.cloud.dimensions import Dimension
from groundproc.commands.reference import commands_page
from groundproc.estimation import observations
from groundproc.survey import SECTIONS, Survey, sample
from groundproc.survey.dynamic import DynamicOptions
from groundproc.survey.setting import command_of, default_of, value_text
from onboard import healthschema

DOCS: Final = Path(__file__).parent
sys.path.insert(0, str(DOCS))
from soak_page import soak_page  # noqa: E402 - beside this file, which is no package

_RULE: Final = "=" * 80 + "\nMSG: "
_STANDARD: Final = ("std_msgs/Header", "builtin_interfaces/Time")

_HEAD: Final = f"""\
# The flight log

<!-- Made by docs/generate.py from flightlog/records.py: change that, not this. -->

A flight log is an [MCAP](https://mcap.dev/spec) file, format version {FORMAT_VERSION}.
Foxglove, `rosbags` and `mcap-ros2-support` read it as it is.

- **Profile** `ros2`: every channel is CDR (little endian, XCDR1) with its `ros2msg` definition in the file.
- **Log time** of a message is when the last packet or chunk in it was received, on the [log scale](conventions.md#time). The header's
  stamp is the same.
- **Stamps** in records are of the log scale too: `sec`, `nanosec` since 1970. ROS 2 gives `sec` 32 bits, which last until 2038.
- **The sensors' own stamps** are inside their raw bytes, and are never changed.
- **Order** in the file is the order of writing. Topics may be out of step with each other by a batch.
- **Chunks** are of about 1 MiB, with checksums, zstd or as they are. A recorder closes one whenever it syncs to the disk, so a power cut
  costs what came after the last sync.
- **A log without footer** is a log: `LogReader` gives all its whole chunks and says that it was cut off. So is one with a damaged
  stretch: it loses the chunks that the damage touches, and says where.

## Topics
"""

_TAIL: Final = """\
## Metadata

| name | content |
|---|---|
| `swath.log` | `format_version`. A reader refuses a version above its own, and reads every one below. |
| `swath.topics` | What channel number means which topic, and `crc32` of that, at the flushes number 1, 2, 4, 8 and so on: see below. |
| `swath.session` | Who wrote it, which version, where or of which files ([importing.md](importing.md)); `lidar`: [model](sensors.md). |

Of a name that occurs more than once, the last one counts. MCAP itself says the channel numbers in the first chunk and in the summary
only; with `swath.topics` a log that was cut off and lost its first chunk can still be read.

## Attachments

| name | content |
|---|---|
| `mount.yaml` | Where lidar and antenna sit on the airframe. |
| `config.yaml` | The effective configuration of the program that wrote the log. |

Both stand ahead of the first message. A log alone can be processed.

## What a reader must do

- Pass over topics, metadata and attachments that it does not know.
- Take range 0 for no return, whatever the intensity says.
- Take azimuth modulo 36000: the sensor does send 36000.
- Tell packets masked aboard from packets lost with `/lidar_account`, not by their number.
- Cut MAVLink frames out of the joined bytes of a link: a frame may straddle chunks and messages.
"""


def page() -> str:
    """The whole page."""
    return _HEAD + "\n" + _overview() + "\n" + "\n".join(map(_section, TABLE)) + "\n" + _TAIL


def _name(row: RecordType) -> str:
    return row.topic + "NAME" if row.topic.endswith("/") else row.topic


def _overview() -> str:
    rows = [f"| [`{_name(row)}`](#{_anchor(row)}) | `{row.schema}` |" for row in TABLE]
    return "\n".join(["| topic | type |", "|---|---|", *rows, "", "NAME is the link: `ins` measures, `fc` flies.", ""])


def _anchor(row: RecordType) -> str:
    """What GitHub makes of the heading."""
    return _name(row).replace("/", "").lower()


def _section(row: RecordType) -> str:
    message, *others = row.definition.split(_RULE)
    own = [part.split("\n", 1) for part in others if not part.startswith(_STANDARD)]
    parts = [f"### {_name(row)}", "", row.about, "", f"`{row.schema}`", "", "```", message.rstrip("\n"), "```", ""]
    for name, text in own:
        parts += [f"with `{name}`", "", "```", text.rstrip("\n"), "```", ""]
    return "\n".join(parts)


_DIMENSIONS: Final = """\
# Attributes of points

<!-- Made by docs/generate.py from groundproc/cloud/dimensions.py: change that, not this. -->

Every cloud that `swath` writes or reads has its attributes from this table. LAS files are of version 1.4, point format 6; with colours 7,
with near infrared 8. What the standard has no field for is in extra bytes of the same name, whose description in the file says the unit.
A file holds what something filled, and no more. In the program a column has the name and the unit that stand here.

A *step* is the least difference that the file can hold; the value is the stored number times the step.

## Every point
"""

_READING: Final = """\
## Clouds of other programs

LAS and LAZ of every version and point format are read. Fields of the standard are taken as they are. Extra bytes are taken as an attribute
of this table if they have its name, their description states its unit, and its column can hold them. A cloud that is written anew with
other coordinates (`swath adjust`) keeps all its fields and extra bytes, those that stand nowhere here too.
"""

_PRODUCTS: Final = """\
# Products

<!-- Made by docs/generate.py from the registry of groundproc/products: change that, not this. -->

`swath process` makes these. `products` in survey.yaml, or `--products`, chooses:

```yaml
products: [cloud.laz, pictures]
```

A product with options of its own is a mapping of its name to them: `{NAME: {OPTION: VALUE}}`. Whatever is chosen, `trajectory.csv` and
`quality.json` are there. Each product is written aside and gets its name when it is whole; an error says which product it is of. A product
of a method is made only where that method ran.

| name | by default | what it is |
|---|---|---|
"""


def dimensions_page() -> str:
    """docs/dimensions.md."""
    parts = [_DIMENSIONS, _attributes(dimensions.PLACED), "## Attributes\n", _attributes(dimensions.TABLE), _READING]
    return "\n".join(parts)


def _attributes(entries: Iterable[Dimension]) -> str:
    rows = [
        "| name | unit | in the file | step | least | largest | meaning | filled by |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for entry in entries:
        low, high = (f"{value:.7g}" for value in entry.limits()) if entry.stored.kind != "f" else ("", "")
        place = f"`{entry.field}`" if entry.field else "extra bytes"
        step = "" if entry.scale is None else f"{entry.scale:g}"
        about = entry.about + ("" if entry.no_data is None else f" {entry.no_data}: not known.")
        rows.append(
            f"| `{entry.name}` | {entry.unit} | {place}, {entry.dtype} | {step} | {low} | {high} | {about} | {entry.source} |"
        )
    return "\n".join(rows) + "\n"


def products_page() -> str:
    """docs/products.md."""
    rows = [
        f"| `{name}` | {'yes' if entry.by_default else 'no'} | {entry.about} |"
        for name, entry in products.REGISTRY.items()
    ]
    return _PRODUCTS + "\n".join(rows) + "\n"


_USES: Final = """\
# Uses as a part of processing

<!-- Made by docs/generate.py from the registry of groundproc/uses: change that, not this. -->

`swath process` makes these of the finished cloud where the survey asks for them:

```yaml
uses: [ground, {wires: {least_height_m: 5}}]
targets: panels.geojson # of use reflectance
```

On the command line it is `--uses ground,wires`. Each use leaves its files in `uses/` of the flight's folder, and `NAME.json` with what it
found; the report tells of all of them, and shows their rasters. Each is entered in the ledger by itself: one more costs its own work, a
changed option makes that use alone again, and an interrupted run goes on with the next ([processing.md](../processing.md)). What a use
warns of is said at the end. The command of the same name does the same with any cloud.
"""


def uses_page() -> str:
    """docs/uses/processing.md: every use with its files and options."""
    parts = [_USES]
    for each in uses.chosen(list(uses.REGISTRY)):
        parts += [f"## {each.name}\n", f"[{each.name}.md]({each.name}.md). Makes {uses.REGISTRY[each.name].about}.\n"]
        parts += ["| option | default | what it is |", "|---|---|---|", *_nested_rows(each.options[0], ""), ""]
    return "\n".join(parts).rstrip() + "\n"


_KINDS: Final = re.compile(r"(<!-- kinds: [^\n]*-->\n).*?(<!-- end of kinds -->)", re.DOTALL)


def observations_page() -> str:
    """docs/methods/observations.md: the table of kinds within the page as it is."""
    rows = ["| kind | what it is | adjustment | smoother |", "|---|---|---|---|"]
    for name, path in observations.KINDS.items():
        module = importlib.import_module(path)
        used = ["yes" if hasattr(module, function) else "" for function in ("of_run", "of_leg")]
        about = (module.__doc__ or "").partition("\n")[0]
        rows.append(f"| `{name}` | {about} | {used[0]} | {used[1]} |")
    before = (DOCS / "methods/observations.md").read_text(encoding="utf-8")
    return _KINDS.sub(lambda found: found[1] + "\n".join(rows) + "\n" + found[2], before)


_SURVEY: Final = """\
# What you choose: survey.yaml

<!-- Made by docs/generate.py from the dataclasses of groundproc/survey: change those, not this. -->

`swath process LOG -o DIR --config survey.yaml` reads this file. Every key is optional. An option on the command line goes before the file.
`swath init LOG -o survey.yaml` writes one for a flight, with what the log tells about each option. A name of a file in it is looked for
beside it. An unknown key, a value that cannot be, and an option that the chosen method would not look at are errors.

`swath process --help` lists the options of the command line. `swath completion bash` (or `zsh`, `fish`) prints a script that completes
them.
"""


def survey_page() -> str:
    """docs/survey.md: every option, step by step, and the whole file."""
    parts = [_SURVEY]
    for section in SECTIONS:
        assert section.__doc__ is not None
        title, _, about = section.__doc__.splitlines()[0].partition(": ")
        parts += [f"\n## {title}\n", f"{about[0].upper()}{about[1:]}\n"]
        parts += [_option_item(field) for field in dataclasses.fields(section)]
    parts += [
        "",
        "## Method dynamic",
        "",
        "Keys below `dynamic:`.",
        "",
        "| key | default | what it is |",
        "|---|---|---|",
    ]
    parts += _nested_rows(DynamicOptions(), "")
    parts += ["", "## The whole file", "", "```yaml", sample(Survey(), {}).rstrip(), "```", ""]
    return "\n".join(parts)


def _option_item(field: "dataclasses.Field[Any]") -> str:
    """An item of a list, which wraps; a table would not."""
    command, value = command_of(field), default_of(field)
    flag = isinstance(value, bool)
    words = ", ".join(f"`{word}{'' if flag else f' {_value_name(field)}'}`" for word in command.words)
    default = "see below" if dataclasses.is_dataclass(value) else f"default `{value_text(value)}`"
    return f"- `{field.name}` ({'; '.join(filter(None, (words, default)))}): {field.metadata['about']}{_bounds(field)}"


def _value_name(field: "dataclasses.Field[Any]") -> str:
    choices = field.metadata.get("choices")
    return "|".join(choices) if choices else command_of(field).metavar


def _nested_rows(options: Any, above: str) -> list[str]:
    rows: list[str] = []
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if dataclasses.is_dataclass(value):
            rows += _nested_rows(value, f"{field.name}.")
        else:
            rows.append(f"| `{above}{field.name}` | `{value_text(value)}` | {_cell(field)} |")
    return rows


def _cell(field: "dataclasses.Field[Any]") -> str:
    """What an option is, its choices and its bounds, in a table."""
    return f"{field.metadata['about']}{_bounds(field)}".replace("|", "\\|")


def _bounds(field: "dataclasses.Field[Any]") -> str:
    """Choices and bounds of an option, in brackets."""
    rules, found = field.metadata, ""
    if rules.get("choices"):
        found += f" ({', '.join(f'`{choice}`' for choice in rules['choices'])})"
    low, high = rules.get("minimum"), rules.get("maximum")
    if low is not None or high is not None:
        found += f" ({'' if low is None else f'{low:g}'} to {'' if high is None else f'{high:g}'})"
    return found


def health_schema() -> str:
    """health.schema.json, from the records of onboard/health.py."""
    return json.dumps(healthschema.schema(), indent=1) + "\n"


_MARK: Final = re.compile(r" *(?:- |\d+\. )?")
_NO_PROSE: Final = ("|", "#", "```", "<", "    ")


def wrapped(text: str) -> str:
    """A page whose paragraphs and lists have lines of up to 118 characters; tables, headings and code stay."""
    out: list[str] = []
    paragraph: list[str] = []
    code = False

    def flush() -> None:
        if not paragraph:
            return
        found = _MARK.match(paragraph[0])
        mark = found[0] if found else ""
        joined = " ".join(line.strip() for line in paragraph).removeprefix(mark.strip()).strip()
        out.extend(
            textwrap.wrap(
                joined,
                118,
                initial_indent=mark,
                subsequent_indent=" " * len(mark),
                break_long_words=False,
                break_on_hyphens=False,
            )
            if max(map(len, paragraph)) > 118
            else paragraph
        )
        paragraph.clear()

    for line in text.split("\n"):
        code ^= line.startswith("```")
        prose = line.strip() and not code and not line.startswith(_NO_PROSE)
        if not prose or (found := _MARK.match(line)) is None or found[0].strip():
            flush()
        if prose:
            paragraph.append(line)
        else:
            out.append(line)
    flush()
    return "\n".join(out)


_MADE: Final[dict[str, Callable[[], str]]] = {
    "log-format.md": page, "dimensions.md": dimensions_page, "products.md": products_page, "survey.md": survey_page,
    "uses/processing.md": uses_page,
    "methods/observations.md": observations_page, "commands.md": commands_page, "health.schema.json": health_schema,
    "soak.md": soak_page,
}  # fmt: skip
PAGES: Final[dict[str, Callable[[], str]]] = {
    name: (lambda made=made: wrapped(made())) if name.endswith(".md") else made for name, made in _MADE.items()
}


if __name__ == "__main__":
    for name, made in PAGES.items():
        (DOCS / name).write_text(made(), encoding="utf-8")
