"""Asks before something is changed."""

import sys

from flightlog.errors import UsageError


def agreed(what: str, yes: bool) -> bool:
    """Whether the user agrees: said so on the command line, or says so now.

    Raises
    ------
    UsageError
        There is nobody to ask.
    """
    if yes:
        return True
    if not sys.stdin.isatty():
        raise UsageError(f"nothing was changed: say --yes to {what}")
    return input(f"{what}? [y/N] ").strip().lower() in ("y", "yes")
