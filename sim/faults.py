"""Faults on purpose, named in words: ``z.late@3``, ``feed.garble@10%``, ``z.stall@12.5um``, ``camera.hang@4``.

Faults of the wire strike replies, those of the camera frames, those of the block sections, those of the trigger cables
pulses; faults of the mechanics are done to a device once, by whoever gave its device to `Faults.when_changed`.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from devices.errors import RigError, did_you_mean

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from devices.protocols import Clock

LATE_S = 0.7
NUMBER, SHARE, SECONDS, PLACE, DRIFT, LENGTH = "", "%", "s", "um", "ppm", "nm"
ONCE, LASTING = (NUMBER, SHARE), (NUMBER, SECONDS)
ON_A_WIRE = {"silent": LASTING, "die": LASTING, "drop": ONCE, "late": ONCE, "garble": ONCE, "half": ONCE}
SERIAL_DEVICES = ("z", "feed", "glasses")
PULSES = ".pulse-"
KINDS: dict[str, tuple[str, ...]] = {
    **{f"{device}.{kind}": units for device in SERIAL_DEVICES for kind, units in ON_A_WIRE.items()},
    "z.stall": (PLACE,),
    "z.limit": (PLACE,),
    "z.pulse-lost": ONCE,
    "z.pulse-doubled": ONCE,
    "feed.stall": (PLACE,),
    "feed.alarm": (PLACE,),
    "feed.jam": (),
    "feed.uncounted": (),
    "feed.word-order": (),
    "glasses.drift": (DRIFT,),
    "camera.drop": ONCE,
    "camera.late": ONCE,
    "camera.half": ONCE,
    "camera.hang": LASTING,
    "camera.die": LASTING,
    "camera.pulse-lost": ONCE,
    "camera.freeze": LASTING,
    "camera.partial": ONCE,
    "lamp.bright": (),
    "lamp.flicker": (SHARE,),
    "block.debris": ONCE,
    "block.miss": ONCE,
    "block.lost": LASTING,
    "block.stuck": (),
    "block.uneven": (LENGTH,),
    "block.drift": (LENGTH,),
    "block.focus": (LENGTH,),
}
SIGNED = {PLACE, DRIFT, LENGTH}
MEANING = {
    NUMBER: "N (the Nth)",
    SHARE: "N% (a share of all)",
    SECONDS: "Ns (seconds after the start)",
    PLACE: "Zum",
    DRIFT: "Nppm",
    LENGTH: "Nnm",
}
_FAULT = re.compile(r"([a-z]+\.[a-z-]+)(?:@(-?\d+(?:\.\d+)?)(um|ppm|nm|s|%|))?")


@dataclass(frozen=True)
class Fault:
    """One fault: what happens, and when.

    Attributes
    ----------
    kind : str
        A key of `KINDS`.
    when : float or None
        Number, share in percent, seconds or place, as ``unit`` says; None is always.
    """

    kind: str
    when: float | None = None
    unit: str = NUMBER

    @property
    def device(self) -> str:
        """The device it happens to."""
        return self.kind.partition(".")[0]

    @property
    def counted(self) -> str:
        """What it strikes: the device's replies or frames, or the pulses that come to it."""
        return pulses_of(self.device) if PULSES in self.kind else self.device

    @property
    def of_mechanics(self) -> bool:
        """Whether it is done to a device once, instead of to its replies."""
        return NUMBER not in KINDS[self.kind]

    def __str__(self) -> str:
        return self.kind if self.when is None else f"{self.kind}@{self.when:g}{self.unit}"

    def strikes(self, number: int, elapsed_s: float, chance: Callable[[], float]) -> bool:
        """Tell whether it strikes the ``number``-th command or frame, counted from 1."""
        if self.when is None:
            return True
        if self.unit == SECONDS:
            return elapsed_s >= self.when
        if self.unit == SHARE:
            return chance() * 100 < self.when
        return number >= self.when if SECONDS in KINDS[self.kind] else number == self.when


def parse_fault(text: str) -> Fault:
    """Read one fault.

    Raises
    ------
    RigError
        No such fault, or not with this kind of number.
    """
    found = _FAULT.fullmatch(text.strip())
    kind = found.group(1) if found else text.partition("@")[0]
    if kind not in KINDS:
        raise RigError(f"no fault '{text}'{did_you_mean(kind, list(KINDS))}")
    if found is None or not _fits(found.group(2), found.group(3), KINDS[kind]):
        raise RigError(f"fault '{text}': cannot be read.", fix=f"write {' or '.join(_forms(kind))}")
    when, unit = found.group(2), found.group(3) or NUMBER
    return Fault(kind, None if when is None else float(when), unit)


def pulses_of(device: str) -> str:
    """Return the name under which pulses that come to a device are counted."""
    return f"{device} pulses"


def parse_faults(texts: Iterable[str]) -> tuple[Fault, ...]:
    """Read faults; raises as `parse_fault` does."""
    return tuple(parse_fault(text) for text in texts)


def _fits(when: str | None, unit: str | None, units: tuple[str, ...]) -> bool:
    if when is None:
        return not set(units) & SIGNED
    return (unit or NUMBER) in units and (unit in SIGNED or float(when) >= 0)


def _forms(kind: str) -> list[str]:
    bare = [] if set(KINDS[kind]) & SIGNED else [f"{kind} (always)"]
    return bare + [f"{kind}@{MEANING[unit]}" for unit in KINDS[kind]]


class PortDied(Exception):
    """The device is gone: its ports close."""


class HungUp(PortDied):
    """The device ends this connection, and takes the next."""


@dataclass(frozen=True)
class Delayed:
    """A reply, and how long it is kept back."""

    data: bytes
    delay_s: float = 0.0


@dataclass(frozen=True)
class Armed:
    """A fault that is on, and what had been counted when it was switched on."""

    fault: Fault
    count: int
    since_s: float


class Faults:
    """Decides which faults strike; counts the commands of each device, the frames of the camera, and pulses.

    They may be switched on and off at any time, from any thread; a number or a time counts from there.

    Parameters
    ----------
    faults : iterable of Fault
        Those that are on from the beginning.
    clock : Clock
        Time.
    seed : int
        Of the shares.
    """

    def __init__(self, faults: Iterable[Fault], clock: Clock, *, seed: int = 0) -> None:
        self._clock = clock
        self._chance = np.random.default_rng(seed).random
        self._counts: Counter[str] = Counter()
        self._mechanics: dict[str, Callable[[Fault | None], None]] = {}
        self._armed: tuple[Armed, ...] = ()
        for fault in faults:
            self.switch_on(fault)

    @property
    def active(self) -> tuple[Fault, ...]:
        """Return the faults that are on."""
        return tuple(armed.fault for armed in self._armed)

    def number(self, kind: str) -> float | None:
        """Return the number a fault that is on was given, 0 without one; None when it is off."""
        return next((fault.when or 0.0 for fault in self.active if fault.kind == kind), None)

    def when_changed(self, kind: str, do: Callable[[Fault | None], None]) -> None:
        """Let ``do`` be called with a fault of the mechanics when it goes on, with None when it goes off."""
        self._mechanics[kind] = do
        for fault in self.active:
            if fault.kind == kind:
                do(fault)

    def switch_on(self, fault: Fault) -> None:
        """Switch a fault on; one of the same kind that was on ends."""
        others = tuple(armed for armed in self._armed if armed.fault.kind != fault.kind)
        self._armed = (*others, Armed(fault, self._counts[fault.counted], self._clock.now()))
        self._done(fault.kind, fault)

    def switch_off(self, kind: str) -> bool:
        """Switch the faults of a kind off and tell whether one was on."""
        before = self._armed
        self._armed = tuple(armed for armed in before if armed.fault.kind != kind)
        self._done(kind, None)
        return len(self._armed) < len(before)

    def strike(self, counted: str) -> set[str]:
        """Count one command or frame of a device, or one of `pulses_of` it, and return the kinds that strike it."""
        self._counts[counted] += 1
        mine = [armed for armed in self._armed if armed.fault.counted == counted and not armed.fault.of_mechanics]
        return {armed.fault.kind for armed in mine if self._strikes(armed)}

    def _strikes(self, armed: Armed) -> bool:
        number = self._counts[armed.fault.counted] - armed.count
        return armed.fault.strikes(number, self._clock.now() - armed.since_s, self._chance)

    def _done(self, kind: str, fault: Fault | None) -> None:
        if kind in self._mechanics:
            self._mechanics[kind](fault)


class FaultyTwin:
    """A twin whose replies go wrong.

    Parameters
    ----------
    feed : callable
        The twin.
    faults : Faults
        What goes wrong.
    device : str
        Whose faults are meant.
    """

    def __init__(self, feed: Callable[[bytes], list[bytes]], faults: Faults, device: str = "z") -> None:
        self._feed = feed
        self._faults = faults
        self._device = device

    def feed(self, data: bytes) -> list[Delayed]:
        """Feed the twin; raises `PortDied` in place of the reply at which it dies."""
        spoiled = [self._spoil(reply) for reply in self._feed(data)]
        return [reply for reply in spoiled if reply.data]

    def _spoil(self, reply: bytes) -> Delayed:
        kinds = {kind.partition(".")[2] for kind in self._faults.strike(self._device)}
        if "die" in kinds:
            raise PortDied
        if kinds & {"silent", "drop"}:
            return Delayed(b"")
        if "garble" in kinds:
            reply = garbled(reply)
        if "half" in kinds:
            reply = reply[: len(reply) // 2]
        return Delayed(reply, LATE_S if "late" in kinds else 0.0)


def garbled(reply: bytes) -> bytes:
    """Return a reply with its bits disturbed, its end intact."""
    said = reply.rstrip(b"\r\n")
    return bytes(byte ^ 0xA5 for byte in said) + reply[len(said) :]
