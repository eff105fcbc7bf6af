"""The cycle of a section, as states and the ways between them.

::

    IDLE ── HOMING ── READY ── ADVANCING ── READY
                        │
                        └── CUTTING ── RETRACTING ── CLEARING ── VERIFYING ── READY

    from anywhere:  ALARM  ESTOPPED  UNKNOWN,  and CLEARING to bring the knife out without a further feed
"""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from devices.errors import DeviceError, LinkError, Unsafe
from devices.feed_errors import FeedAlarm, FeedAstray, FeedEstop, FeedUndecided
from devices.feed_values import FeedState

if TYPE_CHECKING:
    from collections.abc import Iterator

S = FeedState
FROM_ANYWHERE = frozenset({S.ALARM, S.ESTOPPED, S.UNKNOWN, S.CLEARING, S.IDLE})
WAYS: dict[FeedState, frozenset[FeedState]] = {
    S.IDLE: frozenset({S.HOMING, S.READY}),
    S.HOMING: frozenset({S.READY}),
    S.READY: frozenset({S.HOMING, S.ADVANCING, S.RETRACTING, S.CUTTING}),
    S.ADVANCING: frozenset({S.READY}),
    S.CUTTING: frozenset({S.RETRACTING, S.READY}),
    S.RETRACTING: frozenset({S.READY}),
    S.CLEARING: frozenset({S.VERIFYING, S.READY}),
    S.VERIFYING: frozenset({S.READY}),
}
HINTS = {
    S.IDLE: "home it: stereotome section home",
    S.ALARM: "see to the cause, then reset and look again: stereotome section show --reset",
    S.ESTOPPED: "release the emergency stop, then look again: stereotome section show",
    S.UNKNOWN: "look again, nothing will move: stereotome section show",
}


class FeedCycle:
    """Where the cycle stands. An illegal way is a mistake of the program, a wrong state at the start an interlock.

    Attributes
    ----------
    state : FeedState
        Now.
    """

    def __init__(self) -> None:
        self.state = S.IDLE

    def require(self, *states: FeedState) -> None:
        """Raise `Unsafe` unless the cycle stands at one of ``states``."""
        if self.state not in states:
            raise Unsafe(
                f"feed: it is {self.state}, not {' or '.join(states)}. Nothing was sent.",
                fix=HINTS.get(self.state, "wait for the end of what it does."),
            )

    def enter(self, state: FeedState) -> None:
        """Go on to a state."""
        if state not in FROM_ANYWHERE | WAYS.get(self.state, frozenset()):
            raise ValueError(f"no way from {self.state} to {state}")
        self.state = state

    @contextmanager
    def during(self, state: FeedState) -> Iterator[None]:
        """Be in a state for a while; an error leaves the cycle where the error says that the feed is."""
        self.enter(state)
        try:
            yield
        except DeviceError as error:
            self.enter(after(error))
            raise


def after(error: DeviceError) -> FeedState:
    """Return what is known about the feed after an error: nothing when the wire failed or it went astray."""
    if isinstance(error, FeedAlarm):
        return S.ALARM
    if isinstance(error, FeedEstop):
        return S.ESTOPPED
    unknown = isinstance(error, LinkError | FeedUndecided | FeedAstray)
    return S.UNKNOWN if unknown else S.IDLE
