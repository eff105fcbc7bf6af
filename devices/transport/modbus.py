"""Modbus over a serial line, TCP, or RTU frames within TCP. Reads may be repeated; a write is sent once, ever.

A repeated relative move cuts twice, so the client's own repetition is off (``retries=0``). After a silence nothing is
asked before the line has been quiet for one time-out: on RTU a late reply looks like the answer to the next question.
"""

from __future__ import annotations

import json
import logging
import socket
from threading import Lock
from typing import TYPE_CHECKING, Any, Protocol

import serial
from pymodbus import FramerType
from pymodbus.client import ModbusSerialClient, ModbusTcpClient
from pymodbus.exceptions import ConnectionException, ModbusException
from pymodbus.framer import FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)

from devices.errors import DeviceError, LinkError, LinkLost, MalformedReply, NoReply, Refused
from devices.transport.ports import open_failure
from devices.wire.modbus_map import RegisterRead, RegisterWrite

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from devices.profile import LinkTable, Profile
    from devices.protocols import Clock

logging.getLogger("pymodbus").addHandler(logging.NullHandler())
log = logging.getLogger(__name__)

Addressed = tuple[int, RegisterWrite]

GONE = (ConnectionException, OSError, TypeError, AttributeError)  # the last two: closed by another thread meanwhile
READ_ATTEMPTS = 3
NOISY_ROUNDS = 4
URGENT_WAIT_S = 0.04
WRITE_TIMEOUT_S = 2.0
EXCEPTIONS = {
    1: "it does not know this function",
    2: "it has no such register",
    3: "it does not take this value",
    4: "it failed",
    5: "it needs more time",
    6: "it is busy",
    8: "a checksum was wrong",
    10: "the gateway has no path to it",
    11: "the gateway got no answer from it",
}


class RegisterBus(Protocol):
    """Registers of the units behind one wire."""

    def read(self, unit: int, request: RegisterRead) -> list[int]:
        """Return the words; asks again when the reply is lost."""
        ...

    def write(self, unit: int, request: RegisterWrite) -> None:
        """Write once. An error of the wire leaves open whether the unit acted."""
        ...

    def write_urgently(self, requests: Sequence[Addressed]) -> None:
        """Write without waiting for a conversation going on; only for what may be done twice, such as a stop."""
        ...

    def reopen(self) -> None:
        """Hang up and connect anew."""
        ...

    def close(self) -> None:
        """Release the port."""
        ...


class ModbusBus:
    """One Modbus line and everything on it.

    Parameters
    ----------
    connect : callable
        Opens the line and returns a connected client; raises one of our errors.
    name : str
        The port or address, for messages.
    clock : Clock
        Keeps the silence between requests.
    gap_s : float
        Least silence between requests.
    exceptions : mapping, optional
        What exception numbers mean on this device, where it differs from the standard.
    """

    def __init__(
        self,
        connect: Callable[[], Any],
        *,
        name: str,
        clock: Clock,
        gap_s: float,
        exceptions: Mapping[int, str] | None = None,
    ) -> None:
        self._exceptions = EXCEPTIONS | dict(exceptions or {})
        self.name = name
        self._connect = connect
        self._clock = clock
        self._gap_s = gap_s
        self._conversation = Lock()
        self._urgent = Lock()
        self._must_drain = False
        self._spoke_s = clock.now() - gap_s
        self._client = connect()

    def read(self, unit: int, request: RegisterRead) -> list[int]:
        """Return the words of consecutive registers; asks up to three times, never after the line is lost.

        Raises
        ------
        NoReply, MalformedReply
            Nothing, or nothing usable, came back.
        LinkLost
            The port or connection is gone.
        Refused
            The unit said no.
        """
        for _ in range(READ_ATTEMPTS - 1):
            try:
                return self._read_once(unit, request)
            except LinkLost:
                raise
            except LinkError as error:
                log.warning("%s: %s asking again", self.name, error.what)
        return self._read_once(unit, request)

    def write(self, unit: int, request: RegisterWrite) -> None:
        """Write once. Raises as `read`; after an error of the wire nobody knows whether the unit acted."""
        with self._conversation:
            self._write_once(unit, request)

    def write_urgently(self, requests: Sequence[Addressed]) -> None:
        """Write within 40 ms, even into a conversation going on, which then finds no answer; then once more in turn.

        All are sent, whatever becomes of the first. If an answer is missing, or is one to what was asked before, all
        are sent again once the line is quiet; the last failure of that is raised. Never into another urgent
        conversation: both stop the same drive, and neither would be answered.
        """
        with self._urgent:
            if not self._conversation.acquire(timeout=URGENT_WAIT_S):
                self._shout(requests)
                self._conversation.acquire()
            try:
                failures = self._write_anyway(requests)
                if failures:
                    self._must_drain = True
                    failures = self._write_anyway(requests, drain=True)
            finally:
                self._conversation.release()
        if failures:
            raise failures[-1]

    def reopen(self) -> None:
        """Hang up and connect anew; raises as the first connection does."""
        with self._conversation:
            self._client.close()
            self._client = self._connect()
            self._must_drain = False

    def close(self) -> None:
        """Release the port."""
        self._client.close()

    def _read_once(self, unit: int, request: RegisterRead) -> list[int]:
        pdu = read_pdu(unit, request)
        with self._conversation:
            reply = self._ask(unit, pdu, f"read of {request.count} at {request.address:#06x}")
            words = [int(word) for word in reply.registers]
            if len(words) != request.count or reply.function_code != pdu.function_code:
                raise self._malformed(unit, f"{len(words)} words came for {request.count}")
            return words

    def _write_once(self, unit: int, request: RegisterWrite) -> None:
        pdu = write_pdu(unit, request)
        reply = self._ask(unit, pdu, f"write at {request.address:#06x}")
        echoed = (reply.function_code, reply.address)
        if echoed != (pdu.function_code, pdu.address):
            raise self._malformed(unit, f"function and address {echoed} came back")
        if request.single and tuple(reply.registers) != request.values:
            raise self._malformed(unit, f"it took {list(reply.registers)} for {list(request.values)}")

    def _ask(self, unit: int, pdu: ModbusPDU, what: str) -> ModbusPDU:
        self._check_line()
        self._drain()
        self._clock.sleep(self._spoke_s + self._gap_s - self._clock.now())
        try:
            reply: ModbusPDU = self._client.execute(False, pdu)  # noqa: FBT003  the library's signature
        except GONE as cause:
            raise self._lost(str(cause)) from cause
        except (ModbusException, ValueError, IndexError) as cause:  # IndexError: a reply cut inside its header
            self._must_drain = True
            raise self._silent(unit, what) from cause
        finally:
            self._spoke_s = self._clock.now()
        if isinstance(reply, ExceptionResponse):
            raise self._refused(unit, what, reply.exception_code)
        return reply

    def _check_line(self) -> None:
        if self._client.socket is None:
            raise self._lost("It was lost before.")

    def _drain(self) -> None:
        """Wait until nothing has come for one time-out: what comes now answers an older question."""
        rounds = 0
        while self._must_drain:
            try:
                self._must_drain = bool(self._client.recv(None))
            except GONE as cause:
                raise self._lost(str(cause)) from cause
            rounds += 1
            if rounds == NOISY_ROUNDS:
                return

    def _write_anyway(self, requests: Sequence[Addressed], *, drain: bool = False) -> list[DeviceError]:
        """Write all and return what went wrong; without ``drain`` the replies matter less than the stop."""
        failures: list[DeviceError] = []
        for unit, request in requests:
            self._must_drain &= drain
            try:
                self._write_once(unit, request)
            except LinkLost:
                raise
            except (LinkError, Refused) as error:
                failures.append(error)
        return failures

    def _shout(self, requests: Sequence[Addressed]) -> None:
        try:
            for unit, request in requests:
                _put(self._client.socket, self._client.framer.buildFrame(write_pdu(unit, request)))
        except GONE as cause:
            raise self._lost(str(cause)) from cause

    def _lost(self, why: str) -> LinkLost:
        self._client.close()
        return LinkLost(
            f"feed: the connection over {self.name} broke.",
            why=why,
            fix="check cable and power, then start again: the position is read anew before anything moves.",
        )

    def _silent(self, unit: int, what: str) -> NoReply:
        return NoReply(
            f"feed: unit {unit} on {self.name} did not answer the {what}.",
            why="Nothing came back, or nothing with this unit's number and a right checksum.",
            fix=("check unit, baud, parity and wiring against the drive's own settings.", "see that the drive is on."),
        )

    def _malformed(self, unit: int, why: str) -> MalformedReply:
        self._must_drain = True
        return MalformedReply(f"feed: unit {unit} on {self.name} gave an answer that does not fit.", reply=b"", why=why)

    def _refused(self, unit: int, what: str, code: int) -> Refused:
        words = self._exceptions.get(code, "a number of its own")
        return Refused(
            f"feed: unit {unit} refused the {what}: {words} (exception {code}).",
            reason=str(code),
            fix="compare with the manual: stereotome section check PROFILE prints every frame.",
        )


def _put(line: Any, data: bytes) -> None:
    """Write and do nothing else: the client's own ``send`` first reads what has come, and two readers break a port."""
    if isinstance(line, socket.socket):
        line.sendall(data)
    else:
        line.write(data)


def read_pdu(unit: int, request: RegisterRead) -> ModbusPDU:
    """Return a read in the library's terms."""
    return ReadHoldingRegistersRequest(address=request.address, count=request.count, dev_id=unit)


def write_pdu(unit: int, request: RegisterWrite) -> ModbusPDU:
    """Return a write in the library's terms; raises ValueError for unit 0, which every drive on the line obeys."""
    if unit == 0:
        raise ValueError("broadcast moves every drive on the line and is never answered")
    kind = WriteSingleRegisterRequest if request.single else WriteMultipleRegistersRequest
    return kind(address=request.address, registers=list(request.values), dev_id=unit)


def frame(unit: int, request: RegisterRead | RegisterWrite, *, rtu: bool = True) -> bytes:
    """Return the bytes of a request as they go over the wire, with CRC (RTU) or header (TCP, transaction 1)."""
    pdu = read_pdu(unit, request) if isinstance(request, RegisterRead) else write_pdu(unit, request)
    pdu.transaction_id = 1
    framer = (FramerRTU if rtu else FramerSocket)(DecodePDU(is_server=False))
    return framer.buildFrame(pdu)


def open_bus(port: str, profile: Profile, clock: Clock, transcript: Path | None = None) -> ModbusBus:
    """Open a line as a profile says.

    Parameters
    ----------
    port : str
        Serial port for ``rtu``, ``host:port`` otherwise.
    transcript : Path, optional
        File to which every frame is appended.

    Raises
    ------
    DeviceError
        device-missing, device-permission, device-busy.
    """
    note, link = _Notes(transcript, clock) if transcript else None, profile.link

    def connect() -> ModbusSerialClient | ModbusTcpClient:
        return _serial_client(port, link, note) if link.kind == "rtu" else _tcp_client(port, link, note)

    exceptions = profile.exception_words()
    return ModbusBus(connect, name=port, clock=clock, gap_s=link.gap_ms / 1000, exceptions=exceptions)


def _serial_client(port: str, link: LinkTable, note: _Notes | None) -> ModbusSerialClient:
    """Return a client with an open port: the library itself would hide why one does not open."""
    client = ModbusSerialClient(
        port,
        baudrate=link.baud,
        parity=link.parity,
        stopbits=link.stopbits,
        timeout=link.timeout_s,
        retries=0,
        trace_packet=note,
    )
    try:
        client.socket = serial.serial_for_url(
            port,
            baudrate=link.baud,
            parity=link.parity,
            stopbits=link.stopbits,
            timeout=link.timeout_s,
            write_timeout=WRITE_TIMEOUT_S,
            exclusive=True,
        )
    except (OSError, ValueError) as cause:
        raise open_failure("feed", port, getattr(cause, "errno", None), str(cause)) from cause
    return client


def _tcp_client(port: str, link: LinkTable, note: _Notes | None) -> ModbusTcpClient:
    host, _, number = port.removeprefix("socket://").rpartition(":")
    framer = FramerType.RTU if link.kind == "rtu_over_tcp" else FramerType.SOCKET
    try:
        address = (host, int(number))
        client = ModbusTcpClient(
            host, port=address[1], framer=framer, timeout=link.timeout_s, retries=0, trace_packet=note
        )
        client.socket = socket.create_connection(address, timeout=max(link.timeout_s, 1.0))
        client.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    except (OSError, ValueError, OverflowError) as cause:
        raise DeviceError(
            f"feed: no connection to {port}.",
            why=str(cause),
            fix="give host:port, usually port 502, and check that the drive is on and in the same network.",
            code="device-missing",
        ) from cause
    return client


class _Notes:
    """Writes down every frame, as `devices.transport.transcript` does for lines."""

    def __init__(self, path: Path, clock: Clock) -> None:
        self._path = path
        self._clock = clock
        self._seen = 0
        path.parent.mkdir(parents=True, exist_ok=True)

    def __call__(self, sending: bool, data: bytes) -> bytes:  # noqa: FBT001  the library's signature
        new = data if sending else data[self._seen :]
        self._seen = 0 if sending else len(data)
        entry = {
            "t": round(self._clock.now(), 6),
            "to": "device" if sending else "host",
            "bytes": new.decode("latin-1"),
        }
        with self._path.open("a", encoding="ascii") as file:
            file.write(json.dumps(entry) + "\n")
        return data


def frames_of(profile: Profile, requests: tuple[RegisterWrite, ...], *, rtu: bool) -> list[str]:
    """Return requests as hex, the way manuals print them."""
    return [frame(profile.link.unit, request, rtu=rtu).hex(" ").upper() for request in requests]
