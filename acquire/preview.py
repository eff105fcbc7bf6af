"""Small pictures for looking from afar: the newest frame, made only while somebody looks, a few times a second."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import zmq

from acquire.frame import Frame, FrameHeader
from acquire.messages import pack_telling
from acquire.replies import Preview, Telling
from acquire.viewer import RingViewer

if TYPE_CHECKING:
    from collections.abc import Callable

    from devices.protocols import Clock

TOPIC = "preview"
LONGEST_PX = 1024
FRAMES_PER_S = 5.0
QUALITY = 80
DARKEST, BRIGHTEST = 0.5, 99.5  # percentiles that become black and white
SUBSCRIBED = 1


def preview(frame: Frame) -> Preview:
    """Return a frame as a small JPEG, its grey levels stretched between two percentiles that are told with it."""
    small = _small(frame.pixels)
    black, white = _span(small)
    stretched = np.take(_table(black, white, small.dtype), small)
    shown = stretched[..., ::-1] if stretched.ndim == 3 else stretched
    _, jpeg = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    header = frame.header
    return Preview(
        jpeg=jpeg.tobytes(),
        number=frame.number,
        section=header.section,
        plane=header.plane,
        z_um=header.z_um,
        shape=frame.pixels.shape,
        black=black,
        white=white,
        utc_ns=header.utc_ns,
    )


def looked_at(told: Preview) -> Frame:
    """Return a preview as a frame of its full size: grey levels between ``black`` and ``white``, no others.

    It is for eyes: what lies beyond the two percentiles is cut off, and nothing finer than the preview is in it.
    """
    flags = cv2.IMREAD_GRAYSCALE if len(told.shape) == 2 else cv2.IMREAD_COLOR_RGB
    small = cv2.imdecode(np.frombuffer(told.jpeg, np.uint8), flags)
    if small is None:
        raise ValueError("a preview that is no JPEG")
    large = cv2.resize(small, told.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    levels = np.rint(told.black + np.arange(256) * ((told.white - told.black) / 255)).astype(np.uint16)
    header = FrameHeader(told.plane, told.z_um, told.z_um, 0.0, utc_ns=told.utc_ns, section=told.section)
    return Frame(told.number, header, levels[large])


def _table(black: int, white: int, dtype: np.dtype[Any]) -> np.ndarray:
    """Return what becomes of each grey level: straight from ``black`` to ``white``, 0 and 255 beyond."""
    levels = np.arange(np.iinfo(dtype).max + 1, dtype=np.float32)
    return np.asarray(np.rint(np.clip((levels - black) * (255 / (white - black)), 0, 255)), np.uint8)


def _small(pixels: np.ndarray) -> np.ndarray:
    height, width = pixels.shape[:2]
    scale = LONGEST_PX / max(height, width)
    if scale >= 1:
        return pixels
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))


def _span(pixels: np.ndarray) -> tuple[int, int]:
    sample = pixels[::4, ::4] if min(pixels.shape[:2]) >= 16 else pixels
    black, white = (int(level) for level in np.percentile(sample, (DARKEST, BRIGHTEST)))
    return black, max(white, black + 1)


class Previews:
    """Sends previews to those who listen; one thread of its own owns the socket, bound already, until `close`."""

    def __init__(self, socket: zmq.Socket[bytes], where: Callable[[], str], clock: Clock) -> None:
        self._socket = socket
        self._viewer = RingViewer(where, clock)
        self._listeners = 0
        self._sent = 0
        self._last = b""
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="preview", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End."""
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        with self._viewer:
            while not self._over.wait(1 / FRAMES_PER_S):
                self._count_listeners()
                if not self._listeners:
                    self._viewer.close()
                elif (frame := self._viewer.newest(0)) is not None:
                    self._sent += 1
                    self._last = pack_telling(TOPIC, Telling(self._sent, preview(frame)))
                    self._socket.send(self._last, zmq.NOBLOCK)

    def _count_listeners(self) -> None:
        """Note who comes and goes; whoever comes gets the last picture, however old."""
        while self._socket.poll(0):
            came = self._socket.recv()[:1] == bytes([SUBSCRIBED])
            self._listeners += 1 if came else -1
            if came and self._last:
                self._socket.send(self._last, zmq.NOBLOCK)
