"""What the controllers say to what their clients ask, byte for byte: see the heads of the logs in tests/golden."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from devices.values import Limits
from sim.clock import SimClock
from sim.controllers.asi_tiger import Tiger
from sim.controllers.open3d import Emitter
from sim.feed_line import DRIVES, FeedTwin
from sim.motion import Axis

if TYPE_CHECKING:
    from collections.abc import Callable

GOLDEN = Path(__file__).parents[1] / "golden"
REST_S = 20.0


def tiger(clock: SimClock) -> Callable[[str], str]:
    twin = Tiger({letter: Axis(clock, Limits(-500.0, 500.0)) for letter in "XYZ"})
    return lambda command: escaped(b"".join(twin.feed(command.encode() + b"\r")))


def emitter(clock: SimClock) -> Callable[[str], str]:
    twin = Emitter(clock)
    return lambda command: escaped(b"".join(twin.feed(command.encode() + b"\n")))


def drive(profile: str) -> Callable[[SimClock], Callable[[str], str]]:
    def make(clock: SimClock) -> Callable[[str], str]:
        twin = FeedTwin(profile, clock)
        twin.machine.zero_here()
        return lambda command: b"".join(twin.feed(bytes.fromhex(command))).hex(" ")

    return make


MAKERS = {"asi_tiger": tiger, "open3d": emitter, **{name.replace("-", "_"): drive(name) for name in DRIVES}}


def escaped(reply: bytes) -> str:
    return reply.decode("latin-1").encode("unicode_escape").decode()


@pytest.mark.parametrize("name", MAKERS)
def test_the_twin_answers_as_the_log_says(name: str):
    clock = SimClock(100.0)
    ask, asked = MAKERS[name](clock), 0
    for line in (GOLDEN / f"{name}.log").read_text(encoding="ascii").splitlines():
        command, _, reply = line.partition(" -> ")
        if command == "wait":
            clock.sleep(REST_S)
        elif not command.startswith("#"):
            clock.sleep(0.05)
            asked += 1
            assert (command, ask(command)) == (command, reply)
    assert asked > 5
