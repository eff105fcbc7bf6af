"""Which gamepad or 3-D mouse moves the stage, how fast, and which of its axes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from devices.errors import StereotomeError
from display.console import gamepad, spacemouse
from display.console.panels import widgets as w
from display.console.sticks import TOP_UM_S

if TYPE_CHECKING:
    from pathlib import Path

    from display.console.model import Console
    from display.console.sticks import InputDevice

NONE = "none"


class StickPanel:
    """Remembers where the axes rested while one is being learnt."""

    def __init__(self) -> None:
        self._rest: list[float] | None = None

    def draw(self, console: Console) -> None:
        """Draw what belongs to the stick."""
        stick = console.stick
        pads = {gamepad.Gamepad(number, gamepad.Mapping()).name: number for number in gamepad.pads()}
        mice = {f"3-D mouse {path.name}": path for path in spacemouse.found()}
        names = [NONE, *pads, *mice]
        before = NONE if stick.device is None else stick.device.name
        if before not in names:
            names.append(before)
        chosen = w.choice("moves the stage", names, before, 10)
        if chosen != before:
            self._use(console, chosen, pads.get(chosen), mice.get(chosen))
        if stick.device is None:
            return
        _, top_um_s = w.number("µm/s at most", stick.top_um_s, 5, "%.0f")
        stick.top_um_s = min(max(top_um_s, TOP_UM_S[0]), TOP_UM_S[1])
        w.words(stick.still or "moving", w.GREY if stick.still else w.BLUE)
        if isinstance(stick.device, gamepad.Gamepad):
            self._learn(console, stick.device)

    def _use(self, console: Console, name: str, pad: int | None, mouse: Path | None) -> None:
        self._rest = None
        try:
            device: InputDevice | None = None if mouse is None else spacemouse.SpaceMouse(mouse, name)
        except StereotomeError as error:
            console.journal.error("stick", error)
            return
        if pad is not None:
            device = gamepad.Gamepad(pad, gamepad.Mapping())
            stored = console.settings.pads.get(device.guid)
            device.mapping = gamepad.Mapping.of(stored) if stored else device.mapping
        console.stick.use(device)

    def _learn(self, console: Console, pad: gamepad.Gamepad) -> None:
        """Let the axis that is meant be shown instead of named."""
        if self._rest is None:
            if w.button("Another axis or button ..."):
                self._rest = gamepad.axes_of(pad.number)
                console.stick.block()
            return
        console.stick.block()
        w.words("Hold the button that is to be held, and push the axis up.", w.ORANGE)
        axes, buttons = gamepad.axes_of(pad.number), gamepad.buttons_of(pad.number)
        found = gamepad.learnt(self._rest, axes, buttons)
        if found is not None:
            pad.mapping, self._rest = found, None
            console.settings.pads[pad.guid] = found.stored()
