"""House rules of numba kernels, and of the constant that stood in a dozen places, read from the source of the package."""

import ast
from functools import cache
from pathlib import Path

import groundproc

PACKAGE = Path(groundproc.__file__).parent
MOST = 8
"""Parameters of a kernel: what belongs together is passed as a named tuple of arrays, with documented fields."""


@cache
def sources() -> list[tuple[str, ast.Module]]:
    return [
        (path.relative_to(PACKAGE).as_posix(), ast.parse(path.read_text())) for path in sorted(PACKAGE.rglob("*.py"))
    ]


@cache
def kernels() -> list[tuple[str, ast.FunctionDef]]:
    """All functions that numba compiles, as "file:name"."""
    return [
        (f"{name}:{node.name}", node)
        for name, tree in sources()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef) and any("njit" in ast.unparse(one) for one in node.decorator_list)
    ]


def parameters(node: ast.FunctionDef) -> list[ast.arg]:
    return [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]


def test_kernels_are_found() -> None:
    assert {"numerics/planeproducts.py:products", "estimation/inertial/kalman.py:smooth"} <= {
        name for name, _ in kernels()
    }


def test_no_kernel_has_more_parameters_than_one_can_keep_apart() -> None:
    assert {name: len(parameters(node)) for name, node in kernels() if len(parameters(node)) > MOST} == {}


def test_the_factor_of_the_median_deviation_stands_in_one_place() -> None:
    found = [
        name
        for name, tree in sources()
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and node.value in (1.4826, 0.6745, 0.67449)
    ]
    assert found == ["numerics/robust.py"]


def test_rooms_of_mathematics_know_no_other_room() -> None:
    """`numerics` imports nothing of the package but itself."""
    for name, tree in sources():
        if name.startswith("numerics/"):
            modules = [node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
            others = [
                one for one in modules if one.startswith("groundproc") and not one.startswith("groundproc.numerics")
            ]
            assert others == [], name
