"""The command ``stereotome glasses pattern``: pictures by which a person sees whether the glasses are right."""

from __future__ import annotations

import json as json_text
import sys
from pathlib import Path  # noqa: TC003  cyclopts reads the annotations
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from display.flip_process import FlipOptions
from display.glasses_patterns import pattern as drawn
from display.page_flip import PageFlip

if TYPE_CHECKING:
    from display.shown_report import ShownReport

Flag = Parameter(negative="")
SIZE, SIZE_WITHOUT_A_DISPLAY = (1920, 1080), (320, 180)
LOOK_S = 0.5
KEYS = (
    "Keys: S exchanges the eyes; up and down: shutters open later, sooner; right and left: longer, shorter; Esc ends.\n"
)


def pattern(
    kind: Literal["eyes", "crosstalk", "depth"] = "eyes",
    /,
    *,
    instrument: Annotated[Path | None, Parameter(name=["--instrument", "-i"])] = None,
    code: Literal["none", "white-line", "blue-line", "dlp-ready", "trigger-boxes"] = "none",
    swap: Annotated[bool, Flag] = False,
    window: Annotated[bool, Flag] = False,
    clock_hz: float | None = None,
    seconds: float | None = None,
    json: Annotated[bool, Flag] = False,
) -> int:
    """Show a test picture for each eye through the shutter glasses, and report how that went.

    Parameters
    ----------
    kind
        eyes: who sees LEFT? crosstalk: how bright is the ghost of the other eye's patch? depth: a disc that only two
        eyes see, before the screen if they are not exchanged.
    instrument
        The instrument file with the glasses; left out for glasses that watch a sync code or the display's plug.
    code
        Marks that are drawn for glasses which watch the picture.
    swap
        Exchange the eyes.
    window
        A window instead of the whole display.
    clock_hz
        No window: a clock of this rate in the display's place, to try the link to the glasses without a display.
    seconds
        For how long; until Esc when left out.
    json
        One JSON object instead of words.
    """
    options = FlipOptions(
        mailbox="",
        code=code,
        windowed=window,
        swap=swap,
        instrument=None if instrument is None else str(instrument),
        clock_hz=clock_hz,
        seconds=seconds,
    )
    size = SIZE if clock_hz is None else SIZE_WITHOUT_A_DISPLAY
    with PageFlip(size, options) as flip:
        flip.show(*drawn(kind, size))
        if not json and clock_hz is None:
            sys.stdout.write(KEYS)
        while not flip.wait(LOOK_S):
            pass
        report = flip.close()
    sys.stderr.writelines(f"{line}\n" for line in flip.said)
    if report is None:
        return 10
    sys.stdout.write(_said(report, json=json) + "\n")
    return 0


def _said(report: ShownReport, *, json: bool) -> str:
    return json_text.dumps(report.as_json()) if json else report.words()
