"""What an ASI controller says of itself: which of its cards drives Z, and what that card can do."""

from __future__ import annotations

import re
from dataclasses import dataclass

_RING = re.compile(r"RING BUFFER\s+(\d+)")


@dataclass(frozen=True)
class Card:
    """Where Z is driven.

    Attributes
    ----------
    address : str
        Character before commands to the card; empty on an MS-2000, which has no cards.
    axis_mask : int
        The bit of Z among the axes of its card.
    halt : str
        How a halt is spelled: an addressed backslash is not understood by a Tiger.
    """

    address: str = ""
    axis_mask: int = 4
    halt: str = "\\"


MS2000 = Card()


def ring_slots(build: tuple[str, ...]) -> int:
    """Return how many positions the ring holds, 0 for firmware without one."""
    found = [_RING.fullmatch(line) for line in build]
    return next((int(match.group(1)) for match in found if match), 0)


def tiger_card(build: tuple[str, ...], axis: str = "Z") -> Card | None:
    """Return the card of a Tiger that drives an axis, from what its communication card says; None without it.

    ``Motor Axes: X Y Z`` names the axes in their order, ``Axis Addr: 1 1 2`` the card of each.
    """
    told = dict(line.split(":", 1) for line in build if ":" in line)
    axes, addresses = told.get("Motor Axes", "").split(), told.get("Axis Addr", "").split()
    if axis not in axes or len(axes) != len(addresses):
        return None
    address = addresses[axes.index(axis)]
    mates = [letter for letter, other in zip(axes, addresses, strict=True) if other == address]
    return Card(address, 1 << mates.index(axis), "HALT")
