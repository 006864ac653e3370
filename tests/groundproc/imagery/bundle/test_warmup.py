from typing import Any

from groundproc.imagery.bundle import intersection, rows, schur
from groundproc.imagery.bundle.warmup import warm_up


def test_what_a_block_adjustment_runs_is_compiled_beforehand() -> None:
    """Kernels that others call are loaded with those, and then have no signatures of their own."""
    warm_up()
    kernels: list[Any] = [
        intersection._intersect, rows.residuals, schur._reduce, schur._back, schur._point_cofactors
    ]  # fmt: skip
    assert [one.__name__ for one in kernels if not one.signatures] == []
