"""A feed driver over its twin: in one thread on simulated time, the bytes through the real Modbus client."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pymodbus.client import ModbusSerialClient

from devices.drivers.feed import ModbusFeed
from devices.errors import LinkLost
from devices.feed_spec import FeedSpec
from devices.transport.modbus import ModbusBus
from sim.clock import SimClock
from sim.faults import PortDied
from sim.feed_line import FeedTwin, build_feed_twin

if TYPE_CHECKING:
    from collections.abc import Callable

PROFILES = ["leadshine-rs", "applied-motion-scl", "oriental-az", "plc-mailbox"]
TIMEOUT_S = 0.008


class TwinPort:
    """Looks to the Modbus client like an open serial port; behind it answers a twin, in the same thread."""

    def __init__(self, twin: FeedTwin) -> None:
        self.twin = twin
        self.timeout = self.inter_byte_timeout = 0
        self.coming: list[tuple[float, bytes]] = []
        self.sent: list[bytes] = []
        self.is_open = True
        self.unplugged = False
        self.on_write: Callable[[], None] = lambda: None

    def write(self, data: bytes) -> int:
        self._check()
        self.sent.append(data)
        self.on_write()
        try:
            replies = self.twin.feed_upset(data)
        except PortDied:
            self.unplugged = True
            replies = []
        # a late reply comes while the line is drained: that wait is the library's, in real time
        self.coming += [(time.monotonic() + min(reply.delay_s, 1.5 * TIMEOUT_S), reply.data) for reply in replies]
        return len(data)

    @property
    def in_waiting(self) -> int:
        self._check()
        return sum(len(data) for due, data in self.coming if due <= time.monotonic())

    def read(self, size: int) -> bytes:
        self._check()
        now = time.monotonic()
        come = b"".join(data for due, data in self.coming if due <= now)
        self.coming = [(due, data) for due, data in self.coming if due > now]
        return come

    def close(self) -> None:
        self.is_open = False

    def _check(self) -> None:
        if self.unplugged:
            raise OSError(5, "Input/output error")


def spec_of(profile: str, **changes: object) -> FeedSpec:
    """A microtome with this drive; the three bare drives have a PLC beside them for the knife, as unit 2."""
    knife = {"window_um": (300.0, 0.0), "clearance_um": 5.0, "grace_s": 1.0}
    if profile != "plc-mailbox":
        knife |= {"profile": "plc-mailbox", "unit": 2}
    table = {"profile": profile, "port": "twin", "link": "rtu", "timeout_s": TIMEOUT_S, "gap_ms": 0, "backlash_um": 0.0}
    limits = {"feed_um_max": 4000.0, "thickness_nm_max": 10_000.0}
    return FeedSpec.model_validate(table | {"limits": limits, "knife": knife} | changes)


@dataclass
class OnTwin:
    """A driver, its twin, the port between them, and their clock."""

    feed: ModbusFeed
    twin: FeedTwin
    port: TwinPort
    clock: SimClock
    allowed: list[str]

    def ready(self) -> OnTwin:
        self.feed.identify()
        self.feed.home()
        return self


def on_twin(profile: str, **changes: object) -> OnTwin:
    spec, clock = spec_of(profile, **changes), SimClock(100.0)
    twin = build_feed_twin(spec, clock)
    ports: list[TwinPort] = []

    def connect() -> ModbusSerialClient:
        if ports and ports[0].unplugged:
            raise LinkLost("feed: still unplugged.")
        client = ModbusSerialClient("twin", baudrate=1_000_000, timeout=TIMEOUT_S, retries=0)
        client._recv_interval = 0.0005
        client.socket = ports[0] if ports else TwinPort(twin)
        ports.append(client.socket)
        return client

    bus = ModbusBus(connect, name="twin", clock=clock, gap_s=0.0, exceptions=spec.feed_profile().exception_words())
    allowed: list[str] = []
    feed = ModbusFeed(bus, spec, clock, may_cut=lambda: allowed.append("asked"))
    return OnTwin(feed, twin, ports[0], clock, allowed)
