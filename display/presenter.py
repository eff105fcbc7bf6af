"""The loop that gives each refresh of the display to one eye, and tells the glasses. Knows no window and no OpenGL."""

from __future__ import annotations

from collections import deque
from itertools import islice
from typing import TYPE_CHECKING, Protocol

from devices.errors import DeviceError
from display.pacing import Pacer, check_rate, measured_beat

if TYPE_CHECKING:
    from devices.glasses_timing import Edge
    from devices.protocols import Clock, Eyewear
    from display.pacing import Turn

MEASURED_SWAPS = 60
BUFFERS = 3  # that a driver may have between drawing and seeing
MOST_REDRAWN = 4  # a computer that cannot draw in time for so long shows what it has
KEPT_FLIPS = 1 << 17


class Screen(Protocol):
    """A window on a display."""

    @property
    def refresh_hz(self) -> float:
        """Pictures a second, as the display names them."""
        ...

    def draw(self, turn: Turn | None) -> None:
        """Draw the newest picture of the turn's eye, with its sync code; None: darkness. Returns when it is drawn."""
        ...

    def swap(self) -> None:
        """Let what was drawn be seen from the next refresh on; returns at that refresh."""
        ...


class Presenter:
    """Shows pairs in turn.

    Parameters
    ----------
    screen : Screen
        Where.
    clock : Clock
        CLOCK_MONOTONIC.
    glasses : Eyewear, optional
        Told of each flip, or of where the flips are, as they want it. When they fail, the pictures go on.
    swap : bool
        Exchange the eyes.

    Attributes
    ----------
    pacer : Pacer
        Which turn it is, and the books.
    flips : deque of Edge
        The latest flips: since when whose picture was shown.
    failure : DeviceError or None
        What became of the glasses.
    """

    def __init__(self, screen: Screen, clock: Clock, glasses: Eyewear | None = None, *, swap: bool = False) -> None:
        check_rate(screen.refresh_hz)
        self._screen = screen
        self._clock = clock
        self._glasses = glasses
        self._swap = swap
        self.flips: deque[Edge] = deque(maxlen=KEPT_FLIPS)
        self.failure: DeviceError | None = None
        self.pacer = self._measured()

    @property
    def swap(self) -> bool:
        """Whether the eyes are exchanged; may be changed at any time."""
        return self._swap

    @swap.setter
    def swap(self, swap: bool) -> None:
        self._swap = self.pacer.swap = swap

    def step(self) -> Edge:
        """Show one picture, and return whose and since when it is seen."""
        turn = self._drawn()
        self._clock.sleep(turn.not_before_s - self._clock.now())
        self._screen.swap()
        flip = self.pacer.flipped(turn, self._clock.now())
        self.flips.append(flip)
        if self._glasses is not None and not self._glasses.free_running:
            self._tell(flip)
        if self.pacer.lost:
            self.pacer = Pacer(self._measured().beat, self._swap, self.pacer.report)
        return flip

    def lock_glasses(self) -> None:
        """Tell glasses that run free where the flips are; to be called about four times a second, in another thread."""
        if self._glasses is None or self.failure is not None or not self._glasses.free_running:
            return
        try:
            self._glasses.lock_to(1 / self.pacer.beat.period_s, self.pacer.left_flip_s())
        except DeviceError as error:
            if error.code != "glasses-unlocked":  # the computer was busy: the next call tries again
                self.failure = error

    def recent_flips(self, count: int) -> list[Edge]:
        """Return the latest flips, oldest first."""
        return list(islice(self.flips, max(len(self.flips) - count, 0), None))

    def _measured(self) -> Pacer:
        """Let darkness pass a number of times and see when."""
        for _ in range(BUFFERS):
            self._screen.draw(None)
            self._screen.swap()
        returns_s = []
        for _ in range(MEASURED_SWAPS):
            self._screen.swap()
            returns_s.append(self._clock.now())
        return Pacer(measured_beat(returns_s, self._screen.refresh_hz), self._swap)

    def _drawn(self) -> Turn:
        """Draw for the upcoming turn; when drawing took until the other eye's turn, draw that one's picture."""
        turn = self.pacer.upcoming(self._clock.now())
        self._screen.draw(turn)
        for _ in range(MOST_REDRAWN):
            upcoming = self.pacer.upcoming(self._clock.now())
            if upcoming.eye == turn.eye:
                return upcoming
            turn = upcoming
            self.pacer.redrawn()
            self._screen.draw(turn)
        return turn

    def _tell(self, flip: Edge) -> None:
        assert self._glasses is not None
        if self.failure is None:
            try:
                self._glasses.show(flip.eye)
            except DeviceError as error:
                self.failure = error
