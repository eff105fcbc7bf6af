"""Shutter glasses: test pictures that tell whose eye sees what, and how well the shutters keep to the pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING, get_args

from imgui_bundle import imgui

from display.console.flipping import REVIEW
from display.console.panels import widgets as w
from display.sync_codes import Code

if TYPE_CHECKING:
    from display.console.model import Console
    from display.page_flip import Going

CODES: tuple[Code, ...] = get_args(Code)
TESTS = {
    "eyes": ("Whose eye?", "each eye reads its own name; else exchange the eyes: S in that window"),
    "crosstalk": ("Crosstalk", "find the step that is as bright as the ghost of the other eye's white patch"),
    "depth": ("Depth", "a disc stands before the screen, behind it if the eyes are exchanged"),
}
NS_PER_S = 1_000_000_000


def draw(console: Console) -> None:
    """Draw the panel."""
    flipping = console.flipping
    rig = console.bench.rig
    glasses = None if rig is None else rig.glasses
    w.words(
        "No [glasses] in the instrument file: only glasses that watch the picture, or the display's plug."
        if glasses is None
        else f"{glasses.driver} at {glasses.port}",
        w.GREY,
    )
    running = "end the show first" if flipping.shows else ""
    imgui.begin_disabled(bool(running))
    flipping.code = CODES[CODES.index(w.choice("marks in the picture", CODES, flipping.code, 9))]
    _, flipping.windowed = imgui.checkbox("in a window, not the whole display", flipping.windowed)
    imgui.end_disabled()
    for kind, (label, what) in TESTS.items():
        if w.button(label, "", f"{what} (G)" if kind == "eyes" else what):
            flipping.begin(kind)
        imgui.same_line()
    if w.button("End", "" if flipping.shows else "nothing is shown"):
        flipping.end()
    _stands(flipping.shows, flipping.going)
    for line in flipping.report:
        w.words(line)


def _stands(shows: str, going: Going | None) -> None:
    if not shows:
        w.words("Nothing is shown. Review shows a run here: stereo, page-flip.", w.GREY)
        return
    w.words("the review" if shows == REVIEW else TESTS[shows][1], w.BLUE)
    if going is None or not going.period_ns:
        imgui.text("starting ...")
        return
    imgui.text(f"{going.flips} pictures at {NS_PER_S / going.period_ns:.2f} Hz, {going.late} late")
    bad = going.wrong_eye > 0
    imgui.text_colored(w.ORANGE if bad else w.GREY, f"wrong eye in {going.wrong_eye} of {going.refreshes} refreshes")
