"""A stage on a serial line that is asked again and again until it rests: what drivers of such stages share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from threading import Event
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from devices.drivers.arrival import Arrival
from devices.errors import DeviceError, LinkLost, MalformedReply, NoReply, StageStalled, StageTimeout
from devices.link import RECONNECT_S, Link
from devices.transport.serial_port import SerialPort
from devices.transport.transcript import Recorder

if TYPE_CHECKING:
    from collections.abc import Callable

    from devices.protocols import Clock, Transport
    from devices.registry import DeviceContext
    from devices.rig import AxisSpec
    from devices.values import Limits
    from devices.wire.exchange import Request

FAST_BAUD = 57600
FAST_POLL_S = 0.004
SLOW_POLL_S = 0.02  # at 9600 baud a question and its answer take 15 ms of wire, and an FTDI adapter adds as much
REPLY_TIMEOUT_S = 0.5


class PolledStage(ABC):
    """Drives one axis; every method may be called from any thread, one conversation at a time.

    A driver says how its controller starts a move, what one reading of it is, what halts it and how it is greeted.
    After a lost link, or a controller that fell silent, moves are refused until `reconnect` succeeded.

    Parameters
    ----------
    link : Link
        To the controller.
    spec : AxisSpec
        ``[stage.z]`` of the instrument file.
    clock : Clock
        Time.
    tolerance_um : float
        How near to its target an axis that rests has to be.

    Attributes
    ----------
    counts_from_power_on : bool
        Whether a controller that was switched off and on calls the place 0 where it stands then.
    """

    counts_from_power_on: ClassVar[bool] = True

    def __init__(self, link: Link, spec: AxisSpec, clock: Clock, *, tolerance_um: float) -> None:
        self._link = link
        self._clock = clock
        self._spec = spec
        self._tolerance_um = tolerance_um
        self._poll_s = FAST_POLL_S if spec.baud >= FAST_BAUD else SLOW_POLL_S
        self._target_um: float | None = None
        self._met: str | None = None
        self._halted = Event()

    @property
    def limits(self) -> Limits:
        """Soft limits in µm."""
        return self._spec.soft_limits

    @property
    def position_known(self) -> bool:
        """Tell whether the controller has been in touch without a break since it was greeted."""
        return self._link.position_known

    def move_to(self, z_um: float) -> None:
        """Start an absolute move; raises `LimitError` with nothing sent, position-unknown before a `reconnect`."""
        self.limits.check(z_um)
        self._halted.clear()
        self._target_um = z_um
        self._start(z_um)

    def settle(self, timeout_s: float) -> float:
        """Wait until the axis rests at its target, then for ``settle_ms``, and return the position read last.

        Rest is the arrival rule of `Arrival`; without a move before, any place will do. A halted move never arrives.

        Raises
        ------
        StageStalled
            No progress for 1 s, or halted.
        StageTimeout
            Still moving after ``timeout_s``.
        """
        arrival = Arrival(self._target_um, tolerance_um=self._tolerance_um, now=self._clock.now())
        deadline = self._clock.now() + timeout_s
        while True:
            moving, z_um = self._moving(), self.position_um()
            now = self._clock.now()
            if arrival.reached(z_um, now, moving=moving):
                return self._rested(z_um)
            self._check_under_way(arrival, z_um, now, deadline, timeout_s)
            self._clock.sleep(arrival.wait_s(now, self._poll_s))

    @abstractmethod
    def position_um(self) -> float:
        """Read the position now, in µm."""

    def halt(self) -> None:
        """Stop all axes of the controller; goes out at once, whatever another thread is waiting for."""
        self._halted.set()
        self._link.interrupt(self._halting())

    def close(self) -> None:
        """Release the port; the axis stays where it is."""
        self._link.close()

    def reconnect(self, timeout_s: float = RECONNECT_S, *, at_um: float | None = None) -> float:
        """Open the port anew, make sure that the same controller answers, and return the position it tells, in µm.

        Moves are accepted again afterwards.

        Parameters
        ----------
        timeout_s : float
            After which no further attempt is begun.
        at_um : float or None
            Where it has to be, and at rest; None takes whatever it tells.

        Raises
        ------
        DeviceError
            Not within ``timeout_s``; another controller answers (device-other); it is elsewhere, or says 0 as after its
            power was off (position-unknown). Moves stay refused.
        """
        self._target_um = None
        return self._link.reconnect(self.greet if at_um is None else lambda: self._greet_at(at_um), timeout_s)

    def greet(self) -> float:
        """Identify the controller, make it ready to move, and return the position in µm.

        Raises
        ------
        DeviceError
            It is another one than before (device-other), or cannot be made ready.
        """
        told = self.identity()
        if self._met not in (None, told):
            raise DeviceError(
                f"z stage: another controller answers at {self._link.name}.",
                why=f"It was '{self._met}' and is '{told}'.",
                fix="check which cable is in which port, then start again.",
                code="device-other",
            )
        self._met = told
        self._prepare()
        return self.position_um()

    def _greet_at(self, at_um: float) -> float:
        """Greet the controller; raise `DeviceError` unless it stands where it was known to be last."""
        z_um = self.greet()
        if self._moving():
            raise DeviceError("z stage: it is back, and still moves.", fix="wait until it rests.")
        near_um = self._tolerance_um * Arrival.ROUNDING
        zeroed = self.counts_from_power_on and abs(z_um) <= near_um
        if zeroed or not abs(z_um - at_um) <= near_um:  # nor is it where it was if nobody knows where that is
            raise DeviceError(
                f"z stage: it was out of touch, {at_um:+.2f} µm was read last, and it says {z_um:+.2f} µm now. "
                "Nothing moved.",
                why=(
                    "It says 0 as after its power was off: then its numbers mean other places."
                    if zeroed
                    else "It was moved, or its power was off: then its numbers mean other places."
                ),
                fix=(
                    "look where it is, and call that place 0: stereotome control zero, or Zero here",
                    "or end the instrument's process, see to the stage, and start it anew",
                ),
                code="position-unknown",
            )
        return z_um

    @abstractmethod
    def identity(self) -> str:
        """Return what the controller says it is."""

    @abstractmethod
    def _prepare(self) -> None:
        """Make the controller ready to move, and compare what it tells with the instrument file."""

    @abstractmethod
    def _start(self, z_um: float) -> None:
        """Start an absolute move."""

    @abstractmethod
    def _moving(self) -> bool:
        """Ask whether the axis moves, or has not settled."""

    @abstractmethod
    def _halting(self) -> Request[Any]:
        """Return what halts the axis."""

    def _rested(self, z_um: float) -> float:
        if not self._spec.settle_ms:
            return z_um
        self._clock.sleep(self._spec.settle_ms / 1000)
        return self.position_um()

    def _check_under_way(self, arrival: Arrival, z_um: float, now: float, deadline: float, timeout_s: float) -> None:
        sent = "" if self._target_um is None else f", sent to {self._target_um:+.2f} µm"
        where = f"it is at {z_um:+.2f} µm{sent}"
        if self._halted.is_set():
            raise StageStalled(f"z stage: the move was halted; {where}.")
        if arrival.stalled(now):
            raise StageStalled(
                f"z stage: no progress for {arrival.STALL_S:g} s; {where}.",
                why=self._why_stalled(),
                fix="free the axis, check the controller's own limits, then start again.",
            )
        if now > deadline:
            raise StageTimeout(f"z stage: still moving after {timeout_s:g} s; {where}.")

    def _why_stalled(self) -> str:
        return "The axis is blocked, at a limit of the controller, was moved by hand, or lost its power."


S = TypeVar("S", bound=PolledStage)


def open_polled(
    table: AxisSpec, context: DeviceContext, make: Callable[[Link], S], *, terminator: bytes, fix: str
) -> S:
    """Open the port and greet the controller.

    Parameters
    ----------
    make : callable
        From the link to the driver.
    fix : str
        What to do when nothing sensible answers: usually, which baud the controller is delivered with.

    Raises
    ------
    DeviceError
        device-missing, device-permission, device-busy; device-silent or device-garbled when no valid answer comes;
        what `PolledStage.greet` raises.
    """

    def transport() -> Transport:
        port = SerialPort(table.port, table.baud, device="z stage")
        return (
            port if context.transcript is None else Recorder(port, context.transcript / "stage-z.jsonl", context.clock)
        )

    link = Link(transport(), context.clock, terminator=terminator, timeout_s=REPLY_TIMEOUT_S, reopen=transport)
    try:
        stage = make(link)
        _greet(stage, table, fix)
    except BaseException:
        link.close()
        raise
    return stage


def _greet(stage: PolledStage, table: AxisSpec, fix: str) -> None:
    try:
        stage.greet()
    except LinkLost:
        raise
    except (NoReply, MalformedReply) as error:
        raise _no_answer(table, error, fix) from error


def _no_answer(table: AxisSpec, error: NoReply | MalformedReply, fix: str) -> DeviceError:
    received = error.reply if isinstance(error, MalformedReply) else error.received
    came = f"unreadable data came back: {received[:16].hex(' ')}" if received else "nothing came back"
    return DeviceError(
        f"z stage: no valid answer from {table.port}.",
        why=f"The port opened at {table.baud} baud but {came}.",
        fix=(fix, "check that the controller is on, and that this is its port: stereotome devices list"),
        code="device-garbled" if received else "device-silent",
    )
