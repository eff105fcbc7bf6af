"""What goes wrong with a feed, each with a name of its own and what the operator should look at."""

from __future__ import annotations

from devices.errors import DeviceError, Unsafe

LOOK = "look at the drive's display or at the feed itself, home it, and compare the depth with the run's last section."


class FeedAlarm(DeviceError):
    """The drive stopped with an alarm."""

    code = "feed-alarm"


class FeedEstop(DeviceError):
    """The emergency stop is pressed."""

    code = "feed-estop"


class FeedHalted(DeviceError):
    """Somebody halted the motion; the feed stands short of its target."""

    code = "feed-halted"


class FeedStalled(DeviceError):
    """The feed makes no progress; it was told to stop."""

    code = "feed-stalled"


class FeedAstray(DeviceError):
    """The feed is where it was not sent; it was told to stop."""

    code = "feed-astray"


class FeedNotExecuted(DeviceError):
    """A read-back shows that the command was never executed; it may be given again."""

    code = "feed-not-executed"


class FeedUndecided(Unsafe):
    """Nobody can tell whether the feed moved or the knife cut; nothing more is done until it is known."""

    code = "feed-undecided"


class KnifeFailed(DeviceError):
    """The knife did not do what it was told."""

    code = "knife-failed"


def undecided(what: str, cause: DeviceError) -> FeedUndecided:
    """Return the error for a command whose fate no read-back tells."""
    return FeedUndecided(f"feed: {what}, and nobody knows whether it was executed.", why=cause.what, fix=LOOK)


def not_executed(what: str, cause: DeviceError) -> FeedNotExecuted:
    """Return the error for a command that a read-back shows not to have been executed."""
    return FeedNotExecuted(
        f"feed: {what} was not executed; nothing moved.",
        why=cause.what,
        fix="see to the cause, then give the command again.",
    )
