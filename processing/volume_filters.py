"""Operators that look at the neighbours of each voxel: rank, median, variance, entropy, Sobel, Frei-Chen, template.

A volume is (z, y, x) uint8, uint16 or float32. ``spacing_um`` is the distance of voxels along (z, y, x); where planes
are more than three times farther apart than pixels, the neighbours are those of the plane alone, and `note_on` says so.
Beyond the border the outermost voxels are repeated. All loops are those of `processing.volume_kernels`; the library
functions they replace are 15 to 40 times slower and stand with the tests, where they must give the same.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np

from devices.errors import InputError
from processing import volume_kernels as kernels
from processing.neighbours import CUBIC, Neighbours, Rule, Spacing, ball, neighbours
from processing.networks import selecting_pairs
from processing.operators import Layer, like, operator

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    Array = NDArray[Any]

TYPES = ("uint8", "uint16", "float32")
SOBEL_SUM = 32.0  # of the weights of one side of the 3x3x3 operator, times the two voxels between its sides
ENTROPY_LEVELS = 64
BOX = 26  # the rule whose neighbours fill a cube


def checked(volume: Array, types: tuple[str, ...] = TYPES) -> Array:
    """Return the volume as one of the types that kernels are compiled for, (z, y, x), contiguous.

    True and False become 1 and 0 of 8 bit, other number types float32.

    Raises
    ------
    InputError
        ``volume-shape``: it is not of three axes, or empty, or complex; ``volume-nan``: a value is no number.
    """
    if volume.ndim != 3 or 0 in volume.shape:
        raise InputError(
            f"a volume has three axes, (z, y, x); this has {volume.shape}.",
            fix="choose one band: --channel N",
            code="volume-shape",
        )
    if volume.dtype.kind not in "biuf":
        raise InputError(
            f"grey values are numbers; these are {volume.dtype}.", fix="save what is to be seen.", code="volume-shape"
        )
    counted = volume.view(np.uint8) if volume.dtype == np.bool_ else volume
    with np.errstate(over="ignore"):  # what is too large becomes infinite, and is told below
        taken = counted if counted.dtype.name in types else counted.astype(np.float32)
    if taken.dtype.kind == "f" and not np.isfinite(taken).all():
        wrong = np.count_nonzero(~np.isfinite(taken))
        raise InputError(
            f"{wrong} voxels of the volume are not numbers, or too large for 32 bit.",
            fix="fill or mask them first; filters would spread them.",
            code="volume-nan",
        )
    return np.ascontiguousarray(taken)


def around(rule: int, radius: float, spacing_um: Spacing | None) -> Neighbours:
    """Return the neighbours of a rule, or of a ball where ``radius`` is above zero."""
    spacing = spacing_um or CUBIC
    return ball(radius, spacing) if radius > 0 else neighbours(cast("Rule", rule), spacing)


def note_on(spacing_um: Spacing | None) -> str:
    """Return what a user must be told about neighbours at this spacing; empty for nothing."""
    return neighbours(26, spacing_um or CUBIC).note


def reach(params: Mapping[str, Any]) -> tuple[int, int, int]:
    """How far a filter looks, in voxels, whatever the spacing."""
    return (max(1, int(params.get("radius", 0))),) * 3


@operator("filter.rank", gives=[like("volume")], halo=reach)
def rank(
    volume: Array, spacing_um: Spacing | None = None, *, percent: float = 50.0, rule: int = 26, radius: float = 0.0
) -> Array:
    """Value of a rank among the neighbours: 0 % the smallest, 50 % the median, 100 % the largest.

    Parameters
    ----------
    volume : array (z, y, x)
        Grey values.
    spacing_um : tuple of float, optional
        Distance of voxels along (z, y, x).
    percent : float
        Which rank; the nearest that there is, of two the lower.
    rule : 6, 18 or 26
        Which neighbours count beside the voxel itself.
    radius : float
        A ball of that many pixels instead of a rule.

    Returns
    -------
    array (z, y, x)
        Of the volume's type.

    Raises
    ------
    InputError
        ``operator-params``: a rank beyond 0 … 100 %; ``volume-shape``, ``volume-nan``, ``neighbours``.
    """
    if not 0 <= percent <= 100:
        raise InputError(f"a rank of {percent:g} % is not possible.", fix="0 … 100", code="operator-params")
    grey, near = checked(volume), around(rule, radius, spacing_um)
    chosen = int(np.ceil(percent / 100 * (len(near.offsets) - 1) - 0.5 - 1e-9))
    out = np.empty_like(grey)
    kernels.rank_rows(grey, near.offsets, selecting_pairs(len(near.offsets), chosen), chosen, out)
    return out


@operator("filter.median", gives=[like("volume")], halo=reach)
def median(volume: Array, spacing_um: Spacing | None = None, *, rule: int = 26, radius: float = 0.0) -> Array:
    """Median of the neighbours: single wrong voxels go, steps stay.

    Parameters
    ----------
    volume : array (z, y, x)
        Grey values.
    spacing_um : tuple of float, optional
        Distance of voxels along (z, y, x).
    rule, radius : int, float
        Which neighbours, as of `rank`.

    Returns
    -------
    array (z, y, x)
        Of the volume's type; errors as of `rank`.
    """
    return rank(volume, spacing_um, percent=50.0, rule=rule, radius=radius)


@operator("filter.variance", gives=[Layer("volume", "volume", "float32")], halo=reach)
def variance(volume: Array, spacing_um: Spacing | None = None, *, rule: int = 26, radius: float = 0.0) -> Array:
    """Variance of the neighbours in grey levels²: dense in texture and at edges, empty where it is even.

    Parameters
    ----------
    volume : array (z, y, x)
        Grey values.
    spacing_um : tuple of float, optional
        Distance of voxels along (z, y, x).
    rule, radius : int, float
        Which neighbours, as of `rank`.

    Returns
    -------
    array (z, y, x) float32
        Mean square less square mean, from sums that are exact for 8 and 16 bits.
    """
    grey, near = checked(volume), around(rule, radius, spacing_um)
    exact = np.int32 if grey.dtype == np.uint8 and len(near.offsets) < 181 else np.float64  # 181²·255² is 2³¹
    out = np.empty(grey.shape, np.float32)
    zero = np.zeros(1, exact)
    if radius <= 0 and rule == BOX:
        kernels.box_moment_rows(grey, zero, out)
    else:
        kernels.moment_rows(grey, near.rows, zero, out)
    return np.maximum(out, 0, out=out)


@operator("filter.entropy", gives=[Layer("volume", "volume", "float32")],
          halo=lambda params: None if params["low"] is None or params["high"] is None else reach(params))  # fmt: skip
def entropy(
    volume: Array,
    spacing_um: Spacing | None = None,
    *,
    rule: int = 26,
    radius: float = 0.0,
    low: float | None = None,
    high: float | None = None,
) -> Array:
    """Entropy of the neighbours in bits: how many grey levels share them, and how evenly.

    The range of values is divided into 64 levels first, so that noise of less than a level counts for nothing.

    Parameters
    ----------
    volume : array (z, y, x)
        Grey values.
    spacing_um : tuple of float, optional
        Distance of voxels along (z, y, x).
    rule, radius : int, float
        Which neighbours, as of `rank`.
    low, high : float, optional
        Ends of the range; the volume's smallest and largest value where left out.

    Returns
    -------
    array (z, y, x) float32
        −Σ p log2 p, at most the logarithm of the number of neighbours.
    """
    grey, near = checked(volume), around(rule, radius, spacing_um)
    bottom, top = (float(grey.min()) if low is None else low), (float(grey.max()) if high is None else high)
    scale = (ENTROPY_LEVELS - 1e-3) / (top - bottom) if top > bottom else 0.0
    levels = (np.clip(grey - np.float32(bottom), 0, top - bottom) * np.float32(scale)).astype(np.uint8)
    counts = np.arange(1, len(near.offsets) + 1, dtype=np.float64)
    out = np.empty(grey.shape, np.float32)
    kernels.entropy_rows(levels, near.rows, np.concatenate([[0.0], counts * np.log2(counts)]), out)
    return np.maximum(out, 0, out=out)


@operator("filter.sobel", gives=[Layer("volume", "volume", "float32")], halo=reach)
def sobel(volume: Array, spacing_um: Spacing | None = None) -> Array:
    """Length of the gradient, in grey levels per µm (per voxel without a spacing).

    Parameters
    ----------
    volume : array (z, y, x)
        Grey values.
    spacing_um : tuple of float, optional
        Distance of voxels along (z, y, x).

    Returns
    -------
    array (z, y, x) float32
        From differences over 3x3x3 voxels with the weights 1 2 1 across (Sobel 1968, in three dimensions), each axis
        divided by its spacing; where planes are too far apart, from the two axes of the plane.
    """
    grey = checked(volume)
    out = np.empty(grey.shape, np.float32)
    kernels.sobel_magnitude_rows(grey, per_um(spacing_um), out)
    return out


@operator("filter.gradient", gives=[Layer("volume", "volume", "float32"), Layer("azimuth", "volume", "float32"),
                                    Layer("elevation", "volume", "float32")], halo=reach)  # fmt: skip
def gradient(volume: Array, spacing_um: Spacing | None = None) -> tuple[Array, Array, Array]:
    """Length of the gradient and its direction as two angles.

    Parameters
    ----------
    volume : array (z, y, x)
        Grey values.
    spacing_um : tuple of float, optional
        Distance of voxels along (z, y, x).

    Returns
    -------
    volume : array (z, y, x) float32
        As of `sobel`.
    azimuth, elevation : array (z, y, x) float32
        Degrees: in the plane from x towards y, −180 … 180, and out of the plane towards higher z, −90 … 90.
    """
    grey = checked(volume)
    parts = np.empty((3, *grey.shape), np.float32)
    kernels.sobel_rows(grey, per_um(spacing_um), parts)
    dz, dy, dx = parts
    flat = np.hypot(dx, dy)
    return np.hypot(flat, dz), np.degrees(np.arctan2(dy, dx)), np.degrees(np.arctan2(dz, flat))


def per_um(spacing_um: Spacing | None) -> NDArray[np.float32]:
    """Return by what the sums of the Sobel operator along each axis are multiplied; 0 along z for distant planes."""
    spacing = spacing_um or CUBIC
    scale = np.array([1 / (SOBEL_SUM * s) for s in spacing], np.float32)
    if neighbours(26, spacing).by_plane:
        scale[0] = 0.0
    return scale


@operator("filter.frei_chen", gives=[Layer("edges", "volume", "float32"), Layer("lines", "volume", "float32")],
          halo=reach)  # fmt: skip
def frei_chen(volume: Array, spacing_um: Spacing | None = None) -> tuple[Array, Array]:
    """How much of what differs within 3x3x3 voxels is an edge, and how much a line or a blob, whatever the contrast.

    The 27 voxels are projected on the orthonormal basis made of the products of (1, 1, 1)/√3, (−1, 0, 1)/√2 and
    (1, −2, 1)/√6 along the axes (Frei and Chen 1977, in three dimensions). Its 13 members that are odd under
    reflection at the middle are edges, the 13 even ones besides the mean are lines; together they are the odd and the
    even part of the voxels, which is how they are computed.

    Parameters
    ----------
    volume : array (z, y, x)
        Grey values.
    spacing_um : tuple of float, optional
        Distance of voxels along (z, y, x).

    Returns
    -------
    edges, lines : array (z, y, x) float32
        Cosine of the angle to either subspace, 0 … 1; edges² + lines² = 1, and both 0 where nothing differs.

    Raises
    ------
    InputError
        ``spacing``: planes are too far apart for a basis in three dimensions.
    """
    near = neighbours(26, spacing_um or CUBIC)
    if near.by_plane:
        raise InputError(
            "planes are more than 3 times farther apart than pixels; Frei-Chen looks at cubes of voxels.",
            fix="make the voxels cubic first: stereotome process resample",
            code="spacing",
        )
    grey = checked(volume)
    half = near.offsets[[tuple(step) > (0, 0, 0) for step in near.offsets.tolist()]]
    edges, lines = np.empty(grey.shape, np.float32), np.empty(grey.shape, np.float32)
    kernels.frei_chen_rows(grey, half, edges, lines)
    return edges, lines


@operator("filter.template", gives=[Layer("volume", "volume", "float32")])
def template(volume: Array, pattern: Array) -> Array:
    """Normalised correlation with a pattern, −1 … 1: 1 where it is found, however bright.

    Parameters
    ----------
    volume : array (z, y, x)
        Grey values.
    pattern : array (z, y, x)
        Smaller than the volume; must not be even.

    Returns
    -------
    array (z, y, x) float32
        At the middle of the pattern (scikit-image's ``match_template``: fast normalised correlation, Lewis 1995).

    Raises
    ------
    InputError
        ``operator-inputs``: the pattern is even, or larger than the volume.
    """
    from skimage.feature import match_template  # noqa: PLC0415  takes half a second

    grey, sample = checked(volume), checked(pattern)
    if sample.min() == sample.max() or any(p > v for p, v in zip(sample.shape, grey.shape, strict=True)):
        raise InputError(
            "the pattern is even, or larger than the volume.",
            fix="cut out a feature with some background around it.",
            code="operator-inputs",
        )
    found = match_template(grey, sample, pad_input=True, mode="edge")  # type: ignore[no-untyped-call]
    return np.asarray(found, np.float32)
