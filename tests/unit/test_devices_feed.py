"""The feed's table in an instrument file, and the ways of its cycle."""

from __future__ import annotations

import pytest
from feeds import spec_of
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from devices.drivers.feed_cycle import FeedCycle
from devices.errors import DeviceError, NoReply, Unsafe
from devices.feed_errors import FeedAlarm, FeedEstop, FeedHalted, FeedUndecided
from devices.feed_values import FeedState

S = FeedState


def test_an_installation_replaces_what_the_profile_says():
    profile = spec_of("leadshine-rs", unit=7, baud=38400, word_order="little", counts_per_um=250.0).feed_profile()
    assert (profile.link.unit, profile.link.baud, profile.address.word_order) == (7, 38400, "little")
    assert profile.axis.speed_per_um_s == 1.5


def test_the_knife_is_on_the_same_line_with_its_own_number():
    knife = spec_of("leadshine-rs").knife_profile()
    assert (knife.profile, knife.link.unit, knife.link.kind) == ("plc-mailbox", 2, "rtu")
    assert spec_of("plc-mailbox", unit=5).knife_profile().link.unit == 5


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"limits": {"feed_um_max": 30_000.0}}, "must lie within 0 … 20000 µm of the profile"),
        ({"limits": {"feed_um_max": 100.0, "feed_um_min": 200.0}}, "feed_um_min must be below feed_um_max"),
        ({"limits": {"feed_um_max": 100.0, "thickness_nm_max": 20_000.0}}, "above the profile's max_step_um 10 µm"),
        ({"counts_per_um": 1e7, "speed_um_s": 0.01}, "does not fit into i32"),
        ({"speed_um_s": 30_000.0}, "90000 does not fit into u16"),
        ({"unit": 0}, "greater than or equal to 1"),
    ],
)
def test_a_table_that_makes_no_sense(changes: dict, words: str):
    with pytest.raises(ValidationError, match=words):
        spec_of("leadshine-rs", **changes)


@pytest.mark.parametrize(
    ("error", "state"),
    [
        (FeedAlarm("x"), S.ALARM),
        (FeedEstop("x"), S.ESTOPPED),
        (FeedHalted("x"), S.IDLE),
        (NoReply("x"), S.UNKNOWN),
        (FeedUndecided("x"), S.UNKNOWN),
    ],
)
def test_an_error_leaves_the_cycle_where_the_feed_is(error: DeviceError, state: FeedState):
    cycle = FeedCycle()
    with pytest.raises(DeviceError), cycle.during(S.HOMING):
        raise error
    assert cycle.state is state


def test_a_cut_is_reached_from_ready_only():
    for state in set(S) - {S.READY}:
        cycle = FeedCycle()
        cycle.state = state
        with pytest.raises(ValueError, match="no way from"):
            cycle.enter(S.CUTTING)
        with pytest.raises(Unsafe, match="Nothing was sent"):
            cycle.require(S.READY)


@given(st.lists(st.sampled_from(S), max_size=30))
def test_whatever_happens_the_knife_can_be_brought_out(states: list[FeedState]):
    cycle = FeedCycle()
    for state in states:
        cycle.state = state
        cycle.enter(S.CLEARING)
        assert cycle.state is S.CLEARING
