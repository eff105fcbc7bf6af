"""Scenes are what they say: the same for the same seed, and true to themselves."""

import numpy as np

from processing.focus import focus_stack
from processing.psf import Optics, modelled
from sim.scenes.beads import beads
from sim.scenes.focus import scene


def test_a_focal_scene_is_found_again_from_its_planes():
    first, again = (scene(31, side=96, planes=16) for _ in range(2))
    np.testing.assert_array_equal(first.planes, again.planes)
    assert (scene(32, side=96, planes=16).planes != first.planes).any()
    result = focus_stack(list(first.planes), register=False)
    error = result.range - first.depth
    assert np.median(np.abs(error)) < 0.25
    assert np.sqrt(np.mean((result.extended_focus - first.sharp) ** 2)) < 5


def test_each_column_is_sharpest_in_the_plane_of_its_depth():
    """The truth by brute force: of all planes, the one at the true depth is nearest to the picture in focus."""
    made = scene(33, side=96, planes=16)
    away = np.abs(made.planes.astype(float) - made.sharp).mean((1, 2))
    at_truth = np.take_along_axis(made.planes, np.rint(made.depth).astype(int)[None], 0)[0]
    assert np.abs(at_truth - made.sharp).mean() < 0.7 * away.min()


def test_needles_stand_out_bright_on_dark():
    plain, spiked = scene(34, side=96, planes=16), scene(34, side=96, planes=16, spikes=8)
    nearer = spiked.depth < plain.depth - 1
    assert 8 <= nearer.sum() <= 8 * 4
    assert spiked.sharp[nearer].mean() > 3 * spiked.sharp[spiked.sharp < plain.sharp - 20].mean()


def test_beads_lie_where_they_are_said_to():
    psf = modelled(Optics(1.0, 0.525, 1.33), (0.3, 0.12, 0.12), (7, 13, 13))
    made = beads(35, psf, (20, 64, 64), count=3)
    assert len(made.places) == 3
    for place in made.places:
        low = np.round(place).astype(int)
        box = tuple(slice(p - 2, p + 3) for p in low)
        weight = made.truth[box] / made.truth[box].sum()
        middle = [(weight * grid).sum() for grid in np.mgrid[box]]
        np.testing.assert_allclose(middle, place, atol=1e-4)
        assert made.seen[tuple(low)] > made.background + 500
