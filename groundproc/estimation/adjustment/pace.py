"""Progress of a run: reading and adjusting as one."""

from typing import Final

from groundproc.estimation.method import Progress


class Pace:
    """Tells the progress of reading and adjusting as one: a window's bytes count in part as they are read, in part as it is adjusted.

    Parameters
    ----------
    progress : callable
    """

    READING: Final = 0.4
    """Part of the work that is done while the log is read: the odometry."""
    STEPS: Final = 8
    """Steps that a window takes, or so."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._owed, self._step = 0, 0

    def read(self, stage: str, done: int) -> None:
        """So many bytes more are read."""
        now = round(self.READING * done)
        self._owed += done - now
        self._step = self._owed // self.STEPS
        self._progress(stage, now)

    def stepped(self) -> None:
        """A step of a window is done."""
        self._pay(min(self._step, self._owed))

    def caught_up(self) -> None:
        """A window is done."""
        self._pay(self._owed)

    def _pay(self, done: int) -> None:
        self._owed -= done
        self._progress("adjust", done)


class Part:
    """Tells a share of the progress of a part of the work, so that both parts together tell all of it.

    Parameters
    ----------
    progress : callable
    share : float
    """

    def __init__(self, progress: Progress, share: float) -> None:
        self._progress, self._share = progress, share
        self._all, self._told = 0, 0

    def __call__(self, stage: str, done: int) -> None:
        """So many bytes more are through it."""
        self._all += done
        now = round(self._share * self._all) - self._told
        self._told += now
        self._progress(stage, now)

    def rest(self, stage: str) -> None:
        """The other part is not done: what it would have told."""
        self._progress(stage, self._all - self._told)
