"""Which voxels count as neighbours, named the same everywhere, and what is done when voxels are no cubes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from devices.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

Rule = Literal[6, 18, 26]
RULES: tuple[Rule, ...] = (6, 18, 26)
Spacing = tuple[float, float, float]
CUBIC: Spacing = (1.0, 1.0, 1.0)
ANISOTROPY_MAX = 3.0  # beyond this a neighbour in z is no neighbour: filters work plane by plane


@dataclass(frozen=True)
class Neighbours:
    """The voxels around a voxel.

    Attributes
    ----------
    offsets : array (m, 3) int64
        Steps along (z, y, x), the voxel itself first.
    distances : array (m,) float64
        How far away each is, in units of the pixel size in the plane.
    by_plane : bool
        True when only voxels of the same plane count, because planes are too far apart.
    """

    offsets: NDArray[np.int64]
    distances: NDArray[np.float64]
    by_plane: bool

    @property
    def rows(self) -> NDArray[np.int64]:
        """The same as runs along x, (n, 3): steps along z and y, and how far the run reaches to both sides.

        Longest runs first. Every rule and every ball is made of such runs, which is what makes filters of whole
        rows fast.
        """
        runs: dict[tuple[int, int], int] = {}
        for z, y, x in self.offsets.tolist():
            runs[z, y] = max(runs.get((z, y), 0), x)
        return np.array(sorted(((z, y, x) for (z, y), x in runs.items()), key=lambda run: -run[2]), np.int64)

    @property
    def note(self) -> str:
        """What the user is told about it; empty for nothing."""
        if not self.by_plane:
            return ""
        return f"planes are more than {ANISOTROPY_MAX:g} times farther apart than pixels: filtered plane by plane"


def neighbours(rule: Rule = 26, spacing_um: Spacing = CUBIC) -> Neighbours:
    """Return a voxel and its 6, 18 or 26 neighbours: those that share a face, an edge too, a corner too.

    Parameters
    ----------
    rule : 6, 18 or 26
        Which ones.
    spacing_um : tuple of float
        Distance of voxels along (z, y, x). Where planes are more than `ANISOTROPY_MAX` times farther apart than
        pixels, only the neighbours in the plane are left: 4 for rule 6, 8 for the others.

    Raises
    ------
    InputError
        ``neighbours``: there is no such rule; ``spacing``: a spacing is not above zero.
    """
    if rule not in RULES:
        raise InputError(f"there is no neighbour rule {rule}.", fix="take 6, 18 or 26.", code="neighbours")
    reach = {6: 1, 18: 2, 26: 3}[rule]
    return _within([step for step in product((-1, 0, 1), repeat=3) if np.abs(step).sum() <= reach], spacing_um)


def ball(radius: float, spacing_um: Spacing = CUBIC) -> Neighbours:
    """Return all voxels whose centres lie within ``radius`` pixels, measured with the true spacing.

    A ball needs no special case for distant planes: none of their voxels lies within it.
    """
    ratios = _ratios(spacing_um)
    span = [np.arange(-int(radius / ratio), int(radius / ratio) + 1) for ratio in ratios]
    steps = np.stack(np.meshgrid(*span, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = np.sqrt(((steps * ratios) ** 2).sum(axis=1)) <= radius + 1e-9
    return _ordered(steps[inside], ratios, by_plane=False)


def _within(steps: list[tuple[int, ...]], spacing_um: Spacing) -> Neighbours:
    ratios = _ratios(spacing_um)
    by_plane = bool(ratios[0] > ANISOTROPY_MAX)
    kept = [step for step in steps if not (by_plane and step[0])]
    return _ordered(np.array(kept), ratios, by_plane=by_plane)


def _ordered(steps: NDArray[Any], ratios: NDArray[np.float64], *, by_plane: bool) -> Neighbours:
    distances = np.sqrt(((steps * ratios) ** 2).sum(axis=1))
    order = np.argsort(distances, kind="stable")
    return Neighbours(steps[order].astype(np.int64), distances[order], by_plane)


def checked_spacing(spacing_um: Spacing) -> Spacing:
    """Return the spacing; raise `InputError` ``spacing`` where one is not above zero."""
    spacing = np.asarray(spacing_um, np.float64)
    if spacing.shape != (3,) or not np.all(np.isfinite(spacing)) or np.any(spacing <= 0):
        raise InputError(
            f"a spacing of {tuple(float(s) for s in spacing)} µm is not possible.",
            fix="give (z, y, x), each above zero.",
            code="spacing",
        )
    return float(spacing[0]), float(spacing[1]), float(spacing[2])


def _ratios(spacing_um: Spacing) -> NDArray[np.float64]:
    """Return the spacing in units of the pixel size in the plane."""
    spacing = np.asarray(checked_spacing(spacing_um))
    ratios: NDArray[np.float64] = spacing / np.sqrt(spacing[1] * spacing[2])
    return ratios
