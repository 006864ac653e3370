"""Post-processing of a rover's raw observations against a base station, by RTKLIB's programs.

RTKLIB (T. Takasu; Debian's package `rtklib`) converts receivers' files and solves epoch by epoch; forward and backward runs go side
by side and are combined here (`combine`), because RTKLIB's own combination states sigmas that are too small.
"""

import contextlib
import gzip
import os
import re
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.config import option
from flightlog.constants import NS_PER_S
from flightlog.errors import SourceError, SwathError, UsageError
from groundproc import system
from groundproc.files import written_aside
from groundproc.flight.positions import rinex
from groundproc.flight.positions.combine import Combined, combined, refuted
from groundproc.flight.positions.ellipsoid import ecef_from_geodetic, geodetic_from_ecef
from groundproc.flight.positions.rtklib import read_pos, write_pos
from groundproc.flight.positions.solution import Quality, Solution
from groundproc.text import head_of, is_plain, make_plain, open_text

Array = npt.NDArray[np.float64]
Advance = Callable[[float], None]

SOLVER: Final = "rnx2rtkp"
CONVERTER: Final = "convbin"
_SYSTEMS: Final = {"G": 1, "S": 2, "R": 4, "E": 8, "J": 16, "C": 32}
_FREQUENCIES: Final = {1: "l1", 2: "l1+l2", 3: "l1+l2+l5"}
_EPHEMERIS_REACH_NS: Final = 2 * 3600 * NS_PER_S
"""How far from its reference time RTKLIB uses a GPS ephemeris."""
_FEWEST_SATELLITES: Final = 4
_LONG_BASELINE_M: Final = {1: 15_000.0, 2: 50_000.0, 3: 50_000.0}
"""Beyond these the ionosphere no longer cancels, and a fix is luck."""
_PROCESSING: Final = re.compile(rb"processing : (\d{4})/(\d\d)/(\d\d) (\d\d):(\d\d):(\d\d)")
_MESSAGE: Final = re.compile(rb"(?:error|warning)[^\r\n]*", re.IGNORECASE)


class PpkError(SwathError):
    """Observations from which no solution can be made."""


@dataclass(frozen=True, slots=True)
class PpkOptions:
    """What RTKLIB is told; the defaults are for a single-frequency u-blox receiver on a multirotor, some kilometres from its base."""

    frequencies: int = option(1, "1: L1; 2: L1 and L2; 3: L5 as well", minimum=1, maximum=3)
    systems: str = option("GREJC", "GPS, R GLONASS, E Galileo, J QZSS, C BeiDou, S SBAS")
    direction: str = option(
        "combined", "in which the filter runs over the flight", choices=("combined", "forward", "backward")
    )
    ambiguities: str = option(
        "continuous", "how they are resolved", choices=("continuous", "fix-and-hold", "instantaneous", "off")
    )
    ratio: float = option(
        3.0, "a fix must be this much better than the second best ambiguities", minimum=1.0, maximum=100.0
    )
    shortest_fix_s: float = option(
        10.0, "a fix that only one direction finds must last this long [s]", minimum=0.0, maximum=3600.0
    )
    elevation_mask_deg: float = option(15.0, "satellites below are not used [deg]", minimum=0.0, maximum=60.0)
    phase_sigma_m: float = option(
        0.003,
        "carrier phase: its variance is the square of this times 1 + 1/sin(elevation)^2 [m]",
        minimum=0.0005,
        maximum=0.1,
    )
    code_to_phase: float = option(300.0, "sigma of the code over that of the phase", minimum=10.0, maximum=10_000.0)
    longest_age_s: float = option(30.0, "oldest observation of the base that is used [s]", minimum=0.1, maximum=300.0)

    def __post_init__(self) -> None:
        if not self.systems or set(self.systems) - set(_SYSTEMS):
            raise ValueError(f"systems: {self.systems!r} found, expected letters of {''.join(_SYSTEMS)}")

    def lines(self, base: "Base") -> list[str]:
        """RTKLIB's configuration, without the direction.

        Dynamics are off: RTKLIB's model of constant acceleration between epochs biased fixes by centimetres to decimetres on a
        circling rover, with sigmas of millimetres.
        """
        settings = {
            "pos1-posmode": "kinematic",
            "pos1-frequency": _FREQUENCIES[self.frequencies],
            "pos1-elmask": f"{self.elevation_mask_deg:g}",
            "pos1-dynamics": "off",
            "pos1-tidecorr": "off",
            "pos1-ionoopt": "brdc",
            "pos1-tropopt": "saas",
            "pos1-sateph": "brdc",
            "pos1-posopt5": "on",
            "pos1-navsys": str(sum(_SYSTEMS[letter] for letter in set(self.systems))),
            "pos2-armode": self.ambiguities,
            "pos2-gloarmode": "off",
            "pos2-bdsarmode": "on",
            "pos2-arthres": f"{self.ratio:g}",
            "pos2-maxage": f"{self.longest_age_s:g}",
            "stats-eratio1": f"{self.code_to_phase:g}",
            "stats-eratio2": f"{self.code_to_phase:g}",
            "stats-errphase": f"{self.phase_sigma_m:g}",
            "stats-errphaseel": f"{self.phase_sigma_m:g}",
            "out-solformat": "llh",
            "out-outhead": "on",
            "out-outopt": "on",
            "out-outvel": "on",
            "out-outsingle": "on",
            "out-timesys": "gpst",
            "out-timeform": "hms",
            "out-timendec": "6",
            "out-degform": "deg",
            "out-height": "ellipsoidal",
        } | base.settings()
        return [f"{name:<18}={value}" for name, value in settings.items()]


@dataclass(frozen=True, slots=True)
class Base:
    """Where the base station's antenna is.

    Attributes
    ----------
    position : tuple of float, or None
        Latitude, longitude [deg], ellipsoidal height [m].
    averaged : bool
        Without a position: the mean of its own code positions, instead of what its RINEX header says.
    """

    position: tuple[float, float, float] | None = None
    averaged: bool = False

    def settings(self) -> dict[str, str]:
        """RTKLIB's options for it."""
        if self.position is not None:
            values = dict(zip(("ant2-pos1", "ant2-pos2", "ant2-pos3"), map(repr, self.position), strict=True))
            return {"ant2-postype": "llh"} | values
        return {"ant2-postype": "single" if self.averaged else "rinexhead"}

    def source(self) -> str:
        """Who says so."""
        if self.position is not None:
            return "given"
        return "average of its own code positions (metres)" if self.averaged else "header of its RINEX file"


@dataclass(frozen=True, slots=True)
class _Input:
    """A file as RTKLIB gets it: `path` in the working folder, `name` as the user knows it."""

    name: str
    kind: str
    path: Path
    converted: bool = False


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
        inputs = _prepared(rover, base, navigation, folder)
        seen, base_seen, notes = _checked(inputs, where)
        directions = ("forward", "backward") if options.direction == "combined" else (options.direction,)
        *runs, witness = _solve(inputs, folder, directions, options.lines(where), seen, advance)
        both = combined(runs[0], runs[1], options.shortest_fix_s) if len(runs) == 2 else Combined(runs[0], 0, 0, 0)
        solution, wrong = refuted(both.solution, witness)
        solution = replace(solution, source=output.name)
        inputs_named = [item.name for item in inputs]
        summary = _summary(both, wrong, solution, seen, base_seen, where, options, notes)
        with written_aside(output) as aside, aside.open("w", encoding="ascii", newline="\n") as file:
            write_pos(file, solution, _comments(solution, inputs_named, options, where))
    return Processed(solution, summary)


def _tool(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        raise SourceError(f"{name}: is not installed here; apt install rtklib brings it")
    return found


def _prepared(rover: Path, base: Path, navigation: Sequence[Path], folder: Path) -> list[_Input]:
    """Rover, base and navigation as RINEX files in the working folder; converted and unpacked where they must be."""
    _tool(SOLVER)
    inputs = [*_taken(rover, "rover", folder), *_taken(base, "base", folder)]
    for number, path in enumerate(navigation):
        inputs += _taken(path, f"nav{number}", folder)
    for wanted, path in (("rover", rover), ("base", base)):
        if not any(item.kind == "observations" and item.path.stem == wanted for item in inputs):
            raise PpkError(f"{path}: holds no observations, expected RINEX or u-blox RXM-RAWX")
    extra = [item for item in inputs if item.kind == "observations" and item.path.stem not in ("rover", "base")]
    if extra:
        raise PpkError(f"{extra[0].name}: holds observations, expected ephemerides (--nav)")
    return sorted(inputs, key=lambda item: (item.kind != "observations", item.path.stem != "rover"))


def _taken(path: Path, stem: str, folder: Path) -> list[_Input]:
    """One file of the user as what it is, by its content."""
    whole = _unpacked(path, folder / f"{stem}.raw")
    try:
        kind = rinex.kind_of(head_of(whole, 1 << 16))
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from None
    if kind in ("observations", "navigation"):
        link = folder / f"{stem}.{'obs' if kind == 'observations' else 'nav'}"
        if is_plain(whole):
            system.linked(link, whole)
        else:  # RTKLIB looks at columns of plain text
            make_plain(whole, link)
        return [_Input(path.name, kind, link)]
    if kind == "ubx":
        return _converted(path, whole, stem, folder)
    reasons = {
        "compact": "is Hatanaka-compressed RINEX; crx2rnx unpacks it",
        "other_rinex": "is RINEX, but neither observations nor GPS navigation",
        "rtcm3": "is RTCM 3, which does not say its date; convbin -r rtcm3 -tr DATE TIME makes RINEX of it",
    }
    raise PpkError(f"{path}: {reasons.get(kind, 'is nothing that is known')}, expected RINEX 2 or 3 or u-blox UBX")


def _unpacked(path: Path, to: Path) -> Path:
    """The file itself, or what is in it if it is gzip."""
    try:
        with path.open("rb") as file:
            if file.read(2) != b"\x1f\x8b":
                return path
        with gzip.open(path, "rb") as packed, to.open("wb") as plain:
            shutil.copyfileobj(packed, plain, 1 << 20)
    except (EOFError, gzip.BadGzipFile) as error:
        raise PpkError(f"{path}: is a damaged gzip file ({error})") from None
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from None
    return to


def _converted(path: Path, whole: Path, stem: str, folder: Path) -> list[_Input]:
    """RINEX of a u-blox file, by RTKLIB."""
    observed, sent = folder / f"{stem}.obs", folder / f"{stem}.nav"
    words = [
        _tool(CONVERTER),
        "-r",
        "ubx",
        "-v",
        "3.04",
        "-od",
        "-os",
        "-o",
        observed.name,
        "-n",
        sent.name,
        str(whole.resolve()),
    ]
    _run([words], folder, None)
    found = [
        _Input(path.name, kind, made, converted=True)
        for kind, made in (("observations", observed), ("navigation", sent))
        if _has_body(made)
    ]
    if not found:
        raise PpkError(f"{path}: holds neither observations (RXM-RAWX) nor ephemerides (RXM-SFRBX) of u-blox")
    return found


def _has_body(path: Path) -> bool:
    """Whether a RINEX file has anything after its header."""
    if not path.is_file():
        return False
    with open_text(path) as file:
        for line in file:
            if line[60:].startswith("END OF HEADER"):
                return bool(next(file, "").strip())
    return False


def _checked(inputs: Sequence[_Input], where: Base) -> tuple[rinex.Observations, rinex.Observations, list[str]]:
    """Observations of rover and base, found to fit together, and sentences on what is not as it should be."""
    seen, base_seen = (_named(item, rinex.observations) for item in inputs[:2])
    rover_name, base_name = inputs[0].name, inputs[1].name
    overlap_s = (min(seen.end_ns, base_seen.end_ns) - max(seen.start_ns, base_seen.start_ns)) / NS_PER_S
    if overlap_s <= 0:
        raise PpkError(
            f"{base_name}: covers {_stretch(base_seen)}, but the rover {rover_name} {_stretch(seen)}: they do not overlap in time"
        )
    if where.position is None and not where.averaged:
        help_is = "give --base-position, or --base-average for a rough one"
        if inputs[1].converted:
            raise PpkError(f"{base_name}: a UBX file states no surveyed position; {help_is}")
        if base_seen.approximate_m is None:
            raise PpkError(f"{base_name}: its header states no position; {help_is}")
    _check_ephemerides(inputs, seen, rover_name)
    notes = []
    if overlap_s < 0.99 * seen.seconds:
        notes.append(f"the base covers {overlap_s:.0f} s of the rover's {seen.seconds:.0f} s only")
    return seen, base_seen, notes


def _named(item: _Input, read: Callable[[Path], Any]) -> Any:
    """What a reader gives of a file in the working folder; its errors name the user's file."""
    try:
        return read(item.path)
    except SwathError as error:
        raise PpkError(str(error).replace(str(item.path), item.name)) from None


def _check_ephemerides(inputs: Sequence[_Input], seen: rinex.Observations, rover_name: str) -> None:
    sent: list[rinex.Navigation] = [_named(item, rinex.navigation) for item in inputs if item.kind == "navigation"]
    if not sent:
        raise PpkError(
            f"{rover_name}: there is no ephemeris; give a RINEX navigation file with --nav (services of base stations have them)"
        )
    count = sum(item.satellites_near(seen.start_ns, seen.end_ns, _EPHEMERIS_REACH_NS) for item in sent)
    if count < _FEWEST_SATELLITES:
        raise PpkError(
            f"{rover_name}: the navigation files have ephemerides of {count} satellites within 2 h of {_stretch(seen)}, expected "
            f"{_FEWEST_SATELLITES} or more"
        )


def _stretch(seen: rinex.Observations) -> str:
    start, end = (
        np.datetime_as_string(np.datetime64(t, "ns"), "s").replace("T", " ") for t in (seen.start_ns, seen.end_ns)
    )
    return f"{start} to {end}"


def _solve(
    inputs: Sequence[_Input],
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
        commands.append([_tool(SOLVER), "-k", f"{name}.conf", "-o", f"{name}.pos", *files])
    share = None if advance is None else _Share(seen, list(runs), advance)
    messages = _run(commands, folder, share)
    found = []
    for name, message in zip(runs, messages, strict=True):
        made = folder / f"{name}.pos"
        if not made.is_file() or not made.stat().st_size:
            raise PpkError(f"{inputs[0].name}: RTKLIB made no solution ({message or 'it does not say why'})")
        try:
            found.append(read_pos(made))
        except SwathError:
            raise PpkError(
                f"{inputs[0].name}: RTKLIB found no position from {_stretch(seen)}; do rover, base and ephemerides belong together?"
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


def _run(commands: Sequence[Sequence[str]], folder: Path, share: Callable[[int, int], None] | None) -> list[str]:
    """Run programs side by side in a folder; gives the last complaint of each.

    Raises
    ------
    PpkError
        One ends with an error.
    """
    environment = os.environ | {"LC_ALL": "C"}
    with contextlib.ExitStack() as stack:
        running = []
        for words in commands:
            process = subprocess.Popen(
                words,
                cwd=folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
            )
            stack.enter_context(process)
            stack.callback(process.kill)  # does nothing to one that has ended
            running.append(process)
        messages = [""] * len(running)

        def listen(number: int) -> None:
            for message in _words(running[number]):
                at = _PROCESSING.search(message)
                if at is not None and share is not None:
                    share(number, _calendar_ns(at))
                elif _MESSAGE.search(message):
                    messages[number] = message.decode("ascii", errors="replace").strip()

        threads = [threading.Thread(target=listen, args=(number,)) for number in range(len(running))]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        for process, words, message in zip(running, commands, messages, strict=True):
            if process.wait() != 0:
                raise PpkError(
                    f"{Path(words[0]).name}: ended with {process.returncode} ({message or 'it does not say why'})"
                )
    return messages


def _words(process: subprocess.Popen[bytes]) -> Iterator[bytes]:
    """What a program shows on its standard error: pieces that end with a carriage return or a line end."""
    assert process.stderr is not None
    rest = b""
    while chunk := os.read(process.stderr.fileno(), 1 << 16):
        *pieces, rest = re.split(rb"[\r\n]", rest + chunk)
        # of many at once, the last that names an epoch is enough
        yield from (piece for piece in pieces if piece.strip())
    if rest.strip():
        yield rest


def _calendar_ns(found: re.Match[bytes]) -> int:
    year, month, day, hour, minute, second = (int(word) for word in found.groups())
    return int(
        np.datetime64(f"{year:04d}-{month:02d}-{day:02d}T{hour:02d}:{minute:02d}:{second:02d}", "ns").astype(np.int64)
    )


def _comments(solution: Solution, inputs: Sequence[str], options: PpkOptions, where: Base) -> list[str]:
    """Header lines of the output."""
    lines = [f"{'program':<10}: swath ppk, by RTKLIB's {SOLVER}"]
    lines += [f"{'inp file':<10}: {name}" for name in inputs]
    if solution.base_ecef_m is not None:
        latitude, longitude, height = (float(v) for v in geodetic_from_ecef(np.array(solution.base_ecef_m)))
        lines.append(f"{'ref pos':<10}: {latitude:.9f} {longitude:.9f} {height:.4f}")
    # RTKLIB's own word "combined" would say that its sigmas are too small; these are not
    direction = "forward and backward" if options.direction == "combined" else options.direction
    lines.append(f"{'solution':<10}: {direction}")
    return lines + [f"{'option':<10}: {' '.join(line.split())}" for line in options.lines(where)]


def _summary(
    both: Combined,
    wrong: int,
    solution: Solution,
    seen: rinex.Observations,
    base_seen: rinex.Observations,
    where: Base,
    options: PpkOptions,
    notes: Sequence[str],
) -> dict[str, Any]:
    base = np.array(solution.base_ecef_m) if solution.base_ecef_m is not None else np.full(3, np.nan)
    places = ecef_from_geodetic(solution.latitude_deg, solution.longitude_deg, solution.height_m)
    length = np.linalg.norm(places - base, axis=1)
    notes = [*notes]
    if float(np.median(length)) > _LONG_BASELINE_M[options.frequencies]:
        notes.append(
            f"the baseline is {np.median(length) / 1e3:.0f} km long: the ionosphere does not cancel, and fixes may be wrong"
        )
    if where.averaged and where.position is None:
        notes.append("the base's own position is known to metres only, and so is everything here, in one piece")
    if wrong:
        notes.append(
            f"{wrong} positions were metres away from what the code says, and are the code's now: does the receiver report its cycle slips?"
        )
    if not (solution.quality == Quality.FIX).any():
        notes.append("no position is fixed: decimetres at best")
    return {
        "rover_epochs": seen.epochs,
        "base_epochs": base_seen.epochs,
        "positions": len(solution),
        "lost_epochs": max(seen.epochs - len(solution), 0),
        "seconds": round(seen.seconds, 3),
        "quality": {name: round(value, 4) for name, value in solution.shares().items()},
        "sigma_m": _sigmas(solution),
        "directions": {"agreed": both.agreed, "contradicted": both.contradicted, "unsupported": both.unsupported},
        "refuted_by_code": wrong,
        "baseline_m": {
            "shortest": _rounded(length.min()),
            "median": _rounded(np.median(length)),
            "longest": _rounded(length.max()),
        },
        "base": {
            "source": where.source(),
            "position": [round(float(v), 9) for v in geodetic_from_ecef(base)],
        },
        "notes": notes,
    }


def _sigmas(solution: Solution) -> dict[str, dict[str, float]]:
    """Median sigma of each kind, horizontal (of both axes together) and vertical [m]."""
    sigma = solution.sigma_m
    found = {}
    for kind in Quality:
        rows = solution.quality == kind
        if rows.any():
            horizontal = np.hypot(sigma[rows, 0], sigma[rows, 1])
            found[kind.name.lower()] = {
                "horizontal": round(float(np.median(horizontal)), 4),
                "vertical": round(float(np.median(sigma[rows, 2])), 4),
            }
    return found


def _rounded(value: Any) -> float:
    return round(float(value), 3)


def base_position(text: str) -> tuple[float, float, float]:
    """Latitude, longitude [deg] and ellipsoidal height [m] of a text such as 58.39,15.62,80.5.

    Raises
    ------
    UsageError
        It is none.
    """
    try:
        latitude, longitude, height = (float(word) for word in text.split(","))
    except ValueError:
        latitude = longitude = height = float("nan")
    if not (abs(latitude) <= 90 and abs(longitude) <= 360 and -1000 <= height <= 9000):
        raise UsageError(
            f"--base-position {text!r}: expected latitude, longitude in degrees and ellipsoidal height in metres: 58.39,15.62,80.5"
        )
    return latitude, longitude, height
