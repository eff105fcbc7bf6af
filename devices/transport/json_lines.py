"""A TCP connection that carries one JSON object a line, both ways."""

from __future__ import annotations

import json
import socket
from typing import Any

from devices.errors import DeviceError, LinkLost, MalformedReply, RigError

CONNECT_TIMEOUT_S = 3.0
SEND_TIMEOUT_S = 2.0
MAX_LINE_BYTES = 1 << 20


class JsonLines:
    """The client's end.

    Parameters
    ----------
    address : str
        ``"host:port"``.
    device : str
        What is at the other end, for messages.

    Raises
    ------
    RigError
        The address is none.
    DeviceError
        Nothing answers there (code device-missing).
    """

    def __init__(self, address: str, *, device: str) -> None:
        self.name = address
        self._device = device
        self._received = b""
        host, _, port = address.rpartition(":")
        if not host or not port.isdigit():
            raise RigError(f"{device}: '{address}' is no address.", fix='write address = "127.0.0.1:PORT"')
        try:
            self._socket = socket.create_connection((host, int(port)), CONNECT_TIMEOUT_S)
        except (OSError, OverflowError) as cause:
            raise DeviceError(
                f"{device}: nothing answers at {address}.",
                why=str(cause),
                fix="start the simulated bench (stereotome sim serve) and use the instrument file it writes.",
                code="device-missing",
            ) from cause
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, message: dict[str, Any]) -> None:
        """Send one object."""
        self._socket.settimeout(SEND_TIMEOUT_S)
        try:
            self._socket.sendall(json.dumps(message).encode() + b"\n")
        except OSError as cause:
            raise self._lost(str(cause)) from cause

    def receive(self, wait_s: float) -> dict[str, Any] | None:
        """Return the next object, or None when no whole one has come after ``wait_s`` without any byte.

        Raises
        ------
        LinkLost
            The other end closed.
        MalformedReply
            A line is no JSON object.
        """
        self._socket.settimeout(max(wait_s, 1e-3))
        while b"\n" not in self._received:
            try:
                data = self._socket.recv(65536)
            except TimeoutError:
                return None
            except OSError as cause:
                raise self._lost(str(cause)) from cause
            if not data:
                raise self._lost("the other end closed it")
            self._received = self._bounded(self._received + data)
        line, _, self._received = self._received.partition(b"\n")
        return self._object(line)

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()

    def _object(self, line: bytes) -> dict[str, Any]:
        try:
            message = json.loads(line)
        except ValueError:
            message = None
        if not isinstance(message, dict):
            raise MalformedReply(f"{self._device}: no JSON object: {line[:60]!r}.", reply=line)
        return message

    def _bounded(self, received: bytes) -> bytes:
        if len(received) > MAX_LINE_BYTES:
            raise MalformedReply(f"{self._device}: a line of more than {MAX_LINE_BYTES} bytes.", reply=received[:60])
        return received

    def _lost(self, why: str) -> LinkLost:
        return LinkLost(
            f"{self._device}: the connection to {self.name} broke.",
            why=why,
            fix="see whether the other program still runs, then start again.",
        )
