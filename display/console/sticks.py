"""Gamepads, 3-D mice and a scripted hand behind one protocol: a rate and a dead man's button, and what must stop it.

A device says how fast the stage is to go, from -1 (down) to 1 (up), and whether its button is held. `Stick` makes
short moves of it. Any doubt stops it: the button let go, nothing heard for 200 ms, the device gone, the window not in
front, a run, STOP, a refusal. After a doubt the button has to be let go before it moves anything again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Sequence

    from display.console.moving import Jogger

WATCH_S = 0.2
LONGEST_S = 0.1
DEAD = 0.12  # of the way: sticks do not rest at 0
TOP_UM_S = (1.0, 2000.0)


@dataclass(frozen=True)
class Reading:
    """What a device told last.

    Attributes
    ----------
    rate : float
        From -1 to 1, up is positive.
    held : bool
        The dead man's button.
    told_s : float
        When it told.
    """

    rate: float
    held: bool
    told_s: float


class InputDevice(Protocol):
    """Anything that gives a rate."""

    name: str

    def read(self, now_s: float) -> Reading | None:
        """Return what it told last, None when it is gone; never waits."""
        ...

    def close(self) -> None:
        """Let go of it."""
        ...


class Scripted:
    """A hand that does what is written, for tests and demonstrations: (since when in s, rate, button held).

    Before the first entry and from ``until_s`` on the device is gone; from an entry without a rate on it is silent.
    """

    name = "scripted"

    def __init__(self, script: Sequence[tuple[float, float | None, bool]], until_s: float = float("inf")) -> None:
        self._script = script
        self._until_s = until_s

    def read(self, now_s: float) -> Reading | None:
        """Return the entry of this time."""
        begun = [entry for entry in self._script if entry[0] <= now_s]
        if not begun or now_s >= self._until_s:
            return None
        since_s, rate, held = begun[-1]
        if rate is not None:
            return Reading(rate, held, now_s)
        _, last_rate, last_held = next(entry for entry in reversed(begun) if entry[1] is not None)
        assert last_rate is not None
        return Reading(last_rate, last_held, since_s)

    def close(self) -> None:
        """Nothing to let go of."""


def shaped(rate: float) -> float:
    """Return a rate without what a resting stick tells, cubed, so that small ways are fine ways."""
    way = max(abs(rate) - DEAD, 0.0) / (1 - DEAD)
    return min(way, 1.0) ** 3 * (1 if rate > 0 else -1)


class Stick:
    """Moves the stage at the rate of a device.

    Attributes
    ----------
    device : InputDevice or None
        Off without one.
    top_um_s : float
        Speed with the stick all the way, in µm/s.
    still : str
        Why nothing is moved, in words; empty while it may move.
    """

    def __init__(self, top_um_s: float = 100.0) -> None:
        self.device: InputDevice | None = None
        self.top_um_s = top_um_s
        self.still = ""
        self._blocked = True
        self._before_s = 0.0
        self._moves = False

    def use(self, device: InputDevice | None) -> None:
        """Take another device, or none; its button has to be let go first."""
        if self.device is not None:
            self.device.close()
        self.device, self._blocked = device, True

    def block(self) -> None:
        """Move nothing until the button was let go: a stop, or a refusal."""
        self._blocked = True

    def tick(self, jogger: Jogger, now_s: float, why_not: str) -> None:
        """Make a move of what the device tells; with a reason ``why_not`` against it, none."""
        passed_s, self._before_s = min(now_s - self._before_s, LONGEST_S), now_s
        if self.device is None:
            return
        reading = self.device.read(now_s)
        self.still = self._doubt(reading, now_s, why_not)
        rate = 0.0 if self.still or reading is None else shaped(reading.rate)
        if rate:
            self._moves = True
            jogger.drive(rate * self.top_um_s * passed_s, abs(rate) * self.top_um_s * WATCH_S)
        elif self._moves:
            self._moves = False
            jogger.wanted_um = 0.0

    def _doubt(self, reading: Reading | None, now_s: float, why_not: str) -> str:
        if reading is None:
            self._blocked = True
            return "the device is gone"
        if now_s - reading.told_s > WATCH_S:
            self._blocked = True
            return "nothing was heard from the device"
        if not reading.held:
            self._blocked = False
            return "hold its button to move"
        if why_not:
            self._blocked = True
            return why_not
        return "let its button go first" if self._blocked else ""
