"""`swath`: finds its commands by entry points, runs one, and turns errors of the outside world into one sentence."""

import argparse
import atexit
import gc
import os
import re
import signal
import sys
from collections.abc import Sequence
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Final, NoReturn

from groundproc.machine.stopping import Stopped, stoppable

GROUP: Final = "swath.commands"
OURS: Final = ("flightlog", "groundproc", "onboard", "simulator")
_INTERRUPTED: Final = 128 + signal.SIGINT
_BROKEN_PIPE: Final = 128 + 13  # SIGPIPE, which is not on every system
_LONGEST: Final = 4000
"""Characters of a sentence on the terminal."""


@cache
def commands() -> dict[str, EntryPoint]:
    """All commands that installed packages offer, by name."""
    return {point.name: point for point in sorted(entry_points(group=GROUP), key=lambda point: point.name)}


class Parser(argparse.ArgumentParser):
    """Says what is wrong with a command line in one sentence, and what was perhaps meant."""

    def error(self, message: str) -> NoReturn:
        """End with the sentence."""
        self.exit(2, f"{self.prog}: {message}{self._meant(message)}; `{self.prog} --help` lists all\n")

    def _meant(self, message: str) -> str:
        """The nearest of what could have been typed, in words."""
        import difflib

        if found := re.search(r"invalid choice: '(.*)' \(choose from (.*)\)", message):
            typed, known = [found[1]], re.findall(r"'([^']*)'|([\w.-]+)", found[2])
            names = [quoted or plain for quoted, plain in known]
        elif message.startswith("unrecognized arguments: "):
            typed = [word.partition("=")[0] for word in message.split()[2:] if word.startswith("-")]
            names = list(self._option_string_actions)
        else:
            return ""
        near = [name for word in typed for name in difflib.get_close_matches(word, names, 1, 0.6)]
        return f"; did you mean {', '.join(dict.fromkeys(near))}?" if near else ""


def main(argv: Sequence[str] | None = None) -> int:
    """Run `swath` and give its exit code: 0, 1 for what went wrong outside, 2 for a wrong command line."""
    words = list(sys.argv[1:] if argv is None else argv)
    _make_legible()
    if argv is None:  # this is the program, not a call from another one, whose end is its own
        _end_soon()
    try:
        with stoppable():
            code = _dispatch(words)
            sys.stdout.flush()
    except Stopped as stop:
        if stop.number not in (signal.SIGINT, signal.SIGTERM):  # whoever sent those knows
            _say("the processor's time that this process may take (ulimit -t) is used up; nothing half-written is left")
        return 128 + stop.number
    except KeyboardInterrupt:
        return _INTERRUPTED
    except BrokenPipeError:
        # whoever read our output has gone; keep the interpreter from flushing into the broken pipe once more
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _BROKEN_PIPE
    except Exception as error:  # `_outside` raises again what is a mistake of ours
        sentence, code = _outside(error)
        _say(sentence)
    return code


def _end_soon() -> None:
    """At the end of the program the collector looks for rings in all that was loaded, for more than half a second: it is not to."""
    atexit.register(gc.freeze)


def _make_legible() -> None:
    """Signs that the console's encoding lacks are shown by their numbers, so that no sentence ends in an error."""
    for stream in (sys.stdout, sys.stderr):
        reconfigure = getattr(stream, "reconfigure", None)
        if reconfigure is not None and getattr(stream, "errors", "") == "strict":
            reconfigure(errors="backslashreplace")


def _say(sentence: str) -> None:
    """One line on the terminal, whatever the words of a file in it hold."""
    from flightlog.words import clean

    print(f"swath: {clean(sentence, _LONGEST)}", file=sys.stderr)


def _outside(error: Exception) -> tuple[str, int]:
    """Sentence and exit code of an error that is not our own mistake; raises any other again."""
    # imported late: the package loads numpy, which `swath --help` can do without
    from flightlog.errors import SwathError

    if isinstance(error, SwathError):
        return str(error), error.exit_code
    if isinstance(error, ModuleNotFoundError) and error.name and error.name.partition(".")[0] not in OURS:
        return f"{error.name} is not installed; pip install 'swath[ground,simulator]' brings what the commands need", 1
    if isinstance(error, OSError):
        reason = error.strerror or str(error)
        return (f"{error.filename}: {reason}" if error.filename else reason), 1
    if isinstance(error, ValueError) and "null byte" in str(error):  # what open() says of a name
        return "a name of a file that was given, here or in a configuration, holds a zero byte", 2
    raise error


def _dispatch(words: list[str]) -> int:
    if nul := next((word for word in words if "\x00" in word), None):
        from flightlog.errors import UsageError

        raise UsageError(f"{nul!r} found, expected words without zero bytes")
    found = commands()
    if words[:1] == ["help"]:  # as many programs have it
        words = [*words[1:2], "--help"]
    if words and words[0] in found:
        point = found[words[0]]
        module = point.load()
        parser = Parser(prog=f"swath {point.name}", description=module.HELP)
        module.add_arguments(parser)
        arguments = parser.parse_args(words[1:])
        # imported late, as the command itself: `swath --help` can do without
        from groundproc.machine.screen import cleaned

        with cleaned():
            return int(module.run(arguments))
    parser = Parser(
        prog="swath",
        description="Turns flight logs into point clouds.",
        epilog=_listing(found) if not words or {"-h", "--help"} & set(words) else None,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="store_true", help="show the version and exit")
    parser.add_argument("command", nargs="?", metavar="COMMAND", choices=list(found), help="see below")
    if parser.parse_args(words).version:
        print(f"swath {_version()}")
        return 0
    parser.print_help(sys.stderr)
    return 2


def _listing(found: dict[str, EntryPoint]) -> str:
    """One line for each command, by chapters."""
    from groundproc.commands import grouped

    width = max(map(len, found)) + 2
    lines = ["commands (swath COMMAND --help says more):"]
    for chapter, names in grouped(found).items():
        lines += ["", f"{chapter}:"]
        for name in names:
            try:
                about = found[name].load().HELP
            except ImportError as error:
                about = f"not available here: {error}"
            lines.append(f"  {name:<{width}}{about}")
    return "\n".join(lines)


def _version() -> str:
    from flightlog import __version__

    return __version__
