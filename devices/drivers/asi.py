"""Opens the Z axis of an ASI MS-2000; `devices.drivers.asi_tiger` does the same for a Tiger."""

from __future__ import annotations

import logging
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from devices.drivers.asi_axis import AsiStage
from devices.drivers.asi_triggered import AsiTriggeredStage, slots_of
from devices.errors import DeviceError, MalformedReply, NoReply, Refused
from devices.link import Link
from devices.transport.serial_port import SerialPort
from devices.transport.transcript import Recorder
from devices.wire import asi
from devices.wire.asi_identity import MS2000

if TYPE_CHECKING:
    from collections.abc import Iterator

    from devices.protocols import Transport
    from devices.registry import DeviceContext
    from devices.rig import AxisSpec

__all__ = ["AsiStage", "open_stage"]
log = logging.getLogger(__name__)
REPLY_TIMEOUT_S = 0.5


def open_stage(table: AxisSpec, context: DeviceContext) -> AsiTriggeredStage:
    """Open the port, make sure that an MS-2000 answers, and set the speed if the file gives one.

    Raises
    ------
    DeviceError
        device-missing, device-permission, device-busy; device-silent or device-garbled when no valid answer comes.
    """
    with opened_link(table, context) as link:
        link.ask(asi.where())
        return greeted(AsiTriggeredStage(link, table, context.clock, slots=slots_of(link, MS2000)), table)


@contextmanager
def opened_link(table: AxisSpec, context: DeviceContext) -> Iterator[Link]:
    """Open the port for a first conversation; whatever goes wrong there closes it and says how to mend it."""
    transport: Transport = SerialPort(table.port, table.baud, device="z stage")
    try:
        if context.transcript is not None:
            transport = Recorder(transport, context.transcript / "stage-z.jsonl", context.clock)
        yield Link(transport, context.clock, terminator=asi.TERMINATOR, timeout_s=REPLY_TIMEOUT_S)
    except BaseException as error:
        transport.close()
        if isinstance(error, (NoReply, MalformedReply)):
            raise _no_answer(table, error) from error
        raise


def greeted(stage: AsiTriggeredStage, table: AxisSpec) -> AsiTriggeredStage:
    """Let a controller that answers tell its limits, and set the speed; return the stage."""
    with suppress(Refused):
        stage.disarm()
    stage.heed_controller_limits()
    if table.speed_um_s is not None:
        stage.set_speed_um_s(table.speed_um_s)
    try:
        log.info("z stage: %s takes up %g µm of backlash.", stage.firmware(), stage.controller_backlash_um())
    except Refused as refusal:
        log.info("z stage: it does not tell its firmware or backlash. %s", refusal.what)
    return stage


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
