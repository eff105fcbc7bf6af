"""Gamepads and joysticks, read through GLFW by the thread of the window.

To be imported after ``imgui_bundle``, which names the GLFW library that both then use.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import glfw as typed_glfw

from display.console.sticks import Reading

glfw: Any = typed_glfw  # its own type hints are wrong in several places
LEARNT_WAY = 0.6


@dataclass(frozen=True)
class Mapping:
    """Which axis and button of a kind of pad mean something; remembered by the pad's GUID."""

    axis: int = 1
    button: int = 0
    flipped: bool = True  # most pads tell -1 for a stick that is pushed forward

    @classmethod
    def of(cls, stored: list[int]) -> Mapping:
        """Return the mapping the settings keep."""
        axis, button, flipped = stored
        return cls(axis, button, bool(flipped))

    def stored(self) -> list[int]:
        """Return it as the settings keep it."""
        return [self.axis, self.button, int(self.flipped)]


class Gamepad:
    """One pad."""

    def __init__(self, number: int, mapping: Mapping) -> None:
        self.number = number
        self.mapping = mapping
        self.name = _text(glfw.get_joystick_name(number)) or f"joystick {number + 1}"
        self.guid = _text(glfw.get_joystick_guid(number))

    def read(self, now_s: float) -> Reading | None:
        """Return how its axis and button are now; None when it is unplugged."""
        axes, buttons = axes_of(self.number), buttons_of(self.number)
        if self.mapping.axis >= len(axes) or self.mapping.button >= len(buttons):
            return None
        rate = axes[self.mapping.axis] * (-1 if self.mapping.flipped else 1)
        return Reading(rate, bool(buttons[self.mapping.button]), now_s)

    def close(self) -> None:
        """Nothing to let go of."""


def pads() -> list[int]:
    """Return the numbers of the pads that are plugged in."""
    return [number for number in range(glfw.JOYSTICK_LAST + 1) if glfw.joystick_present(number)]


def axes_of(number: int) -> list[float]:
    """Return the axes of a pad, from -1 to 1; none when it is gone."""
    found, count = glfw.get_joystick_axes(number)
    return [float(found[k]) for k in range(count)] if found else []


def buttons_of(number: int) -> list[int]:
    """Return which buttons of a pad are pressed; none when it is gone."""
    found, count = glfw.get_joystick_buttons(number)
    return [int(found[k]) for k in range(count)] if found else []


def learnt(rest: list[float], axes: list[float], buttons: list[int]) -> Mapping | None:
    """Return the mapping once the axis that is meant is pushed up and its button held; None before."""
    ways = [now - then for now, then in zip(axes, rest, strict=False)]
    far = max(range(len(ways)), key=lambda k: abs(ways[k]), default=0)
    if not ways or abs(ways[far]) < LEARNT_WAY or not any(buttons):
        return None
    return Mapping(far, buttons.index(1), ways[far] < 0)


def _text(name: Any) -> str:
    return name.decode("utf-8", "replace") if isinstance(name, bytes) else str(name or "")
