"""A halt that needs no conversation: the bytes that stop a controller, sent at once, past whoever holds the port."""

from __future__ import annotations

from typing import TYPE_CHECKING

from devices.errors import DeviceBusy, RigError
from devices.transport.serial_port import SerialPort
from devices.transport.urgent import send_past_lock

if TYPE_CHECKING:
    from collections.abc import Mapping

# An ASI takes a backspace for "forget what was typed so far": half a command of the program that holds the port must
# not become part of ours. A Prior has no such key; an empty line ends what was begun. A PI listens to its byte 24
# anywhere in a line.
HALTS: Mapping[str, bytes] = {
    "asi-ms2000": b"\x08\\\r",
    "asi-tiger": b"\x08HALT\r",
    "pi-gcs2": b"\x18",
    "prior-proscan": b"\rK\r",
}
ROOM_S = 1.0
DEVICE = "z stage"


def halt_now(driver: str, port: str, baud: int) -> str:
    """Stop all motion of a controller and return how it was told; its answer is not waited for.

    Raises
    ------
    RigError
        It is not known how a controller of this driver is stopped.
    DeviceError
        The port is missing, or a network port that another program uses.
    """
    if driver not in HALTS:
        raise RigError(f"no halt is known for the driver '{driver}'.", fix="stop at the controller itself.")
    try:
        own = SerialPort(port, baud, device=DEVICE)
    except DeviceBusy:
        send_past_lock(port, HALTS[driver], device=DEVICE, wait_s=ROOM_S)
        return f"halt sent to {port}, past the program that holds it"
    try:
        own.write(HALTS[driver])
        own.read(ROOM_S)
    finally:
        own.close()
    return f"halt sent to {port}"
