"""The right to command an instrument: one holder at a time, who loses it by falling silent."""

from __future__ import annotations

import secrets
from dataclasses import dataclass
from typing import TYPE_CHECKING

from devices.errors import StereotomeError

if TYPE_CHECKING:
    from devices.protocols import Clock

LASTS_S = 3.0
BEAT_S = 1.0


class NotCommanding(StereotomeError):
    """The one who asks does not hold the lease; nothing was done."""

    code = "lease-needed"
    exit_code = 8


@dataclass(frozen=True)
class _Holding:
    token: str
    actor: str
    until_s: float


class LeaseBook:
    """Says who commands. Used by one thread.

    A holder who was silent for ``lasts_s`` has lost the lease to whoever asks next; until somebody does, it may
    still go on where it was.
    """

    def __init__(self, clock: Clock, *, lasts_s: float = LASTS_S) -> None:
        self.lasts_s = lasts_s
        self._clock = clock
        self._holding: _Holding | None = None

    @property
    def holder(self) -> str:
        """Who commands now, empty when nobody does."""
        holding = self._holding
        return holding.actor if holding is not None and self._clock.now() < holding.until_s else ""

    def take(self, actor: str) -> str:
        """Return the token of a new lease; raises `NotCommanding` while somebody else is alive and holds it."""
        if self.holder:
            raise NotCommanding(
                f"{self.holder} commands this instrument.",
                why="One commands at a time; any number may look on, and anyone may stop it.",
                fix=f"wait until {self.holder} gives the lease back; it is free {self.lasts_s:g} s after its last word",
                code="lease-held",
            )
        return self._hold(secrets.token_hex(16), actor or "somebody without a name")

    def keep(self, token: str) -> None:
        """Note that the holder is alive; raises `NotCommanding` for everybody else."""
        holding = self._holding
        if holding is None or not secrets.compare_digest(holding.token.encode(), token.encode()):
            raise self._refusal(token)
        self._hold(holding.token, holding.actor)

    def release(self, token: str) -> None:
        """Give the lease back; raises `NotCommanding` for everybody but its holder."""
        self.keep(token)
        self._holding = None

    def _hold(self, token: str, actor: str) -> str:
        self._holding = _Holding(token, actor, self._clock.now() + self.lasts_s)
        return token

    def _refusal(self, token: str) -> NotCommanding:
        now = f"{self.holder} commands now" if self.holder else "nobody commands now"
        if token:
            return NotCommanding(f"this lease is over: {now}. Nothing was done.", fix="take it anew", code="lease-lost")
        return NotCommanding(
            f"only who holds the lease may do this: {now}. Nothing was done.", fix="take the lease first"
        )
