"""`swath compass`: the compass model of several runs, for later ones to begin with."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "learn a compass model (yaw trim over heading) from the trims.csv of several runs of method dynamic"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    from groundproc.commands.outputs import add_force

    parser.add_argument(
        "trims", nargs="+", type=Path, metavar="TRIMS", help="trims.csv of a run, or the folder of its products"
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="the model, such as compass.yaml"
    )
    add_force(parser)
    parser.add_argument(
        "--harmonics", type=int, choices=(0, 1, 2, 3, 4), default=2, help="periods in a full turn; default: 2"
    )


def run(arguments: argparse.Namespace) -> int:
    """Fit and write."""
    from groundproc.commands.inputs import expect
    from groundproc.commands.outputs import claim_file
    from groundproc.estimation.calibration.compass import fit_compass, write_compass
    from groundproc.estimation.dynamic.dynamic import settled_run

    paths = [path / "trims.csv" if path.is_dir() else path for path in arguments.trims]
    expect(paths, ("trims", "table"), "the trims.csv of a run of method dynamic")
    claim_file(arguments.output, (".yaml", ".yml"), arguments.force, paths)
    curve = fit_compass([settled_run(path) for path in paths], arguments.harmonics)
    write_compass(arguments.output, curve)
    print(
        f"{arguments.output}: {curve.runs} runs, {curve.seen:.0%} of all headings seen, "
        f"runs lie {curve.scatter_deg:.2f} deg about the curve\n"
        f"yaw trim [deg] = {_formula(curve.coefficients_deg)}"
    )
    return 0


def _formula(coefficients_deg: tuple[float, ...]) -> str:
    parts = [f"{coefficients_deg[0]:+.2f}"]
    for i, value in enumerate(coefficients_deg[1:]):
        order = i // 2 + 1
        parts.append(f"{value:+.2f} {'sin' if i % 2 == 0 else 'cos'}({'' if order == 1 else order}heading)")
    return " ".join(parts)
