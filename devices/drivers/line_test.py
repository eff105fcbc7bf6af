"""How fast the lines of a port are: RTS is wired to CTS (pins 7 and 8), switched, and its echo timed."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import median, quantiles
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from devices.drivers.modem_glasses import Lines
    from devices.protocols import Clock

TOGGLES = 200
FIRST = 10  # when none of these comes back there is no loop, and the others need not be waited for
LOST_AFTER_S = 0.05
POLL_S = 20e-6
POWER = "dtr"


@dataclass(frozen=True)
class LoopReport:
    """What the loop showed.

    Attributes
    ----------
    toggles, lost : int
        Edges sent, and those that CTS did not follow within 50 ms.
    p50_ms, p99_ms, max_ms : float
        From the call to the echo, of those that came; 0 when none did.
    """

    toggles: int
    lost: int
    p50_ms: float = 0.0
    p99_ms: float = 0.0
    max_ms: float = 0.0

    @property
    def wired(self) -> bool:
        """Whether anything came back at all."""
        return self.lost < self.toggles


def loop_test(lines: Lines, clock: Clock, *, toggles: int = TOGGLES) -> LoopReport:
    """Switch RTS to and fro, DTR on all the while, and time each echo on CTS.

    The glasses take part: they flicker for a moment, which does them no harm.
    """
    if lines.clear_to_send():
        lines.set([POWER])
        _follows(lines, clock, wanted=False)
    echoes_s = [_toggle_s(lines, clock, on=index % 2 == 0) for index in range(FIRST)]
    if any(echo_s is not None for echo_s in echoes_s):
        echoes_s += [_toggle_s(lines, clock, on=index % 2 == 0) for index in range(toggles - FIRST)]
    came_ms = [1000 * echo_s for echo_s in echoes_s if echo_s is not None]
    lost = len(echoes_s) - len(came_ms)
    if len(came_ms) < 2:
        return LoopReport(len(echoes_s), lost)
    return LoopReport(len(echoes_s), lost, median(came_ms), quantiles(came_ms, n=100)[-1], max(came_ms))


def _toggle_s(lines: Lines, clock: Clock, *, on: bool) -> float | None:
    before, begun_s = lines.clear_to_send(), clock.now()
    lines.set([POWER, "rts"] if on else [POWER])
    followed = _follows(lines, clock, wanted=on)
    return clock.now() - begun_s if followed and before != on else None


def _follows(lines: Lines, clock: Clock, *, wanted: bool) -> bool:
    """Wait until CTS is as wanted; False when it never is."""
    deadline_s = clock.now() + LOST_AFTER_S
    while lines.clear_to_send() != wanted:
        if clock.now() > deadline_s:
            return False
        clock.sleep(POLL_S)
    return True
