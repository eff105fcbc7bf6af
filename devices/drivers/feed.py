"""A microtome's or polisher's feed over Modbus, with its knife and its interlocks."""

from __future__ import annotations

import logging
from threading import Event, Thread
from typing import TYPE_CHECKING

from devices.drivers.feed_cycle import FeedCycle
from devices.drivers.feed_drive import ARRIVED_COUNTS, FeedDrive
from devices.drivers.knife import Knife
from devices.drivers.registers import Registers
from devices.errors import DeviceError, LimitError, LinkLost, Unsafe
from devices.feed_errors import FeedAstray, FeedNotExecuted, FeedUndecided, KnifeFailed
from devices.feed_spec import KnifeSpec
from devices.feed_values import FeedState, KnifeState
from devices.transport.modbus import open_bus

if TYPE_CHECKING:
    from collections.abc import Callable

    from devices.feed_spec import FeedSpec
    from devices.profile import Profile
    from devices.protocols import Clock
    from devices.registry import DeviceContext
    from devices.transport.modbus import RegisterBus

log = logging.getLogger(__name__)

S = FeedState
NM_PER_UM = 1000
ARMED_FOR_S = 10.0
BEATS = 0x10000
POWER_ON_REACH_UM = 1000.0


def _no_interlock() -> None:
    raise Unsafe(
        "knife: nothing vouches for the microscope being out of its way. Nothing was cut.",
        fix="a run does this itself; by hand, park the stage and say so: section cut --stage-is-parked",
    )


class ModbusFeed:
    """A feed on a line; also a `devices.protocols.Feed`.

    Nothing moves until the drive is referenced and a look at it (`resolve`) found no alarm and, with a knife, the knife
    clear. Depth counts from the home position, towards the knife; the place in counts is computed from the depth each
    time anew, so that rounding never adds up.

    Parameters
    ----------
    bus : RegisterBus
        The line; closed by `close`.
    spec : FeedSpec
        What the instrument file says.
    may_cut : callable
        Raises `Unsafe` unless the microscope is out of the knife's way; asked right before each stroke.
    """

    def __init__(
        self, bus: RegisterBus, spec: FeedSpec, clock: Clock, *, may_cut: Callable[[], None] = _no_interlock
    ) -> None:
        self.profile = spec.feed_profile()
        self.removed_nm: list[float] = []
        self._bus = bus
        self._spec = spec
        self._clock = clock
        self._may_cut = may_cut
        self._drive = FeedDrive(Registers(bus, self.profile), clock)
        self._knife = self._make_knife(spec)
        self._cycle = FeedCycle()
        self._referenced = False
        self._expected: int | None = None
        self._armed_until_s = clock.now() - 1
        self._beats = 0

    @property
    def thickness_limits(self) -> tuple[float, float]:
        """Least and greatest thickness of one section in nm."""
        return self._spec.limits.thickness_nm_min, self._spec.limits.thickness_nm_max

    @property
    def state(self) -> FeedState:
        """Where the cycle stands."""
        return self._cycle.state

    @property
    def has_knife(self) -> bool:
        """Whether a knife is set up."""
        return self._knife is not None

    def identify(self) -> None:
        """Make sure that it is the drive the profile describes, and that numbers mean what they seem to.

        Raises
        ------
        Unsafe
            Another drive, or one with its words in the other order.
        """
        registers, axis = self._drive.registers, self.profile.axis
        registers.check_identity()
        reach = (POWER_ON_REACH_UM + axis.max_um - axis.min_um) * axis.counts_per_um
        registers.check_word_order("position", -reach, reach)
        if self.profile.do.limits:
            self._set_drive_limits()
        self.resolve()

    def resolve(self) -> FeedState:
        """Look at feed and knife without moving anything, and say where things stand.

        The only way out of UNKNOWN, ALARM and ESTOPPED.
        """
        with self._cycle.during(S.IDLE):
            status = self._drive.check_alarm()
            here = self._drive.counts()
            self._referenced = status.homed if status.homed is not None else self._referenced
            clear = self.knife_state() in (KnifeState.CLEAR, KnifeState.ABSENT)
            if self._referenced and clear and not status.moving:
                self._expected = here
                self._cycle.enter(S.READY)
        return self.state

    def home(self) -> None:
        """Find the reference: the feed moves to its home switch, away from the knife."""
        self._cycle.require(S.IDLE, S.READY)
        self._check_interlocks()
        with self._cycle.during(S.HOMING):
            if self.profile.do.enable and self._drive.status().enabled is False:
                self._drive.registers.do(self.profile.do.enable)
            self._drive.home(self._spec.home_timeout_s)
        self._referenced = True
        self.resolve()

    def trust_reference(self) -> None:
        """Take the operator's word that this drive, which does not tell, was homed since its power came on."""
        self._referenced = True
        self.resolve()

    def advance_to(self, depth_nm: float) -> None:
        """Feed forward to an absolute depth and read it back."""
        self._cycle.require(S.READY)
        self._check_thickness(depth_nm)
        self._move(S.ADVANCING, depth_nm)

    def approach_to(self, depth_nm: float) -> None:
        """Go to a depth in one go, forwards or backwards, whatever the thickness of a section; for setting up."""
        self._cycle.require(S.READY)
        self._check_depth(depth_nm)
        self._move(S.RETRACTING if depth_nm < self.position_nm() else S.ADVANCING, depth_nm)

    def position_nm(self) -> float:
        """Read the depth now, in nm."""
        return self._nm(self._drive.counts())

    def allow_cuts(self, may_cut: Callable[[], None]) -> None:
        """Let ``may_cut`` vouch for the microscope from now on: it raises `Unsafe` unless that is out of the way."""
        self._may_cut = may_cut

    def arm(self) -> None:
        """Allow one cut within the next 10 s."""
        self._cycle.require(S.READY)
        self._armed_until_s = self._clock.now() + ARMED_FOR_S

    def cut(self) -> None:
        """Take one section: stroke, retract by the clearance, knife clear, return, verify.

        Raises
        ------
        Unsafe
            No knife, not ready, not armed, knife not clear, or ``may_cut`` said no; nothing was cut.
        FeedUndecided
            The stroke may or may not have cut. The knife was brought out, nothing else moves until `resolve`.
        KnifeFailed
            It is stuck; it was told to come out.
        """
        self._stroke(0)

    def sweep(self, distance_nm: float) -> None:
        """Let the knife wipe over the face with the feed drawn back: one stroke that cuts nothing; raises as `cut`."""
        self._stroke(abs(round(distance_nm * self._counts_per_nm)))

    @property
    def behind_nm(self) -> float:
        """How far behind its depth a stroke or the taking up of lost motion may leave the feed."""
        return max(self._knife_spec.clearance_um, self.profile.axis.backlash_um) * NM_PER_UM

    def _stroke(self, drawn_back: int) -> None:
        self._cycle.require(S.READY)
        knife = self._armed_knife()
        self._check_interlocks()
        self._may_cut()
        depth = self._fresh_counts()
        if drawn_back:
            with self._cycle.during(S.RETRACTING):
                self._expected = self._drive.go(self._behind(depth, drawn_back))
            self._cycle.enter(S.READY)
        try:
            with self._cycle.during(S.CUTTING):
                knife.set_stroke()
                knife.cut()
        except DeviceError as error:
            self._bring_out(knife, error)
            raise
        self._withdraw(knife, depth, drawn_back)

    def abort(self) -> None:
        """Bring the knife out without a further feed; whatever the state."""
        if self._knife is not None:
            with self._cycle.during(S.CLEARING):
                self._knife.park()
        self._cycle.enter(S.IDLE)

    def knife_state(self) -> KnifeState:
        """Read the knife's sensors."""
        return self._knife.state() if self._knife else KnifeState.ABSENT

    def cut_count(self) -> int:
        """Read the counter of strokes; 0 without a knife."""
        return self._knife.count() if self._knife else 0

    def record_removal(self, removed_nm: float) -> None:
        """Note what a polisher took off, as measured afterwards."""
        self.removed_nm.append(removed_nm)

    def jog(self, distance_sign: int, seconds: float) -> None:
        """Run slowly while reminded, at most every 50 ms, for a time; stops by itself when the reminders end."""
        self._cycle.require(S.READY)
        jog = self.profile.jog
        if jog is None:
            raise Unsafe("feed: this drive cannot be jogged. Nothing was sent.", fix="use section approach.")
        self._check_interlocks()
        action = jog.plus if distance_sign > 0 else jog.minus
        ends_s = self._clock.now() + seconds
        with self._cycle.during(S.ADVANCING):
            try:
                self._drive.registers.do(action)
                while self._clock.now() < ends_s:
                    self._clock.sleep(min(jog.repeat_ms / 1000 or FeedDrive.POLL_S, ends_s - self._clock.now()))
                    self._check_depth(self.position_nm())
                    if jog.repeat_ms:
                        self._drive.registers.do(action)
            finally:
                self._drive.registers.do(jog.release)
        self._wait_for_rest()
        self.resolve()

    def reset_alarm(self) -> FeedState:
        """Clear the drive's alarm, then look; nothing moves."""
        if self.profile.do.reset:
            self._drive.registers.do(self.profile.do.reset)
        return self.resolve()

    def reconnect(self) -> FeedState:
        """Connect anew after the line was lost, make sure who is there, and look.

        A drive that does not tell whether it was homed may have been off: it is homed again before anything moves.
        """
        self._cycle.enter(S.UNKNOWN)
        self._referenced = False
        self._bus.reopen()
        self.identify()
        return self.state

    def keep_alive(self) -> None:
        """Say something, so that a drive that hangs up after a silence does not, and one that waits for us goes on."""
        self._beats = (self._beats + 1) % BEATS
        self._drive.registers.words("status")
        if self.profile.do.heartbeat:
            self._drive.registers.do(self.profile.do.heartbeat, beat=self._beats)

    def halt(self) -> None:
        """Stop feed and knife; from any thread, whatever another is waiting for."""
        self._drive.halted.set()
        knife = self._knife.stop_writes() if self._knife else []
        self._bus.write_urgently([*self._drive.stop_writes(), *knife])

    def close(self) -> None:
        """Release the line; feed and knife stay where they are."""
        self._bus.close()

    def _make_knife(self, spec: FeedSpec) -> Knife | None:
        profile, table = spec.knife_profile(), spec.knife or KnifeSpec()
        if profile.knife is None or (spec.knife is None and spec.kind == "polisher"):
            return None
        return Knife(Registers(self._bus, profile), profile.knife, table, self._clock, self._drive.halted)

    def _move(self, state: FeedState, depth_nm: float) -> None:
        self._check_interlocks()
        here, target = self._fresh_counts(), self._counts(depth_nm)
        try:
            with self._cycle.during(state):
                self._approach_from_behind(here, target)
        except FeedNotExecuted:
            self.resolve()
            raise
        self._cycle.enter(S.READY)

    def _approach_from_behind(self, here: int, target: int) -> None:
        """Take lost motion out: the last way is always forward, and longer than it."""
        slack = round(self.profile.axis.backlash_um * self.profile.axis.counts_per_um)
        run_up = self._behind(min(here, target, key=self._nm), slack)
        if slack:
            self._expected = self._drive.go(run_up)
        self._expected = self._drive.go(target)

    def _wait_for_rest(self) -> None:
        patience_s = self._clock.now() + FeedDrive.GRACE_S
        while self._drive.status().moving and self._clock.now() < patience_s:
            self._clock.sleep(FeedDrive.POLL_S)

    def _withdraw(self, knife: Knife, depth: int, drawn_back: int) -> None:
        """Draw the feed back, bring the knife out, return to the same depth, and verify."""
        axis = self.profile.axis
        clearance = round(self._knife_spec.clearance_um * axis.counts_per_um)
        back = self._behind(depth, max(clearance, drawn_back))
        with self._cycle.during(S.RETRACTING):
            self._expected = self._drive.go(back)
        with self._cycle.during(S.CLEARING):
            knife.park()
        with self._cycle.during(S.VERIFYING):
            self._expected = self._drive.go(depth)
            knife.check_clear()
        self._cycle.enter(S.READY)

    def _behind(self, place: int, distance: int) -> int:
        """Return a place further from the knife, as far as the limits go."""
        least = self._counts(self._spec.limits.feed_um_min * NM_PER_UM)
        return max(place - self._sense * distance, least, key=self._nm)

    def _bring_out(self, knife: Knife, error: DeviceError) -> None:
        """After a failed stroke: knife out, no feed; what is known afterwards is no more than before."""
        state = self.state
        if isinstance(error, FeedNotExecuted):
            self.resolve()
            return
        if isinstance(error, FeedUndecided | KnifeFailed):
            try:
                knife.park()
            except DeviceError as worse:
                error.add_note(worse.what)
        self._cycle.enter(state)

    @property
    def _knife_spec(self) -> KnifeSpec:
        return self._spec.knife or KnifeSpec()

    def _armed_knife(self) -> Knife:
        if self._knife is None:
            raise Unsafe("feed: no knife is set up. Nothing was sent.", fix="add [microtome.knife] to the file.")
        armed, self._armed_until_s = self._clock.now() <= self._armed_until_s, self._clock.now() - 1
        if not armed:
            raise Unsafe(
                f"knife: not armed, or armed more than {ARMED_FOR_S:g} s ago. Nothing was cut.",
                fix="arm it right before the cut.",
            )
        return self._knife

    def _check_interlocks(self) -> None:
        seen: dict[str, int] = {}
        for name, bit in self.profile.interlocks.items():
            if not self._drive.registers.test(bit, seen):
                raise Unsafe(f"feed: the interlock '{name}' is open. Nothing was sent.", fix=f"see to it: {name}.")
        if self._knife is not None and self._spec.interlock == "knife_clear":
            self._knife.check_clear()

    def _check_thickness(self, depth_nm: float) -> None:
        self._check_depth(depth_nm)
        least, most = self.thickness_limits
        thickness_nm = depth_nm - self._nm(self._expected or 0)
        half_count_nm = NM_PER_UM / self.profile.axis.counts_per_um
        if not least - half_count_nm <= thickness_nm <= most + half_count_nm:
            raise LimitError(
                f"feed: a section of {thickness_nm:.0f} nm is not within {least:g} … {most:g} nm. Nothing moved.",
                fix="choose another thickness, or change limits in [microtome].",
            )

    def _check_depth(self, depth_nm: float) -> None:
        limits = self._spec.limits
        if not limits.feed_um_min * NM_PER_UM <= depth_nm <= limits.feed_um_max * NM_PER_UM:
            raise LimitError(
                f"feed: a depth of {depth_nm / NM_PER_UM:.2f} µm is outside "
                f"{limits.feed_um_min:g} … {limits.feed_um_max:g} µm. Nothing moved.",
                fix="retract and trim the block anew, or change limits in [microtome].",
            )

    def _fresh_counts(self) -> int:
        """Read the position; raises `FeedAstray` when it is not where the command before left it, or counts anew."""
        self._check_reference_kept()
        here = self._drive.counts()
        if self._expected is not None and abs(here - self._expected) > ARRIVED_COUNTS:
            self._cycle.enter(S.UNKNOWN)
            raise FeedAstray(
                f"feed: it stands at {self._nm(here):.0f} nm, but was left at {self._nm(self._expected):.0f} nm. "
                "Nothing was sent.",
                why="It was moved by hand, or its power went off and on.",
                fix="home it, then compare the depth with the last section.",
            )
        return here

    def _check_reference_kept(self) -> None:
        """Ask a drive that can tell: one that was off counts anew, and may by chance say the number expected."""
        if self._drive.status().homed is False:
            self._referenced = False
            self._cycle.enter(S.UNKNOWN)
            raise FeedAstray(
                "feed: the drive is not homed any more. Nothing was sent.",
                why="Its power went off and on.",
                fix="home it, then compare the depth with the last section.",
            )

    def _set_drive_limits(self) -> None:
        limits = self._spec.limits
        low, high = (self._counts(um * NM_PER_UM) for um in (limits.feed_um_min, limits.feed_um_max))
        slack = round(self.profile.axis.backlash_um * self.profile.axis.counts_per_um)
        bounds = {"min": min(low, high) - slack, "max": max(low, high) + slack}
        for step in self.profile.do.limits:
            term = step.terms[0]
            self._drive.registers.put(step.reg, bounds[term] if isinstance(term, str) else term)

    @property
    def _sense(self) -> int:
        return -1 if self.profile.axis.invert else 1

    @property
    def _counts_per_nm(self) -> float:
        return self._sense * self.profile.axis.counts_per_um / NM_PER_UM

    def _counts(self, depth_nm: float) -> int:
        return round(depth_nm * self._counts_per_nm)

    def _nm(self, counts: int) -> float:
        return counts / self._counts_per_nm


class Heartbeat:
    """Keeps a line awake from a thread of its own until it is closed; what fails there, the next command says."""

    def __init__(self, feed: ModbusFeed, period_s: float) -> None:
        self._feed = feed
        self._period_s = period_s
        self._over = Event()
        self._thread = Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._over.wait(self._period_s):
            try:
                self._feed.keep_alive()
            except LinkLost:
                return
            except DeviceError as error:
                log.warning("heartbeat: %s", error.what)


class OpenFeed(ModbusFeed):
    """A feed whose line is kept awake."""

    heartbeat: Heartbeat | None = None

    def close(self) -> None:
        """End the heartbeat and release the line."""
        if self.heartbeat is not None:
            self.heartbeat.close()
        super().close()


def open_feed(table: FeedSpec, context: DeviceContext, *, look: bool = True) -> ModbusFeed:
    """Open the line, make sure which drive is there, and look where it stands; nothing moves.

    Without ``look`` nothing is asked: for a stop, or for a drive in alarm.

    Raises
    ------
    DeviceError
        device-missing, device-permission, device-busy, device-silent; feed-alarm and the like; what `identify` says.
    """
    profile: Profile = table.feed_profile()
    transcript = context.transcript / "feed.jsonl" if context.transcript else None
    feed = OpenFeed(open_bus(table.port, profile, context.clock, transcript), table, context.clock)
    try:
        if look:
            feed.identify()
    except BaseException:
        feed.close()
        raise
    if profile.link.kind != "rtu" or profile.do.heartbeat:
        feed.heartbeat = Heartbeat(feed, profile.link.heartbeat_s)
    return feed
