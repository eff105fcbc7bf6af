"""The Z axis of an ASI MS-2000 or Tiger controller as a `devices.protocols.Stage`."""

from __future__ import annotations

from threading import Event
from typing import TYPE_CHECKING

from devices.drivers.arrival import Arrival
from devices.errors import DeviceError, LinkLost, MalformedReply, NoReply, StageStalled, StageTimeout
from devices.link import Link
from devices.transport.serial_port import SerialPort
from devices.transport.transcript import Recorder
from devices.wire import asi

if TYPE_CHECKING:
    from devices.protocols import Clock, Transport
    from devices.registry import DeviceContext
    from devices.rig import AxisSpec
    from devices.values import Limits

UM_PER_MM = 1000.0
REPLY_TIMEOUT_S = 0.5
FAST_BAUD = 57600
FAST_POLL_S = 0.004
SLOW_POLL_S = 0.02  # at 9600 baud one question and answer take 15 ms of wire, and an FTDI adapter adds as much


class AsiStage:
    """Drives one axis; every method may be called from any thread, one conversation at a time.

    Parameters
    ----------
    link : Link
        To the controller.
    spec : AxisSpec
        ``[stage.z]`` of the instrument file.
    clock : Clock
        Time.
    """

    def __init__(self, link: Link, spec: AxisSpec, clock: Clock) -> None:
        self._link = link
        self._clock = clock
        self._spec = spec
        self._units_per_um = -spec.units_per_um if spec.invert else spec.units_per_um
        self._target_um: float | None = None
        self._halted = Event()

    @property
    def limits(self) -> Limits:
        """Soft limits in µm."""
        return self._spec.soft_limits

    def move_to(self, z_um: float) -> None:
        """Start an absolute move; raises `LimitError` with nothing sent."""
        self.limits.check(z_um)
        self._set_off(z_um)
        self._link.ask(asi.move(z_um * self._units_per_um))

    def move_by(self, distance_um: float) -> None:
        """Start a relative move from where the axis is; it is sent once only."""
        target_um = self.position_um() + distance_um
        self.limits.check(target_um)
        self._set_off(target_um)
        self._link.ask(asi.move_by(distance_um * self._units_per_um))

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
        arrival = Arrival(self._target_um, tolerance_um=self._resolution_um, now=self._clock.now())
        deadline = self._clock.now() + timeout_s
        while True:
            moving, z_um = self._link.ask(asi.is_moving()), self.position_um()
            now = self._clock.now()
            if arrival.reached(z_um, now, moving=moving):
                return self._rested(z_um)
            self._check_under_way(arrival, z_um, now, deadline, timeout_s)
            self._clock.sleep(arrival.wait_s(now, self._poll_s))

    def position_um(self) -> float:
        """Read the position now, in µm."""
        return self._link.ask(asi.where()) / self._units_per_um

    def halt(self) -> None:
        """Stop all axes of the controller; goes out at once, whatever another thread is waiting for."""
        self._halted.set()
        self._link.interrupt(asi.halt())

    def close(self) -> None:
        """Release the port; the axis stays where it is."""
        self._link.close()

    def zero_here(self) -> None:
        """Call the present place 0 µm. The soft limits move with it: they are distances from zero."""
        self._target_um = None
        self._link.ask(asi.here(0.0))

    def set_speed_um_s(self, speed_um_s: float) -> float:
        """Set the top speed and return what the controller made of it: it clips without a word."""
        self._link.ask(asi.set_speed(speed_um_s / UM_PER_MM))
        return self._link.ask(asi.speed()) * UM_PER_MM

    def firmware(self) -> str:
        """Return the firmware's name."""
        return self._link.ask(asi.version())

    @property
    def _resolution_um(self) -> float:
        return 1.0 / self._spec.units_per_um

    @property
    def _poll_s(self) -> float:
        return FAST_POLL_S if self._spec.baud >= FAST_BAUD else SLOW_POLL_S

    def _set_off(self, target_um: float) -> None:
        self._halted.clear()
        self._target_um = target_um

    def _rested(self, z_um: float) -> float:
        if not self._spec.settle_ms:
            return z_um
        self._clock.sleep(self._spec.settle_ms / 1000)
        return self.position_um()

    def _check_under_way(self, arrival: Arrival, z_um: float, now: float, deadline: float, timeout_s: float) -> None:
        where = f"it is at {z_um:+.2f} µm" + (f" of {self._target_um:+.2f} µm" if self._target_um is not None else "")
        if self._halted.is_set():
            raise StageStalled(f"z stage: the move was halted; {where}.")
        if arrival.stalled(now):
            raise StageStalled(
                f"z stage: no progress for {arrival.STALL_S:g} s; {where}.",
                why="The axis is blocked, at a limit of the controller, or was moved by hand.",
                fix="free the axis, check the controller's limits (SL, SU), then start again.",
            )
        if now > deadline:
            raise StageTimeout(f"z stage: still moving after {timeout_s:g} s; {where}.")


def open_stage(table: AxisSpec, context: DeviceContext) -> AsiStage:
    """Open the port, make sure that an ASI controller answers, and set the speed if the file gives one.

    Raises
    ------
    DeviceError
        device-missing, device-permission, device-busy; device-silent or device-garbled when no valid answer comes.
    """
    transport: Transport = SerialPort(table.port, table.baud, device="z stage")
    try:
        if context.transcript is not None:
            transport = Recorder(transport, context.transcript / "stage-z.jsonl", context.clock)
        link = Link(transport, context.clock, terminator=asi.TERMINATOR, timeout_s=REPLY_TIMEOUT_S)
        stage = AsiStage(link, table, context.clock)
        _greet(stage, table)
    except BaseException:
        transport.close()
        raise
    return stage


def _greet(stage: AsiStage, table: AxisSpec) -> None:
    try:
        stage.position_um()
        if table.speed_um_s is not None:
            stage.set_speed_um_s(table.speed_um_s)
    except LinkLost:
        raise
    except (NoReply, MalformedReply) as error:
        raise _no_answer(table, error) from error


def _no_answer(table: AxisSpec, error: NoReply | MalformedReply) -> DeviceError:
    received = error.reply if isinstance(error, MalformedReply) else error.received
    came = f"unreadable data came back: {received[:16].hex(' ')}" if received else "nothing came back"
    return DeviceError(
        f"z stage: no valid answer from {table.port}.",
        why=f"The port opened at {table.baud} baud but {came}.",
        fix=(
            "set baud as on the controller: an MS-2000 is delivered with 9600, a Tiger with 115200.",
            "check that the controller is on, and that this is its port: stereotome devices list",
        ),
        code="device-garbled" if received else "device-silent",
    )
