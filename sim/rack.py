"""The devices of a bench on their wires, as they look from outside: with a plug, a power switch and a counter."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

from devices.errors import InputError, did_you_mean
from devices.values import Limits
from sim.faults import FaultyTwin
from sim.motion import ENDLESS
from sim.serial_line import SerialLine
from sim.stages import stage_kind
from sim.triggered_camera import FaultyLines, TriggerLines

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import ExitStack
    from pathlib import Path

    from devices.profile import LinkTable
    from devices.protocols import Clock
    from sim.bench import Bench
    from sim.controllers.registers import RegisterTwin, WordOrder
    from sim.faults import Fault, Faults
    from sim.feed_line import FeedTwin
    from sim.motion import Axis
    from sim.stages import Twin


EMITTER_BAUD = 115200


class Line(Protocol):
    """The wires of a device."""

    @property
    def pty_path(self) -> str | None:
        """Name of the pseudo-terminal, if there is one."""
        ...

    @property
    def tcp_url(self) -> str:
        """Name of the network port."""
        ...

    def plug(self) -> None:
        """Open the ports, under the same names as before."""
        ...

    def unplug(self) -> None:
        """Close the ports: clients see them vanish."""
        ...


class PowerSwitch:
    """A twin that hears nothing while it is off, and has forgotten what it did not save when it is on again."""

    def __init__(self, twin: Twin) -> None:
        self._twin = twin
        self.on = True

    def feed(self, data: bytes) -> list[bytes]:
        """Let the twin answer, if it is on."""
        return self._twin.feed(data) if self.on else []

    def switch(self, *, on: bool) -> None:
        """Switch on or off; switching on what is on does nothing."""
        if on and not self.on:
            self._twin.power_cycle()
        self.on = on


@dataclass
class Device:
    """One device of the bench.

    Attributes
    ----------
    name : str
        As faults call it.
    port : str
        What the instrument file says.
    line : Line
        Its plug.
    power : PowerSwitch
        Its switch.
    pulse : callable or None
        Its TTL input, if it has one.
    counters : callable
        What it counted.
    """

    name: str
    port: str
    line: Line
    power: PowerSwitch
    pulse: Callable[[], None] | None = None
    counters: Callable[[], dict[str, Any]] = field(default=dict)


Rack = dict[str, Device]


def fill_rack(bench: Bench, faults: Faults, folder: Path, cleanup: ExitStack, *, tcp: bool) -> Rack:
    """Put every device of the bench on its wires; `cleanup` takes them off."""
    spec, rack = bench.spec, {}
    makers: list[Callable[[], Device]] = [lambda: stage_device(bench, faults, folder, tcp=tcp)]
    if spec.microtome is not None and bench.feed is not None:
        link = spec.microtome.feed_profile().link
        makers.append(partial(feed_device, bench.feed, link, faults, bench.axis.clock, folder))
    if spec.glasses is not None and spec.glasses.driver == "open3d":
        makers.append(partial(glasses_device, faults, bench.axis.clock, folder, tcp=tcp))
    for make in makers:
        device = make()
        cleanup.callback(device.line.unplug)
        rack[device.name] = device
    return rack


def stage_device(bench: Bench, faults: Faults, folder: Path, *, tcp: bool) -> Device:
    """Put the stage on its wires; its faults of the mechanics go to the axis."""
    kind, power = stage_kind(bench.spec.stage.z.driver), PowerSwitch(bench.twin)
    feed = FaultyTwin(power.feed, faults, "z").feed
    line = SerialLine(feed, bench.spec.stage.z.baud, bench.axis.clock, link=folder / "z.port", misheard=kind.misheard)
    faults.when_changed("z.stall", partial(_stall, bench.axis))
    faults.when_changed("z.limit", _Limit(bench.axis))
    pulse = FaultyLines(bench.twin, faults).ttl_in if isinstance(bench.twin, TriggerLines) else None
    return Device("z", line.tcp_url if tcp else line.port, line, power, pulse)


def feed_device(twin: FeedTwin, link: LinkTable, faults: Faults, clock: Clock, folder: Path) -> Device:
    """Put the drive of a microtome, and its knife, on a line."""
    power = PowerSwitch(twin)
    line = SerialLine(
        FaultyTwin(power.feed, faults, "feed").feed, link.baud, clock, link=folder / "feed.port", misheard=b""
    )
    machine, knife = twin.machine, twin.plc.knife
    faults.when_changed("feed.stall", partial(_stall, machine.axis))
    faults.when_changed("feed.alarm", lambda fault: setattr(machine, "trip_at_um", _number(fault)))
    faults.when_changed("feed.jam", lambda fault: setattr(knife, "jam", fault is not None))
    faults.when_changed("feed.word-order", partial(_swap_words, twin.drive, twin.drive.word_order))
    faults.when_changed("feed.uncounted", lambda fault: setattr(knife, "counter_dead", fault is not None))
    port = line.port if link.kind == "rtu" else line.tcp_url.removeprefix("socket://")
    return Device("feed", port, line, power, counters=twin.counters)


def glasses_device(faults: Faults, clock: Clock, folder: Path, *, tcp: bool) -> Device:
    """Put the emitter of shutter glasses on its line."""
    from sim.controllers.open3d import Emitter  # noqa: PLC0415

    twin = Emitter(clock)
    power = PowerSwitch(twin)
    feed = FaultyTwin(power.feed, faults, "glasses").feed
    line = SerialLine(feed, EMITTER_BAUD, clock, link=folder / "glasses.port", any_baud=True)
    faults.when_changed("glasses.drift", lambda fault: twin.set_drift(_number(fault) or 0.0))
    port = line.tcp_url if tcp else line.port
    return Device("glasses", port, line, power, counters=lambda: {"edges": len(twin.edges()), "saves": twin.saves})


def _stall(axis: Axis, fault: Fault | None) -> None:
    """Put something in the way; what was in the way of a move ends that move where it is when it is taken out."""
    z_um = _number(fault)
    if z_um is not None:
        axis.obstruct(z_um)
    elif axis.travel != ENDLESS:
        axis.travel = ENDLESS
        axis.halt()


def _swap_words(drive: RegisterTwin, order: WordOrder, fault: Fault | None) -> None:
    """Let a drive put its 32-bit numbers the other way round than its manual says, as some can be set to."""
    other: WordOrder = "little" if order == "big" else "big"
    drive.word_order = other if fault else order


def _number(fault: Fault | None) -> float | None:
    return None if fault is None else fault.when


class _Limit:
    """A limit of the controller's own, inside those of the instrument."""

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self._without = axis.limits

    def __call__(self, fault: Fault | None) -> None:
        before, z_um = self._without, _number(fault)
        if z_um is None:
            self._axis.limits = before
        elif z_um > self._axis.encoder_um():
            self._axis.limits = Limits(before.min_um, min(z_um, before.max_um))
        else:
            self._axis.limits = Limits(max(z_um, before.min_um), before.max_um)


def device_of(rack: Rack, name: object) -> Device:
    """Return a device by name.

    Raises
    ------
    InputError
        The bench has none of this name.
    """
    if not isinstance(name, str) or name not in rack:
        raise InputError(f"this bench has no device '{name}'{did_you_mean(str(name), list(rack))}")
    return rack[name]
