"""Bytes to a port that another program holds: for a halt, and for nothing else."""

from __future__ import annotations

import os
import select

from devices.errors import DeviceBusy
from devices.transport.ports import open_failure


def send_past_lock(port: str, data: bytes, *, device: str, wait_s: float) -> None:
    """Send bytes through a port at the speed the program that holds it has set; its answer goes to that program.

    The lock upon a port is an agreement among programs: it does not keep one from writing.

    Parameters
    ----------
    port : str
        A device of this machine.
    wait_s : float
        For room in the port's buffer.

    Raises
    ------
    DeviceError
        The port cannot be written to.
    """
    if os.name != "posix" or "://" in port:
        raise DeviceBusy(
            f"{device}: {port} is in use, and this kind of port admits one program only. Nothing was sent.",
            fix="stop in the program that holds it, or at the controller itself.",
        )
    try:
        handle = os.open(port, os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            while data:
                if not select.select([], [handle], [], wait_s)[1]:
                    raise DeviceBusy(f"{device}: {port} takes no bytes. Nothing was stopped.")
                data = data[os.write(handle, data) :]
        finally:
            os.close(handle)
    except OSError as cause:
        raise open_failure(device, port, cause.errno, str(cause)) from cause
