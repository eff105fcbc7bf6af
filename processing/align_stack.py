"""A stack of sections aligned as a whole: pairs on arrival, then one robust solution for all sections together.

Neighbours are matched, and sections two apart as a check on them; where a section cannot be matched, pairs reach
further and bridge it. The maps of all sections follow from all pairs by least squares, repeated with weights that
take the say from pairs the others contradict; marks whose places are known enter as absolute rows.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from devices.errors import InputError
from processing.align_methods import matcher
from processing.align_models import Model, deformation, distance_px, nearest_in_pixels
from processing.align_pair import SMALLEST_SIDE, View, view
from processing.align_solve import Row, solve
from processing.align_start import match

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from processing.align_methods import Method
    from processing.align_models import Deformation
    from processing.align_pair import Match

    Array = NDArray[Any]
    Pairs = Mapping[tuple[int, int], Match]

PAIRED: dict[Model, Model] = {
    "uniaxial": "affine"
}  # two sections compressed across each other differ by more than that
REACH = 5  # sections a pair may bridge
CHECK = 2  # sections two apart are always matched as well
LEAST_TEXTURE = 0.05  # share of a section that must show structure
TWIN = 0.998  # correlation no two different sections reach
BETTER_WITHOUT = 0.03  # neighbours of a damaged section agree better with each other than with it, by this
MORE_ALIKE = 0.06  # and so large a share of it fits neither of them
BRIDGED = 0.02  # weight of a damaged section's pairs: those across it place its neighbours
PROBES = 6
DEFORMED_PX = 0.3  # at the border, from which sections are not rigid


@dataclass(frozen=True)
class Section:
    """Where one section lies.

    Attributes
    ----------
    index : int
        Place in the stack.
    matrix : array (3, 3)
        From output pixel (x, y) to pixel (x, y) of the section as it was taken.
    error_px : float
        Expected mean error against the reference section, from the disagreement of loops of pairs.
    deformation : Deformation
        Rotation, compression and its direction against the reference section.
    flags : tuple of str
        ``blank``, ``unmatched``, ``damaged``, ``duplicate``, ``unconnected``, ``gap``: see `FLAGS`.
    """

    index: int
    matrix: Array
    error_px: float
    deformation: Deformation
    flags: tuple[str, ...]


FLAGS = {
    "blank": "shows no structure; placed between its neighbours",
    "unmatched": "could not be matched to any neighbour; placed between them",
    "damaged": "its neighbours fit each other better than it: fold, debris, blur or a foreign picture",
    "duplicate": "the same picture as the section before",
    "unconnected": "nothing connects it to the reference section",
    "gap": "sections are missing before it",
    "interpolated": "is drawn from the sections beside it, as was asked for: to be looked at, not to be measured",
}


@dataclass(frozen=True)
class Alignment:
    """All sections in the frame of the reference section.

    Attributes
    ----------
    sections : tuple of Section
        In order.
    reference : int
        The section that stays where it is.
    model : Model
        Maps allowed.
    pairs : dict
        Every match that was tried, by (first, second).
    loop_px : float
        Typical disagreement of a pair of sections two apart with the two pairs between them.
    """

    sections: tuple[Section, ...]
    reference: int
    model: Model
    pairs: dict[tuple[int, int], Match]
    loop_px: float
    shape: tuple[int, ...]

    def compression_errors(self, section: Section) -> tuple[float, float]:
        """Return the errors of a section's compression and of its direction in degrees.

        An error of so many pixels, mean over the section, is taken as a length at its rim; that of the direction is
        the same across, as far as the compression stands out from it.
        """
        error = section.error_px / (max(self.shape[:2]) / 4)
        direction = np.degrees(error / max(2 * section.deformation.compression, 1e-9))
        return error, min(float(direction), 90.0)

    def with_matrices(self, matrices: Sequence[Array]) -> Alignment:
        """Return the alignment with other maps for its sections."""
        moved = [replace(s, matrix=m, deformation=deformation(m)) for s, m in zip(self.sections, matrices, strict=True)]
        return replace(self, sections=tuple(moved))

    @property
    def matrices(self) -> Array:
        """All matrices, (n, 3, 3)."""
        return np.stack([section.matrix for section in self.sections])


@dataclass
class SectionAligner:
    """Takes sections one after the other and says of each at once where it lies.

    `add` needs the last few sections only; `finish` solves the whole stack once all are there.
    """

    model: Model
    method: Method = "auto"
    pairs: dict[tuple[int, int], Match] = field(default_factory=dict)
    blank: list[int] = field(default_factory=list)
    _count: int = 0
    _recent: deque[tuple[int, View]] = field(default_factory=lambda: deque(maxlen=REACH))
    _chain: dict[int, Array] = field(default_factory=dict)
    _shape: tuple[int, ...] = ()

    def add(self, section: Array) -> Array:
        """Match the next section; returns its map from output to section pixels, as far as can be told now."""
        seen, index = view(section), self._count
        self._count, self._shape = index + 1, seen.shape
        if seen.texture < LEAST_TEXTURE or min(seen.shape) < SMALLEST_SIDE:
            self.blank.append(index)
            self._chain[index] = self._chain.get(index - 1, np.eye(3))
            return self._chain[index]
        self._match_back(index, seen)
        self._recent.append((index, seen))
        return self._chain[index]

    def forget_last(self) -> None:
        """Take the last section back: it is taken again."""
        self._count -= 1
        last = self._count
        self.pairs = {pair: found for pair, found in self.pairs.items() if last not in pair}
        self.blank = [k for k in self.blank if k != last]
        self._chain.pop(last)
        if self._recent and self._recent[-1][0] == last:
            self._recent.pop()

    def _match_back(self, index: int, seen: View) -> None:
        """Match with the sections before, further back until enough pairs are believed."""
        believed = 0
        self._chain[index] = self._chain.get(index - 1, np.eye(3))
        for before, other in reversed(self._recent):
            if believed >= CHECK:
                break
            predicted = self._chain[index] @ np.linalg.inv(self._chain[before]) if believed else None
            found = matcher(self.method)(other, seen, PAIRED.get(self.model, self.model), predicted)
            self.pairs[before, index] = found
            if found.believed and not believed:
                self._chain[index] = found.matrix @ self._chain[before]
            believed += found.believed

    @property
    def first_sound(self) -> int:
        """The first section that fits another one: what the others can be laid upon."""
        return min((k for pair, found in self.pairs.items() if found.believed for k in pair), default=0)

    def finish(self, reference: int = 0, anchors: Sequence[Row] = (), gaps: Sequence[int] = ()) -> Alignment:
        """Solve for all sections together.

        Parameters
        ----------
        reference : int
            The section that stays as it is.
        anchors : sequence of Row
            Maps known absolutely, from fiducial marks.
        gaps : sequence of int
            Sections before which others are missing.

        Raises
        ------
        InputError
            ``align-no-match``: not one pair of sections could be matched.
        """
        good = {pair: found for pair, found in self.pairs.items() if found.believed}
        if not good and not anchors and self._count > 1:
            raise no_match(self._count)
        bad = {k for k in range(self._count) if damaged(k, self.pairs)}
        weight = {pair: (BRIDGED if bad & set(pair) else 1) / (pair[1] - pair[0]) ** 2 for pair in good}
        rows = [Row(i, j, found.matrix, weight[i, j]) for (i, j), found in good.items()]
        fixed = Row(None, reference, np.eye(3), 1.0)
        matrices = solve(self._count, [*rows, *(anchors or [fixed])], self._shape)
        matrices = [nearest_in_pixels(self.model, m, self._shape) for m in matrices]
        if not anchors:
            back = np.linalg.inv(matrices[reference])
            matrices = [m @ back for m in matrices]
        flags = self._flags(good, bad, reference, gaps, anchored={row.second for row in anchors})
        loop = loop_disagreement_px(good, self._shape)
        placed = [
            Section(k, matrix, _error(k, reference, loop, anchors), deformation(matrix), tuple(flags[k]))
            for k, matrix in enumerate(matrices)
        ]
        return Alignment(tuple(placed), reference, self.model, self.pairs, loop, self._shape)

    def _flags(
        self, good: Pairs, bad: set[int], reference: int, gaps: Sequence[int], anchored: set[int | None]
    ) -> list[list[str]]:
        joined = connected(good, reference) | anchored
        paired = {k for pair in good for k in pair} | anchored
        found: list[list[str]] = [[] for _ in range(self._count)]
        for k, flags in enumerate(found):
            if k in self.blank:
                flags.append("blank")
            elif k not in paired and self._count > 1:
                flags.append("unmatched")
            elif k not in joined and k != reference:
                flags.append("unconnected")
            if k in bad:
                flags.append("damaged")
            if (before := good.get((k - 1, k))) is not None and before.correlation > TWIN:
                flags.append("duplicate")
            if k in gaps:
                flags.append("gap")
        return found


def no_match(count: int) -> InputError:
    """Return the error for sections of which no two could be matched."""
    return InputError(
        f"not one pair of the {count} sections could be matched.",
        why="They are blank or saturated, show too little structure, hardly overlap, or are not of one specimen.",
        fix=("look at the sections", "give places of marks: --fiducials marks.csv"),
        code="align-no-match",
    )


def damaged(k: int, pairs: Pairs) -> bool:
    """Say whether the sections on both sides of section ``k`` fit each other better than either fits it."""
    before, after, across = (pairs.get(pair) for pair in ((k - 1, k), (k, k + 1), (k - 1, k + 1)))
    if before is None or after is None or across is None or not across.believed:
        return False
    better = across.correlation > max(before.correlation, after.correlation) + BETTER_WITHOUT
    return better or across.inliers > max(before.inliers, after.inliers) + MORE_ALIKE


def connected(good: Pairs, reference: int) -> set[int]:
    """Return the sections that believed pairs connect to the reference."""
    neighbours: dict[int, set[int]] = {}
    for i, j in good:
        neighbours.setdefault(i, set()).add(j)
        neighbours.setdefault(j, set()).add(i)
    found, waiting = {reference}, [reference]
    while waiting:
        new = neighbours.get(waiting.pop(), set()) - found
        found |= new
        waiting.extend(new)
    return found


def loop_disagreement_px(good: Pairs, shape: tuple[int, ...]) -> float:
    """Median distance between a pair two apart and the two pairs between; 0 when there is no such loop."""
    loops = [
        distance_px(across.matrix, good[j, k].matrix @ good[i, j].matrix, shape)
        for (i, k), across in good.items()
        for j in range(i + 1, k)
        if (i, j) in good and (j, k) in good
    ]
    return float(np.median(loops)) if loops else 0.0


def _error(index: int, reference: int, loop_px: float, anchors: Sequence[Row]) -> float:
    """Pairs' errors add up like a random walk; a loop is three of them."""
    own = [row.sigma_px for row in anchors if row.second == index]
    return min([loop_px * float(np.sqrt(abs(index - reference) / 3)), *own])


def choose_model(sections: Sequence[Array]) -> tuple[Model, str]:
    """Look at a few pairs and say whether sections are deformed, with the reason in words.

    Rigid when the affine maps of the probed pairs deform the section by less than `DEFORMED_PX` in the median.
    """
    starts = sorted({round(k) for k in np.linspace(0, len(sections) - 2, PROBES)}) if len(sections) > 1 else []
    bends = []
    for k in starts:
        first, second = view(sections[k]), view(sections[k + 1])
        if min(first.texture, second.texture) >= LEAST_TEXTURE and (found := match(first, second, "affine")).believed:
            bends.append(bend_px(found.matrix, first.shape))
    if not bends:
        return "rigid", "no pair of sections could be probed; rigid maps are used."
    bend = float(np.median(bends))
    chosen: Model = "affine" if bend > DEFORMED_PX else "rigid"
    return chosen, f"neighbours are deformed by {bend:.2f} px against each other: {chosen} maps are used (--model)."


def bend_px(matrix: Array, shape: tuple[int, ...]) -> float:
    """How far a map is from the nearest rigid one, in pixels."""
    return distance_px(matrix, nearest_in_pixels("rigid", matrix, shape), shape)
