"""A whole measurement: from a volume to features, numbers of the whole, and what must be said of them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from devices.errors import InputError
from processing.facet_sums import FacetSums, facet_sums
from processing.facets import between_values, rounded
from processing.features import FEW_VOXELS, Table, checked_count, in_voxels, measured
from processing.labels import checked_labels, components
from processing.masks import fill_holes
from processing.measure_network import Network, network
from processing.planes import Lazy, changed, side_of, surrounded
from processing.stereology import Estimate, surface_ways, volume_fraction
from processing.thresholds import Values, values_of
from processing.volume_filters import checked
from processing.whole import Whole, whole

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from processing.grey_volume import GreyVolume
    from processing.neighbours import Rule, Spacing
    from processing.planes import Planes

    Array = NDArray[Any]
    Mask = NDArray[np.bool_]

ROUNDED = 0.5
ROUNDED_REACH = 4  # planes that rounding looks up and down
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
    known : Values or None
        Values of the volume; None of labels.
    threshold : float or None
        The one that was taken.
    labels : volume (z, y, x)
    table : dict of arrays
        A row for each feature.
    numbers : dict of Estimate
        Of the whole, by name with unit.
    fullest : tuple of int
        The plane of each axis in which most is inside.
    notes : list of str
        What must be said.
    network : Network or None
        The skeleton, where it was asked for.
    """

    known: Values | None
    threshold: float | None
    labels: Planes
    table: Table
    numbers: dict[str, Estimate]
    fullest: tuple[int, ...]
    notes: list[str] = field(default_factory=list)
    network: Network | None = None


def measure_volume(
    volume: GreyVolume,
    question: Question,
    *,
    seen: Planes | None = None,
    told: Callable[[int], None] | None = None,
) -> Measurement:
    """Measure a volume in memory.

    Parameters
    ----------
    volume : GreyVolume
        Its values are parted by the threshold, or are numbers of features.
    question : Question
    seen : array (z, y, x), optional
        Grey values whose densities are measured, where they are others than those that are parted.
    told : callable, optional
        Told how many of ``3 × planes`` steps are done.

    Raises
    ------
    InputError
        ``mask-empty``: there is no feature; ``threshold``, ``labels-needed``, ``labels-many``, ``volume-nan``,
        ``volume-shape``.
    """
    return measure_features(told_apart(volume, question), question, seen=seen, told=told)


def told_apart(volume: GreyVolume, question: Question) -> Features:
    """Tell the features of a volume in memory apart."""
    if question.labels:
        return Features(volume, None, None, changed(volume.values, checked_labels))
    known = values_of(volume.values)
    level = known.level(question.threshold)
    inside = inside_of(volume.values, level, dark=question.dark)
    return Features(volume, known, level, features(inside[:], question))


def features(inside: Mask, question: Question) -> Array:
    """Return the features of a mask as labels."""
    filled = fill_holes(inside) > 0 if question.fill else inside
    labels: Array = components(filled, rule=question.rule, least=question.smallest)[0]
    return labels


def inside_of(values: Planes, threshold: float, *, dark: bool) -> Planes:
    """Return the mask of what is inside."""
    if dark:
        return changed(values, lambda grey: checked(grey) <= threshold, bool)
    return changed(values, lambda grey: checked(grey) > threshold, bool)


@dataclass(frozen=True, eq=False)
class Features:
    """Features that have been told apart, in memory or to be read slab by slab.

    Attributes
    ----------
    volume : GreyVolume
        What they were found in.
    known : Values or None
        Its values; None where they are labels.
    threshold : float or None
        The one that was taken.
    labels : volume (z, y, x)
    """

    volume: GreyVolume
    known: Values | None
    threshold: float | None
    labels: Planes

    @property
    def grey(self) -> bool:
        """True where there are more than two values, so that surfaces can lie between voxels."""
        return self.known is not None and not self.known.two


def measure_features(
    given: Features,
    question: Question,
    *,
    seen: Planes | None = None,
    told: Callable[[int], None] | None = None,
) -> Measurement:
    """Measure features, going through the planes a few times and holding a slab of them at most.

    Raises
    ------
    InputError
        ``mask-empty``, ``labels-many``.
    """
    volume, labels, spacing = given.volume, given.labels, given.volume.spacing
    checked_count(labels)
    found = whole(labels, question.rule, told)
    if not found.inside:
        raise _nothing(given)
    bright = seen if seen is not None or question.labels else volume.values
    planes = len(labels)
    facets = _facets(given, question, _later(told, planes))
    fine = facets if given.grey else None
    table = measured(labels, bright, spacing, rule=question.rule, facets=fine, told=_later(told, 2 * planes))
    numbers, notes = _of_whole(found, spacing, facets, fine)
    numbers |= _of_features(table, found.size * float(np.prod(spacing)))
    notes = [*_warnings(table, found, spacing), *notes]
    if volume.spacing_um is None:
        table, numbers = in_voxels(table), in_voxels(numbers)
    return Measurement(given.known, given.threshold, labels, table, numbers, found.fullest, notes)


def with_network(found: Measurement, volume: GreyVolume) -> Measurement:
    """Add the skeleton of the features, which is found in memory.

    Raises
    ------
    InputError
        ``mask-full``: the features fill the volume.
    """
    cavities = int(found.numbers["cavities"].value)
    net = network(found.labels[:], found.table["feature"], volume.spacing, cavities=cavities)
    numbers, columns = net.numbers, net.columns
    if volume.spacing_um is None:
        numbers, columns = in_voxels(numbers), in_voxels(columns)
    notes = [*found.notes, *net.notes]
    return replace(found, table=found.table | columns, numbers=found.numbers | numbers, notes=notes, network=net)


def _later(told: Callable[[int], None] | None, done: int) -> Callable[[int], None] | None:
    return None if told is None else lambda k: told(done + k)


def _facets(given: Features, question: Question, told: Callable[[int], None] | None) -> FacetSums | None:
    """Add up triangles: between grey values, or between the rounded steps of a mask; None for a single plane."""
    labels, values, spacing = given.labels, given.volume.values, given.volume.spacing
    if min(labels.shape) < 2:
        return None
    if given.threshold is None or not given.grey:
        stairs = surrounded(labels, rounded, ROUNDED_REACH, np.float32)
        return facet_sums(stairs, ROUNDED, changed(labels, lambda slab: slab > 0, np.uint8), spacing, told)
    level = between_values(values, given.threshold)
    return facet_sums(_surface_of(values, level, labels, dark=question.dark), level, labels, spacing, told)


def _surface_of(values: Planes, level: float, labels: Planes, *, dark: bool) -> Planes:
    """Return grey values that have the surface of the features at the level: small parts and holes are left out."""
    step = float(np.spacing(np.float32(abs(level) + 1)))

    def read(z: slice) -> Array:
        grey, bright = np.asarray(values[z], np.float32), (labels[z] > 0) ^ dark
        return np.where(bright, np.maximum(grey, level + step), np.minimum(grey, level - step))

    return Lazy(values.shape, np.dtype(np.float32), read, side_of(values))


def _nothing(given: Features) -> InputError:
    known = given.known
    if known is None:
        what = "no voxel is labelled: all are 0."
    else:
        what = f"no voxel is inside at the threshold {given.threshold:g}: values are {known.low:g} … {known.high:g}."
    return InputError(
        what,
        fix=("choose another threshold: --threshold V", "keep smaller features: --smallest N", "what is dark: --dark"),
        code="mask-empty",
    )


def _of_whole(
    found: Whole, spacing: Spacing, facets: FacetSums | None, fine: FacetSums | None
) -> tuple[dict[str, Estimate], list[str]]:
    fraction = volume_fraction(found)
    density: tuple[float, float | None] | None = None
    if facets:
        density = fine.density_per_um if fine else (float(facets.totals_um2[0] / facets.seen_um3), None)
    ways, notes = surface_ways(found, spacing, density)
    numbers = {
        "volume_um3": Estimate(found.size * float(np.prod(spacing)), None, "all voxels"),
        "volume_fraction": fraction,
        **{f"surface_per_volume_{name}_per_um": way for name, way in ways.items()},
    }
    best = ways["facets" if fine else "crofton" if facets else "intercepts"].value
    if best:
        numbers["mean_intercept_um"] = Estimate(
            4 * fraction.value / best, None, "4 V_V / S_V: mean length of lines inside"
        )
    return numbers | _topology(found, spacing), notes


def _topology(found: Whole, spacing: Spacing) -> dict[str, Estimate]:
    parts, cavities, euler, share = found.parts, found.cavities, found.euler, found.euler_share
    numbers = {
        "euler_number": Estimate(euler, None, "parts - loops + cavities, as if nothing were outside"),
        "parts": Estimate(parts, None, f"of voxels that touch under rule {found.rule}"),
        "cavities": Estimate(cavities, None, "enclosed on all sides"),
        "loops": Estimate(parts + cavities - euler, None, "parts + cavities - Euler number"),
    }
    if min(found.shape) < 2:  # a plane shows nothing of how things hang together
        return numbers
    volume = found.size * float(np.prod(spacing))
    return numbers | {
        "euler_number_share": Estimate(share, None, "without what the border adds (Odgaard and Gundersen)"),
        "connectivity_density_per_um3": Estimate(
            (1 - share) / volume, None, "(1 - share of the Euler number) / volume"
        ),
    }


def _of_features(table: Table, volume: float) -> dict[str, Estimate]:
    count, counted = len(table["feature"]), int(table["counted"].sum())
    how = f"{counted} of {count} features: each where its last plane, row and column are within"
    return {
        "features": Estimate(count, None, "all there are"),
        "features_at_border": Estimate(int(table["at_border"].sum()), None, "they may go on outside"),
        "number_density_per_um3": Estimate(counted / volume, float(np.sqrt(counted)) / volume, how),
    }


def _warnings(table: Table, found: Whole, spacing: Spacing) -> list[str]:
    notes = []
    if found.inside == found.size:
        notes.append("everything is inside: one feature fills the volume, and has no surface in it.")
    small = int((table["voxels"] < FEW_VOXELS).sum())
    if small:
        notes.append(f"{small} of the features have fewer than {FEW_VOXELS} voxels: they are given no shape.")
    cut = int(table["at_border"].sum())
    if cut:
        notes.append(f"{cut} of the features touch the border and may be larger than measured (at_border).")
    ratio = max(spacing) / min(spacing)
    if ratio > ANISOTROPIC:
        notes.append(f"voxels are {ratio:.3g} times longer one way than another: surfaces and shapes are uncertain.")
    return notes
