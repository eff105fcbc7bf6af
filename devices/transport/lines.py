"""The modem lines of a serial port as switches: DTR and RTS out, CTS in. No byte is ever sent."""

from __future__ import annotations

import errno
from typing import TYPE_CHECKING

import serial

from devices.errors import DeviceError, LinkLost
from devices.transport.ports import open_failure

if TYPE_CHECKING:
    from collections.abc import Collection

BAUD = 57600
NO_SUCH_LINES = (errno.ENOTTY, errno.EINVAL)


class ModemLines:
    """A port, opened for us alone, without flow control: that would move RTS behind our back.

    Parameters
    ----------
    port : str
        Device name or pyserial URL.
    on : collection of str
        Which of ``"dtr"`` and ``"rts"`` are on from the beginning.
    device : str
        What hangs on it, for messages.

    Raises
    ------
    DeviceError
        device-missing, device-permission, device-busy; glasses-no-lines for a port without such lines.
    """

    def __init__(self, port: str, on: Collection[str], *, device: str) -> None:
        self.name = port
        self._device = device
        try:
            self._port = serial.serial_for_url(
                port, baudrate=BAUD, exclusive=True, rtscts=False, dsrdtr=False, do_not_open=True
            )
            self._port.dtr, self._port.rts = "dtr" in on, "rts" in on
            self._port.open()
        except (OSError, ValueError) as cause:  # SerialException is an OSError; its errno is None for a non-tty
            raise open_failure(device, port, getattr(cause, "errno", None), str(cause)) from cause
        try:
            self.set(on)
            self.clear_to_send()
        except BaseException:
            self.close()
            raise

    def set(self, on: Collection[str]) -> None:
        """Switch the lines: DTR first, for it is the power of the circuit that RTS steers."""
        try:
            if self._port.dtr != ("dtr" in on):
                self._port.dtr = "dtr" in on
            self._port.rts = "rts" in on
        except OSError as cause:
            raise self._failed(cause) from cause

    def clear_to_send(self) -> bool:
        """Return the state of CTS."""
        try:
            return bool(self._port.cts)
        except OSError as cause:
            raise self._failed(cause) from cause

    def close(self) -> None:
        """Release the port; the system lets both lines fall."""
        self._port.close()

    def _failed(self, cause: OSError) -> DeviceError:
        if cause.errno in NO_SUCH_LINES:
            return DeviceError(
                f"{self._device}: {self.name} has no modem lines.",
                why="It is a pseudo-terminal or an adapter that leads out RxD and TxD only.",
                fix="take a serial port with RTS and DTR: most USB adapters with a nine-way connector.",
                code="glasses-no-lines",
            )
        return LinkLost(
            f"{self._device}: {self.name} is gone.",
            why=str(cause),
            fix="check the cable and open it again; without power the glasses are at rest.",
        )
