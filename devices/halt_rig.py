"""Stop everything an instrument can move, from outside of whatever program drives it."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from devices.clock import SystemClock
from devices.errors import DeviceBusy, StereotomeError
from devices.halt_now import halt_now
from devices.registry import DeviceContext
from devices.transport.urgent import send_past_lock

if TYPE_CHECKING:
    from collections.abc import Callable

    from devices.feed_spec import FeedSpec
    from devices.rig import RigSpec

ROOM_S = 1.0
EITHER_IS_NEW = (0x8000, 0x8001)  # a mailbox ignores the number it acknowledged last, never both


def halt_rig(spec: RigSpec) -> tuple[list[str], list[str]]:
    """Stop stage and feed, each by its own halt; return in words what was told, and what could not be told."""
    told: list[str] = []
    failed: list[str] = []
    for name, halt in _ways(spec).items():
        try:
            told.append(f"{name}: {halt()}")
        except StereotomeError as error:
            failed.append(f"{name}: {error.what}")
    return told, failed


def _ways(spec: RigSpec) -> dict[str, Callable[[], str]]:
    stage = spec.stage.z
    ways: dict[str, Callable[[], str]] = {"z stage": partial(halt_now, stage.driver, stage.port, stage.baud)}
    if spec.microtome is not None:
        ways["feed"] = partial(halt_feed, spec.microtome)
    return ways


def halt_feed(spec: FeedSpec) -> str:
    """Stop feed and knife at once, also while another program holds the port; return how they were told.

    Raises
    ------
    DeviceError
        The port is missing or takes nothing.
    """
    from devices.drivers.feed import open_feed  # noqa: PLC0415  an instrument without a feed does without

    try:
        feed = open_feed(spec, DeviceContext(SystemClock()), look=False)
    except DeviceBusy:
        _past_lock(spec)
        return f"stop sent to {spec.port}, past the program that holds it"
    try:
        feed.halt()
    finally:
        feed.close()
    return f"stop sent to {spec.port}"


def _past_lock(spec: FeedSpec) -> None:
    """Put the frames of a stop on a line that another program talks over; the answers go to that program."""
    from devices.transport.modbus import frame  # noqa: PLC0415  an instrument without a feed does without

    for profile, action in spec.stops():
        for seq in EITHER_IS_NEW:
            for request in profile.writes(action, {"seq": seq}):
                send_past_lock(spec.port, frame(profile.link.unit, request), device="feed", wait_s=ROOM_S)
