"""Post-processing of a rover's raw observations against a base station, by RTKLIB's programs.

RTKLIB (T. Takasu; Debian's package `rtklib`) converts receivers' files and solves epoch by epoch; forward and backward runs go side
by side and are combined here (`combine`), because RTKLIB's own combination states sigmas that are too small.
"""

import tempfile
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from flightlog.errors import SwathError
from groundproc.files import written_aside
from groundproc.flight.positions import rinex
from groundproc.flight.positions.combine import Combined, combined, refuted
from groundproc.flight.positions.ppkinputs import Input, checked, prepared, stretch
from groundproc.flight.positions.ppkoptions import Base, PpkError, PpkOptions
from groundproc.flight.positions.ppkrunning import SOLVER, run, tool
from groundproc.flight.positions.ppksummary import comments, summary_of
from groundproc.flight.positions.rtklib import read_pos
from groundproc.flight.positions.rtklibwriter import write_pos
from groundproc.flight.positions.solution import Solution

Advance = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class Processed:
    """What came of it.

    Attributes
    ----------
    solution : Solution
    summary : dict
        Plain figures for people and JSON.
    """

    solution: Solution
    summary: dict[str, Any]


def process(
    rover: Path,
    base: Path,
    navigation: Sequence[Path],
    output: Path,
    where: Base,
    options: PpkOptions,
    advance: Advance | None = None,
) -> Processed:
    """Solve a rover's path against a base station and write it as an RTKLIB .pos.

    Parameters
    ----------
    rover, base : Path
        RINEX observations (2 or 3, .gz too), or a u-blox receiver's UBX messages (RXM-RAWX).
    navigation : sequence of Path
        RINEX navigation files; what UBX files hold (RXM-SFRBX) is used as well.
    output : Path
        Written whole or not at all.
    where : Base
    options : PpkOptions
    advance : callable, optional
        Told the share of the work done since it was told last.

    Raises
    ------
    SourceError
        RTKLIB is not installed, or a file cannot be read or written.
    PpkError
        The files lack observations, ephemerides or a base position, do not overlap in time, or RTKLIB finds no position.
    """
    with tempfile.TemporaryDirectory(prefix="swath-ppk-") as name:
        folder = Path(name)
        inputs = prepared(rover, base, navigation, folder)
        seen, base_seen, notes = checked(inputs, where)
        directions = ("forward", "backward") if options.direction == "combined" else (options.direction,)
        *runs, witness = _solve(inputs, folder, directions, options.lines(where), seen, advance)
        both = combined(runs[0], runs[1], options.shortest_fix_s) if len(runs) == 2 else Combined(runs[0], 0, 0, 0)
        solution, wrong = refuted(both.solution, witness)
        solution = replace(solution, source=output.name)
        inputs_named = [item.name for item in inputs]
        summary = summary_of(both, wrong, solution, seen, base_seen, where, options, notes)
        with written_aside(output) as aside, aside.open("w", encoding="ascii", newline="\n") as file:
            write_pos(file, solution, comments(solution, inputs_named, options, where))
    return Processed(solution, summary)


def _solve(
    inputs: Sequence[Input],
    folder: Path,
    directions: Sequence[str],
    lines: Sequence[str],
    seen: rinex.Observations,
    advance: Advance | None,
) -> list[Solution]:
    """A solution of each direction, and one of the code alone that bears witness; they run side by side."""
    code = [line for line in lines if not line.startswith(("pos1-posmode", "pos2-armode"))]
    runs = {direction: [*lines, f"{'pos1-soltype':<18}={direction}"] for direction in directions}
    runs["code"] = [*code, f"{'pos1-posmode':<18}=dgps", f"{'pos1-soltype':<18}=forward"]
    commands = []
    for name, settings in runs.items():
        (folder / f"{name}.conf").write_text("\n".join([*settings, ""]), encoding="ascii")
        files = [item.path.name for item in inputs]
        commands.append([tool(SOLVER), "-k", f"{name}.conf", "-o", f"{name}.pos", *files])
    share = None if advance is None else _Share(seen, list(runs), advance)
    messages = run(commands, folder, share)
    found = []
    for name, message in zip(runs, messages, strict=True):
        made = folder / f"{name}.pos"
        if not made.is_file() or not made.stat().st_size:
            raise PpkError(f"{inputs[0].name}: RTKLIB made no solution ({message or 'it does not say why'})")
        try:
            found.append(read_pos(made))
        except SwathError:
            raise PpkError(
                f"{inputs[0].name}: RTKLIB found no position from {stretch(seen)}; do rover, base and ephemerides belong together?"
            ) from None
    return found


class _Share:
    """Turns the epochs that RTKLIB says it processes into shares of the whole work."""

    def __init__(self, seen: rinex.Observations, runs: Sequence[str], advance: Advance) -> None:
        self._seen, self._runs, self._advance = seen, runs, advance
        self._lock = threading.Lock()
        self._done = [0.0] * len(runs)

    def __call__(self, run: int, time_ns: int) -> None:
        """A run is at an epoch [ns]; a backward one counts from the end."""
        passed = (time_ns - self._seen.start_ns) / max(self._seen.end_ns - self._seen.start_ns, 1)
        part = min(max(1.0 - passed if self._runs[run] == "backward" else passed, 0.0), 1.0)
        with self._lock:
            if part > self._done[run]:
                self._advance((part - self._done[run]) / len(self._runs))
                self._done[run] = part
