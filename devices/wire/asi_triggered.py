"""What an ASI controller does on TTL pulses: the ring of positions, the linear stack, the two lines.

Positions are in controller units, as in `devices.wire.asi`. On a Tiger these commands belong to a card, not to an axis:
``card`` is the character of its address, empty on an MS-2000. Source: ASI, programming manual, RM, LD, TTL and ZS.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from devices.wire import asi

if TYPE_CHECKING:
    from devices.wire.exchange import Request

LONGEST_TIMEOUT_MS: Final = 32767
MOST_PLANES: Final = 32767
MOST_PLANES_OLD: Final = 127  # firmware before 9.50 and 3.43
IN_OFF, IN_RING, IN_STACK = 0, 1, 4
OUT_LOW, OUT_AFTER_MOVE = 0, 2


def clear_ring(card: str = "") -> Request[None]:
    """Empty the ring of positions."""
    return asi.command(f"{card}RM X=0")


def load_ring(position: float) -> Request[None]:
    """Append a position to the ring; a second time it would be there twice."""
    return asi.command(f"LD Z={position:.3f}", repeatable=False)


def use_ring(axis_mask: int, card: str = "") -> Request[None]:
    """Let the ring drive the axes of a bit mask, from its first position on. An MS-2000 starts with X and Y only."""
    return asi.command(f"{card}RM Y={axis_mask} Z=0")


def ring_count(card: str = "") -> Request[float]:
    """Ask how many positions are loaded (firmware from 9.2g, 2.89)."""
    return asi.setting(f"{card}RM X?", "X")


def step_ring(card: str = "") -> Request[None]:
    """Go to the ring's next position, as on a pulse."""
    return asi.command(f"{card}RM", repeatable=False, moves=True)


def stay() -> Request[None]:
    """Move by nothing; all that comes of it is the pulse after a move."""
    return asi.command("R Z=0", repeatable=False, moves=True)


def on_pulse(action: int, card: str = "") -> Request[None]:
    """Choose what a pulse at the input does: ``IN_OFF``, ``IN_RING``, ``IN_STACK``."""
    return asi.command(f"{card}TTL X={action}")


def output(action: int, card: str = "") -> Request[None]:
    """Set the output: ``OUT_LOW``, or a pulse after each move, ``OUT_AFTER_MOVE``."""
    return asi.command(f"{card}TTL Y={action}")


def linear_stack(step: float, planes: int, timeout_ms: int, card: str = "") -> Request[None]:
    """Define a stack around where the first pulse finds the axis; that pulse sends it to the first plane.

    After ``timeout_ms`` without a pulse the axis goes back to where it was, and nothing is said.
    """
    return asi.command(f"{card}ZS X={step:.3f} Y={planes} Z=0 F={timeout_ms}")
