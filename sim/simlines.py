"""Simulated glasses on simulated modem lines, for pyserial in this process: ``simlines://NAME``.

Pseudo-terminals have no modem lines. `plug` makes a circuit known by name and lets pyserial open it; the circuit is
MEKA's: DTR feeds it, RTS chooses the eye.
"""

from __future__ import annotations

import errno
from typing import TYPE_CHECKING

import serial

from devices.glasses_timing import Edge

if TYPE_CHECKING:
    from devices.glasses_timing import Eye
    from devices.protocols import Clock

FAULTS = ("gone", "loose", "unwired", "slow", "no-lines")
EVERY_LOST = 10
SLOW_S = 0.012
UNSEEN_S = 50e-6  # between the switching of one line and the other no crystal moves
_plugged: dict[str, Circuit] = {}


class Circuit:
    """The circuit and the glasses on it.

    Parameters
    ----------
    clock : Clock
        Time.
    inverted : bool
        RTS on opens the right eye instead of the left one.

    Attributes
    ----------
    faults : set of str
        Of `FAULTS`: the port is ``gone``; every tenth change of RTS is lost (``loose``); RTS is not led to CTS
        (``unwired``); each change takes 12 ms (``slow``); the port has none (``no-lines``).
    taken : bool
        Whether a port is open.
    """

    def __init__(self, clock: Clock, *, inverted: bool = False) -> None:
        self._clock = clock
        self._inverted = inverted
        self._dtr = self._rts = False
        self._changes = 0
        self._states: list[tuple[float, Eye | None]] = [(clock.now(), None)]
        self.faults: set[str] = set()
        self.taken = False

    def switch(self, *, dtr: bool, rts: bool) -> None:
        """Take the levels of both lines."""
        self.check()
        if "slow" in self.faults:
            self._clock.sleep(SLOW_S)
        self._dtr = dtr
        if rts != self._rts:
            self._changes += 1
            if "loose" not in self.faults or self._changes % EVERY_LOST:
                self._rts = rts
        self._note()

    def clear_to_send(self) -> bool:
        """Return what comes back on CTS."""
        self.check()
        return self._rts and "unwired" not in self.faults

    def check(self) -> None:
        """Raise as the system does when something is wrong with the port."""
        if "gone" in self.faults:
            raise OSError(errno.EIO, "Input/output error")
        if "no-lines" in self.faults:
            raise OSError(errno.ENOTTY, "Inappropriate ioctl for device")

    def edges(self) -> list[Edge]:
        """Return when each eye was let see."""
        return [Edge(round(at_s * 1e9), eye) for at_s, eye in self._states if eye is not None]

    def longest_hold_s(self) -> float:
        """Return for how long a shutter was held in one state under power."""
        ends_s = [at_s for at_s, _ in self._states[1:]] + [self._clock.now()]
        held = [end_s - at_s for (at_s, eye), end_s in zip(self._states, ends_s, strict=True) if eye is not None]
        return max(held, default=0.0)

    @property
    def powered(self) -> bool:
        """Whether the glasses have power."""
        return self._dtr

    def _note(self) -> None:
        eye: Eye | None = None
        if self._dtr:
            eye = "left" if self._rts != self._inverted else "right"
        now_s = self._clock.now()
        if now_s - self._states[-1][0] < UNSEEN_S and len(self._states) > 1:
            self._states.pop()
        if eye != self._states[-1][1]:
            self._states.append((now_s, eye))


def plug(name: str, circuit: Circuit) -> str:
    """Make a circuit known and return the URL of its port."""
    if __package__ not in serial.protocol_handler_packages:
        serial.protocol_handler_packages.append("sim")
    _plugged[name] = circuit
    return f"simlines://{name}"


def plugged(name: str) -> Circuit | None:
    """Return the circuit of a name."""
    return _plugged.get(name)
