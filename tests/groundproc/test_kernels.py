"""House rules of numba kernels, and of the constant that stood in a dozen places, read from the source of the package."""

import ast
from functools import cache
from pathlib import Path

import groundproc

PACKAGE = Path(groundproc.__file__).parent
MOST = 8
"""Parameters of a kernel: what belongs together is passed as a named tuple of arrays, with documented fields."""


@cache
def sources() -> dict[str, str]:
    return {path.relative_to(PACKAGE).as_posix(): path.read_text() for path in sorted(PACKAGE.rglob("*.py"))}


def trees(*words: str) -> list[tuple[str, ast.Module]]:
    """Files that have one of the words in them: parsing all of them takes ten times as long."""
    return [(name, ast.parse(text)) for name, text in sources().items() if any(word in text for word in words)]


@cache
def kernels() -> list[tuple[str, ast.FunctionDef]]:
    """All functions that numba compiles, as "file:name"."""
    return [
        (f"{name}:{node.name}", node)
        for name, tree in trees("njit")
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef) and any("njit" in ast.unparse(one) for one in node.decorator_list)
    ]


def parameters(node: ast.FunctionDef) -> list[ast.arg]:
    return [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]


def test_kernels_are_found() -> None:
    assert {"numerics/planeproducts.py:products", "estimation/inertial/kalman.py:_back"} <= {
        name for name, _ in kernels()
    }


def test_no_kernel_has_more_parameters_than_one_can_keep_apart() -> None:
    assert {name: len(parameters(node)) for name, node in kernels() if len(parameters(node)) > MOST} == {}


def test_the_factor_of_the_median_deviation_stands_in_one_place() -> None:
    found = [
        name
        for name, tree in trees("4826", "6745")
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and node.value in (1.4826, 0.6745, 0.67449)
    ]
    assert found == ["numerics/robust.py"]


def test_rooms_of_mathematics_know_no_other_room() -> None:
    """`numerics` imports nothing of the package but itself."""
    for name, text in sources().items():
        if name.startswith("numerics/"):
            modules = [node.module or "" for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ImportFrom)]
            others = [
                one for one in modules if one.startswith("groundproc") and not one.startswith("groundproc.numerics")
            ]
            assert others == [], name
