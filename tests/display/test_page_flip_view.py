"""`stereotome view` before shutter glasses: both views reach the process that flips them, each eye its own."""

from dataclasses import replace

import numpy as np

from display.scene import Layer, Scene, View, VolumeLook
from display.stereo import Stereo
from display.view import Viewer


class Flip:
    size = (200, 120)
    running = True
    pair = None

    def show(self, left, right):
        self.pair = (left, right)


def column(picture):
    return (picture[..., 0].astype(float).sum(axis=0) * np.arange(picture.shape[1])).sum() / picture[..., 0].sum()


def test_both_views_are_handed_on_whatever_stereo_the_window_has(renderers):
    from display.load import as_volume

    values = np.zeros((30, 40, 64), np.uint8)
    values[2, 18:22, 30:34] = 255  # far in front of the middle
    scene = Scene(
        (Layer(as_volume(values), "mip", VolumeLook()),), View(pixel_um=1.0), Stereo("rows", vergence_deg=8.0)
    )
    flip = Flip()
    viewer = Viewer(None, renderers["cpu"], None, None, None, None, flip)
    # words and bars are the same for both eyes: what differs is the data
    shown = viewer._flipped(scene, flip)
    left, right = flip.pair
    assert left.shape == right.shape == (120, 200, 3)
    assert np.array_equal(shown, left)
    apart = column(left[50:70, 80:120]) - column(right[50:70, 80:120])
    assert 0.5 < apart < 3  # what is in front lies farther right for the left eye
    viewer._flipped(replace(scene, stereo=replace(scene.stereo, swap=True)), flip)
    assert np.array_equal(flip.pair[0], right)
