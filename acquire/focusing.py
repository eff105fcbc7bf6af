"""The autofocus of a run: gets scores from the section before or from pictures of its own, and keeps the offset."""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire.autofocus import TRACKED_PLANES, Focus, FocusPlan, correct, peak, search
from acquire.measures import focus_energy
from devices.values import to_nm

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from acquire.journal import Record
    from acquire.run_plan import RunPlan
    from acquire.verdict import SectionPlanes
    from devices.values import Limits

DEAD_NM = 200


def focus_plan(plan: RunPlan, limits: Limits) -> FocusPlan:
    """Return what the autofocus of a plan may do on a stage with these limits."""
    targets_nm = plan.stack.targets_nm()
    return FocusPlan(
        most_nm=plan.sections.focus_step_nm if plan.sections else 0,
        dead_nm=DEAD_NM,
        low_nm=min(0, to_nm(limits.min_um) - min(targets_nm)),
        high_nm=max(0, to_nm(limits.max_um) - max(targets_nm)),
    )


class Focusing:
    """Decides before a section where its planes are taken.

    Parameters
    ----------
    plan : RunPlan
        What is taken.
    limits : Limits
        Of the stage.
    planes : callable
        Gives the durable planes of a section.
    picture : callable
        Goes to a position in nm and takes a picture that is not kept.
    note : callable
        Puts a record into the journal.
    focus : Focus
        Where an earlier part of the run left it.
    """

    def __init__(
        self,
        plan: RunPlan,
        limits: Limits,
        planes: Callable[[int], SectionPlanes],
        picture: Callable[[int], np.ndarray],
        note: Callable[[Record], None],
        *,
        focus: Focus,
    ) -> None:
        self._plan = plan
        self._bounds = focus_plan(plan, limits)
        self._planes = planes
        self._picture = picture
        self._note = note
        self.focus = focus

    def before(self, section: int) -> None:
        """Decide for a section; the decision is durable before its first plane is taken."""
        self.focus = self._tracked(section) if self._plan.stack.count >= TRACKED_PLANES else self._searched()
        self._note(self.focus.record(section))

    def _tracked(self, section: int) -> Focus:
        if section == 0:
            return Focus(words="the first section is taken as planned")
        planes = self._planes(section - 1)
        slots = [slot for slot in planes.slots if planes.header(slot).band == 0]
        if len(slots) < TRACKED_PLANES:
            return correct(self.focus, None, self._bounds)
        z_nm = [to_nm(planes.header(slot).z_um) for slot in slots]
        return correct(self.focus, peak(z_nm, [focus_energy(planes.pixels(slot)) for slot in slots]), self._bounds)

    def _searched(self) -> Focus:
        """Search around the middle of the stack, where the sharpest place belongs."""
        positions_nm = [plane.z_nm for plane in self._plan.stack]
        middle_nm = (min(positions_nm) + max(positions_nm)) // 2
        held = Focus(self.focus.offset_nm, middle_nm)
        bounds = self._bounds
        found = search(
            lambda z_nm: focus_energy(self._picture(z_nm)),
            middle_nm + held.offset_nm,
            FocusPlan(bounds.most_nm, 0, bounds.low_nm - held.offset_nm, bounds.high_nm - held.offset_nm),
        )
        return correct(held, found, bounds)
