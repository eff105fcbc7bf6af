"""Modbus masters of other makers against the twins of the feeds: what they read and write is what the manuals say."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING

import minimalmodbus
import pytest
import serial
from feeds import PROFILES, spec_of
from pymodbus.client import ModbusTcpClient

from devices.clock import SystemClock
from sim.feed_line import build_feed_twin
from sim.serial_line import SerialLine

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sim.feed_line import FeedTwin

BAUD = 115_200
STATUS = {"leadshine-rs": 0x1003, "applied-motion-scl": 1, "oriental-az": 0x7F, "plc-mailbox": 17}
POSITION = {"leadshine-rs": 0x1014, "applied-motion-scl": 6, "oriental-az": 0xCC, "plc-mailbox": 19}
MOVING = {"leadshine-rs": 0x04, "applied-motion-scl": 0x10, "oriental-az": 0x2000, "plc-mailbox": 0x04}


@pytest.fixture
def instrument_of() -> Iterator[object]:
    """A minimalmodbus instrument on the pseudo-terminal of a twin."""
    with ExitStack() as running:

        def start(profile: str) -> tuple[minimalmodbus.Instrument, FeedTwin]:
            clock = SystemClock()
            twin = build_feed_twin(spec_of(profile), clock)
            line = SerialLine(twin.feed_upset, BAUD, clock, misheard=b"")
            running.callback(line.close)
            port = serial.Serial(line.port, BAUD, timeout=0.4)
            running.callback(port.close)
            return minimalmodbus.Instrument(port, 1), twin

        yield start


def begin_move(instrument: minimalmodbus.Instrument, profile: str, counts: int) -> None:
    """Send a move as each manual describes it."""
    if profile == "leadshine-rs":
        instrument.write_registers(0x6200, [1, 0, counts, 600, 100, 100, 0, 0x10])
    elif profile == "applied-motion-scl":
        instrument.write_register(29, 2400, functioncode=6)
        instrument.write_long(30, counts, signed=True)
        instrument.write_register(124, 0x67, functioncode=6)
    elif profile == "oriental-az":
        instrument.write_registers(0x58, [0, 0, 0, 1, 0, counts, 1, 0x86A0, 0, 1000, 0, 1000, 0, 1000, 0, 1])
    else:
        instrument.write_long(2, counts, signed=True)
        instrument.write_long(4, 200_000, signed=True)
        instrument.write_register(1, 3, functioncode=6)
        instrument.write_register(0, instrument.read_register(16) + 1, functioncode=6)


@pytest.mark.parametrize("profile", PROFILES)
def test_minimalmodbus_moves_every_twin(instrument_of, profile: str):
    instrument, twin = instrument_of(profile)
    twin.machine.zero_here()
    assert instrument.read_long(POSITION[profile], signed=True) == 0
    begin_move(instrument, profile, 1000)
    while instrument.read_register(STATUS[profile]) & MOVING[profile]:
        pass
    assert instrument.read_long(POSITION[profile], signed=True) == 1000
    assert twin.machine.feeds_executed == 1


@pytest.mark.parametrize("profile", PROFILES)
def test_minimalmodbus_hears_refusals(instrument_of, profile: str):
    instrument, _ = instrument_of(profile)
    with pytest.raises(minimalmodbus.IllegalRequestError, match="function"):
        instrument.read_bit(0, functioncode=1)
    with pytest.raises(minimalmodbus.IllegalRequestError, match="address"):
        instrument.read_register(0x7777)


def test_minimalmodbus_sends_the_ready_frames_of_the_manual(instrument_of):
    instrument, twin = instrument_of("leadshine-rs")
    heard: list[bytes] = []
    frames = twin._server.frames
    twin._server.frames = lambda data: (heard.append(data), frames(data))[1]
    instrument.write_register(0x6002, 0x20, functioncode=6)
    assert b"".join(heard).hex(" ").upper() == "01 06 60 02 00 20 37 D2"


def test_another_library_over_modbus_tcp():
    """pymodbus as a vendor's example uses it, beside our own transport."""
    clock = SystemClock()
    twin = build_feed_twin(spec_of("applied-motion-scl", link="tcp"), clock)
    with ExitStack() as running:
        line = SerialLine(twin.feed_upset, BAUD, clock, misheard=b"")
        running.callback(line.close)
        host, _, port = line.tcp_url.removeprefix("socket://").rpartition(":")
        client = ModbusTcpClient(host, port=int(port), retries=0, timeout=2)
        running.callback(client.close)
        assert client.connect()
        twin.machine.zero_here()
        client.write_registers(30, [0, 500], device_id=1)
        client.write_register(124, 0x67, device_id=1)
        while client.read_holding_registers(1, count=1, device_id=1).registers[0] & 0x10:
            pass
        assert client.read_holding_registers(6, count=2, device_id=1).registers == [0, 500]
        assert client.read_holding_registers(500, count=2, device_id=1).exception_code == 2
