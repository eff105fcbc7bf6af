"""A focal stack as immutable data that enumerates its planes. Positions are whole nanometres inside."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from devices.errors import PlanError
from devices.values import to_nm, to_um

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from devices.values import Limits

DEFAULT_TOLERANCE_NM = 200


@dataclass(frozen=True)
class Plane:
    """One planned plane: its fixed index in the stack and where it is."""

    index: int
    z_nm: int

    @property
    def z_um(self) -> float:
        """Where the stage is sent, in µm."""
        return to_um(self.z_nm)


@dataclass(frozen=True)
class StackPlan:
    """A focal stack of ``count`` planes at ``start + k·step``, or where it says, in the order in which they are taken.

    Attributes
    ----------
    start_nm, step_nm : int
        Position of plane 0 and signed distance between planes.
    count : int
        Number of planes, at least 1; all are visited.
    exposure_ms : float
        Exposure of each plane.
    approach : int
        +1 or -1: every plane is reached by a move in this direction, so that backlash is the same everywhere.
    overshoot_nm : int
        How far beyond a plane the stage goes before it comes back in the approach direction; at least the backlash.
    tolerance_nm : int
        Largest distance between setpoint and readback at which a plane is taken.
    return_nm : int or None
        Where the stage is left afterwards, also after an abort; None stays.
    positions_nm : tuple of int or None
        Where each plane is, when not evenly apart; ``start_nm`` is then the first, ``step_nm`` the mean distance.
    """

    start_nm: int
    step_nm: int
    count: int
    exposure_ms: float
    approach: int = 1
    overshoot_nm: int = 0
    tolerance_nm: int = DEFAULT_TOLERANCE_NM
    return_nm: int | None = None
    positions_nm: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        if self.count < 1:
            raise PlanError("the stack has no planes.", fix="give a range and step that hold at least one plane.")
        if self.count > 1 and self.step_nm == 0:
            raise PlanError("the planes of the stack are 0 µm apart.", fix="give a step of at least 0.001 µm.")
        if not self.exposure_ms > 0:
            raise PlanError(f"exposure {self.exposure_ms:g} ms is not above zero.", fix="set exposure_ms.")
        if self.positions_nm is not None and len(self.positions_nm) != self.count:
            raise PlanError(f"the stack has {self.count} planes and {len(self.positions_nm)} positions.")

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator[Plane]:
        return (self.plane(k) for k in range(self.count))

    def plane(self, index: int) -> Plane:
        """Return one plane."""
        return Plane(index, self.z_nm(index))

    def z_nm(self, plane: int) -> int:
        """Return where a plane is."""
        return self.start_nm + plane * self.step_nm if self.positions_nm is None else self.positions_nm[plane]

    def moves_nm(self, plane: Plane, after: Plane | None) -> tuple[int, ...]:
        """Return the targets visited to reach a plane from its approach side: one or two positions.

        A plane that lies in the approach direction from the one taken before, ``after``, needs no detour.
        """
        with_the_grain = after is not None and (plane.z_nm - after.z_nm) * self.approach > 0
        if with_the_grain or self.overshoot_nm == 0:
            return (plane.z_nm,)
        return (plane.z_nm - self.approach * self.overshoot_nm, plane.z_nm)

    def route(self) -> Iterator[tuple[Plane, tuple[int, ...]]]:
        """Return every plane with the targets visited to reach it when the whole stack is taken."""
        before = None
        for plane in self:
            yield plane, self.moves_nm(plane, before)
            before = plane

    def targets_nm(self) -> list[int]:
        """Return every position the stage will be sent to, the way back included."""
        visited = [target for _, moves in self.route() for target in moves]
        return visited if self.return_nm is None else [*visited, self.return_nm]

    def check(self, limits: Limits) -> None:
        """Raise `devices.errors.LimitError` if any target lies outside ``limits``; nothing is sent."""
        for target_nm in (min(self.targets_nm()), max(self.targets_nm())):
            limits.check(to_um(target_nm))

    def travel_um(self) -> float:
        """Return the sum of all moves from plane 0 on, in µm."""
        return sum(abs(to_um(b - a)) for a, b in pairwise(self.targets_nm()))

    def canonical(self) -> dict[str, Any]:
        """Return the plan as plain data."""
        told = asdict(self)
        if self.positions_nm is None:
            del told["positions_nm"]
        return told

    @property
    def plan_id(self) -> str:
        """sha256 of the canonical JSON: equal plans have equal ids."""
        return id_of(self.canonical())


def id_of(canonical: dict[str, Any]) -> str:
    """Return the sha256 of plain data."""
    text = json.dumps(canonical, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def listed(positions_nm: Sequence[int], exposure_ms: float, **rest: Any) -> StackPlan:
    """Return a stack of planes at given positions, in the order given."""
    if not positions_nm:
        raise PlanError("the list of positions is empty.", fix="give at least one position.")
    first, last, count = positions_nm[0], positions_nm[-1], len(positions_nm)
    mean_nm = round((last - first) / max(1, count - 1)) or (1 if count > 1 else 0)
    return StackPlan(first, mean_nm, count, exposure_ms, positions_nm=tuple(positions_nm), **rest)


def steps_in_range(first_um: float, last_um: float, step_um: float) -> tuple[int, int]:
    """Return the signed step in nm and the number of planes from ``first_um`` towards ``last_um``, not past it.

    The last plane may lie up to one step short of ``last_um``; planes are never squeezed.
    """
    span_nm, step_nm = to_nm(last_um) - to_nm(first_um), abs(to_nm(step_um))
    if step_nm == 0:
        raise PlanError(f"step {step_um:g} µm is less than 0.001 µm.", fix="give a larger step.")
    return (step_nm if span_nm >= 0 else -step_nm), abs(span_nm) // step_nm + 1
