"""Stacks that an ASI controller steps through by itself, on the pulses of a camera."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import TYPE_CHECKING

from devices.drivers.asi_axis import AsiStage
from devices.errors import PlanError, Refused, SequenceBroken
from devices.values import StageSequence
from devices.wire import asi
from devices.wire import asi_triggered as ttl
from devices.wire.asi_identity import MS2000, ring_slots

if TYPE_CHECKING:
    from collections.abc import Sequence

    from devices.link import Link
    from devices.protocols import Clock
    from devices.rig import AxisSpec
    from devices.wire.asi_identity import Card

REACH_START_S = 60.0
SAME_STEP_UM = 0.001
BACKLASH_MARGIN = 2.0


class AsiTriggeredStage(AsiStage):
    """An `AsiStage` that is also a `devices.protocols.SequencedStage`.

    Positions go into the controller's ring if they fit; a longer stack of equal steps is done as a linear stack. The
    ring begins with the axis at the first position and holds the last one twice, so that the pulse of the last frame
    leaves it there. The linear stack is centred on where its first pulse finds the axis, which costs one frame, and
    goes one step too far, upon the pulse of the last frame.

    Parameters
    ----------
    slots : int
        Positions the ring has room for.
    """

    def __init__(self, link: Link, spec: AxisSpec, clock: Clock, card: Card = MS2000, *, slots: int = 0) -> None:
        super().__init__(link, spec, clock, card)
        self._slots = slots
        self._by_ring = True
        self._wait_ms: float | None = None

    def load_sequence(self, positions_um: Sequence[float], longest_wait_s: float) -> StageSequence:
        """Go to where the sequence begins and get ready for pulses; see `devices.protocols.SequencedStage`."""
        self._by_ring = len(positions_um) < self._slots
        if self._by_ring:
            return self._load_ring(positions_um)
        return self._load_linear(positions_um, longest_wait_s)

    def start_sequence(self) -> None:
        """Let the axis go to where it is already: the pulse at the end of that move is the first one.

        Nothing more is sent: a short exposure would be over before the controller had read it.
        """
        self._link.ask(ttl.step_ring(self._card.address) if self._by_ring else ttl.stay())

    def end_sequence(self, timeout_s: float) -> float:
        """Heed no more pulses and return where the axis comes to rest, in µm.

        The halt at the end is for the linear stack: left alone it would send the axis home at its timeout.
        """
        self._target_um = None
        self.disarm()
        if self._wait_ms is not None:
            self._link.ask(asi.set_wait(self._wait_ms))
            self._wait_ms = None
        rest_um = self.settle(timeout_s)
        self._link.ask(asi.halt(self._card.halt))
        return rest_um

    def disarm(self) -> None:
        """Heed no pulses: a program that died may have left the controller armed, and each exposure would move it."""
        self._link.ask(ttl.on_pulse(ttl.IN_OFF, self._card.address))
        self._link.ask(ttl.output(ttl.OUT_LOW, self._card.address))

    def _prepare(self) -> None:
        """Find out how long the ring is; disarm what a program that died may have left armed."""
        with suppress(Refused):
            self._slots = ring_slots(self._link.ask(asi.build(self._card.address)))
            self.disarm()
        super()._prepare()

    def _load_ring(self, positions_um: Sequence[float]) -> StageSequence:
        places_um = (*positions_um, positions_um[-1])
        self._check(places_um)
        self._go(places_um[0] - math.copysign(self._lost_motion_um, _step_um(positions_um)), places_um[0])
        card = self._card.address
        self._link.ask(ttl.clear_ring(card))
        for place_um in places_um:
            self._link.ask(ttl.load_ring(place_um * self._units_per_um))
        self._check_loaded(len(places_um))
        self._link.ask(ttl.use_ring(self._card.axis_mask, card))
        self._arm(ttl.IN_RING)
        return StageSequence(places_um)

    def _check_loaded(self, count: int) -> None:
        try:
            loaded = self._link.ask(ttl.ring_count(self._card.address))
        except Refused:
            return  # firmware before 9.2g counts without telling
        if loaded != count:
            raise SequenceBroken(f"z stage: {loaded:g} of {count} positions are in the controller's ring.")

    def _load_linear(self, positions_um: Sequence[float], longest_wait_s: float) -> StageSequence:
        step_um, timeout_ms = _step_um(positions_um), math.ceil(1000 * longest_wait_s)
        self._check_linear(positions_um, step_um, timeout_ms)
        lead = math.ceil(self._lost_motion_um / abs(step_um))
        first_um, planes = positions_um[0] - lead * step_um, lead + len(positions_um) + 1
        places_um = tuple(first_um + index * step_um for index in range(planes))
        centre_um = (places_um[0] + places_um[-1]) / 2
        self._check(places_um)
        self._go(centre_um)
        self._link.ask(ttl.linear_stack(step_um * self._units_per_um, planes, timeout_ms, self._card.address))
        self._arm(ttl.IN_STACK)
        return StageSequence((centre_um, *places_um), lead_frames=1 + lead)

    def _check_linear(self, positions_um: Sequence[float], step_um: float, timeout_ms: int) -> None:
        even = all(
            abs(place_um - positions_um[0] - index * step_um) < SAME_STEP_UM
            for index, place_um in enumerate(positions_um)
        )
        if not even:
            raise PlanError(
                f"z stage: {len(positions_um)} unequal steps do not fit into the controller's ring of {self._slots}.",
                fix='take fewer planes, or let software trigger them: stack.trigger = "software"',
            )
        if timeout_ms > ttl.LONGEST_TIMEOUT_MS or len(positions_um) + 1 > ttl.MOST_PLANES:
            raise PlanError(
                f"z stage: the controller's stack cannot wait {timeout_ms / 1000:g} s for a pulse; "
                f"{ttl.LONGEST_TIMEOUT_MS / 1000:g} s is the most.",
                fix='shorten the exposure, or let software trigger: stack.trigger = "software"',
            )

    def _check(self, places_um: tuple[float, ...]) -> None:
        for place_um in (min(places_um), max(places_um)):
            self.limits.check(place_um)

    @property
    def _lost_motion_um(self) -> float:
        return BACKLASH_MARGIN * self._spec.backlash_um

    def _go(self, *places_um: float) -> None:
        for place_um in places_um:
            self.move_to(place_um)
            self.settle(REACH_START_S)

    def _arm(self, action: int) -> None:
        self._wait_ms = self._link.ask(asi.wait())
        self._link.ask(asi.set_wait(math.ceil(self._spec.settle_ms)))
        self._link.ask(ttl.output(ttl.OUT_AFTER_MOVE, self._card.address))
        self._link.ask(ttl.on_pulse(action, self._card.address))


def _step_um(positions_um: Sequence[float]) -> float:
    return positions_um[1] - positions_um[0] if len(positions_um) > 1 else 1.0
