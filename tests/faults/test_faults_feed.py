"""Feeds × faults: a named error or a recovery, the position known or UNKNOWN, never a second feed or cut."""

from __future__ import annotations

from threading import Event, Thread
from typing import TYPE_CHECKING

import pytest
from feeds import PROFILES, OnTwin, on_twin

from devices.errors import DeviceError, LinkError, Unsafe
from devices.feed_values import FeedState, KnifeState
from devices.values import Limits
from sim.feed_line import Kind, Upset

if TYPE_CHECKING:
    from collections.abc import Callable

PATIENCE_S = 60
KNOWN = {FeedState.READY, FeedState.IDLE, FeedState.ALARM, FeedState.ESTOPPED}
SPOILT: list[Kind] = ["drop", "late", "half", "garble", "wrong-unit", "noise"]
UNHEARD: list[Kind] = ["deaf", "busy"]
every_profile = pytest.mark.parametrize("profile", PROFILES)


def fails(action: Callable[[], object]) -> DeviceError:
    with pytest.raises(DeviceError) as caught:
        action()
    return caught.value


def advance(bench: OnTwin) -> None:
    bench.feed.advance_to(2000)


def cut(bench: OnTwin) -> None:
    bench.feed.arm()
    bench.feed.cut()


def tells_truth(bench: OnTwin) -> bool:
    """Whether the position the driver reads is where the feed is, to one count."""
    return abs(bench.feed.position_nm() - bench.twin.machine.position_um * 1000) <= 2


@every_profile
@pytest.mark.parametrize("kind", SPOILT)
def test_the_reply_to_a_feed_is_lost(profile: str, kind: Kind):
    """The read-back shows that it was executed; the twin counts one feed."""
    bench = on_twin(profile).ready()
    bench.twin.upsets.append(Upset(kind, "move"))
    before = bench.twin.counters()
    advance(bench)
    assert bench.twin.machine.feeds_executed - before["feeds"] == 1
    assert bench.twin.machine.moves_executed - before["moves"] == 1
    assert bench.twin.machine.position_um == pytest.approx(2.0)
    assert bench.feed.state is FeedState.READY


@every_profile
@pytest.mark.parametrize("kind", UNHEARD)
def test_a_feed_that_is_not_executed(profile: str, kind: Kind):
    bench = on_twin(profile).ready()
    bench.twin.upsets.append(Upset(kind, "move"))
    assert fails(lambda: advance(bench)).code == "feed-not-executed"
    assert bench.twin.machine.position_um == pytest.approx(0.0)
    assert bench.feed.state is FeedState.READY
    advance(bench)
    assert bench.twin.machine.feeds_executed == 1


def test_a_checksum_the_drive_rejects_is_no_feed():
    bench = on_twin("leadshine-rs").ready()
    bench.twin.upsets.append(Upset("crc", "move"))
    assert "wrong CRC" in fails(lambda: advance(bench)).why
    assert bench.twin.machine.feeds_executed == 0
    assert bench.feed.state is FeedState.READY


@every_profile
@pytest.mark.parametrize("kind", SPOILT)
def test_one_reply_to_a_reading_is_lost(profile: str, kind: Kind):
    bench = on_twin(profile).ready()
    advance(bench)
    bench.twin.upsets.append(Upset(kind, "read"))
    assert bench.feed.position_nm() == pytest.approx(2000, abs=2)
    assert bench.feed.state is FeedState.READY


@every_profile
def test_a_reading_is_refused(profile: str):
    bench = on_twin(profile).ready()
    bench.twin.upsets.append(Upset("busy", "read"))
    assert fails(bench.feed.position_nm).code == "device-refused"
    assert tells_truth(bench)


@every_profile
def test_nothing_answers_any_more_after_a_feed(profile: str):
    bench = on_twin(profile).ready()
    silence = Upset("deaf", "read", times=0)
    bench.twin.upsets += [Upset("drop", "move"), silence]

    def silent_after_the_move() -> None:
        silence.times = 100 if bench.twin.machine.feeds_executed else 0

    bench.port.on_write = silent_after_the_move
    error = fails(lambda: advance(bench))
    assert error.code == "feed-undecided"
    assert "look at the drive" in error.message()
    assert bench.feed.state is FeedState.UNKNOWN
    assert isinstance(fails(lambda: advance(bench)), Unsafe)
    assert bench.twin.machine.feeds_executed == 1
    bench.port.on_write = lambda: None
    silence.times = 0
    bench.clock.sleep(1.0)
    assert bench.feed.resolve() is FeedState.READY
    assert tells_truth(bench)


@every_profile
def test_the_drive_fails_on_its_way(profile: str):
    bench = on_twin(profile).ready()
    bench.twin.machine.trip_at_um = 1.0
    error = fails(lambda: advance(bench))
    assert error.code == "feed-alarm"
    assert "no name for" not in error.what
    assert bench.feed.state is FeedState.ALARM
    assert tells_truth(bench)
    assert isinstance(fails(lambda: advance(bench)), Unsafe)
    assert bench.feed.reset_alarm() in KNOWN
    assert bench.twin.machine.feeds_executed == 1


@every_profile
def test_something_holds_the_feed(profile: str):
    bench = on_twin(profile).ready()
    bench.twin.machine.axis.obstruct(1.0)
    assert fails(lambda: advance(bench)).code == "feed-alarm"
    assert bench.feed.state is FeedState.ALARM
    assert tells_truth(bench)
    assert bench.twin.machine.feeds_executed == 1


@every_profile
def test_something_holds_the_feed_and_the_drive_does_not_notice(profile: str, monkeypatch: pytest.MonkeyPatch):
    bench = on_twin(profile).ready()
    bench.twin.machine.axis.obstruct(1.0)
    monkeypatch.setattr(bench.twin.drive, "notice", lambda: None)
    assert fails(lambda: advance(bench)).code == "feed-stalled"
    assert bench.feed.state is FeedState.IDLE
    assert not bench.twin.machine.moving
    assert bench.twin.machine.feeds_executed == 1


@every_profile
def test_a_limit_switch(profile: str):
    bench = on_twin(profile).ready()
    bench.twin.machine.travel = Limits(-50.0, 1.0)
    assert fails(lambda: advance(bench)).code == "feed-alarm"
    assert bench.feed.state is FeedState.ALARM
    assert tells_truth(bench)


@every_profile
def test_the_port_is_pulled_out_during_a_feed(profile: str):
    bench = on_twin(profile).ready()
    bench.twin.upsets.append(Upset("die", "move"))
    assert fails(lambda: advance(bench)).code == "device-lost"
    assert bench.feed.state is FeedState.UNKNOWN
    assert isinstance(fails(lambda: advance(bench)), Unsafe)
    assert fails(bench.feed.reconnect).code == "device-lost"
    bench.port.unplugged = False
    bench.clock.sleep(1.0)
    tells = bench.feed.profile.state.homed is not None
    assert bench.feed.reconnect() is (FeedState.READY if tells else FeedState.IDLE)
    assert bench.twin.machine.feeds_executed == 1
    assert bench.feed.position_nm() == pytest.approx(2000, abs=2)


@every_profile
def test_power_off_and_on_between_feeds(profile: str):
    bench = on_twin(profile).ready()
    advance(bench)
    feeds = bench.twin.machine.feeds_executed
    bench.twin.power_cycle()
    error = fails(lambda: bench.feed.advance_to(4000))
    assert error.code == "feed-astray"
    assert "power went off" in error.why
    assert bench.feed.state is FeedState.UNKNOWN
    assert bench.twin.machine.feeds_executed == feeds


@every_profile
def test_words_in_the_other_order(profile: str):
    bench = on_twin(profile)
    bench.twin.drive.word_order = "little"
    bench.twin.power_cycle()
    bench.twin.machine.zero_here()
    bench.twin.machine.move_to(1000, 200.0)
    bench.clock.sleep(20.0)
    error = fails(bench.feed.identify)
    assert error.code == "feed-word-order"
    assert 'word_order = "little"' in error.message()
    assert isinstance(fails(lambda: advance(bench)), Unsafe)
    assert bench.twin.machine.feeds_executed == 1


@pytest.mark.parametrize(
    ("profile", "code"),
    [
        ("leadshine-rs", "feed-word-order"),  # from its pulses of a turn
        ("plc-mailbox", "feed-word-order"),  # from its mark
        ("oriental-az", "feed-word-order"),  # from its way home
        ("applied-motion-scl", "feed-word-order"),
    ],
)
def test_words_in_the_other_order_at_zero_where_both_look_alike(profile: str, code: str):
    bench = on_twin(profile)
    bench.twin.drive.word_order = "little"
    bench.twin.power_cycle()

    def begin() -> None:
        bench.ready()
        advance(bench)

    assert fails(begin).code == code
    bench.clock.sleep(1.0)
    assert bench.twin.machine.moves_executed == 0
    assert not bench.twin.machine.moving


@pytest.mark.parametrize(
    ("profile", "code"),
    [
        ("oriental-az", "feed-not-executed"),  # it finds no trigger in the swapped words
        ("applied-motion-scl", "feed-astray"),  # stopped as soon as it is seen where it was not sent
    ],
)
def test_words_in_the_other_order_when_not_even_the_way_home_showed_it(profile: str, code: str):
    bench = on_twin(profile)
    bench.twin.drive.word_order = "little"
    bench.twin.machine.home()
    bench.clock.sleep(10.0)
    assert bench.twin.machine.homed
    bench.ready()
    assert bench.twin.machine.counts == 0
    assert fails(lambda: advance(bench)).code == code
    bench.clock.sleep(1.0)
    assert bench.twin.machine.position_um < 10
    assert not bench.twin.machine.moving


@every_profile
def test_another_unit_number(profile: str):
    bench = on_twin(profile, unit=9)
    bench.twin._server.units = {3: bench.twin.drive}
    assert fails(bench.feed.identify).code == "device-silent"
    assert isinstance(fails(lambda: advance(bench)), Unsafe)
    assert bench.twin.machine.moves_executed == 0


@every_profile
def test_no_motion_before_the_reference(profile: str):
    bench = on_twin(profile)
    bench.feed.identify()
    assert bench.feed.state is FeedState.IDLE
    assert isinstance(fails(lambda: advance(bench)), Unsafe)
    assert bench.twin.machine.moves_executed == 0


@every_profile
def test_halt_in_the_middle_of_a_feed(profile: str):
    bench = on_twin(profile).ready()

    def once_it_moves() -> None:
        if bench.twin.machine.position_um > 0.5:
            bench.port.on_write = lambda: None
            bench.feed._drive.halted.set()
            bench.twin.machine.stop()

    bench.port.on_write = once_it_moves
    assert fails(lambda: advance(bench)).code == "feed-halted"
    assert bench.feed.state is FeedState.IDLE
    assert tells_truth(bench)
    assert bench.twin.machine.position_um < 2.0


@every_profile
@pytest.mark.parametrize("kind", SPOILT)
def test_the_reply_to_a_cut_is_lost(profile: str, kind: Kind):
    bench = on_twin(profile).ready()
    advance(bench)
    bench.twin.upsets.append(Upset(kind, "cut"))
    cut(bench)
    assert bench.twin.plc.knife.strokes_begun == bench.twin.plc.knife.cuts_executed == 1
    assert bench.feed.state is FeedState.READY
    assert bench.feed.knife_state() is KnifeState.CLEAR


@every_profile
@pytest.mark.parametrize("kind", UNHEARD)
def test_a_cut_that_is_not_executed(profile: str, kind: Kind):
    bench = on_twin(profile).ready()
    bench.twin.upsets.append(Upset(kind, "cut"))
    assert fails(lambda: cut(bench)).code == "feed-not-executed"
    assert bench.twin.plc.knife.strokes_begun == 0
    assert bench.feed.state is FeedState.READY
    cut(bench)
    assert bench.twin.plc.knife.cuts_executed == 1


@every_profile
def test_the_knife_jams(profile: str):
    bench = on_twin(profile).ready()
    feeds = bench.twin.machine.feeds_executed
    bench.twin.plc.knife.jam = True
    assert fails(lambda: cut(bench)).code == "knife-failed"
    assert bench.feed.knife_state() is KnifeState.CLEAR
    assert bench.feed.state is FeedState.IDLE
    assert bench.twin.machine.feeds_executed == feeds
    assert bench.twin.plc.knife.strokes_begun == 1


@every_profile
def test_the_knife_jams_and_does_not_come_out(profile: str):
    bench = on_twin(profile).ready()
    bench.twin.plc.knife.jam = bench.twin.plc.knife.jam_holds = True
    error = fails(lambda: cut(bench))
    assert error.code == "knife-failed"
    assert any("not clear" in note for note in error.__notes__)
    assert bench.feed.resolve() is FeedState.IDLE
    assert isinstance(fails(lambda: advance(bench)), Unsafe)
    assert fails(bench.feed.abort).code == "knife-failed"


@every_profile
def test_the_counter_of_cuts_stands_still(profile: str):
    bench = on_twin(profile).ready()
    bench.twin.plc.knife.counter_dead = True
    error = fails(lambda: cut(bench))
    assert error.code == "feed-undecided"
    assert "its counter went from 0 to 0" in error.why
    assert bench.feed.state is FeedState.UNKNOWN
    assert bench.feed.knife_state() is KnifeState.CLEAR
    assert isinstance(fails(lambda: cut(bench)), Unsafe)
    assert bench.twin.plc.knife.strokes_begun == 1


@every_profile
def test_the_port_is_pulled_out_during_a_cut(profile: str):
    bench = on_twin(profile).ready()
    bench.twin.upsets.append(Upset("die", "cut"))
    assert fails(lambda: cut(bench)).code == "device-lost"
    assert bench.feed.state is FeedState.UNKNOWN
    bench.port.unplugged = False
    bench.clock.sleep(5.0)
    bench.feed.reconnect()
    assert bench.feed.state is FeedState.IDLE
    bench.feed.abort()
    assert bench.feed.knife_state() is KnifeState.CLEAR
    assert bench.twin.plc.knife.strokes_begun == 1


@every_profile
def test_a_knife_left_in_the_window(profile: str):
    bench = on_twin(profile).ready()
    knife = bench.twin.plc.knife
    knife.window_um, knife.speed_um_s = (10.0, 0.0), 300.0
    knife.cut()
    bench.clock.sleep(5.0)
    assert fails(lambda: advance(bench)).code == "knife-not-clear"
    assert bench.twin.machine.feeds_executed == 0


@every_profile
def test_settings_the_knife_does_not_keep(profile: str, monkeypatch: pytest.MonkeyPatch):
    bench = on_twin(profile).ready()
    plc = bench.twin.plc
    monkeypatch.setattr(plc, "obey", lambda touched: plc.words.update({12: 0, 13: 1}))
    error = fails(lambda: cut(bench))
    assert error.code == "knife-failed"
    assert "Nothing was cut" in error.what
    assert plc.knife.strokes_begun == 0


def test_the_door_is_open():
    bench = on_twin("plc-mailbox").ready()
    bench.twin.plc.door_closed = False
    assert "'door closed' is open" in fails(lambda: advance(bench)).what
    assert bench.twin.machine.feeds_executed == 0


def test_the_emergency_stop():
    bench = on_twin("plc-mailbox").ready()

    def press() -> None:
        bench.twin.plc.estop_released &= bench.twin.machine.position_um < 0.5

    bench.port.on_write = press
    assert fails(lambda: advance(bench)).code == "feed-estop"
    assert bench.feed.state is FeedState.ESTOPPED
    assert tells_truth(bench)


@every_profile
def test_halt_on_a_line_that_loses_the_first_reply_still_stops_the_knife(profile: str):
    bench = on_twin(profile).ready()
    knife = bench.twin.plc.knife
    knife.window_um, knife.speed_um_s = (300.0, 0.0), 30.0
    knife.cut()
    bench.clock.sleep(1.0)
    bench.twin.upsets.append(Upset("drop", "write"))
    bench.feed.halt()  # sent again, since an answer is missing
    assert bench.feed.knife_state() is KnifeState.IN_WINDOW
    bench.clock.sleep(60.0)
    assert knife.cuts_executed == 0


@every_profile
def test_a_halt_into_a_conversation_takes_nothing_from_it(profile: str):
    bench = on_twin(profile).ready()
    sent = Event()
    bench.port.on_write = sent.set
    halting = Thread(target=bench.feed.halt)
    with bench.feed._bus._conversation:
        bench.port.coming = [(0.0, b"for another")]
        halting.start()
        assert sent.wait(PATIENCE_S)
        assert bench.port.coming[0] == (0.0, b"for another")
    halting.join()


@every_profile
def test_a_silent_line_is_no_position(profile: str):
    bench = on_twin(profile).ready()
    bench.twin.upsets.append(Upset("deaf", "any", times=1000))
    error = fails(bench.feed.position_nm)
    assert isinstance(error, LinkError)
    assert error.code == "device-silent"
