"""What a run will cost: time, light and disk, summed over the very steps it will carry out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.run_plan import Kind, run_plan
from devices.values import to_um

if TYPE_CHECKING:
    from collections.abc import Iterator

    from acquire.plan import StackPlan
    from acquire.run_plan import RunPlan, Step

CLEAR_S = 0.1


@dataclass(frozen=True)
class Estimate:
    """What a plan will cost. Times are sums of the parts that can be known before.

    Attributes
    ----------
    planes : int
        Planes of the whole run.
    seconds : float
        From the start to the end.
    bytes_on_disk : int
        As if nothing could be compressed.
    exposure_s : float
        Light on the specimen, all planes together.
    dose_s : float
        Light on one face: what a spot of it gets before it is cut away, or in the whole run if nothing is cut.
    """

    planes: int
    seconds: float
    bytes_on_disk: int
    exposure_s: float
    dose_s: float = 0.0


@dataclass(frozen=True)
class Pace:
    """How fast an instrument is, for estimates.

    Attributes
    ----------
    speed_um_s : float
        Speed of the axis.
    settle_s, overhead_s, readout_s : float
        Per move: waiting for rest, and the controller's question and answer; per frame: readout.
    feed_um_s : float
        Speed of the feed.
    cut_s : float
        One cut: stroke, drawing back, knife out, return.
    """

    speed_um_s: float
    settle_s: float
    overhead_s: float = 0.03
    readout_s: float = 0.0
    feed_um_s: float = 100.0
    cut_s: float = 10.0


@dataclass(frozen=True)
class TimedStep:
    """A step and when it begins, in seconds from the start."""

    step: Step
    at_s: float


class Timer:
    """Adds up the time of steps; remembers where the stage is."""

    def __init__(self, plan: RunPlan, pace: Pace) -> None:
        self._plan = plan
        self._pace = pace
        self._z_nm = plan.sections.park_nm if plan.sections else plan.stack.start_nm
        self.now_s = 0.0

    def add(self, step: Step) -> None:
        """Let a step happen."""
        if step.kind is Kind.WAIT and self._plan.series:
            self.now_s = max(self.now_s, step.section * self._plan.series.interval_ms / 1000)
        for target_nm in step.moves_nm:
            self.move(target_nm)
        self.now_s += self._takes_s(step)

    def move(self, target_nm: int) -> None:
        """Let the stage go somewhere."""
        self.now_s += abs(to_um(target_nm - self._z_nm)) / self._pace.speed_um_s
        self.now_s += self._pace.settle_s + self._pace.overhead_s
        self._z_nm = target_nm

    def _takes_s(self, step: Step) -> float:
        match step.kind:
            case Kind.EXPOSE:
                return self._plan.exposure_ms(step.band) / 1000 + self._pace.readout_s
            case Kind.FEED:
                return to_um(step.thickness_nm) / self._pace.feed_um_s + self._pace.overhead_s
            case Kind.CUT:
                return self._pace.cut_s
            case Kind.CLEAR:
                return CLEAR_S
            case Kind.CLEAN:
                return self._plan.sections.clean_s if self._plan.sections else 0.0
            case _:
                return 0.0


def timed_steps(plan: RunPlan, pace: Pace) -> Iterator[TimedStep]:
    """Return every step of a run with the time at which it begins."""
    timer = Timer(plan, pace)
    for section in range(plan.times):
        for step in plan.steps(section):
            yield TimedStep(step, timer.now_s)
            timer.add(step)


def estimate(plan: StackPlan | RunPlan, frame_bytes: int, pace: Pace) -> Estimate:
    """Return planes, time, light and disk of a plan."""
    whole = run_plan(plan)
    timer = Timer(whole, pace)
    for section in range(whole.times):
        for step in whole.steps(section):
            timer.add(step)
    back_nm = whole.sections.park_nm if whole.sections else whole.stack.return_nm
    if back_nm is not None:
        timer.move(back_nm)
    face_s = sum(whole.exposure_ms(band) for band in range(whole.band_count)) * whole.stack.count / 1000
    return Estimate(
        planes=len(whole),
        seconds=timer.now_s,
        bytes_on_disk=len(whole) * frame_bytes,
        exposure_s=face_s * whole.times,
        dose_s=face_s if whole.sections else face_s * whole.times,
    )
