"""What a microtome feed and its knife can be in."""

from __future__ import annotations

from enum import StrEnum


class FeedState(StrEnum):
    """Where a section's cycle stands; UNKNOWN after a lost reply, until a read-back decides."""

    IDLE = "idle"
    HOMING = "homing"
    READY = "ready"
    ADVANCING = "advancing"
    CUTTING = "cutting"
    RETRACTING = "retracting"
    CLEARING = "clearing"
    VERIFYING = "verifying"
    ALARM = "alarm"
    ESTOPPED = "estopped"
    UNKNOWN = "unknown"


class KnifeState(StrEnum):
    """What the knife's sensors say."""

    CLEAR = "clear"
    IN_WINDOW = "in window"
    CUTTING = "cutting"
    JAMMED = "jammed"
    ABSENT = "absent"
