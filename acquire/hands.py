"""Stage, feed and knife moved by hand from afar: inside the limits, one motion at a time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

from acquire.interlock import arbiter_of
from acquire.replies import Depth, FeedView, Position
from devices.errors import DeviceError, LinkLost, RigError, Unsafe
from devices.protocols import Microtome
from devices.travel import CanZero, travel
from devices.values import to_nm

if TYPE_CHECKING:
    from devices.feed_values import FeedState
    from devices.protocols import Clock, Feed
    from devices.rig import Rig

NM_PER_UM = 1000
PARKED_WITHIN_UM = 5.0


@runtime_checkable
class TellsState(Protocol):
    """A feed that says where its cycle stands."""

    @property
    def state(self) -> FeedState:
        """Where it stands."""
        ...


@runtime_checkable
class MetAnew(Protocol):
    """A feed that can be met anew after its line was lost; nothing moves."""

    def reconnect(self) -> FeedState:
        """Open the line, make sure who is there, and look."""
        ...


class Hands:
    """What a hand may do. Used by one thread."""

    def __init__(self, rig: Rig, clock: Clock) -> None:
        self._rig = rig
        self._clock = clock

    def move(self, z_um: float) -> Position:
        """Bring the stage to a position; while the knife is not seen to be clear, to its park position only."""
        arbiter_of(self._rig, self._clock).before_stage_moves(z_um)
        return Position(z_um=travel(self._rig.stage, self._rig.spec.stage.z, z_um))

    def jog(self, by_um: float) -> Position:
        """Bring the stage further by a distance."""
        return self.move(self._rig.stage.position_um() + by_um)

    def zero(self) -> Position:
        """Call the present place 0 µm."""
        stage = self._rig.stage
        if not isinstance(stage, CanZero):
            raise DeviceError("z stage: this controller's positions are absolute.", code="stage-no-zero")
        stage.zero_here()
        return Position(z_um=stage.position_um())

    def approach(self, depth_um: float) -> Depth:
        """Bring the block near the knife."""
        _, by_hand = self._feed()
        by_hand.approach_to(depth_um * NM_PER_UM)
        return self._depth()

    def home(self) -> Depth:
        """Let the feed search its reference."""
        self._feed_seen().home()
        return self._depth()

    def retract(self) -> Depth:
        """Bring the knife out, then look: a feed that was in doubt is ready again if nothing speaks against it."""
        by_hand = self._feed_seen()
        by_hand.abort()
        by_hand.resolve()
        return self._depth()

    def feed(self, thickness_nm: float) -> Depth:
        """Feed forward by one section; sent once, whatever happens on the line."""
        feed, _ = self._feed()
        feed.advance_to(feed.position_nm() + thickness_nm)
        return self._depth()

    def arm(self) -> None:
        """Allow one cut within the next seconds."""
        self._feed()[1].arm()

    def cut(self) -> Depth:
        """Take one section; the microscope must be parked."""
        feed, by_hand = self._feed()
        by_hand.allow_cuts(self._check_parked)
        feed.cut()
        return self._depth()

    def cuts(self) -> int:
        """Return how many strokes the knife has counted."""
        return self._feed()[0].cut_count()

    def look_at_feed(self) -> FeedView | None:
        """Read feed and knife; None without them."""
        if self._rig.feed is None:
            return None
        feed, _ = self._feed()
        return FeedView(
            state=str(feed.state) if isinstance(feed, TellsState) else "",
            depth_nm=feed.position_nm(),
            knife=str(feed.knife_state()),
            cuts=feed.cut_count(),
        )

    def _feed(self) -> tuple[Feed, Microtome]:
        feed = self._rig.feed
        if feed is None or not isinstance(feed, Microtome):
            raise RigError(
                "this instrument has no feed.", fix="add [microtome] to the instrument file: docs/microtome.md"
            )
        return feed, feed

    def _feed_seen(self) -> Microtome:
        """Return the feed after a look, met anew if its line was lost: for what may be done whatever its state."""
        feed, by_hand = self._feed()
        try:
            by_hand.resolve()
        except LinkLost:
            if not isinstance(feed, MetAnew):
                raise
            feed.reconnect()
        return by_hand

    def _depth(self) -> Depth:
        feed, _ = self._feed()
        return Depth(depth_nm=feed.position_nm(), cuts=feed.cut_count())

    def _check_parked(self) -> None:
        """Raise `Unsafe` unless the stage stands where the instrument file says it is out of the knife's way."""
        park_um = self._rig.spec.stage.z.park_um
        if park_um is None:
            raise Unsafe(
                "knife: the instrument file names no place where the microscope is out of its way. Nothing was cut.",
                fix="set stage.z.park_um",
            )
        z_um = self._rig.stage.position_um()
        if abs(to_nm(z_um) - to_nm(park_um)) > to_nm(PARKED_WITHIN_UM):
            raise Unsafe(
                f"knife: the microscope stands at {z_um:+.2f} µm, it is parked at {park_um:+.2f} µm. Nothing was cut.",
                fix="park the stage first",
            )
