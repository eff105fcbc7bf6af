"""The live picture: the processor's is the one that OpenGL draws, and both are the formula."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from display.gl.canvas import Canvas
from display.gl.live_picture import LivePicture
from display.levels import HATCH, OVER

if TYPE_CHECKING:
    import moderngl

TABLE = np.stack([np.linspace(0, 1, 256), np.linspace(1, 0, 256) ** 2, np.full(256, 0.25)], axis=1)[None].astype(
    np.float32
)
SIZE = (61, 47)


@pytest.fixture
def context(renderers) -> moderngl.Context:
    """The context of all tests."""
    return renderers["gl"].context


def picture(context: moderngl.Context, executor: str, pixels: np.ndarray, place, levels) -> np.ndarray:
    panel = LivePicture(Canvas(context, executor))  # type: ignore[arg-type]
    panel.draw(pixels, 1, size=SIZE, place=place, table=TABLE, levels=levels)
    return panel.read().astype(int)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("place", [(0.0, 0.0, 1.0), (-7.313, 5.617, 2.7), (10.021, -4.037, 0.37)])
@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_both_executors_draw_the_formula(context: moderngl.Context, dtype: type, place, gamma: float) -> None:
    top = int(np.iinfo(dtype).max)
    pixels = np.random.default_rng(1).integers(0, top, (80, 90), endpoint=True).astype(dtype)
    levels = (0.1 * top, 0.8 * top, gamma, float(top), False)
    by_processor = picture(context, "cpu", pixels, place, levels)
    by_opengl = picture(context, "gl", pixels, place, levels)
    assert np.abs(by_processor - by_opengl).max() <= 1
    x, y = 20, 12
    value = float(pixels[int((y + 0.5 - place[1]) // place[2]), int((x + 0.5 - place[0]) // place[2])])
    share = np.clip((value - levels[0]) / (levels[1] - levels[0]), 0, 1) ** (1 / gamma)
    wanted = [255 * np.interp(share, np.linspace(0, 1, 256), TABLE[0, :, band]) for band in range(3)]
    assert by_processor[y, x] == pytest.approx(wanted, abs=0.51)


def test_ends_of_the_scale_are_hatched_alike(context: moderngl.Context) -> None:
    pixels = np.tile(np.repeat([0, 128, 255], 20).astype(np.uint8), (47, 1))
    levels = (0.0, 255.0, 1.0, 255.0, True)
    by_processor = picture(context, "cpu", pixels, (0.0, 0.0, 1.0), levels)
    assert np.abs(by_processor - picture(context, "gl", pixels, (0.0, 0.0, 1.0), levels)).max() <= 1
    over = (by_processor[:, 40:60] == np.rint(np.array(OVER) * 255)).all(axis=2)
    assert over.mean() == pytest.approx(0.5, abs=0.02)
    assert (over[:, :-HATCH] == over[:, HATCH:]).all()
