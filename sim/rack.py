"""The devices of a bench on their wires, as they look from outside: with a plug, a power switch and a counter."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from devices.errors import InputError, did_you_mean
from devices.values import Limits
from sim.faults import FaultyTwin
from sim.motion import ENDLESS
from sim.serial_line import SerialLine
from sim.stages import Triggered, stage_kind

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import ExitStack
    from pathlib import Path

    from sim.bench import Bench
    from sim.faults import Faults
    from sim.motion import Axis
    from sim.stages import Twin


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
    devices = [stage_device(bench, faults, folder, tcp=tcp)]
    for device in devices:
        cleanup.callback(device.line.unplug)
    return {device.name: device for device in devices}


def stage_device(bench: Bench, faults: Faults, folder: Path, *, tcp: bool) -> Device:
    """Put the stage on its wires; its faults of the mechanics go to the axis."""
    kind, power = stage_kind(bench.spec.stage.z.driver), PowerSwitch(bench.twin)
    feed = FaultyTwin(power.feed, faults, "z").feed
    line = SerialLine(feed, bench.spec.stage.z.baud, bench.axis.clock, link=folder / "z.port", misheard=kind.misheard)
    faults.when_changed("z.stall", lambda z_um: _stall(bench.axis, z_um))
    faults.when_changed("z.limit", _Limit(bench.axis))
    pulse = bench.twin.ttl_in if isinstance(bench.twin, Triggered) else None
    return Device("z", line.tcp_url if tcp else line.port, line, power, pulse)


def _stall(axis: Axis, z_um: float | None) -> None:
    """Put something in the way; what was in the way of a move ends that move where it is when it is taken out."""
    if z_um is not None:
        axis.obstruct(z_um)
    elif axis.travel != ENDLESS:
        axis.travel = ENDLESS
        axis.halt()


class _Limit:
    """A limit of the controller's own, inside those of the instrument."""

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self._without = axis.limits

    def __call__(self, z_um: float | None) -> None:
        before = self._without
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
