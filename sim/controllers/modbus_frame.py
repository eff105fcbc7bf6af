"""Modbus as a device speaks it: requests in, replies out, over RTU or TCP framing. Own encoder, no library."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Mapping

READ, WRITE_ONE, WRITE_MANY = 3, 6, 16
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, CRC_ERROR = 1, 2, 3, 8
BROADCAST = 0
FIXED_REQUEST = 8
HEADER = 7
MOST_READ, MOST_WRITTEN = 125, 123
POLYNOMIAL = 0xA001


class RegisterFault(Exception):
    """The device says no, with a Modbus exception number."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


class Unit(Protocol):
    """A device with registers."""

    def read(self, address: int, count: int) -> list[int]:
        """Return words; raises `RegisterFault`."""
        ...

    def write(self, address: int, values: list[int]) -> None:
        """Take words; raises `RegisterFault`."""
        ...


def crc16(data: bytes) -> bytes:
    """Return the checksum of a frame, low byte first, bit by bit as the standard describes it."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ POLYNOMIAL if crc & 1 else crc >> 1
    return struct.pack("<H", crc)


def answer(unit: Unit, pdu: bytes) -> bytes:
    """Return the reply to one request, both without address and checksum."""
    function = pdu[0]
    try:
        if function == READ:
            return _answer_read(unit, pdu)
        if function == WRITE_ONE:
            return _answer_one(unit, pdu)
        if function == WRITE_MANY:
            return _answer_many(unit, pdu)
    except RegisterFault as fault:
        return bytes([function | 0x80, fault.code])
    except struct.error:
        return bytes([function | 0x80, ILLEGAL_VALUE])
    return bytes([function | 0x80, ILLEGAL_FUNCTION])


def written(pdu: bytes) -> tuple[int, list[int]] | None:
    """Return address and words of a request that writes, None for any other."""
    if pdu[:1] == bytes([WRITE_ONE]) and len(pdu) == 5:
        address, value = struct.unpack(">HH", pdu[1:])
        return address, [value]
    if pdu[:1] == bytes([WRITE_MANY]) and len(pdu) >= 6:
        return struct.unpack(">H", pdu[1:3])[0], list(struct.unpack(f">{pdu[5] // 2}H", pdu[6 : 6 + pdu[5] // 2 * 2]))
    return None


def _answer_read(unit: Unit, pdu: bytes) -> bytes:
    address, count = struct.unpack(">HH", pdu[1:])
    if not 1 <= count <= MOST_READ:
        raise RegisterFault(ILLEGAL_VALUE)
    words = unit.read(address, count)
    return struct.pack(f">BB{count}H", READ, 2 * count, *words)


def _answer_one(unit: Unit, pdu: bytes) -> bytes:
    address, value = struct.unpack(">HH", pdu[1:])
    unit.write(address, [value])
    return pdu


def _answer_many(unit: Unit, pdu: bytes) -> bytes:
    address, count, size = struct.unpack(">HHB", pdu[1:6])
    if size != 2 * count or not 1 <= count <= MOST_WRITTEN:
        raise RegisterFault(ILLEGAL_VALUE)
    unit.write(address, list(struct.unpack(f">{count}H", pdu[6:])))
    return pdu[:5]


class RtuServer:
    """Units on one RS-485 line.

    Parameters
    ----------
    units : mapping
        Devices by number. A number that nobody has gets no answer, as on a real line.
    crc_exception : bool
        A wrong checksum is answered with exception 8, as Leadshine drives do; others keep silent.
    """

    def __init__(self, units: Mapping[int, Unit], *, crc_exception: bool = False) -> None:
        self.units = units
        self.crc_exception = crc_exception
        self._pending = b""

    def frames(self, data: bytes) -> list[tuple[int, bytes]]:
        """Return the requests that are complete now, as unit and request; a wrong one as unit and nothing."""
        self._pending += data
        found = []
        while (size := _size(self._pending)) and len(self._pending) >= size:
            body, crc = self._pending[: size - 2], self._pending[size - 2 : size]
            right = crc16(body) == crc
            found.append((body[0], body[1:] if right else b""))
            self._pending = self._pending[size:] if right else b""
        return found

    def forget(self) -> None:
        """Drop the beginning of a frame: a silence on the line ends it."""
        self._pending = b""

    def reply(self, unit: int, pdu: bytes) -> bytes:
        """Return the framed reply to a request, nothing where a device keeps silent."""
        if unit == BROADCAST:
            for device in self.units.values() if pdu else ():
                answer(device, pdu)
            return b""
        if unit not in self.units:
            return b""
        if not pdu:
            return self.frame(unit, bytes([READ | 0x80, CRC_ERROR])) if self.crc_exception else b""
        return self.frame(unit, answer(self.units[unit], pdu))

    def frame(self, unit: int, pdu: bytes) -> bytes:
        """Return a reply with address and checksum."""
        return bytes([unit]) + pdu + crc16(bytes([unit]) + pdu)

    def feed(self, data: bytes) -> list[bytes]:
        """Return the replies to all requests that ``data`` completes."""
        replies = [self.reply(unit, pdu) for unit, pdu in self.frames(data)]
        return [reply for reply in replies if reply]


def _size(pending: bytes) -> int:
    """Return how long the first request will be, 0 while that cannot be told."""
    if len(pending) < 2:
        return 0
    if pending[1] == WRITE_MANY:
        return 9 + pending[6] if len(pending) > 6 else 0
    return FIXED_REQUEST if pending[1] in (READ, WRITE_ONE) else max(len(pending), 4)


class TcpServer(RtuServer):
    """The same devices behind Modbus TCP: a header in place of the checksum."""

    def __init__(self, units: Mapping[int, Unit], *, crc_exception: bool = False) -> None:
        super().__init__(units, crc_exception=crc_exception)
        self._transaction = 0

    def frames(self, data: bytes) -> list[tuple[int, bytes]]:
        """Return the requests that are complete now."""
        self._pending += data
        found = []
        while len(self._pending) >= HEADER:
            self._transaction, protocol, size, unit = struct.unpack(">HHHB", self._pending[:HEADER])
            if protocol or size < 2:
                self._pending = b""
                break
            if len(self._pending) < HEADER - 1 + size:
                break
            found.append((unit, self._pending[HEADER : HEADER - 1 + size]))
            self._pending = self._pending[HEADER - 1 + size :]
        return found

    def frame(self, unit: int, pdu: bytes) -> bytes:
        """Return a reply with the header of its request."""
        return struct.pack(">HHHB", self._transaction, 0, len(pdu) + 1, unit) + pdu
