"""Who is at a serial port: known controllers are asked, one baud after the other, by questions that change nothing.

The order is safe for whoever listens. At each baud first ASI (``/``, "are you moving?", unknown to the others), then
Prior (``DATE``; never ``V``, which asks an ASI for its version but sends a Prior to a place), then PI (``*IDN?`` on a
line of its own), then the emitter of shutter glasses (``0``, which tells its settings), last a Modbus frame that reads
one register. 1200 baud is never used: it restarts the emitter into its boot loader.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from devices.errors import InputError
from devices.transport.serial_port import SerialPort

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from devices.protocols import Clock, Transport

FORBIDDEN_BAUD = 1200
BAUDS = (115200, 9600, 19200, 38400, 57600)
ANSWER_S = 0.25
QUIET_S = 0.05
PORT_NAME = "probe"


@dataclass(frozen=True)
class Exchange:
    """What was asked at which baud, and every byte that came back."""

    baud: int
    sent: bytes
    received: bytes


@dataclass(frozen=True)
class Found:
    """Somebody who answered.

    Attributes
    ----------
    driver : str
        Name for the instrument file; for Modbus devices ``modbus``, for which a profile has to be chosen.
    baud : int
        Where it answered.
    name : str
        What it said it is.
    """

    driver: str
    baud: int
    name: str


@dataclass(frozen=True)
class Probe:
    """Questions for one kind of controller.

    Attributes
    ----------
    name : str
        Of the kind, for people.
    questions : tuple of bytes
        Sent one after the other as long as each is answered.
    recognise : callable
        From all answers to the controller's driver and name, or None.
    """

    name: str
    questions: tuple[bytes, ...]
    recognise: Callable[[list[bytes]], tuple[str, str] | None]


@dataclass
class Report:
    """What a probe found, and all it saw on the way."""

    found: Found | None = None
    exchanges: list[Exchange] = field(default_factory=list)


def probe_port(port: str, bauds: Sequence[int], clock: Clock) -> Report:
    """Ask who is at a port; opens it anew for every baud.

    Raises
    ------
    InputError
        1200 baud was asked for.
    DeviceError
        The port is missing, taken, or not ours to open; or it vanished.
    """
    if FORBIDDEN_BAUD in bauds:
        raise InputError(
            f"{FORBIDDEN_BAUD} baud is never used for probing.",
            why="Opening the emitter of shutter glasses at this speed restarts it into its boot loader.",
            fix="choose the baud that is set on the controller.",
        )
    report = Report()
    for baud in bauds:
        transport = SerialPort(port, baud, device=PORT_NAME)
        try:
            report.found = _ask_all(transport, baud, report.exchanges, clock)
        finally:
            transport.close()
        if report.found:
            break
    return report


def _ask_all(transport: Transport, baud: int, seen: list[Exchange], clock: Clock) -> Found | None:
    for probe in PROBES:
        answers = []
        for question in probe.questions:
            answers.append(_ask(transport, question, clock))
            seen.append(Exchange(baud, question, answers[-1]))
            if not answers[-1]:
                break
        said = probe.recognise(answers)
        if said:
            return Found(said[0], baud, said[1])
    return None


def _ask(transport: Transport, question: bytes, clock: Clock) -> bytes:
    """Send, and listen until it has been quiet for a moment after the first byte."""
    transport.read(0)
    transport.write(question)
    received, deadline = b"", clock.now() + ANSWER_S
    while (now := clock.now()) < deadline:
        came = transport.read(deadline - now)
        if came:
            received, deadline = received + came, clock.now() + QUIET_S
    return received


def _asi(answers: list[bytes]) -> tuple[str, str] | None:
    """``/`` is answered N or B; only a Tiger names card addresses in its build."""
    if answers[0].strip() not in (b"N", b"B"):
        return None
    build = answers[1] if len(answers) > 1 else b""
    name = _text(build).replace("\r", ", ") or "ASI controller"
    return ("asi-tiger" if b"TIGER" in build.upper() or b"Hex Addr" in build else "asi-ms2000"), name


def _prior(answers: list[bytes]) -> tuple[str, str] | None:
    return ("prior-proscan", _text(answers[0]).replace("\r", ", ")) if b"PRIOR" in answers[0].upper() else None


def _pi(answers: list[bytes]) -> tuple[str, str] | None:
    return ("pi-gcs2", _text(answers[0])) if b"Physik Instrumente" in answers[0] else None


def _emitter(answers: list[bytes]) -> tuple[str, str] | None:
    found = re.search(rb"parameters (\d+),", answers[0])
    return ("open3d", f"Open3DOLED emitter, firmware {found.group(1).decode()}") if found else None


def _modbus(answers: list[bytes]) -> tuple[str, str] | None:
    """Any frame of unit 1 with a good checksum is an answer: the register, or an exception that names the reason."""
    frame = answers[0]
    if len(frame) < SHORTEST_FRAME or frame[0] != 1 or frame[1] & 0x7F != READ_HOLDING or crc16(frame) != 0:
        return None
    return "modbus", "a Modbus device, unit 1"


def _text(answer: bytes) -> str:
    return "".join(
        character for character in answer.decode("latin-1").strip() if character.isprintable() or character == "\r"
    )


def crc16(frame: bytes) -> int:
    """Return the checksum of Modbus over serial line V1.02, 6.2.2; 0 for a frame that ends with its own."""
    crc = 0xFFFF
    for byte in frame:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc


def _with_crc(frame: bytes) -> bytes:
    return frame + crc16(frame).to_bytes(2, "little")


READ_HOLDING = 3
SHORTEST_FRAME = 5
PROBES = (
    Probe("ASI MS-2000 or Tiger", (b"/\r", b"BU X\r"), _asi),
    Probe("Prior ProScan", (b"\rDATE\r",), _prior),
    Probe("PI GCS 2.0", (b"\n*IDN?\n",), _pi),
    Probe("Open3DOLED emitter", (b"\n0\n",), _emitter),
    Probe("Modbus RTU, unit 1", (_with_crc(bytes([1, READ_HOLDING, 0, 0, 0, 1])),), _modbus),
)


def words(report: Report, port: str) -> Iterator[str]:
    """Return what was seen, byte for byte, a line each, and what it means."""
    for exchange in report.exchanges:
        answer = f"{exchange.received!r}  [{exchange.received.hex(' ')}]" if exchange.received else "nothing"
        yield f"  {exchange.baud:6d} baud  sent {exchange.sent!r}  got {answer}"
    if report.found is None:
        yield f"{port}: nobody known answered."
    else:
        yield f'{port}: {report.found.name}  (driver = "{report.found.driver}", baud = {report.found.baud})'
