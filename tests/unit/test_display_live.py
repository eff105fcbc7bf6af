"""The pictures that go with a running stack: both views and the anaglyph."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from display.live import write_stereo
from display.shifted import comfortable_pixel, stereo_pair

if TYPE_CHECKING:
    from pathlib import Path

IMAGE = np.random.default_rng(1).integers(0, 256, (40, 300), np.uint8)
RANGE_UM = np.tile(np.linspace(0, 30, 300, dtype=np.float32), (40, 1))


def shown(path: Path) -> np.ndarray:
    return np.asarray(cv2.imread(str(path)))[..., ::-1]


def test_the_pictures_show_the_views(tmp_path: Path) -> None:
    pixel_um = comfortable_pixel(RANGE_UM)
    assert write_stereo(IMAGE, RANGE_UM, tmp_path, pixel_um=pixel_um, angle_deg=8.0) == ()
    pair = stereo_pair(IMAGE, RANGE_UM, pixel_um=pixel_um, angle_deg=8.0)
    assert np.array_equal(shown(tmp_path / "stereo_left.png")[..., 0], pair.left)
    assert np.array_equal(shown(tmp_path / "stereo_right.png")[..., 0], pair.right)
    anaglyph = shown(tmp_path / "anaglyph.png")[:40]
    assert np.array_equal(anaglyph[..., 0], pair.left)
    assert np.array_equal(anaglyph[..., 1], pair.right)


def test_what_is_hard_to_look_at_is_told(tmp_path: Path) -> None:
    assert "tires the eyes" in write_stereo(IMAGE, RANGE_UM, tmp_path, pixel_um=0.02, angle_deg=8.0)[0]
