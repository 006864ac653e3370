"""The page of the long tests: what stands beside the mark in each file of tests."""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

TESTS: Final = Path(__file__).parents[1] / "tests"

_HEAD: Final = """\
# The long tests

<!-- Made by docs/generate.py from the marks in tests/: change those, not this. -->

`make soak` runs what is too long for every change: flights of an hour, many seeds, the second and third variant of what
`make check` shows on one. Beside each stands why it is long and, where it is a finer look at something, what the quick
suite has of it. "Some cases": others of the same test are in the quick suite.

"""


@dataclass(frozen=True, slots=True)
class Long:
    """A test, or some cases of one, of the soak."""

    name: str
    some: bool
    why: str


def soak_page() -> str:
    """docs/soak.md."""
    parts = [_HEAD]
    for path in sorted(TESTS.rglob("test_*.py")):
        found = list(_long(path.read_text(encoding="utf-8")))
        if found:
            parts.append(f"## {path.relative_to(TESTS).as_posix()}\n\n")
            parts += [f"- **{_words(each)}**{': ' + each.why if each.why else ''}\n" for each in found]
            parts.append("\n")
    return "".join(parts).rstrip("\n") + "\n"


def _words(test: Long) -> str:
    said = test.name.removeprefix("test_").replace("_", " ")
    return f"{said}, some cases" if test.some else said


def _long(text: str) -> Iterator[Long]:
    tree, lines = ast.parse(text), text.splitlines()
    whole = next(
        (node for node in tree.body if isinstance(node, ast.Assign) and _sets_marks(node) and _soaks(text, node)), None
    )
    # marks with a name of their own: NAME = pytest.mark.soak, NAME = pytest.param(..., marks=pytest.mark.soak)
    named = {
        target.id: _said_of(tree, node)
        for node in tree.body
        if isinstance(node, ast.Assign) and not _sets_marks(node) and _soaks(text, node)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
            marks = [each for each in node.decorator_list if _soaks(text, each) or _names(each) & named.keys()]
            if whole or marks:
                # comments within the mark go before those above it
                first = min((each.lineno for each in node.decorator_list), default=node.lineno)
                last = max((each.end_lineno or 0 for each in marks), default=first)
                why = _comments(lines[first - 1 : last]) or _comments(_above(lines, first - 1))
                why = why or (_comments(_above(lines, whole.lineno - 1)) if whole else "")
                why = why or "".join(named[name] for each in marks for name in sorted(_names(each) & named.keys()))
                some = bool(marks) and not any(ast.unparse(each) == "pytest.mark.soak" for each in marks)
                yield Long(node.name, some, why)


def _sets_marks(node: ast.Assign) -> bool:
    return any(isinstance(target, ast.Name) and target.id == "pytestmark" for target in node.targets)


def _soaks(text: str, node: ast.AST) -> bool:
    return "mark.soak" in (ast.get_source_segment(text, node) or "")


def _names(node: ast.AST) -> set[str]:
    return {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}


def _said_of(tree: ast.Module, node: ast.Assign) -> str:
    """The string below an assignment."""
    after = tree.body[tree.body.index(node) + 1 :][:1]
    for each in after:
        if isinstance(each, ast.Expr) and isinstance(each.value, ast.Constant) and isinstance(each.value.value, str):
            return " ".join(each.value.value.split())
    return ""


def _above(lines: list[str], row: int) -> list[str]:
    """Comments right above a line."""
    first = row
    while first > 0 and lines[first - 1].startswith("#"):
        first -= 1
    return lines[first:row]


def _comments(lines: list[str]) -> str:
    """What comments say, in one line; rulers between parts of a file and words to checkers are none."""
    found = [match[1] for line in lines if (match := re.search(r"(?:^|\s)# (.*)", line))]
    return " ".join(text for text in found if not re.search(r"-{3}|^(noqa|type:|fmt:)", text)).strip()
