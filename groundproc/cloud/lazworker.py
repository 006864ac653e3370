"""LAZ points unpacked in a process of its own: what the unpacker asks for, and whether it aborts, is then no matter of ours.

Run as a script by `groundproc.cloud.laz`, with the folder of the packages and a JSON object of `Task`'s fields as arguments, and nothing
imported but lazrs: it starts in 30 ms. It shares a memory of two halves with the process that started it. Each line of the standard input,
`HALF COUNT`, asks for the next so many points in one of the halves; `HALF COUNT FIRST` for those from point `FIRST` on; `HALF COUNT PLACE
SIZE` for all points of the one chunk that has so many bytes from there on in the file. `ok` on the standard output says that they are
there, and any other line is an error.
"""

import json
import mmap
import sys
from typing import Any, Final, NamedTuple

_POINTS_PER_CPU_S: Final = 100_000
"""A tenth of what a slow processor unpacks."""
_PATIENCE_CPU_S: Final = 8
_MOST_TEXT: Final = 300


class Task(NamedTuple):
    """What is to be unpacked, and what may be spent on it.

    Attributes
    ----------
    path : str
    offset : int
        Where the points begin in the file [bytes].
    vlr : str
        The record of the file's head that describes its packing, in hexadecimal digits.
    point_bytes : int
    shared : int
        File descriptor of the shared memory.
    half_bytes : int
        Of it.
    memory_bytes : int
        That the process may have.
    parallel : bool
        Unpack chunks side by side, each whole in memory; else one after the other, point by point.
    """

    path: str
    offset: int
    vlr: str
    point_bytes: int
    shared: int
    half_bytes: int
    memory_bytes: int
    parallel: bool


def _answer(text: str) -> None:
    sys.stdout.write(" ".join(text.split())[:_MOST_TEXT] + "\n")
    sys.stdout.flush()


def _allow(points: int) -> None:
    """Let the processor's time for the next points run from now."""
    import resource  # not on every system, and where it is not, nobody runs this

    used = resource.getrusage(resource.RUSAGE_SELF)
    end = int(used.ru_utime + used.ru_stime) + _PATIENCE_CPU_S + points // _POINTS_PER_CPU_S
    _limit(resource.RLIMIT_CPU, end)


def _limit(kind: int, value: int) -> None:
    """Set a limit, no higher than what this process may have at all, such as under `ulimit` or a batch system."""
    import resource

    most = resource.getrlimit(kind)[1]
    resource.setrlimit(kind, (value if most == resource.RLIM_INFINITY else min(value, most), most))


def _unpack(task: Task) -> None:
    import lazrs

    kind: Any = lazrs.ParLasZipDecompressor if task.parallel else lazrs.LasZipDecompressor
    packing = bytes.fromhex(task.vlr)
    with open(task.path, "rb") as file, mmap.mmap(task.shared, 2 * task.half_bytes) as shared:  # noqa: PTH123 - pathlib costs 10 ms
        file.seek(task.offset)
        unpacker: Any = None
        for line in sys.stdin:
            half, count, *where = map(int, line.split())
            _allow(count)
            begin = half * task.half_bytes
            with memoryview(shared) as whole, whole[begin : begin + count * task.point_bytes] as place:
                if len(where) == 2:
                    file.seek(where[0])
                    packed = file.read(where[1])
                    lazrs.decompress_points_with_chunk_table(packed, packing, place, [(count, len(packed))])
                else:
                    unpacker = unpacker or kind(file, packing)
                    if where:
                        unpacker.seek(where[0])
                    unpacker.decompress_many(place)
            _answer("ok")


def main() -> None:
    """Unpack until there is nothing more to read."""
    sys.path.append(sys.argv[1])
    task = Task(**json.loads(sys.argv[2]))
    import resource

    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _limit(resource.RLIMIT_AS, task.memory_bytes)
    try:
        _unpack(task)
    except BaseException as error:
        _answer(f"{type(error).__name__}: {error}")
        sys.exit(1)


if __name__ == "__main__":
    main()
