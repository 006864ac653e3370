"""A picture of profiles: height over the way, a panel a line, a curve a source."""

from collections.abc import Sequence
from pathlib import Path

from groundproc.analysis.profile import Profile
from groundproc.files import written_aside


def draw(path: Path, profiles: Sequence[Profile]) -> None:
    """Draw them; of clouds the band from the lowest to the highest point too."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    names = list(dict.fromkeys(each.line.name for each in profiles))
    figure, panels = plt.subplots(len(names), 1, figsize=(10.0, min(3.2 * len(names) + 0.6, 60.0)), squeeze=False)
    for axes, name in zip(panels[:, 0], names, strict=True):
        for number, each in enumerate(some for some in profiles if some.line.name == name):
            along, colour = each.line.along_m, f"C{number}"
            if len(each.count):
                axes.fill_between(along, each.lowest_m, each.highest_m, color=colour, alpha=0.2, linewidth=0)
            axes.plot(along, each.height_m, color=colour, linewidth=1.2, label=each.source)
        axes.set_title(name, loc="left", fontsize=10)
        axes.set_ylabel("height [m]")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    panels[-1, 0].set_xlabel("along the line [m]")
    figure.tight_layout()
    with written_aside(path) as aside:
        figure.savefig(aside, format="png", dpi=110)
    plt.close(figure)
