"""A drive that moves a feed: started once, watched until it rests, judged by what it reads back."""

from __future__ import annotations

from dataclasses import dataclass
from threading import Event
from typing import TYPE_CHECKING, ClassVar

from devices.errors import DeviceError, LinkError, LinkLost, Refused
from devices.feed_errors import FeedAlarm, FeedAstray, FeedEstop, FeedHalted, FeedStalled, not_executed, undecided

if TYPE_CHECKING:
    from devices.drivers.registers import Registers
    from devices.protocols import Clock
    from devices.transport.modbus import Addressed

ARRIVED_COUNTS = 1
ASTRAY_UM = 0.5


@dataclass(frozen=True)
class DriveStatus:
    """What the drive says of itself; None where its profile has no such bit."""

    fault: bool
    moving: bool
    enabled: bool | None
    done: bool | None
    homed: bool | None
    estop: bool | None


class FeedDrive:
    """Motion in the drive's own counts.

    Parameters
    ----------
    registers : Registers
        The drive's registers.
    clock : Clock
        Time.
    """

    POLL_S: ClassVar = 0.01
    STALL_S: ClassVar = 1.0
    GRACE_S: ClassVar = 2.0
    DEADLINE_FACTOR: ClassVar = 1.5

    def __init__(self, registers: Registers, clock: Clock) -> None:
        self.registers = registers
        self.profile = registers.profile
        self._clock = clock
        self.halted = Event()

    def status(self) -> DriveStatus:
        """Read the status."""
        seen: dict[str, int] = {}
        state = self.profile.state
        bits = {"fault": state.fault, "moving": state.moving, "enabled": state.enabled}
        bits |= {"done": state.done, "homed": state.homed, "estop": state.estop}
        return DriveStatus(**{name: self.registers.test(bit, seen) if bit else None for name, bit in bits.items()})  # type: ignore[arg-type]

    def counts(self) -> int:
        """Read where it is."""
        return self.registers.number("position")

    def go(self, target: int) -> int:
        """Move to a place and return where it then is; the command is sent once.

        When the reply is lost, what the drive reads back decides: at the target, it was executed; at the start and at
        rest, it was not.

        Raises
        ------
        DeviceError
            feed-not-executed: nothing moved.
        FeedUndecided
            No read-back could be had.
        FeedAlarm, FeedEstop, FeedHalted, FeedStalled, FeedAstray
            It stopped elsewhere, and why.
        """
        start = self.counts()
        if start == target:
            return start
        self.halted.clear()
        doubt = self._send_off(target)
        try:
            here = self.settle(start, target)
        except LinkLost:
            raise
        except LinkError as error:
            raise undecided("the move was sent", error) from error
        if abs(here - target) <= ARRIVED_COUNTS:
            return here
        if abs(here - start) <= ARRIVED_COUNTS:
            raise not_executed("the move", doubt or DeviceError("The drive took it and did not act on it."))
        raise self.astray(here, f"of {target} counts")

    def settle(self, start: int, target: int) -> int:
        """Watch a move until it rests and return where that is.

        The "done" of the move before is not believed until motion was seen or ``start_guard_ms`` have passed.
        """
        began = self._clock.now()
        deadline = began + self._expected_s(target - start)
        progress, last, seen = began, start, False
        while True:
            status, words = self._look()
            here, now = self.profile.number_in("position", words), self._clock.now()
            self._check_on_its_way(here, start, target)
            progress, last = (now, here) if here != last else (progress, last)
            seen = seen or status.moving or here != start
            believed = seen or now - began >= self.profile.state.start_guard_ms / 1000
            if believed and not status.moving and status.done is not False:
                return self.counts()
            self._check_progress(here, now - progress, late=now > deadline)
            self._clock.sleep(self.POLL_S)

    def home(self, timeout_s: float) -> None:
        """Search the reference and wait for it; the feed moves to its home switch.

        Raises `Unsafe` when that motion shows that the drive swaps the words of its numbers: a feed would go anywhere.
        """
        self.halted.clear()
        path = [self.registers.words("position")]
        try:
            self.registers.do(self.profile.do.home)
        except LinkLost:
            raise
        except LinkError:
            self._look()  # homing may be asked for twice; whether it runs, the watch below sees
        began, seen = self._clock.now(), False
        while True:
            status, words = self._look()
            path.append(words)
            now = self._clock.now()
            seen = seen or status.moving
            believed = seen or now - began >= self.profile.state.start_guard_ms / 1000
            if believed and not status.moving:
                break
            if now - began > timeout_s:
                self.stop()
                raise FeedStalled(f"feed: no home found within {timeout_s:g} s; it was told to stop.")
            self._clock.sleep(self.POLL_S)
        self.registers.check_path("position", path)
        if status.homed is False or (status.homed is None and not seen and self.counts() != 0):
            raise DeviceError(
                "feed: the drive did not home.",
                why="It stands still without a reference.",
                fix="check home switch and homing mode in the drive.",
                code="feed-not-homed",
            )

    def stop(self) -> None:
        """Stop at once; from any thread."""
        self.halted.set()
        self.registers.bus.write_urgently(self.stop_writes())

    def stop_writes(self) -> list[Addressed]:
        """Return what stops it."""
        return self.registers.urgently(self.profile.do.stop)

    def check_alarm(self) -> DriveStatus:
        """Return the status; raises `FeedAlarm` with the manual's word for it, or `FeedEstop`."""
        status = self.status()
        if status.estop:
            raise FeedEstop("feed: the emergency stop is pressed.", fix="release it, then look again.")
        if status.fault:
            code = self.registers.number("alarm")
            raise FeedAlarm(
                f"feed: alarm {code:#x}: {self.profile.alarm_words(code)}.",
                why="The drive stopped by itself; where it is was read back.",
                fix="see to the cause, then reset: stereotome section show --reset",
            )
        return status

    def astray(self, here: int, words: str) -> FeedAstray:
        """Return the error for a feed that is where it should not be."""
        return FeedAstray(
            f"feed: it stands at {here} counts instead {words}.",
            why="Somebody else commands this drive, it lost steps, or its word order is not the profile's.",
            fix="look at the drive, check word_order, and home again before anything else.",
        )

    def _send_off(self, target: int) -> DeviceError | None:
        """Send the move; return what makes it doubtful, if anything does."""
        try:
            self.registers.do(self.profile.do.move_abs, **self.motion(target))
        except LinkLost:
            raise
        except (LinkError, Refused) as error:
            return error
        return None

    def motion(self, target: int) -> dict[str, int]:
        """Return the values a profile's move may name."""
        axis = self.profile.axis
        speed = max(1, round(axis.speed_um_s * axis.speed_per_um_s))
        return {"pos": target, "speed": speed, "acc": axis.acc, "dec": axis.dec}

    def _look(self) -> tuple[DriveStatus, list[int]]:
        """Return the status, and the words of the position."""
        status, words = self.check_alarm(), self.registers.words("position")
        if self.halted.is_set():
            here = self.profile.number_in("position", words)
            raise FeedHalted(f"feed: halted at {here} counts.", fix="look again before going on: section show")
        return status, words

    def _check_on_its_way(self, here: int, start: int, target: int) -> None:
        margin = max(2 * ARRIVED_COUNTS, round(ASTRAY_UM * self.profile.axis.counts_per_um))
        if not min(start, target) - margin <= here <= max(start, target) + margin:
            self.stop()
            raise self.astray(here, f"of between {start} and {target}")

    def _check_progress(self, here: int, still_s: float, *, late: bool) -> None:
        if still_s > self.STALL_S or late:
            self.stop()
            raise FeedStalled(
                f"feed: no progress for {still_s:.1f} s at {here} counts; it was told to stop.",
                why="The feed is blocked, or the drive's torque or speed is too low.",
                fix="free the feed by hand with the drive off, then home it.",
            )

    def _expected_s(self, distance: int) -> float:
        axis = self.profile.axis
        return abs(distance) / axis.counts_per_um / axis.speed_um_s * self.DEADLINE_FACTOR + self.GRACE_S
