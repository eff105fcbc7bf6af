"""A whole measurement: from a volume to features, numbers of the whole, and what must be said of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from devices.errors import InputError
from processing import thresholds
from processing.facet_sums import FacetSums, facet_sums
from processing.facets import between_values, rounded
from processing.features import Table, in_voxels, measured
from processing.labels import checked_labels, components
from processing.masks import fill_holes
from processing.stereology import Estimate, is_mask, surface_ways, volume_fraction, whole
from processing.volume_filters import checked

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from processing.grey_volume import GreyVolume
    from processing.neighbours import Rule, Spacing

    Array = NDArray[Any]
    Mask = NDArray[np.bool_]

OUTSIDE_RULE: dict[int, Rule] = {6: 26, 18: 6, 26: 6}  # how what is not inside touches
ROUNDED = 0.5
FEW_VOXELS = 27  # shapes of smaller features are those of voxels
ANISOTROPIC = 5.0  # surfaces of voxels so much deeper than wide are uncertain


@dataclass(frozen=True)
class Question:
    """What is to be measured.

    Attributes
    ----------
    threshold : str
        A method of `processing.thresholds`, or a number: inside is what is greater.
    dark : bool
        Inside is what is not greater.
    rule : 6, 18 or 26
        Which voxels touch.
    fill : bool
        Fill holes first.
    smallest : int
        Features of fewer voxels are dropped.
    labels : bool
        The volume holds numbers of features, 0 for none.
    """

    threshold: str = "otsu"
    dark: bool = False
    rule: Rule = 26
    fill: bool = False
    smallest: int = 1
    labels: bool = False


@dataclass(frozen=True, eq=False)
class Measurement:
    """What was found.

    Attributes
    ----------
    threshold : float or None
        The one that was taken.
    labels : array (z, y, x) uint32
    table : dict of arrays
        A row for each feature.
    numbers : dict of Estimate
        Of the whole, by name with unit.
    notes : list of str
        What must be said.
    """

    threshold: float | None
    labels: Array
    table: Table
    numbers: dict[str, Estimate]
    notes: list[str] = field(default_factory=list)


def measure_volume(
    volume: GreyVolume,
    question: Question,
    *,
    seen: Array | None = None,
    told: Callable[[int], None] | None = None,
) -> Measurement:
    """Measure a volume.

    Parameters
    ----------
    volume : GreyVolume
        Its values are parted by the threshold, or are numbers of features.
    question : Question
    seen : array (z, y, x), optional
        Grey values whose densities are measured, where they are others than those that are parted.
    told : callable, optional
        Told how many of ``2 × planes`` steps are done.

    Raises
    ------
    InputError
        ``mask-empty``: there is no feature; ``threshold``, ``labels-needed``, ``labels-many``, ``volume-nan``,
        ``volume-shape``.
    """
    labels, threshold = _features(volume.values, question)
    mask: Mask = labels > 0
    if not mask.any():
        raise _nothing(volume.values, threshold)
    grey = seen if seen is not None or question.labels else volume.values
    spacing = volume.spacing
    spacing, planes = volume.spacing, len(mask)
    facets = _facets(volume.values, threshold, labels, spacing, question, told)
    fine = None if question.labels or is_mask(volume.values) else facets
    table = measured(labels, grey, spacing, rule=question.rule, facets=fine, told=_later(told, planes))
    numbers, notes = _of_whole(mask, spacing, question, facets, fine)
    numbers |= _of_features(table, mask.size * float(np.prod(spacing)))
    notes = [*_warnings(table, mask, spacing), *notes]
    if volume.spacing_um is None:
        table, numbers = in_voxels(table), in_voxels(numbers)
    return Measurement(threshold, labels, table, numbers, notes)


def _later(told: Callable[[int], None] | None, done: int) -> Callable[[int], None] | None:
    return None if told is None else lambda k: told(done + k)


def _facets(
    values: Array,
    threshold: float | None,
    labels: Array,
    spacing: Spacing,
    question: Question,
    told: Callable[[int], None] | None,
) -> FacetSums | None:
    """Add up triangles: between grey values, or between the rounded steps of a mask; None for a single plane."""
    if min(labels.shape) < 2:
        return None
    if threshold is None or is_mask(values):
        return facet_sums(rounded(labels), ROUNDED, labels > 0, spacing, told)
    grey, level = _surface_of(values, threshold, labels > 0, question)
    return facet_sums(grey, level, labels, spacing, told)


def _features(values: Array, question: Question) -> tuple[Array, float | None]:
    if question.labels:
        return checked_labels(values), None
    grey = checked(values)
    threshold = level_of(grey, question.threshold)
    inside = (grey <= threshold) if question.dark else (grey > threshold)
    if question.fill:
        inside = fill_holes(inside) > 0
    labels, _ = components(inside, rule=question.rule, least=question.smallest)
    return labels, threshold


def level_of(grey: Array, threshold: str) -> float:
    """Return the threshold: a number as it is, or what a method finds; of two values the lower."""
    try:
        return float(threshold)
    except ValueError:
        pass
    if threshold in thresholds.METHODS and is_mask(grey) and grey.min() < grey.max():
        return float(grey.min())
    return thresholds.found(threshold, *thresholds.histogram(grey))


def _nothing(values: Array, threshold: float | None) -> InputError:
    level = "labelled" if threshold is None else f"inside at the threshold {threshold:g}"
    return InputError(
        f"no voxel is {level}: values are {values.min()} … {values.max()}.",
        fix=("choose another threshold: --threshold V", "keep smaller features: --smallest N", "what is dark: --dark"),
        code="mask-empty",
    )


def _of_whole(
    mask: Mask, spacing: Spacing, question: Question, facets: FacetSums | None, fine: FacetSums | None
) -> tuple[dict[str, Estimate], list[str]]:
    total, fraction = whole(mask, spacing, question.rule), volume_fraction(mask)
    density: tuple[float, float | None] | None = None
    if facets:
        density = fine.density_per_um if fine else (float(facets.totals_um2[0] / facets.seen_um3), None)
    ways, notes = surface_ways(mask, spacing, total.surface_um2, density)
    numbers = {
        "volume_um3": Estimate(mask.size * float(np.prod(spacing)), None, "all voxels"),
        "volume_fraction": fraction,
        **{f"surface_per_volume_{name}_per_um": way for name, way in ways.items()},
    }
    best = ways["facets" if fine else "crofton" if facets else "intercepts"].value
    if best:
        numbers["mean_intercept_um"] = Estimate(
            4 * fraction.value / best, None, "4 V_V / S_V: mean length of lines inside"
        )
    return numbers | _topology(mask, total.euler, total.euler_share, spacing, question.rule), notes


def _surface_of(values: Array, threshold: float, mask: Mask, question: Question) -> tuple[Array, float]:
    """Return grey values and the level at which they have the mask's surface."""
    level, bright = between_values(values, threshold), ~mask if question.dark else mask
    if np.array_equal(values > level, bright):
        return values, level
    step = float(np.spacing(np.float32(abs(level) + 1)))
    grey = np.asarray(values, np.float32)
    return np.where(bright, np.maximum(grey, level + step), np.minimum(grey, level - step)), level


def _topology(mask: Mask, euler: int, share: float, spacing: Spacing, rule: Rule) -> dict[str, Estimate]:
    _, parts = components(mask, rule=rule)
    cavities = _cavities(mask, OUTSIDE_RULE[rule])
    volume = mask.size * float(np.prod(spacing))
    return {
        "euler_number": Estimate(euler, None, "parts - loops + cavities, as if nothing were outside"),
        "parts": Estimate(int(parts), None, f"of voxels that touch under rule {rule}"),
        "cavities": Estimate(cavities, None, "enclosed on all sides"),
        "loops": Estimate(int(parts) + cavities - euler, None, "parts + cavities - Euler number"),
        "euler_number_share": Estimate(share, None, "without what the border adds (Odgaard and Gundersen)"),
        "connectivity_density_per_um3": Estimate(
            (1 - share) / volume, None, "(1 - share of the Euler number) / volume"
        ),
    }


def _cavities(mask: Mask, rule: Rule) -> int:
    outside, count = components(~mask, rule=rule)
    sides = [
        np.unique(outside[side]) for side in ((0,), (-1,), np.s_[:, 0], np.s_[:, -1], np.s_[:, :, 0], np.s_[:, :, -1])
    ]
    open_ones = np.unique(np.concatenate(sides))
    return int(count) - int(np.count_nonzero(open_ones))


def _of_features(table: Table, volume: float) -> dict[str, Estimate]:
    count, counted = len(table["feature"]), int(table["counted"].sum())
    how = f"{counted} of {count} features: each where its last plane, row and column are within"
    return {
        "features": Estimate(count, None, "all there are"),
        "features_at_border": Estimate(int(table["at_border"].sum()), None, "they may go on outside"),
        "number_density_per_um3": Estimate(counted / volume, float(np.sqrt(counted)) / volume, how),
    }


def _warnings(table: Table, mask: Mask, spacing: Spacing) -> list[str]:
    notes = []
    if mask.all():
        notes.append("everything is inside: one feature fills the volume, and has no surface in it.")
    small = int((table["voxels"] < FEW_VOXELS).sum())
    if small:
        notes.append(f"{small} features have fewer than {FEW_VOXELS} voxels: do not believe their shapes.")
    cut = int(table["at_border"].sum())
    if cut:
        notes.append(f"{cut} features touch the border and may be larger than measured (at_border).")
    ratio = max(spacing) / min(spacing)
    if ratio > ANISOTROPIC:
        notes.append(f"voxels are {ratio:.3g} times longer one way than another: surfaces and shapes are uncertain.")
    return notes
