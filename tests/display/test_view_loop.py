"""The loop of a window: resized to nothing and back, and a driver that gives up."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from devices.errors import DisplayError
from display.controls import Shown
from display.gl.context import check
from display.load import as_volume
from display.view import Viewer
from display.window import Happened
from sim.clock import SimClock


class Window:
    """A window whose size is another one at each look."""

    def __init__(self, clock: SimClock, sizes: list[tuple[int, int]]) -> None:
        self.clock, self.sizes, self.swaps = clock, sizes, 0

    @property
    def size(self) -> tuple[int, int]:
        return self.sizes[0]

    @property
    def closed(self) -> bool:
        return len(self.sizes) == 1

    def wait(self, timeout_s: float) -> Happened:
        del timeout_s
        self.clock.sleep(0.3)
        self.sizes.pop(0)
        return Happened()

    def swap(self) -> None:
        self.swaps += 1


def test_a_window_of_no_size_shows_nothing_and_goes_on_when_it_has_one_again(renderers, monkeypatch):
    monkeypatch.setattr("display.view.show", lambda canvas, picture, size: None)
    clock = SimClock()
    sizes = [(64, 48), (64, 48), (0, 0), (0, 48), (80, 60), (80, 60)]
    window = Window(clock, sizes)
    volume = as_volume(np.random.default_rng(1).integers(0, 255, (8, 20, 24), np.uint8))
    viewer = Viewer(window, renderers["cpu"], clock, volume, None, None)
    last = viewer.run(Shown(("mip",), 8, mode="mip"))
    assert last is not None
    assert last.shape == (60, 80, 3)
    assert window.swaps == 2


@pytest.mark.parametrize("error", ["GL_CONTEXT_LOST", "GL_UNKNOWN_ERROR"])
def test_a_lost_context_is_told_in_words(error):
    with pytest.raises(DisplayError, match="gave up after drawing") as caught:
        check(SimpleNamespace(error=error), "drawing")
    assert caught.value.code == "opengl"
