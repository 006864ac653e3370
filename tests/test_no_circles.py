"""No file imports itself by way of others, be it inside a function or for types only."""

import ast
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ROOMS = ("flightlog", "onboard", "simulator", "groundproc", "benchmarks", "package")


def modules(root: Path) -> dict[str, Path]:
    """Files by the name that imports them."""
    found = {}
    for room in ROOMS:
        for path in (root / room).rglob("*.py"):
            parts = path.relative_to(root).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@cache
def imports(path: Path) -> list[ast.Import | ast.ImportFrom]:
    """All statements of a file that import something, wherever they stand."""
    return [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Import | ast.ImportFrom)]


def imported(path: Path, known: dict[str, Path]) -> set[str]:
    """Files of ours that a file names, wherever the import stands.

    What a package only hands on counts as an import of the file itself: `from room import file`.
    """
    names = set()
    for node in imports(path):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif node.module and not node.level:
            files = {f"{node.module}.{alias.name}" for alias in node.names} & known.keys()
            names.update(files)
            if len(files) < len(node.names):
                names.add(node.module)
    return names & known.keys()


def test_no_circle_of_files() -> None:
    known = modules(ROOT)
    assert len(known) > 700
    graph = {name: imported(path, known) - {name} for name, path in known.items()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail("files that import each other: " + " <- ".join(error.args[1]))


def test_no_import_goes_by_dots() -> None:
    """So that the test above sees every import."""
    dotted = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path in modules(ROOT).values()
        for node in imports(path)
        if isinstance(node, ast.ImportFrom) and node.level
    ]
    assert dotted == []
