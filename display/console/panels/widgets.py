"""What several panels draw with. Sizes are in em, so that they follow the font."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
from imgui_bundle import hello_imgui, imgui

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

ORANGE = imgui.ImVec4(0.95, 0.6, 0.15, 1)  # told apart from blue by all eyes; words stand beside every colour
BLUE = imgui.ImVec4(0.35, 0.65, 1.0, 1)
GREY = imgui.ImVec4(0.65, 0.65, 0.65, 1)
BROWN = imgui.ImVec4(0.6, 0.35, 0.0, 1)
RED = imgui.ImVec4(0.85, 0.12, 0.1, 1)
TALL = 1.3
YELLOW = 0xFF30D0FF
WHITE = 0xFFFFFFFF
SHADE = 0xA0000000
WHY_NOT = int(imgui.HoveredFlags_.allow_when_disabled | imgui.HoveredFlags_.for_tooltip)


def em(width: float, height: float = 0.0) -> imgui.ImVec2:
    """Return a size in widths of a letter."""
    return hello_imgui.em_to_vec2(width, height)


def button(label: str, why_not: str = "", hint: str = "", width: float = 0.0) -> bool:
    """Draw a button; with a reason against it, it is off and says so under the mouse."""
    imgui.begin_disabled(bool(why_not))
    pressed = imgui.button(label, em(width, 0))
    imgui.end_disabled()
    words = why_not or hint
    if words and imgui.is_item_hovered(WHY_NOT):
        imgui.set_tooltip(words.replace("%", "%%"))
    return pressed


def hint(words: str) -> None:
    """Say more of the last field under the mouse."""
    if imgui.is_item_hovered(WHY_NOT):
        imgui.set_tooltip(words)


def choice(label: str, items: Sequence[str], chosen: str, width: float) -> str:
    """Draw a drop-down list and return what is chosen."""
    imgui.set_next_item_width(em(width).x)
    index = items.index(chosen) if chosen in items else 0
    _, index = imgui.combo(label, index, list(items))
    return items[index]


def number(label: str, value: float, width: float = 6.0, form: str = "%.2f") -> tuple[bool, float]:
    """Draw a field for a number; true when it was entered."""
    imgui.set_next_item_width(em(width).x)
    _, value = imgui.input_float(label, value, 0.0, 0.0, form)
    return imgui.is_item_deactivated_after_edit(), value


def whole(label: str, value: int, least: int, most: int, width: float = 7.0) -> int:
    """Draw a field for a whole number with steps."""
    imgui.set_next_item_width(em(width).x)
    _, value = imgui.input_int(label, value)
    return min(max(value, least), most)


def words(text: str, colour: imgui.ImVec4 | None = None) -> None:
    """Draw text that is broken at the panel's edge."""
    if colour is not None:
        imgui.push_style_color(imgui.Col_.text, colour)
    imgui.push_text_wrap_pos(0.0)
    imgui.text_unformatted(text)
    imgui.pop_text_wrap_pos()
    if colour is not None:
        imgui.pop_style_color()


def over_picture(lines: imgui.ImDrawList, corner: imgui.ImVec2, text: str, colour: int = WHITE) -> None:
    """Write over a picture, on a shade."""
    size = imgui.calc_text_size(text)
    end = imgui.ImVec2(corner.x + size.x + 3, corner.y + size.y + 1)
    lines.add_rect_filled(imgui.ImVec2(corner.x - 3, corner.y - 1), end, SHADE)
    lines.add_text(corner, colour, text)


def curve(lines: imgui.ImDrawList, values: NDArray[np.float64], corner: imgui.ImVec2, end: imgui.ImVec2) -> None:
    """Draw values from the left to the right of a box as high as it is; where there is none, nothing."""
    known = np.isfinite(values)
    low, high = float(values[known].min()), float(values[known].max())
    across = np.linspace(corner.x, end.x, len(values))
    down = end.y - (values - low) / max(high - low, 1e-9) * (end.y - corner.y)
    for run in np.split(np.arange(len(values)), np.flatnonzero(np.diff(known)) + 1):
        if known[run[0]]:
            lines.add_polyline([imgui.ImVec2(across[k], down[k]) for k in run], YELLOW, 1.5, 0)


def text_field(label: str, text: str, width: float = 12.0) -> str:
    """Draw a field for a line of text."""
    imgui.set_next_item_width(em(width).x)
    _, text = imgui.input_text(label, text)
    return text


@contextmanager
def larger(factor: float) -> Iterator[None]:
    """Write larger."""
    imgui.push_font(None, factor * imgui.get_style().font_size_base)
    try:
        yield
    finally:
        imgui.pop_font()


@contextmanager
def coloured(colour: imgui.ImVec4) -> Iterator[None]:
    """Draw buttons in a colour."""
    for which in (imgui.Col_.button, imgui.Col_.button_hovered, imgui.Col_.button_active):
        imgui.push_style_color(which, colour)
    try:
        yield
    finally:
        imgui.pop_style_color(3)
