"""MAVLink links, serial or UDP: bytes are logged as received, and parsed only to see if the autopilot is alive.

The link may come and go: it is reopened as often as needed, and the rest of the daemon does not notice.
"""

import logging
import select
import time
from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog import records
from flightlog.constants import NS_PER_MS
from flightlog.errors import SourceError
from flightlog.mavlink import Frame, FrameParser
from flightlog.signing import Checker, Word, read_key, time_of
from onboard.autopilotclock import AutopilotClock
from onboard.backlog import Put
from onboard.config import LinkConfig
from onboard.linkcounts import LinkCounts, note_frames
from onboard.requester import Requester
from onboard.sources import Chunk, Source, UdpSource, open_source
from onboard.timesync import LogTime, read_clocks
from onboard.voice import Voice
from onboard.worker import Worker

_log = logging.getLogger(__name__)

BATCH_NS: Final = 100 * NS_PER_MS
"""A message of the log spans about this much."""
_WAIT_S: Final = 0.1
_RETRY_S: Final = (0.5, 1.0, 2.0, 5.0)

_OUTBOX: Final = 20
"""Messages that wait to be sent; while the link is down the oldest go."""


class Link(Worker):
    """Reads one MAVLink link into the log.

    Parameters
    ----------
    name : str
        `ins` or `fc`; its topic is /mavlink/<name>.
    config : LinkConfig
    log_time : LogTime
    put : callable
        The recorder's.
    """

    def __init__(self, name: str, config: LinkConfig, log_time: LogTime, put: Put) -> None:
        super().__init__(name)
        self.counts = LinkCounts()
        self._config, self._log_time, self._put = config, log_time, put
        self._topic = records.MAVLINK.topic + name
        self._chunks: list[Chunk] = []
        self._parser = FrameParser()
        key = None if config.signing_key is None else read_key(Path(config.signing_key))
        self._checker = None if key is None else Checker(key)
        self._voice = Voice(key)
        self._requester = Requester(config.streams, self._voice)
        self.clock = AutopilotClock(name)
        self._outbox: deque[dialect.MAVLink_message] = deque(maxlen=_OUTBOX)

    def tell(self, messages: Iterable[dialect.MAVLink_message]) -> None:
        """Send messages to the autopilot and through it to the ground, if it listens."""
        if self.listens:
            self._outbox.extend(messages)

    @property
    def listens(self) -> bool:
        """Whether this is a link to talk on, and an autopilot is heard on it."""
        return self._config.requests and self.counts.connected and self.counts.autopilot is not None

    def work(self) -> None:
        """Open, read, open again, until asked to stop."""
        tries = 0
        while not self.stopping:
            try:
                source = open_source(self._config, self._log_time)
            except SourceError as error:
                self._tell_trouble(str(error))
                self._wait(_RETRY_S[min(tries, len(_RETRY_S) - 1)])
                tries += 1
                continue
            tries = 0
            self._tell_connected()
            try:
                self._read(source)
            except OSError as error:
                self._tell_trouble(f"{self._config.device}: {error.strerror or error}")
                self._wait(_RETRY_S[0])
            finally:
                self._hand_over()
                self.counts.connected = False
                source.close()

    def _wait(self, seconds: float) -> None:
        """Wait between two attempts without looking dead."""
        for _ in range(round(seconds / _WAIT_S)):
            self.progress()
            self.pause(_WAIT_S)

    def _read(self, source: Source) -> None:
        poll = select.poll()
        poll.register(source.fileno(), select.POLLIN)
        while not self.stopping:
            if poll.poll(_WAIT_S * 1000):
                self._take(source.read())
            now_ns = self._log_time.at(read_clocks())
            if self._chunks and now_ns - self._chunks[0][0] >= BATCH_NS:
                if isinstance(source, UdpSource):
                    self.counts.kernel_drops = source.drops
                self._hand_over()
            if self._config.requests:
                self._talk(source, now_ns)
            self.progress()
            self.pause(source.pause_s)
        if poll.poll(0):  # reading nothing from a serial device looks like its end
            self._take(source.read())

    def _take(self, chunks: list[Chunk]) -> None:
        """Keep the chunks for the log, and examine the frames in them."""
        self._chunks += chunks
        for time_ns, data in chunks:
            frames = self._believed(self._parser.feed(time_ns, data))
            note_frames(self.counts, frames)
            for frame in frames:
                if frame.known and (frame.system, frame.component) == self.counts.autopilot:
                    answer = self.clock.hear(frame)
                    if answer is not None:
                        self.tell([answer])
        self.counts.bad_bytes = self._parser.bad_bytes
        self.counts.unknown_frames = self._parser.unknown

    def _believed(self, frames: list[Frame]) -> list[Frame]:
        """Those frames that nobody else can have sent; where there is no key, all."""
        if self._checker is None:
            return frames
        good = [frame for frame in frames if frame.known and self._checker.check(frame) is Word.GOOD]
        self.counts.signatures = {word.value: count for word, count in self._checker.counts.items()}
        self._voice.sign_from(self._checker.newest + 1)
        return good

    def _talk(self, source: Source, now_ns: int) -> None:
        """Send what is due."""
        if self._checker is not None:
            self._voice.sign_from(time_of(time.time_ns()))
        for data in self._requester.due(self.counts, now_ns):
            source.write(data)
        if self.counts.autopilot is None:
            return
        system, version = self.counts.autopilot[0], self.counts.version
        while self._outbox:
            source.write(self._voice.frame(self._outbox.popleft(), system, version))
        sent_ns = self._log_time.at(read_clocks())
        if (question := self.clock.question(sent_ns)) is not None:
            source.write(self._voice.frame(question, system, version))

    def _hand_over(self) -> None:
        """Give the chunks to the recorder."""
        if not self._chunks:
            return
        chunks, self._chunks = self._chunks, []
        stamp_ns = chunks[-1][0]
        size = sum(len(data) for _, data in chunks)
        self.counts.received_bytes += size
        if not self._put(self._topic, stamp_ns, records.encode_raw(stamp_ns, chunks, self.name), True):
            self.counts.queue_dropped_bytes += size

    def _tell_trouble(self, sentence: str) -> None:
        if sentence != self.counts.trouble:
            _log.warning("link %s: %s; trying again", self.name, sentence)
        self.counts.trouble = sentence

    def _tell_connected(self) -> None:
        self.counts.connected, self.counts.trouble = True, ""
        self.counts.opened += 1
        self._requester.start()
        _log.info("link %s: %s is open", self.name, self._config.device)
