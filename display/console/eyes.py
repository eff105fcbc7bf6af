"""The newest frames and what can be read off each, in a thread of its own that looks and never disturbs."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from acquire.measures import focus_energy
from acquire.viewer import RingViewer
from devices.clock import SystemClock
from display.console.contrast import Histogram

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.client import Instrument
    from acquire.frame import Frame, FrameHeader
    from acquire.preview_viewer import PreviewViewer
    from devices.protocols import Clock

LOOK_S, DARK_S = 0.015, 0.1  # between looks, while frames may come and while none can
STILL_S = 1.0
BINS = 256
EIGHT_BITS = 255
TREND = 120  # frames
KEPT_BYTES = 1 << 30
SCORED_PX = 512


@dataclass(frozen=True, eq=False)
class Seen:
    """One frame and what was read off it.

    Attributes
    ----------
    number : int
        Counts the frames this console saw.
    over, under : float
        Share of all pixels at the top of the camera's scale, and at 0.
    score : float
        How sharp the middle of the frame is; comparable between frames of one specimen.
    mean, sd : float
        Mean and standard deviation of all its grey levels, bands together.
    """

    number: int
    pixels: np.ndarray
    header: FrameHeader
    histogram: Histogram
    over: float
    under: float
    score: float
    mean: float
    sd: float


def histogram_of(pixels: np.ndarray, top: int) -> Histogram:
    """Return the histogram of every pixel, bands together."""
    counts = cv2.calcHist([pixels.reshape(pixels.shape[0], -1)], [0], None, [BINS], [0, float(top + 1)])
    histogram = Histogram(np.ravel(counts).astype(np.int64), top)
    _ = histogram.bars  # in this thread, not in that of the window which draws them
    return histogram


def middle(pixels: np.ndarray, side: int = SCORED_PX) -> np.ndarray:
    """Return the middle of a frame, at most ``side`` pixels wide and high."""
    height, width = pixels.shape[:2]
    top, left = max((height - side) // 2, 0), max((width - side) // 2, 0)
    return pixels[top : top + side, left : left + side]


def top_of(pixels: np.ndarray, told: int) -> int:
    """Return the largest grey level: that of the instrument file, unless such pixels cannot have it."""
    most = int(np.iinfo(pixels.dtype).max)
    return most if told <= EIGHT_BITS < most else min(told, most)


def look(number: int, pixels: np.ndarray, header: FrameHeader, top: int) -> Seen:
    """Return a frame with what can be read off it; ``top`` is the largest grey level in the instrument file."""
    top = top_of(pixels, top)
    mean, sd = (float(each.item()) for each in cv2.meanStdDev(pixels.reshape(pixels.shape[0], -1)))
    over, under = int(np.count_nonzero(pixels >= top)), pixels.size - int(np.count_nonzero(pixels))
    return Seen(
        number,
        pixels,
        header,
        histogram_of(pixels, top),
        over / pixels.size,
        under / pixels.size,
        focus_energy(middle(pixels)),
        mean,
        sd,
    )


class Eyes:
    """Looks at the newest frames.

    Parameters
    ----------
    ring : callable
        Returns the file of the ring in which frames appear now, empty for none.
    top : callable
        Returns the largest grey level of the camera.
    instrument : callable
        Returns the connection, asked for previews when the ring is on another computer; None while there is none.

    Attributes
    ----------
    seen : Seen or None
        The newest frame.
    trend : deque of float
        Focus scores of the last frames.
    afar : bool
        What is seen are previews from another computer: smaller, compressed, a few a second.
    rate_hz : float
        Frames a second that were looked at.
    wake : callable
        Called, in another thread, with each new frame.
    rest_s : float
        Time to look at nothing after a frame; frames that are to be kept are all looked at.
    """

    def __init__(
        self,
        ring: Callable[[], str],
        top: Callable[[], int],
        clock: Clock | None = None,
        *,
        instrument: Callable[[], Instrument | None] = lambda: None,
    ) -> None:
        self.seen: Seen | None = None
        self.trend: deque[float] = deque(maxlen=TREND)
        self.rate_hz = 0.0
        self.wake: Callable[[], None] = lambda: None
        self.rest_s = 0.0
        self.afar = False
        self._instrument = instrument
        self._met: Instrument | None = None
        self._previews: PreviewViewer | None = None
        self.kept: list[Seen] | None = None
        self._ring = ring
        self._top = top
        self._clock = clock or SystemClock()
        self._viewer = RingViewer(ring, self._clock)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="eyes", daemon=True)
        self._thread.start()

    def keep(self) -> None:
        """Keep frames from now on, as many as there is room for."""
        self.kept = []

    def keep_no_more(self) -> list[Seen]:
        """Return the frames that were kept."""
        kept, self.kept = self.kept, None
        return kept or []

    def close(self) -> None:
        """Look no more."""
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        number, before_s = 0, self._clock.now()
        with self._viewer:
            while not self._over.is_set():
                frame = self._newest()
                now_s = self._clock.now()
                if frame is None:
                    self._over.wait(LOOK_S if self._ring() else DARK_S)
                    self.rate_hz *= 1.0 if now_s - before_s < STILL_S else 0.0
                    continue
                number += 1
                apart_s = 1 / self.rate_hz if self.rate_hz else now_s - before_s
                self.rate_hz = 1 / max(apart_s + 0.1 * (now_s - before_s - apart_s), 1e-3)
                before_s = now_s
                self._take(look(number, frame.pixels, frame.header, self._top()))
                if self.kept is None:
                    self._over.wait(self.rest_s)

            self._look_afar(None)

    def _newest(self) -> Frame | None:
        """Return a frame of the ring; where there is no such file, a preview of it."""
        ring = self._ring()
        if not ring:
            return None
        instrument = self._instrument()
        # one that was found here is here, though the ring it names may just be gone
        self.afar = instrument is not None and not instrument.meeting.pid and not Path(ring).exists()
        self._look_afar(instrument if self.afar else None)
        return self._viewer.newest(0.0) if self._previews is None else self._previews.newest()

    def _look_afar(self, instrument: Instrument | None) -> None:
        """Listen to the previews of an instrument, no longer to those of another."""
        if instrument is self._met:
            return
        if self._previews is not None:
            self._previews.close()
        self._met, self._previews = instrument, None if instrument is None else instrument.previews()

    def _take(self, seen: Seen) -> None:
        self.seen = seen
        self.trend.append(seen.score)
        kept = self.kept
        if kept is not None and len(kept) * seen.pixels.nbytes < KEPT_BYTES:
            kept.append(seen)
        self.wake()
