"""The arbiter between everybody who moves something: stage and knife never meet, whoever gives the commands.

It stands below every client of the process, the engine, the instrument process and hands alike: they get the guarded
stage and feed of `guarded`, and these say no before a byte is sent. Limits, reference, one command at a time, retries
and the knife's own sensors are the drivers' business and not repeated here.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

from devices.errors import Unsafe
from devices.feed_values import KnifeState
from devices.protocols import Microtome
from devices.rig import Rig
from devices.values import to_nm, to_um

if TYPE_CHECKING:
    from collections.abc import Callable

    from devices.protocols import Clock, Feed, Stage
    from devices.values import Limits

PARK_TOLERANCE_NM = 1000
AT_REST_NM = 100
REST_S = 0.02
CLEAR_TWICE_S = 0.05
MOVES_THE_STAGE = {"load_sequence", "start_sequence"}
MOVES_THE_FEED = {"approach_to", "jog"}  # homing goes away from knife and objective


G = TypeVar("G", bound="GuardedStage | GuardedFeed")


class MotionLease:
    """Whoever lets the knife move holds it; until it is given back nobody moves the stage.

    Attributes
    ----------
    holder : str
        Who holds it; empty for nobody.
    """

    def __init__(self) -> None:
        self.holder = ""

    def take(self, holder: str) -> None:
        """Hold it; whoever holds it already keeps it."""
        if self.holder not in ("", holder):
            raise Unsafe(f"the stage is held by {self.holder}. Nothing was sent.", fix="wait until it is done.")
        self.holder = holder

    def release(self) -> None:
        """Give it back; the stage still stays parked until the knife is seen to be clear."""
        self.holder = ""


class Arbiter:
    """Knows where stage and knife are allowed to be at the same time.

    Parameters
    ----------
    stage, feed : Stage, Feed or None
        The drivers.
    park_nm : int or None
        Where the stage is out of the knife's way.
    """

    def __init__(self, stage: Stage, feed: Feed | None, park_nm: int | None, clock: Clock) -> None:
        self._stage = stage
        self._feed = feed
        self._park_nm = park_nm
        self._clock = clock
        self._clear_seen = False
        self.lease = MotionLease()

    def before_stage_moves(self, target_um: float | None) -> None:
        """Raise `Unsafe` unless the stage may go there: anywhere while the knife is clear, only to park otherwise."""
        if self.lease.holder:
            raise Unsafe(
                f"z stage: it stays parked while {self.lease.holder} has the knife. Nothing was sent.",
                fix="wait until the knife is clear.",
            )
        if None not in (self._park_nm, target_um) and to_nm(target_um or 0.0) == self._park_nm:
            return
        if not self._clear_seen:
            self._see_clear()

    def before_feed_moves(self) -> None:
        """Raise `Unsafe` unless the stage is parked and at rest, read now."""
        if self._park_nm is None:
            raise Unsafe(
                "feed: nobody knows where the stage is out of its way. Nothing was sent.",
                fix="set stage.z.park_um in the instrument file.",
            )
        first_um = self._stage.position_um()
        self._clock.sleep(REST_S)
        second_um = self._stage.position_um()
        moving = abs(to_nm(second_um) - to_nm(first_um)) > AT_REST_NM
        if moving or abs(to_nm(second_um) - self._park_nm) > PARK_TOLERANCE_NM:
            raise Unsafe(
                f"z stage: it {'moves' if moving else 'is'} at {second_um:+.2f} µm, not parked at "
                f"{to_um(self._park_nm):+.2f} µm. Neither feed nor knife moved.",
                fix="park it: stereotome stage park",
            )
        self._clear_seen = False

    def _see_clear(self) -> None:
        """Raise `Unsafe` unless the knife is clear, read twice."""
        if self._feed is not None:
            self._check_clear(self._feed)
            self._clock.sleep(CLEAR_TWICE_S)
            self._check_clear(self._feed)
        self._clear_seen = True

    def _check_clear(self, feed: Feed) -> None:
        state = feed.knife_state()
        if state not in (KnifeState.CLEAR, KnifeState.ABSENT):
            raise Unsafe(
                f"knife: it is {state}, not clear. The stage stays where it is.",
                fix="bring the knife out: stereotome section retract --knife",
            )


class GuardedStage:
    """A stage that asks the arbiter before it moves; all else goes straight to the driver, `halt` above all."""

    def __init__(self, stage: Stage, arbiter: Arbiter) -> None:
        self._stage = stage
        self.arbiter = arbiter

    def __getattr__(self, name: str) -> Any:
        """Give what only some stages can do."""
        if name in MOVES_THE_STAGE:
            return _after(lambda: self.arbiter.before_stage_moves(None), getattr(self._stage, name))
        return getattr(self._stage, name)

    @property
    def limits(self) -> Limits:
        """Soft limits in µm."""
        return self._stage.limits

    def move_to(self, z_um: float) -> None:
        """Start a move, if the knife is out of the way; see `devices.protocols.Stage`."""
        self.limits.check(z_um)
        self.arbiter.before_stage_moves(z_um)
        self._stage.move_to(z_um)

    def settle(self, timeout_s: float) -> float:
        """Wait until the axis rests."""
        return self._stage.settle(timeout_s)

    def position_um(self) -> float:
        """Read the position now, in µm."""
        return self._stage.position_um()

    def halt(self) -> None:
        """Stop all motion of this axis."""
        self._stage.halt()

    def close(self) -> None:
        """Release the port."""
        self._stage.close()


class GuardedFeed:
    """A feed that asks the arbiter before it moves; all else goes straight to the driver, `halt` above all."""

    def __init__(self, feed: Feed, arbiter: Arbiter) -> None:
        self._feed = feed
        self.arbiter = arbiter
        if isinstance(feed, Microtome):
            feed.allow_cuts(arbiter.before_feed_moves)  # asked once more by the driver, right before the stroke

    def __getattr__(self, name: str) -> Any:
        """Give what only some feeds can do."""
        if name in MOVES_THE_FEED:
            return _after(self.arbiter.before_feed_moves, getattr(self._feed, name))
        return getattr(self._feed, name)

    @property
    def thickness_limits(self) -> tuple[float, float]:
        """Least and greatest thickness of one section in nm."""
        return self._feed.thickness_limits

    def advance_to(self, depth_nm: float) -> None:
        """Feed forward, if the stage is parked; see `devices.protocols.Feed`."""
        self.arbiter.before_feed_moves()
        self._feed.advance_to(depth_nm)

    def position_nm(self) -> float:
        """Read the depth now, in nm."""
        return self._feed.position_nm()

    def cut(self) -> None:
        """Take one section, if the stage is parked."""
        self._feed.cut()

    def knife_state(self) -> KnifeState:
        """Read the knife's sensors."""
        return self._feed.knife_state()

    def cut_count(self) -> int:
        """Read the counter of strokes."""
        return self._feed.cut_count()

    def halt(self) -> None:
        """Stop feed and knife."""
        self._feed.halt()

    def close(self) -> None:
        """Release the line."""
        self._feed.close()


def guarded(rig: Rig, clock: Clock) -> Rig:
    """Return an instrument whose stage and feed ask the arbiter; one that is guarded already stays as it is."""
    if isinstance(rig.stage, GuardedStage):
        return rig
    arbiter = arbiter_of(rig, clock)
    stage = _showing(GuardedStage, rig.stage)(rig.stage, arbiter)
    feed = None if rig.feed is None else _showing(GuardedFeed, rig.feed)(rig.feed, arbiter)
    return Rig(rig.spec, stage, rig.camera, feed, rig.glasses, open_camera=rig.reopen_camera)


def _showing(guard: type[G], device: object) -> type[G]:
    """Return a guard whose class has what only this device can do: from Python 3.12 on a protocol looks there alone."""
    only = [name for name in dir(device) if not name.startswith("_") and not hasattr(guard, name)]
    return type(guard.__name__, (guard,), {name: property(partial(_passed_on, name=name)) for name in only})


def _passed_on(guard: Any, name: str) -> Any:
    return guard.__getattr__(name)


def arbiter_of(rig: Rig, clock: Clock) -> Arbiter:
    """Return an arbiter over an instrument's stage and feed; it has not seen the knife yet."""
    park_um = rig.spec.stage.z.park_um
    return Arbiter(rig.stage, rig.feed, None if park_um is None else to_nm(park_um), clock)


def lease_of(stage: Stage) -> MotionLease:
    """Return the lease on a stage's motion; a stage that nobody guards has one of its own."""
    return stage.arbiter.lease if isinstance(stage, GuardedStage) else MotionLease()


def _after(check: Callable[[], None], do: Callable[..., Any]) -> Callable[..., Any]:
    def checked(*given: Any, **named: Any) -> Any:
        check()
        return do(*given, **named)

    return checked
