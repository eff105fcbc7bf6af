"""A stage that was out of touch: met anew, it moves again only if it tells the place where it was known last."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from devices.errors import DeviceError, LinkLost
from devices.protocols import ComesBack
from devices.travel import CanZero

if TYPE_CHECKING:
    from devices.protocols import Stage

log = logging.getLogger(__name__)
ELSEWHERE, ANOTHER = "position-unknown", "device-other"


class Comeback:
    """Reads where a stage is, and meets one anew that was lost or fell silent. Moves nothing.

    While it does not answer it is tried again with every reading. One that came back elsewhere, or as after its power
    was off, stays refused until somebody says where it is: `take_as_it_is`, before its place is called 0.
    """

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._last_um = float("nan")
        self._refused: DeviceError | None = None

    @property
    def _lost(self) -> ComesBack | None:
        stage = self._stage
        return stage if isinstance(stage, ComesBack) and not stage.position_known else None

    def knew(self, z_um: float) -> None:
        """Note where the stage was read while nothing was amiss."""
        self._last_um = z_um

    def read_um(self, *, may_meet: bool) -> float | None:
        """Return where the stage is, of a lost one once it was met anew; None if it is lost and not to be met now.

        Raises
        ------
        DeviceError
            It does not answer, or is not where it was.
        """
        elsewhere = self._refused is not None and self._refused.code == ELSEWHERE
        lost = None if elsewhere else self._lost
        if lost is not None and not may_meet:
            return None
        try:
            return self._read_um(lost)
        except DeviceError as error:
            if isinstance(error, LinkLost) or error.code in (ELSEWHERE, ANOTHER):
                self._refused = error
            raise

    def check(self) -> None:
        """Raise `DeviceError` while the stage is lost, or came back elsewhere."""
        if self._lost is not None:
            raise self._refused or DeviceError(
                "z stage: it is out of touch, and its position is unknown. Nothing moved.",
                why="Its connection broke, or it stopped answering.",
                fix="see to cable and power: it goes on by itself if it comes back where it was.",
                code=ELSEWHERE,
            )

    def take_as_it_is(self) -> None:
        """Let a lost stage move again wherever it says it is, if its place can be called 0: that has to come next."""
        if (lost := self._lost) is not None and isinstance(self._stage, CanZero):
            self._last_um = lost.reconnect(0.0)

    def _read_um(self, lost: ComesBack | None) -> float:
        if lost is not None:
            z_um = lost.reconnect(0.0, at_um=self._last_um)
            log.info("z stage: it was out of touch and is back at %+.2f µm, where it was.", z_um)
        z_um = self._stage.position_um()
        if self._lost is None:
            self._last_um, self._refused = z_um, None
        return z_um
