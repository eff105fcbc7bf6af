"""Going on over the same view, on the same z scale: what lies before the camera now, beside a plane on the disk.

A stage that was re-zeroed, homed or without power since the run ended reads other numbers at the same place. Its
readings cannot tell; pictures can: of pictures taken along z, the one most like a plane on the disk is where it was
taken.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.optics import depth_of_field_um
from acquire.plan import Plane
from acquire.resume import stored_plan
from acquire.snap import snap
from acquire.standing import Act, standing
from devices.bands import choose_bands, switch_band
from devices.errors import Unsafe
from devices.values import to_nm, to_um

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.plan import StackPlan
    from acquire.store import StoredRun
    from devices.protocols import Clock
    from devices.rig import Rig, RigSpec

COARSE_PX, FINE_PX = 4, 2
SAME_VIEW = 0.6  # correlation of binned pictures; another field of the same specimen stays near 0
DISTANCES = 3  # tried one after the other, each twice the one before
FURTHEST = 32  # pictures taken to find out how far z is off
SIGMAS, LEAST_DIFFERENCE = 4.0, 0.005  # of two scores: what is less means nothing
SETTLE_S = 60.0


@dataclass(frozen=True)
class Compared:
    """How the view is, beside a plane on the disk.

    Attributes
    ----------
    slot : int or None
        The plane; None if none on the disk shows what lies before the camera now.
    likeness : float
        Correlation of the two pictures.
    apart_um : float or None
        Pictures so far from it along z are less like it, on both sides; None if no pictures told it from its
        neighbours, as far as they were taken.
    """

    slot: int | None = None
    likeness: float = 0.0
    apart_um: float | None = None

    @property
    def record(self) -> dict[str, Any]:
        """For the journal."""
        return {"e": "compared", "plane": self.slot, "likeness": round(self.likeness, 3), "apart_um": self.apart_um}

    @property
    def doubt(self) -> str:
        """What has to be told, if anything."""
        if self.apart_um is not None:
            return ""
        if self.slot is None:
            return "no plane of the face that lies free now is on the disk: nothing tells whether z reads as it did."
        return f"plane {self.slot} looks the same at its neighbours along z: nothing tells whether z reads as it did."


class _View:
    """Takes pictures along z and compares each with a plane on the disk."""

    def __init__(self, stored: StoredRun, slot: int, rig: Rig, clock: Clock) -> None:
        self._plan, self._rig, self._clock = stored_plan(stored), rig, clock
        self._header = stored.planes[slot].header
        self._stored = stored.read(slot)
        self.z_nm = to_nm(self._header.setpoint_um)  # the focus may have moved since the plan was made
        self.blocks = self._stored.shape[0] * self._stored.shape[1] // FINE_PX**2
        self._seen: dict[int, np.ndarray] = {}
        if self._plan.bands:
            band = choose_bands(rig.spec.band, [self._plan.bands[self._header.band].name])[0]
            switch_band(rig.camera, band, self._header.exposure_ms)

    def picture(self, z_nm: int) -> np.ndarray:
        if z_nm not in self._seen:
            for target_nm in self._plan.stack.moves_nm(Plane(0, z_nm), None):
                self._rig.stage.move_to(to_um(target_nm))
                z_um = self._rig.stage.settle(SETTLE_S)
            self._seen[z_nm], _ = snap(self._rig.camera, self._clock, self._header.exposure_ms, z_um)
        return self._seen[z_nm]

    def likeness(self) -> float:
        """Of what lies where the plane was taken, noise mostly taken away."""
        return correlation(self.picture(self.z_nm), self._stored)

    def score(self, z_nm: int) -> float:
        """Likeness of the fine detail, which is the first to go out of focus."""
        return _cosine(_detail(self.picture(z_nm)), _detail(self._stored))

    def allowed(self, z_nm: int) -> bool:
        """Whether the stage may go there: a step beyond the stack at most, from either side of the approach."""
        stack, limits = self._plan.stack, self._rig.stage.limits
        planes_nm = [plane.z_nm for plane in stack] + [self.z_nm]
        margin_nm = step_nm(stack, self._rig.spec)
        inside = min(planes_nm) - margin_nm <= z_nm <= max(planes_nm) + margin_nm
        moves_nm = stack.moves_nm(Plane(0, z_nm), None)
        return inside and all(limits.min_um <= to_um(target_nm) <= limits.max_um for target_nm in moves_nm)


def check_same_view(stored: StoredRun, rig: Rig, clock: Clock) -> Compared | None:
    """Take a durable plane again, and its neighbours along z, and return how they compare; None before the first plane.

    Of a run of sections only a plane of the face that lies free now can be compared. The new pictures are compared and
    forgotten; the planes on disk stay as they are.

    Raises
    ------
    Unsafe
        ``other-view``: it shows something else. ``z-shifted``: it is found at another reading of the stage.
    """
    slot = _comparable(stored)
    if slot is None:
        return Compared() if stored.planes else None
    view = _View(stored, slot, rig, clock)
    likeness = view.likeness()
    if not likeness >= SAME_VIEW:
        raise Unsafe(
            f"plane {slot} does not look as it did: correlation {likeness:.2f}, at least {SAME_VIEW:g} is expected.",
            why="The specimen, the light or the focus changed since; later planes would not fit the earlier ones.",
            fix=("bring back the view, then try again", "start a new run"),
            code="other-view",
        )
    apart_nm, best_nm = compare_z(
        view.score, view.z_nm, step_nm(stored_plan(stored).stack, rig.spec), view.blocks, view.allowed
    )
    if best_nm != view.z_nm:
        raise _shifted(slot, view.z_nm, best_nm)
    return Compared(slot, likeness, None if apart_nm is None else to_um(apart_nm))


def compare_z(
    score: Callable[[int], float], z_nm: int, apart_nm: int, blocks: int, allowed: Callable[[int], bool]
) -> tuple[int | None, int]:
    """Find out whether a plane is where it was: its own picture is more like it than those around it.

    Parameters
    ----------
    score : callable
        Correlation with what is seen at a position in nm.
    z_nm, apart_nm : int
        Where the plane was taken, and the first distance at which to look, in nm; twice and four times that come next.
    blocks : int
        How many values were correlated: the error of a score ρ is (1 - ρ²) / √blocks.
    allowed : callable
        Whether the stage may go to a position.

    Returns
    -------
    apart_nm : int or None
        The distance at which both sides are less like it; None if none is.
    best_nm : int
        Where it is found.
    """
    here = score(z_nm)
    for distance_nm in (apart_nm << doubled for doubled in range(DISTANCES)):
        sides = {side_nm: score(side_nm) for side_nm in (z_nm - distance_nm, z_nm + distance_nm) if allowed(side_nm)}
        best_nm = max(sides, key=sides.__getitem__, default=z_nm)
        best = sides.get(best_nm, here)
        clear = abs(best - here) > max(LEAST_DIFFERENCE, SIGMAS * (1 - min(best, here) ** 2) / math.sqrt(blocks))
        if clear and best > here:
            return distance_nm, _peak(score, best_nm, best_nm - z_nm, allowed)
        if clear and len(sides) == 2:
            return distance_nm, z_nm
    return None, z_nm


def _peak(score: Callable[[int], float], from_nm: int, by_nm: int, allowed: Callable[[int], bool]) -> int:
    """Go on while it becomes more alike, and return where it is most so."""
    for best_nm in range(from_nm, from_nm + FURTHEST * by_nm, by_nm):
        if not allowed(best_nm + by_nm) or score(best_nm + by_nm) <= score(best_nm):
            break
    return best_nm


def step_nm(stack: StackPlan, spec: RigSpec) -> int:
    """Return how far apart pictures have to be to tell planes apart: a step, or half the depth of field if more."""
    optics = spec.optics
    half_depth_nm = to_nm(depth_of_field_um(optics.na, optics.wavelength_um, optics.medium_index) / 2)
    steps_nm = [after - before for before, after in pairwise(sorted({plane.z_nm for plane in stack}))]
    return max(half_depth_nm, min(steps_nm, default=0))


def _shifted(slot: int, z_nm: int, best_nm: int) -> Unsafe:
    was_um, is_um = to_um(z_nm), to_um(best_nm)
    return Unsafe(
        f"plane {slot} was taken at {was_um:+.2f} µm and is found at about {is_um:+.2f} µm now.",
        why="The stage's zero was moved, its power was off, or the specimen sank: later planes would not fit.",
        fix=(
            "bring back the zero: move to the place of that plane, and let the stage call it what it was",
            "start a new run",
        ),
        code="z-shifted",
    )


def _comparable(stored: StoredRun) -> int | None:
    """Return the last durable plane of what lies before the camera now, one between others in z if there is one."""
    last = max(stored.planes, default=None)
    if last is None or not _lies_free(stored, last):
        return None
    section, band, _ = stored.layout.place(last)
    same = [slot for slot in sorted(stored.planes, reverse=True) if stored.layout.place(slot)[:2] == (section, band)]
    stack = stored_plan(stored).stack
    ends_nm = [end(plane.z_nm for plane in stack) for end in (min, max)]
    return next((slot for slot in same if stack.z_nm(stored.layout.place(slot)[2]) not in ends_nm), last)


def _lies_free(stored: StoredRun, last: int) -> bool:
    if stored_plan(stored).sections is None:
        return True
    now = standing(stored.records)
    face_is_out = now.cleared or now.feed is Act.PENDING
    return face_is_out and stored.layout.place(last)[0] == (now.section if now.cleared else now.section - 1)


def correlation(live: np.ndarray, stored: np.ndarray) -> float:
    """Return the normalised cross-correlation of two pictures after binning 4x4, which takes most of the noise away.

    Parameters
    ----------
    live, stored : ndarray, shape (y, x) or (y, x, 3), uint8 or uint16

    Returns
    -------
    float
        From -1 to 1; 0 when a picture shows nothing.
    """
    a, b = _binned(live, COARSE_PX), _binned(stored, COARSE_PX)
    return _cosine(a - a.mean(), b - b.mean())


def _detail(pixels: np.ndarray) -> np.ndarray:
    """Return the differences between neighbours, across and down."""
    blocks = _binned(pixels, FINE_PX)
    return np.concatenate([np.diff(blocks, axis=axis).ravel() for axis in (0, 1)])


def _cosine(a: np.ndarray, b: np.ndarray) -> float:
    scale = float(np.sqrt(np.sum(a * a) * np.sum(b * b)))
    return float(np.sum(a * b)) / scale if scale else 0.0


def _binned(pixels: np.ndarray, side_px: int) -> np.ndarray:
    grey = pixels.mean(axis=2) if pixels.ndim == 3 else pixels.astype(np.float64)
    if min(grey.shape) < side_px:
        return grey
    height, width = (n // side_px for n in grey.shape)
    return np.asarray(
        grey[: height * side_px, : width * side_px].reshape(height, side_px, width, side_px).mean(axis=(1, 3))
    )
