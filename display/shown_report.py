"""What became of a show through shutter glasses: refreshes, phase, wrong eyes, crosstalk."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from devices.glasses_timing import FEWEST, PhaseReport, phase_report

if TYPE_CHECKING:
    from collections.abc import Sequence

    from devices.glasses_timing import Edge
    from display.pacing import PaceReport

BUSY = 0.02  # a greater share of late pictures is seen as stutter
MUCH_CROSSTALK = 0.02


@dataclass(frozen=True)
class ShownReport:
    """How it went.

    Attributes
    ----------
    refresh_hz : float
        As measured.
    pace : PaceReport
        Of the pictures.
    phase : PhaseReport or None
        Of the shutters against the pictures; None without glasses, or when too few turns are known.
    """

    refresh_hz: float
    pace: PaceReport
    phase: PhaseReport | None = None

    def as_json(self) -> dict[str, Any]:
        """Return everything under plain names."""
        phase = {} if self.phase is None else {f"glasses_{key}": value for key, value in asdict(self.phase).items()}
        return {"refresh_hz": self.refresh_hz, **asdict(self.pace), **phase}

    def words(self) -> str:
        """Return what a person wants to know, in lines."""
        pace = self.pace
        lines = [
            f"{pace.flips} pictures in {pace.refreshes} refreshes at {self.refresh_hz:.3f} Hz; {pace.late} late",
            f"wrong eye in {pace.wrong_eye} refreshes, at most {pace.longest_wrong} in a row",
        ]
        if self.phase is not None:
            lines += _of_glasses(self.phase)
        return "\n".join([*lines, *self._advice()])

    def _advice(self) -> list[str]:
        said = []
        if self.pace.late > BUSY * max(self.pace.refreshes, 1):
            said.append("This computer is too busy: close what else works on it.")
        if self.phase is not None and self.phase.crosstalk > MUCH_CROSSTALK:
            said.append("The eyes see each other's pictures: change delay_us, or make open_us shorter.")
        return said


def _of_glasses(phase: PhaseReport) -> tuple[str, str]:
    when = f"phase {phase.bias_ms:+.2f} ms, p99 {phase.p99_ms:.2f} ms, drift {phase.drift_ppm:+.0f} ppm"
    what = f"{phase.missed} missed, {phase.alternation_faults} of the wrong eye, crosstalk {phase.crosstalk:.1%}"
    return f"shutters: {when}", f"shutters: {phase.edges} turns, {what}"


def shown_report(
    refresh_hz: float,
    pace: PaceReport,
    flips: Sequence[Edge],
    turns: Sequence[Edge],
    *,
    delay_s: float = 0.0,
    open_s: float | None = None,
) -> ShownReport:
    """Compare pictures with shutters.

    Parameters
    ----------
    flips : sequence of Edge
        Since when whose picture was seen.
    turns : sequence of Edge
        When which shutter was told to open; none without glasses.
    delay_s : float
        How much later than its flip a shutter is meant to open.
    open_s : float, optional
        How long it stays open; None: until the other one opens.
    """
    both = [edge for edge in turns if flips and flips[0].at_ns <= edge.at_ns <= flips[-1].at_ns]
    if min(len(flips), len(both)) < FEWEST:
        return ShownReport(refresh_hz, pace)
    inside = [flip for flip in flips if flip.at_ns >= both[0].at_ns - round(1e9 / refresh_hz)]
    if len(inside) < FEWEST:
        return ShownReport(refresh_hz, pace)
    return ShownReport(refresh_hz, pace, phase_report(both, inside, delay_s=delay_s, open_s=open_s))
