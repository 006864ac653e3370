"""Progress bars for long reads, on a terminal only; and what a first use spends on compiling."""

import contextlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from tqdm import tqdm

COMPILING: Final = "compiling (first use)"


@contextlib.contextmanager
def compiling(show: Callable[[bool], None]) -> Iterator[None]:
    """Tell when kernels are compiled: show(True) when that begins, show(False) when it is done.

    What the cache of an earlier run holds is loaded, and not told of.
    """
    try:
        from numba.core import event
    except ModuleNotFoundError:  # nothing to compile, then
        yield
        return

    class Listener(event.Listener):
        depth = 0  # one kernel calls for the next

        def on_start(self, _: Any) -> None:
            self.depth += 1
            if self.depth == 1:
                show(True)

        def on_end(self, _: Any) -> None:
            self.depth -= 1
            if self.depth == 0:
                show(False)

    with event.install_listener("numba:compile", Listener()):
        yield


@contextlib.contextmanager
def stages(
    logs: Sequence[Path], names: Mapping[str, str], counted: Mapping[str, str] = MappingProxyType({})
) -> Iterator[Callable[[str, int], None]]:
    """A function that is told (stage, bytes of the logs done); it shows one bar after the other, and where it waits for the compiler.

    Stages that are `counted` are told of pieces of whatever kind; how many there are is not known.
    """
    named = {**names, **counted}
    total = sum(path.stat().st_size for path in logs if path.is_file())
    bars: dict[str, Any] = {}

    def begin(stage: str, name: str) -> None:
        for bar in bars.values():
            bar.close()
        whole, unit = (None, "") if stage in counted else (total, "B")
        bars[stage] = tqdm(
            total=whole, unit=unit, unit_scale=True, desc=name, leave=False, disable=not sys.stderr.isatty()
        )

    def advance(stage: str, done: int) -> None:
        if stage not in bars:
            begin(stage, named[stage])
        bars[stage].update(done)

    def show(compiles: bool) -> None:
        if not bars:
            begin("", COMPILING)
        bar = next(reversed(bars.values()))
        bar.set_postfix_str(COMPILING if compiles and bar is not bars.get("") else "", refresh=True)

    try:
        with compiling(show):
            yield advance
    finally:
        for bar in bars.values():
            bar.close()
