"""Faults on purpose, named in words: ``z.late@3``, ``z.garble@10%``, ``z.stall@12.5um``, ``camera.hang@4``."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from devices.errors import RigError, did_you_mean

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from devices.protocols import Clock

LATE_S = 0.7
NUMBER, SHARE, SECONDS, PLACE = "", "%", "s", "um"
ONCE, LASTING = (NUMBER, SHARE), (NUMBER, SECONDS)
KINDS = {
    "z.silent": LASTING,
    "z.die": LASTING,
    "z.drop": ONCE,
    "z.late": ONCE,
    "z.garble": ONCE,
    "z.half": ONCE,
    "z.stall": (PLACE,),
    "camera.drop": ONCE,
    "camera.hang": LASTING,
}
MEANING = {NUMBER: "N (the Nth)", SHARE: "N% (a share of all)", SECONDS: "Ns (seconds after the start)", PLACE: "Zum"}
_FAULT = re.compile(r"([a-z]+\.[a-z]+)(?:@(-?\d+(?:\.\d+)?)(um|s|%|))?")


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


def parse_faults(texts: Iterable[str]) -> tuple[Fault, ...]:
    """Read faults; raises as `parse_fault` does."""
    return tuple(parse_fault(text) for text in texts)


def _fits(when: str | None, unit: str | None, units: tuple[str, ...]) -> bool:
    if when is None:
        return PLACE not in units
    return (unit or NUMBER) in units and (unit == PLACE or float(when) >= 0)


def _forms(kind: str) -> list[str]:
    bare = [] if PLACE in KINDS[kind] else [f"{kind} (always)"]
    return bare + [f"{kind}@{MEANING[unit]}" for unit in KINDS[kind]]


class PortDied(Exception):
    """The device is gone: its ports close."""


@dataclass(frozen=True)
class Delayed:
    """A reply, and how long it is kept back."""

    data: bytes
    delay_s: float = 0.0


class Faults:
    """Decides which faults strike; counts commands (``z``) and frames (``camera``).

    Parameters
    ----------
    faults : iterable of Fault
        All of them.
    clock : Clock
        Time since now counts for faults given in seconds.
    seed : int
        Of the shares.
    """

    def __init__(self, faults: Iterable[Fault], clock: Clock, *, seed: int = 0) -> None:
        self._faults = tuple(faults)
        self._clock = clock
        self._started_s = clock.now()
        self._chance = np.random.default_rng(seed).random
        self._counts = {"z": 0, "camera": 0}

    @property
    def stall_um(self) -> float | None:
        """Where the axis gets stuck, if it does."""
        return next((fault.when for fault in self._faults if fault.kind == "z.stall"), None)

    def strike(self, device: str) -> set[str]:
        """Count one command or frame of a device and return the kinds that strike it."""
        self._counts[device] += 1
        number, elapsed_s = self._counts[device], self._clock.now() - self._started_s
        mine = [fault for fault in self._faults if fault.kind.startswith(device) and fault.unit != PLACE]
        return {fault.kind for fault in mine if fault.strikes(number, elapsed_s, self._chance)}


class FaultyTwin:
    """A twin whose replies go wrong."""

    def __init__(self, feed: Callable[[bytes], list[bytes]], faults: Faults) -> None:
        self._feed = feed
        self._faults = faults

    def feed(self, data: bytes) -> list[Delayed]:
        """Feed the twin; raises `PortDied` in place of the reply at which it dies."""
        spoiled = [self._spoil(reply) for reply in self._feed(data)]
        return [reply for reply in spoiled if reply.data]

    def _spoil(self, reply: bytes) -> Delayed:
        kinds = self._faults.strike("z")
        if "z.die" in kinds:
            raise PortDied
        if kinds & {"z.silent", "z.drop"}:
            return Delayed(b"")
        if "z.garble" in kinds:
            reply = garbled(reply)
        if "z.half" in kinds:
            reply = reply[: len(reply) // 2]
        return Delayed(reply, LATE_S if "z.late" in kinds else 0.0)


def garbled(reply: bytes) -> bytes:
    """Return a reply with its bits disturbed, its end intact."""
    return bytes(byte ^ 0xA5 for byte in reply.rstrip(b"\r\n")) + b"\r\n"
