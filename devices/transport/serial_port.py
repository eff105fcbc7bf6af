"""Serial ports, pseudo-terminals and everything else pyserial opens by URL (``socket://host:port``, ``loop://``)."""

from __future__ import annotations

import contextlib

import serial

from devices.errors import LinkLost
from devices.transport.ports import open_failure

WRITE_TIMEOUT_S = 2.0
READ_SLICE_S = 0.02


class SerialPort:
    """A port, opened for us alone.

    Parameters
    ----------
    port : str
        Device name or pyserial URL.
    baud : int
        Bits per second; without meaning for a socket.
    device : str
        What hangs on it, for messages.

    Raises
    ------
    DeviceError
        With code device-missing, device-permission or device-busy.
    """

    def __init__(self, port: str, baud: int, *, device: str) -> None:
        self.name = port
        self._device = device
        try:
            self._port = serial.serial_for_url(
                port, baudrate=baud, timeout=READ_SLICE_S, write_timeout=WRITE_TIMEOUT_S, exclusive=True
            )
        except (OSError, ValueError) as cause:  # SerialException is an OSError; its errno is None for a non-tty
            raise open_failure(device, port, getattr(cause, "errno", None), str(cause)) from cause
        # An FTDI adapter holds bytes back for 16 ms unless told otherwise; ptys and sockets have no such mode.
        with contextlib.suppress(OSError, ValueError, AttributeError, NotImplementedError):
            self._port.set_low_latency_mode(True)

    def write(self, data: bytes) -> None:
        """Send all of ``data``."""
        try:
            self._port.write(data)
        except OSError as cause:
            raise self._lost(cause) from cause

    def read(self, wait_s: float) -> bytes:
        """Return what has arrived; waits at most ``READ_SLICE_S`` for the first byte, not at all for ``wait_s`` 0.

        A closed pty or an unplugged adapter shows as "ready but no data", as EIO, or, from ``in_waiting``, as a bare
        OSError; a port that another thread closed meanwhile as a TypeError of pyserial's: all of them mean that the
        port is gone.
        """
        try:
            first = self._port.read(1) if wait_s > 0 else b""
            return first + self._port.read(self._port.in_waiting)
        except (OSError, TypeError) as cause:
            raise self._lost(cause) from cause

    def close(self) -> None:
        """Release the port."""
        self._port.close()

    def _lost(self, cause: Exception) -> LinkLost:
        return LinkLost(
            f"{self._device}: the connection over {self.name} broke.",
            why=str(cause),
            fix="check cable and power, then start again: the position is read anew.",
        )
