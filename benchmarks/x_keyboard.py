"""A key pressed at the X server, as by a hand: neither the program nor its test engine knows of it beforehand."""

import ctypes
import ctypes.util

ESCAPE = 0xFF1B  # its keysym


class Keyboard:
    """The keyboard of the X server named by DISPLAY; needs libXtst."""

    def __init__(self):
        self._x = ctypes.CDLL(ctypes.util.find_library("X11"))
        self._test = ctypes.CDLL(ctypes.util.find_library("Xtst"))
        self._x.XOpenDisplay.restype = ctypes.c_void_p
        self._display = ctypes.c_void_p(self._x.XOpenDisplay(None))
        self._code = self._x.XKeysymToKeycode(self._display, ctypes.c_ulong(ESCAPE))

    def escape(self, *, down):
        """Press Escape, or let it go."""
        self._test.XTestFakeKeyEvent(self._display, self._code, int(down), ctypes.c_ulong(0))
        self._x.XFlush(self._display)
