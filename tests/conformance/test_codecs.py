"""What every codec must do: whatever bytes come back, they mean something or are one of our errors.

Codecs and their requests are found, not listed: a new one is met without a word here. Replies are any bytes, and what
the golden logs of the controllers hold, cut, doubled and disturbed.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from feeds import PROFILES, on_twin
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import devices.wire
from devices.errors import DeviceError, LinkError, MalformedReply, Refused
from devices.wire.open3d import Glasses, Settings

if TYPE_CHECKING:
    from devices.wire.exchange import Request

GOLDEN = Path(__file__).parents[1] / "golden"
SAMPLES = {
    "words": "W Z", "letter": "Z", "axis": "1", "card": "2", "word": "\\", "by": "switch", "glasses": Glasses.STEREO,
    "settings": Settings(*range(17)), "on": True, "enabled": True, "axis_mask": 4, "planes": 5, "timeout_ms": 500,
    "action": 1, "count": 1, "steps": 5,
}  # fmt: skip


def requests_of(module) -> dict[str, Request]:
    """Every request a codec makes, by the function that makes it."""
    found = {}
    for name, make in inspect.getmembers(module, inspect.isfunction):
        ours = make.__module__ == module.__name__ and not name.startswith("_")
        if ours and "Request[" in str(make.__annotations__.get("return")):
            values = {p.name: SAMPLES.get(p.name, 5) for p in inspect.signature(make).parameters.values()}
            made = make(**values)
            found |= {f"{name} {i}": one for i, one in enumerate(made if isinstance(made, tuple) else (made,))}
    return found


MODULES = [
    importlib.import_module(found.name) for found in pkgutil.iter_modules(devices.wire.__path__, "devices.wire.")
]
REQUESTS = {f"{m.__name__.rpartition('.')[2]}.{name}": one for m in MODULES for name, one in requests_of(m).items()}
SEEN = [
    line.rpartition(" -> ")[2].encode("latin-1").decode("unicode_escape").encode("latin-1")
    for log in sorted(GOLDEN.glob("*.log"))
    for line in log.read_text(encoding="latin-1").splitlines()
    if not line.startswith("#")
]


@st.composite
def disturbed(draw: st.DrawFn) -> bytes:
    """A reply that some controller gave, with something done to it."""
    reply = draw(st.sampled_from(SEEN))
    at, noise = draw(st.integers(0, len(reply))), draw(st.binary(max_size=3))
    return draw(st.sampled_from([reply[:at], reply[at:], reply + reply, reply[:at] + noise + reply[at + len(noise) :]]))


def test_every_codec_is_met():
    assert {name.partition(".")[0] for name in REQUESTS} >= {"asi", "asi_triggered", "open3d", "pi_gcs", "prior"}
    assert len(REQUESTS) > 50


@pytest.mark.parametrize("name", REQUESTS)
@settings(max_examples=40)
@given(reply=st.binary(max_size=60) | disturbed())
def test_any_bytes_decode_or_raise_one_of_ours(name: str, reply: bytes):
    request = REQUESTS[name]
    framed = request.framing(reply) if request.framing else reply
    if framed is None:
        return
    with suppress(MalformedReply, Refused):
        request.decode(framed)


@pytest.mark.parametrize("name", [name for name, request in REQUESTS.items() if request.framing])
@given(data=st.binary(max_size=40), more=st.binary(max_size=20))
@settings(max_examples=30)
def test_a_framed_reply_does_not_depend_on_what_comes_after_it(name: str, data: bytes, more: bytes):
    framing = REQUESTS[name].framing
    if (reply := framing(data)) is not None:
        assert reply in data
        assert framing(data + more) is not None


@pytest.mark.parametrize("profile", PROFILES)
@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(noise=st.binary(max_size=40))
def test_any_bytes_from_a_drive_are_a_number_or_one_of_ours(profile: str, noise: bytes):
    bench = on_twin(profile).ready()
    feeds = bench.twin.machine.feeds_executed
    bench.port.twin = Noisy(noise)
    for ask in (bench.feed.position_nm, lambda: bench.feed.advance_to(2000)):
        with pytest.raises(DeviceError) as caught:
            ask()
        assert isinstance(caught.value, LinkError | Refused) or caught.value.code.startswith(("feed-", "interlock"))
    assert bench.twin.machine.feeds_executed == feeds


class Noisy:
    """Answers everything with the same noise."""

    def __init__(self, noise: bytes) -> None:
        self.noise = noise

    def feed_upset(self, data: bytes) -> list:
        from sim.faults import Delayed

        return [Delayed(self.noise)] if self.noise else []
