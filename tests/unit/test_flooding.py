"""Floods of 64 voxels at a time: what SciPy's labels say is joined, whatever the shape, also across words."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from processing.flooding import flooded

WIDTHS = st.integers(1, 10) | st.sampled_from([63, 64, 65, 127, 128, 129, 200])


@given(
    shape=st.tuples(st.integers(1, 7), st.integers(1, 7), WIDTHS),
    density=st.floats(0.1, 1.0),
    rule=st.sampled_from([6, 18, 26]),
    number=st.integers(0, 1 << 32),
)
def test_it_is_the_part_that_is_joined_to_the_seed(shape, density, rule, number):
    rng = np.random.default_rng(number)
    inside = rng.random(shape) < density
    seed = tuple(int(rng.integers(side)) for side in shape)
    inside[seed] = True
    labels, _ = ndimage.label(inside, ndimage.generate_binary_structure(3, {6: 1, 18: 2, 26: 3}[rule]))
    np.testing.assert_array_equal(flooded(inside, seed, rule), labels == labels[seed])
