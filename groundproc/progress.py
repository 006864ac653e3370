"""Progress bars for long reads, on a terminal only."""

import contextlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm


@contextlib.contextmanager
def stages(logs: Sequence[Path], names: Mapping[str, str]) -> Iterator[Callable[[str, int], None]]:
    """A function that is told (stage, bytes of the logs done); it shows one bar after the other."""
    total = sum(path.stat().st_size for path in logs if path.is_file())
    bars: dict[str, Any] = {}

    def advance(stage: str, done: int) -> None:
        if stage not in bars:
            for bar in bars.values():
                bar.close()
            bars[stage] = tqdm(
                total=total, unit="B", unit_scale=True, desc=names[stage], leave=False, disable=not sys.stderr.isatty()
            )
        bars[stage].update(done)

    try:
        yield advance
    finally:
        for bar in bars.values():
            bar.close()
