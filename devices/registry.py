"""Drivers by name. A driver is an entry point of the group ``stereotome.devices``.

The entry point names a function ``open_stage(table, context)``, or ``open_camera``, ``open_feed``, ``open_glasses``;
which of them it is called tells what it drives, so that nothing needs importing to list what is installed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from devices.errors import RigError, did_you_mean
from devices.installed import installed

if TYPE_CHECKING:
    from collections.abc import Callable
    from importlib.metadata import EntryPoint
    from pathlib import Path

    from devices.protocols import Clock

GROUP = "stereotome.devices"
Kind = Literal["stage", "camera", "feed", "glasses"]
KINDS: tuple[Kind, ...] = ("stage", "camera", "feed", "glasses")


@dataclass(frozen=True)
class DeviceContext:
    """What a driver may know beside its own table.

    Attributes
    ----------
    clock : Clock
        Time.
    transcript : Path or None
        Folder into which exchanges are recorded, if they are.
    stage_position_um : callable or None
        Where the z stage is now, for a camera that replays images by their z.
    """

    clock: Clock
    transcript: Path | None = None
    stage_position_um: Callable[[], float] | None = None


def drivers(kind: Kind) -> dict[str, EntryPoint]:
    """Return the installed drivers of a kind of device by name."""
    return {point.name: point for point in installed(GROUP) if point.attr == f"open_{kind}"}


def unknown_driver(name: str, kind: Kind) -> str | None:
    """Return what is wrong with a driver's name, in words, or None."""
    known = drivers(kind)
    return None if name in known else f"no {kind} driver '{name}'{did_you_mean(name, list(known))}"


def factory(name: str, kind: Kind) -> Callable[[Any, DeviceContext], Any]:
    """Return the function that opens a device, ``factory(table, context)``; imports its module.

    Raises
    ------
    RigError
        No such driver is installed.
    """
    problem = unknown_driver(name, kind)
    if problem:
        raise RigError(problem, fix="list what is installed: stereotome devices list")
    loaded: Callable[[Any, DeviceContext], Any] = drivers(kind)[name].load()
    return loaded
