"""Writes docs/log-format.md from the table of records, so that the page and the programs cannot differ.

Run it after a change of flightlog/records.py: python docs/generate.py
"""

from pathlib import Path
from typing import Final

from flightlog.records import FORMAT_VERSION, TABLE, RecordType

PAGE: Final = Path(__file__).with_name("log-format.md")

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
| `swath.session` | Who wrote the log, with which version, on what host or from which files; `lidar`: its [model](sensors.md). |

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


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
