"""Whether there is room on the disk for what is recorded; logs that were pulled are deleted where there is not."""

import contextlib
import logging
from pathlib import Path
from typing import Final

from onboard import logfolder
from onboard.config import RecorderConfig
from onboard.journal import event
from onboard.logfolder import Space

_log = logging.getLogger(__name__)

_NEWS: Final = {
    Space.ROOM: (logging.WARNING, "there is room on the disk again: everything is recorded"),
    Space.LOW: (logging.ERROR, "space on the disk is low: the lidar is not recorded any more"),
    Space.FULL: (logging.CRITICAL, "the disk is full: the log is closed, nothing is recorded any more"),
}


class SpaceWatch:
    """Looks at the free space, and says when its state changes.

    Parameters
    ----------
    config : RecorderConfig

    Attributes
    ----------
    space : Space
        As it was last seen.
    """

    def __init__(self, config: RecorderConfig) -> None:
        self.space = Space.ROOM
        self._floor_bytes = config.min_free_mb << 20
        self._prunes = config.prune_acknowledged

    def look(self, directory: Path) -> Space:
        """Look at the disk of a folder."""
        if self._prunes and self._judge(directory) is not Space.ROOM:
            with contextlib.suppress(OSError):  # a disk that does not let us delete is told by the writing
                logfolder.prune(directory, lambda: self._judge(directory) is Space.ROOM)
        return self.note(self._judge(directory))

    def note(self, space: Space) -> Space:
        """Take a state, whatever the free space says."""
        if space is not self.space:
            _log.log(*_NEWS[space], extra=event("space", space=space.value))
        self.space = space
        return space

    def _judge(self, directory: Path) -> Space:
        try:
            free_bytes = logfolder.free_bytes(directory)
        except OSError:  # it is made with the next segment, or that says what is wrong
            return Space.ROOM
        return logfolder.space(free_bytes, self._floor_bytes, self.space)
