"""What the knife leaves of a block: the face that lies open, and what went wrong with it on purpose."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from sim.faults import Faults

NM_PER_UM = 1000
LEAST_UM = 0.001  # a stroke that would take off less sweeps the face and takes nothing
DRIFT_DIRECTION = (0.8, 0.6)


@dataclass(frozen=True)
class Face:
    """What lies open to the objective.

    Attributes
    ----------
    depth_um : float
        How deep in the block it lies.
    section : int
        How many sections were taken before it.
    debris : int or None
        What lies on it: the section that left it there; None when it is clean.
    offset_um : (float, float)
        How far the block has wandered along x and y.
    focus_um : float
        How much higher the stage has to stand than at the first face.
    lost : bool
        The specimen fell out of its block: nothing is there but resin.
    """

    depth_um: float = 0.0
    section: int = 0
    debris: int | None = None
    offset_um: tuple[float, float] = (0.0, 0.0)
    focus_um: float = 0.0
    lost: bool = False


class Block:
    """A block in front of a knife.

    Faults of ``block`` are counted in sections: ``block.debris@5`` is left behind by the fifth.

    Parameters
    ----------
    faults : Faults, optional
        What goes wrong.
    seed : int
        Of the thickness errors.

    Attributes
    ----------
    face : Face
        What lies open now; replaced as a whole by each stroke.
    surface_um : float or None
        Where in the block the knife passed last; None before the first time.
    removed_um : list of float
        Thickness of what each stroke took away.
    """

    def __init__(self, faults: Faults | None = None, *, seed: int = 0) -> None:
        self._faults = faults
        self._rng = np.random.default_rng(seed)
        self._deepest_um = -np.inf
        self.face = Face()
        self.surface_um: float | None = None
        self.removed_um: list[float] = []

    def stroke(self, depth_um: float) -> None:
        """Let the knife pass at a depth of the feed: what stands above its plane is gone, with all that lay on it.

        A stroke that reaches no deeper than those before is a sweep.
        """
        if depth_um > self._deepest_um + LEAST_UM:
            self._deepest_um = depth_um
            self._section(depth_um)
        else:
            self.removed_um.append(0.0)
            self._sweep()

    def _section(self, depth_um: float) -> None:
        struck = set() if self._faults is None else self._faults.strike("block")
        taken = "block.miss" not in struck
        if taken:
            self._take_off(depth_um)
        else:
            self.removed_um.append(0.0)
        face, drift_um = self.face, self._number("block.drift")
        section = face.section + 1
        self.face = Face(
            depth_um=self.surface_um or 0.0,
            section=section,
            debris=section if "block.debris" in struck else None if taken else face.debris,
            offset_um=(
                face.offset_um[0] + drift_um * DRIFT_DIRECTION[0],
                face.offset_um[1] + drift_um * DRIFT_DIRECTION[1],
            ),
            focus_um=face.focus_um + self._number("block.focus"),
            lost=face.lost or "block.lost" in struck,
        )

    def _take_off(self, depth_um: float) -> None:
        """Remove a section; the knife passes where it is told, give or take the fault ``block.uneven``."""
        at_um = depth_um + self._rng.normal() * self._number("block.uneven")
        before_um = at_um if self.surface_um is None else self.surface_um
        self.surface_um = max(at_um, before_um)
        self.removed_um.append(self.surface_um - before_um)

    def _sweep(self) -> None:
        if self._faults is None or self._faults.number("block.stuck") is None:
            self.face = replace(self.face, debris=None)

    def _number(self, kind: str) -> float:
        """Return the number of a fault in µm, 0 when it is off."""
        number_nm = None if self._faults is None else self._faults.number(kind)
        return (number_nm or 0.0) / NM_PER_UM
