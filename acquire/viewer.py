"""Look at the newest frame, whichever ring it is in: that of the live view or that of a run."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from acquire.ring import RingReader
from devices.errors import StoreError

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType
    from typing import Self

    from acquire.frame import Frame
    from devices.protocols import Clock

log = logging.getLogger(__name__)
LOOK_AGAIN_S = 0.1


class RingViewer:
    """Copies of the newest frames, for one thread. Holds nobody up; a ring that ends is followed by the next.

    Parameters
    ----------
    where : callable
        Returns the file of the ring in which frames appear now, empty for none.
    """

    def __init__(self, where: Callable[[], str], clock: Clock) -> None:
        self._where = where
        self._clock = clock
        self._reader: RingReader | None = None
        self._refused = ""
        self.received = 0
        self.lost = 0

    def newest(self, timeout_s: float) -> Frame | None:
        """Return the newest frame not seen yet, or None when none came in time."""
        deadline = self._clock.now() + timeout_s
        while True:
            reader = self._follow()
            left_s = deadline - self._clock.now()
            frame = None if reader is None else self._read(reader, max(0.0, min(left_s, LOOK_AGAIN_S)))
            if frame is not None or left_s <= 0:
                return frame
            if reader is None:
                self._clock.sleep(min(left_s, LOOK_AGAIN_S))

    def close(self) -> None:
        """Leave the ring."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _follow(self) -> RingReader | None:
        """Return the reader of the ring in use now, attached anew when it is another one."""
        where = self._where()
        if self._reader is not None and str(self._reader.path) != where:
            self.close()
        if self._reader is None and where:
            try:
                self._reader = RingReader.attach(Path(where), "latest", clock=self._clock)
                self._reader.look_back()
            except StoreError as error:  # it ended a moment ago, or has no room for another reader
                if where != self._refused:  # it is tried again at every look
                    self._refused = where
                    log.info("%s", error.what)
        return self._reader

    def _read(self, reader: RingReader, timeout_s: float) -> Frame | None:
        before = reader.received + reader.lost
        try:
            frame = reader.read(timeout_s)
        except StoreError:  # the writer went away
            self.close()
            return None
        if frame is not None:
            self.received += 1
            self.lost += reader.received + reader.lost - before - 1
        return frame
