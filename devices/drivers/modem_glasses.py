"""Shutter glasses on the modem lines of a serial port, as a `devices.protocols.Eyewear`.

The circuit holds whatever state it was left in, and a liquid crystal that is held closed by direct current dies. So a
thread changes the state whenever nobody else has for ``max_hold_ms``; and in a free run it takes the turns itself, by
the clock by which the display's flips are timed: there is no drift between the two.
"""

from __future__ import annotations

import contextlib
import math
from collections import deque
from threading import Event, RLock, Thread
from typing import TYPE_CHECKING, Literal, Protocol

from devices.drivers.open3d import check_refresh
from devices.errors import DeviceError
from devices.glasses_timing import Edge, EyewearTiming, Lock, other
from devices.transport.lines import ModemLines

if TYPE_CHECKING:
    from collections.abc import Collection

    from devices.glasses_spec import GlassesSpec
    from devices.glasses_timing import Eye
    from devices.protocols import Clock
    from devices.registry import DeviceContext

DEVICE = "glasses"
IDLE_HOLD_S = 0.02  # both eyes see, dimmed, and nothing flickers slower than films do
ROUNDING_S = 20e-6
KEPT_EDGES = 1 << 14
KEPT_LOCKS = 1024
Work = Literal["turns", "free-run", "idle"]


class Lines(Protocol):
    """What the driver wants of `devices.transport.lines.ModemLines`."""

    name: str

    def set(self, on: Collection[str]) -> None:
        """Switch the lines."""
        ...

    def clear_to_send(self) -> bool:
        """Return the state of CTS."""
        ...

    def close(self) -> None:
        """Release the port."""
        ...


class ModemGlasses:
    """Switches the lines; every method may be called from any thread.

    Somebody has to call `tend` when it says: `open_glasses` starts a thread for that.

    Parameters
    ----------
    lines : Lines
        The port's.
    spec : GlassesSpec
        ``[glasses]`` of the instrument file.
    clock : Clock
        Time.
    """

    def __init__(self, lines: Lines, spec: GlassesSpec, clock: Clock) -> None:
        self._lines = lines
        self._spec = spec
        self._clock = clock
        self._turn = RLock()
        self._changed = Event()
        self._closed = False
        self._thread: Thread | None = None
        self._failure: DeviceError | None = None
        self._work: Work = "idle"
        self._eye: Eye | None = None
        self._since_s = clock.now()
        self._edges: deque[Edge] = deque(maxlen=KEPT_EDGES)
        self._sent = 0
        self._locks: deque[Lock] = deque(maxlen=KEPT_LOCKS)

    @property
    def free_running(self) -> bool:
        """Whether the instrument file wants a free run."""
        return self._spec.drive == "free-run"

    @property
    def timing(self) -> EyewearTiming:
        """Every change of the lines, also those that only keep the crystals alive."""
        locked = self._work == "free-run" and self._failure is None
        return EyewearTiming(tuple(self._edges), self._sent, tuple(self._locks), locked)

    def show(self, eye: Eye) -> None:
        """Give one eye its turn now. Held for longer than ``max_hold_ms``, it passes to the other eye by itself."""
        with self._turn:
            self._work = "turns"
            self._switch(eye)

    def both_open(self) -> None:
        """Let the eyes take slow turns, or take the power away, as ``idle`` says."""
        with self._turn:
            self._work = "idle"
            if self._spec.idle == "off":
                self._rest()
            else:
                self._switch(other(self._eye or "right"))
        self._changed.set()

    def lock_to(self, refresh_hz: float, left_flip_s: float) -> None:
        """Take the turns of a display from now on; raises `LimitError` for a rate that none has."""
        check_refresh(refresh_hz)
        with self._turn:
            self._check()
            self._locks.append(Lock(refresh_hz, left_flip_s))
            self._work = "free-run"
        self._changed.set()

    def close(self) -> None:
        """Take the power from the glasses and release the port."""
        with self._turn:
            self._closed = True
        self._changed.set()
        if self._thread is not None:
            self._thread.join()
        with contextlib.suppress(DeviceError):
            self._rest()
        self._lines.close()

    def tend(self) -> float:
        """Do what is due and return the seconds after which something will be."""
        with self._turn:
            now_s = self._clock.now()
            if self._work == "free-run":
                return self._keep_turns(now_s)
            if self._eye is None:
                return self._hold_s
            if now_s - self._since_s >= self._hold_s:
                self._switch(other(self._eye))
            return max(self._since_s + self._hold_s - self._clock.now(), 0.0)

    def keep_tending(self) -> None:
        """Start the thread that calls `tend`."""
        self._thread = Thread(target=self._tend_on, name="glasses", daemon=True)
        self._thread.start()

    @property
    def _hold_s(self) -> float:
        longest_s = self._spec.max_hold_ms / 1000
        return min(IDLE_HOLD_S, longest_s) if self._work == "idle" else longest_s

    def _keep_turns(self, now_s: float) -> float:
        lock = self._locks[-1]
        number = math.floor((now_s + ROUNDING_S - lock.left_s) * lock.refresh_hz)
        eye: Eye = "right" if number % 2 else "left"
        if eye != self._eye:
            self._switch(eye)
        return max(lock.left_s + (number + 1) / lock.refresh_hz - self._clock.now(), 0.0)

    def _switch(self, eye: Eye) -> None:
        self._check()
        swapped = other(eye) if self._spec.swap else eye
        self._set(self._spec.left if swapped == "left" else self._spec.right)
        if eye != self._eye:
            self._eye, self._since_s = eye, self._clock.now()
        self._edges.append(Edge(round(self._clock.now() * 1e9), eye))
        self._sent += 1

    def _rest(self) -> None:
        self._check()
        self._eye = None
        self._set(self._spec.off)

    def _set(self, on: Collection[str]) -> None:
        try:
            self._lines.set(on)
        except DeviceError as error:
            self._failure = error
            raise

    def _check(self) -> None:
        """Raise once more what ended the work: the lines are gone, and with them the power of the glasses."""
        if self._failure is not None:
            raise self._failure

    def _tend_on(self) -> None:
        try:
            while not self._closed:
                self._changed.wait(self.tend())
                self._changed.clear()
        except DeviceError as error:
            self._failure = error


def open_glasses(table: GlassesSpec, context: DeviceContext) -> ModemGlasses:
    """Open the port with the glasses at rest, then let both eyes see.

    Raises
    ------
    DeviceError
        device-missing, device-permission, device-busy; glasses-no-lines for a port without modem lines.
    """
    glasses = ModemGlasses(ModemLines(table.port, table.off, device=DEVICE), table, context.clock)
    glasses.both_open()
    glasses.keep_tending()
    return glasses
