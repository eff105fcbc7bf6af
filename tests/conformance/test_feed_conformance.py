"""What every feed must do: each driver over its twin, on simulated time and on the three kinds of real wire."""

from __future__ import annotations

import threading
from contextlib import ExitStack, closing
from typing import TYPE_CHECKING

import pytest
from feeds import PROFILES, on_twin, spec_of

from devices.clock import SystemClock
from devices.drivers.feed import ModbusFeed, open_feed
from devices.errors import DeviceBusy, DeviceError, LimitError, Unsafe
from devices.feed_values import FeedState, KnifeState
from devices.protocols import Feed
from devices.registry import DeviceContext
from devices.transport.modbus import frame
from devices.wire.modbus_map import RegisterRead
from sim.feed_line import FeedTwin, Upset, build_feed_twin
from sim.serial_line import SerialLine

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

WIRES = ["rtu", "rtu_over_tcp", "tcp"]
FAST_BAUD = 4_000_000
every_profile = pytest.mark.parametrize("profile", PROFILES)


@pytest.fixture
def on_wire() -> Iterator[object]:
    with ExitStack() as running:

        def start(profile: str, wire: str, **changes: object) -> tuple[ModbusFeed, FeedTwin, SerialLine]:
            clock = SystemClock()
            table = {"link": wire, "baud": FAST_BAUD, "timeout_s": 0.15, **changes}
            twin = build_feed_twin(spec_of(profile, **table), clock)
            line = SerialLine(twin.feed_upset, FAST_BAUD, clock, misheard=b"")
            running.callback(line.close)
            port = line.port if wire == "rtu" else line.tcp_url.removeprefix("socket://")
            feed = open_feed(spec_of(profile, **(table | {"port": port})), DeviceContext(clock))
            running.callback(feed.close)
            feed.home()
            return feed, twin, line

        yield start


@every_profile
def test_it_is_a_feed(profile: str):
    bench = on_twin(profile).ready()
    assert isinstance(bench.feed, Feed)
    assert bench.feed.thickness_limits == (20, 10_000)
    assert bench.feed.state is FeedState.READY
    assert bench.feed.knife_state() is KnifeState.CLEAR
    assert bench.feed.cut_count() == 0


@every_profile
def test_sections_add_up_without_rounding(profile: str):
    """150 sections of 333.3 nm: 0.1 count each would be 15 counts in the end."""
    bench = on_twin(profile).ready()
    for section in range(1, 151):
        bench.feed.advance_to(section * 333.3)
    count_nm = 1000 / bench.feed.profile.axis.counts_per_um
    assert bench.feed.position_nm() == pytest.approx(150 * 333.3, abs=count_nm)
    assert bench.twin.machine.position_um == pytest.approx(150 * 0.3333, abs=count_nm / 1000)
    assert bench.twin.machine.feeds_executed == 150


@every_profile
def test_lost_motion_is_taken_out(profile: str):
    bench = on_twin(profile, backlash_um=3.0).ready()
    bench.twin.machine.axis.backlash_um = 2.0
    for depth_nm in (10_000, 20_000, 21_000):
        bench.feed.approach_to(depth_nm)
    bench.feed.approach_to(12_000)
    load_um = bench.twin.machine.axis.load_um(bench.clock.now())
    assert load_um == pytest.approx(12.0, abs=0.01)


@every_profile
def test_a_section_is_cut_at_its_depth(profile: str):
    bench = on_twin(profile).ready()
    for depth_nm in (1000, 3000, 3500):
        bench.feed.advance_to(depth_nm)
        bench.feed.arm()
        bench.feed.cut()
        assert bench.feed.position_nm() == pytest.approx(depth_nm, abs=2)
    assert bench.twin.machine.removed_um == pytest.approx([0.0, 2.0, 0.5], abs=0.003)
    assert bench.feed.cut_count() == 3
    assert len(bench.allowed) == 3


@every_profile
@pytest.mark.parametrize("depth_nm", [-1.0, 10.0, 10_100.0, 5_000_000.0, float("nan")])
def test_a_wrong_thickness_sends_nothing(profile: str, depth_nm: float):
    bench = on_twin(profile).ready()
    sent = len(bench.port.sent)
    with pytest.raises(LimitError, match="Nothing moved"):
        bench.feed.advance_to(depth_nm)
    assert len(bench.port.sent) == sent


@every_profile
def test_no_cut_unless_armed_within_ten_seconds(profile: str):
    bench = on_twin(profile).ready()
    with pytest.raises(Unsafe, match="not armed"):
        bench.feed.cut()
    bench.feed.arm()
    bench.clock.sleep(10.5)
    with pytest.raises(Unsafe, match="more than 10 s ago"):
        bench.feed.cut()
    bench.feed.arm()
    bench.feed.cut()
    with pytest.raises(Unsafe, match="not armed"):
        bench.feed.cut()
    assert bench.twin.plc.knife.strokes_begun == 1


@every_profile
def test_no_cut_while_the_microscope_is_in_the_way(profile: str):
    bench = on_twin(profile).ready()

    def in_the_way() -> None:
        raise Unsafe("z stage: not parked.")

    bench.feed.allow_cuts(in_the_way)
    bench.feed.arm()
    with pytest.raises(Unsafe, match="not parked"):
        bench.feed.cut()
    assert bench.twin.plc.knife.strokes_begun == 0
    assert bench.feed.state is FeedState.READY


def test_no_cut_by_default():
    bench = on_twin("plc-mailbox").ready()
    feed = ModbusFeed(bench.feed._bus, spec_of("plc-mailbox"), bench.clock)
    feed.resolve()
    feed.arm()
    with pytest.raises(Unsafe, match="nothing vouches"):
        feed.cut()


@every_profile
def test_halt_stops_at_once_and_reaches_clear_without_a_feed(profile: str):
    bench = on_twin(profile).ready()
    feeds = bench.twin.machine.feeds_executed

    def in_the_middle_of_the_stroke() -> None:
        if bench.twin.plc.knife.strokes_begun:
            bench.port.on_write = lambda: None
            bench.feed._drive.halted.set()

    bench.port.on_write = in_the_middle_of_the_stroke
    bench.feed.arm()
    with pytest.raises(DeviceError) as caught:
        bench.feed.cut()
    assert caught.value.code == "feed-halted"
    bench.feed.halt()
    assert bench.feed.knife_state() is KnifeState.IN_WINDOW
    bench.feed.abort()
    assert bench.feed.knife_state() is KnifeState.CLEAR
    assert bench.feed.resolve() is FeedState.READY
    assert bench.twin.machine.feeds_executed == feeds


@every_profile
def test_a_halt_at_rest_does_not_end_the_next_stroke_and_one_right_before_it_lets_none_begin(profile: str):
    bench = on_twin(profile).ready()
    knife = bench.twin.plc.knife
    bench.feed.halt()
    bench.feed.arm()
    bench.feed.cut()
    assert (knife.strokes_begun, knife.cuts_executed) == (1, 1)

    def halt_when_it_counts() -> int:
        bench.feed._drive.halted.set()
        return 1

    bench.feed._knife.count = halt_when_it_counts
    bench.feed.arm()
    with pytest.raises(DeviceError, match="Nothing was cut") as caught:
        bench.feed.cut()
    assert caught.value.code == "feed-halted"
    assert knife.strokes_begun == 1


@every_profile
def test_an_inverted_feed(profile: str):
    bench = on_twin(profile, invert=True, backlash_um=0.5).ready()
    bench.twin.machine.travel = type(bench.twin.machine.travel)(-5000.0, 50.0)
    bench.feed.advance_to(4000)
    assert bench.twin.machine.position_um == pytest.approx(-4.0)
    assert bench.feed.position_nm() == pytest.approx(4000)
    bench.feed.arm()
    bench.feed.cut()
    assert bench.feed.position_nm() == pytest.approx(4000)


@pytest.mark.parametrize("profile", ["leadshine-rs", "oriental-az"])
def test_a_jog_is_reminded_and_ends(profile: str):
    bench = on_twin(profile).ready()
    bench.feed.jog(+1, 1.0)
    bench.clock.sleep(1.0)
    assert not bench.twin.machine.moving
    assert bench.twin.machine.position_um == pytest.approx(20.0, rel=0.1)
    assert bench.feed.state is FeedState.READY


def test_a_drive_without_jog_says_so():
    with pytest.raises(Unsafe, match="cannot be jogged"):
        on_twin("plc-mailbox").ready().feed.jog(1, 1.0)


def test_a_jog_nobody_reminds_of_stops_by_itself():
    bench = on_twin("leadshine-rs").ready()
    bench.feed._drive.registers.do(bench.feed.profile.jog.plus)
    bench.clock.sleep(0.2)
    bench.feed.position_nm()
    bench.clock.sleep(1.0)
    assert not bench.twin.machine.moving


def test_a_polisher_records_what_was_measured():
    bench = on_twin("leadshine-rs", kind="polisher", knife=None).ready()
    bench.feed.advance_to(2000)
    bench.feed.record_removal(1830.0)
    assert bench.feed.removed_nm == [1830.0]
    assert bench.feed.knife_state() is KnifeState.ABSENT
    bench.feed.resolve()
    with pytest.raises(Unsafe, match="no knife"):
        bench.feed.cut()


def test_the_drive_gets_soft_limits_of_its_own():
    bench = on_twin("leadshine-rs").ready()
    assert (bench.twin.drive.number(0x6006), bench.twin.drive.number(0x6008)) == (2_000_000, 0)
    assert bench.twin.drive.words[0x6000] == 0x02


def test_the_done_bit_of_the_move_before_is_not_believed():
    """The leadshine still says "path done" right after the write: a slow start is not an arrival."""
    bench = on_twin("leadshine-rs").ready()
    drive, started = bench.twin.drive, []
    go = drive._run_path

    def slow_start() -> None:
        started.append(bench.clock.now())

    def show() -> None:
        if started and bench.clock.now() - started[0] > 0.015:
            started.clear()
            go()
        type(drive).show(drive)

    drive._run_path, drive.show = slow_start, show
    bench.feed.advance_to(2000)
    assert bench.twin.machine.position_um == pytest.approx(2.0)


@every_profile
@pytest.mark.parametrize("wire", WIRES)
def test_a_lost_reply_on_a_real_wire_is_one_feed(on_wire, profile: str, wire: str):
    """Done when 2 of the issue, with the bytes on a pseudo-terminal and on TCP."""
    feed, twin, _ = on_wire(profile, wire)
    twin.upsets.append(Upset("drop", "move"))
    feed.advance_to(2000)
    assert (twin.machine.feeds_executed, twin.machine.moves_executed) == (1, 1)
    assert twin.machine.position_um == pytest.approx(2.0)
    assert feed.position_nm() == pytest.approx(2000, abs=2)


def test_a_line_that_is_pulled_out_and_put_back(on_wire):
    feed, twin, line = on_wire("plc-mailbox", "rtu_over_tcp")
    feed.advance_to(2000)
    line.unplug()
    with pytest.raises(DeviceError) as caught:
        feed.advance_to(4000)
    assert caught.value.code == "device-lost"
    line.plug()
    feed.reconnect()
    assert feed.position_nm() == pytest.approx(2000)
    feed.advance_to(4000)
    assert twin.machine.feeds_executed == 2


def test_a_stop_breaks_into_a_conversation(on_wire):
    """The line is silent, a reading waits for its answer: the stop goes out all the same."""
    feed, twin, _ = on_wire("leadshine-rs", "rtu", timeout_s=1.0)
    heard = threading.Event()
    stop = twin.machine.stop

    def stopped() -> None:
        stop()
        heard.set()

    twin.machine.stop = stopped
    asked = threading.Event()
    twin.upsets.append(Upset("deaf", "read"))
    reply = twin._reply

    def answer(unit: int, pdu: bytes):
        asked.set()
        return reply(unit, pdu)

    twin._reply = answer
    reading = threading.Thread(target=feed.position_nm)
    reading.start()
    assert asked.wait(10)
    feed._drive.stop()
    assert heard.wait(10)
    reading.join()


@every_profile
def test_a_stop_that_reads_the_answer_to_an_earlier_question_is_sent_again_and_is_no_failure(profile: str):
    bench = on_twin(profile).ready()
    stops: list[None] = []
    bench.twin.machine.stop = lambda: stops.append(None)

    def an_old_answer_comes_first() -> None:
        bench.port.on_write = lambda: None
        bench.port.coming.append((0.0, bench.twin.feed_upset(frame(1, RegisterRead(0, 1)))[0].data))

    bench.port.on_write = an_old_answer_comes_first
    bench.feed.halt()
    assert stops
    assert bench.feed.position_nm() == pytest.approx(0.0, abs=2)


def test_a_port_that_is_taken(on_wire):
    _, _, line = on_wire("leadshine-rs", "rtu")
    spec = spec_of("leadshine-rs", port=line.port, baud=FAST_BAUD)
    with pytest.raises(DeviceBusy, match="in use by another program"):
        open_feed(spec, DeviceContext(SystemClock()))


@pytest.mark.parametrize("port", ["127.0.0.1:1", "nowhere", "127.0.0.1:99999", "127.0.0.1:x"])
def test_what_is_no_address(port: str):
    with pytest.raises(DeviceError) as caught:
        open_feed(spec_of("plc-mailbox", link="tcp", port=port), DeviceContext(SystemClock()))
    assert caught.value.code == "device-missing"


@pytest.mark.parametrize("port", ["/dev/no-such-port", __file__])
def test_what_is_no_port(port: str):
    with pytest.raises(DeviceError) as caught:
        open_feed(spec_of("leadshine-rs", port=port), DeviceContext(SystemClock()))
    assert caught.value.code == "device-missing"


def test_a_transcript_is_kept(tmp_path: Path):
    clock = SystemClock()
    twin = build_feed_twin(spec_of("leadshine-rs"), clock)
    with closing(SerialLine(twin.feed_upset, FAST_BAUD, clock, misheard=b"")) as line:
        spec = spec_of("leadshine-rs", port=line.port, baud=FAST_BAUD, timeout_s=0.15)
        open_feed(spec, DeviceContext(clock, tmp_path)).close()
    lines = (tmp_path / "feed.jsonl").read_text().splitlines()
    assert '"to": "device", "bytes": "\\u0001\\u0003\\u0000\\u0000\\u0000\\u0002' in lines[0]
    assert '"to": "host"' in lines[1]


def test_a_silent_tcp_drive_hangs_up_after_a_minute_and_a_heartbeat_prevents_it():
    bench = on_twin("applied-motion-scl").ready()
    bench.twin._hangs_up = True  # on TCP only; the bytes here are RTU
    for _ in range(10):
        bench.clock.sleep(10.0)
        bench.feed.keep_alive()
    bench.feed.advance_to(1000)
    bench.clock.sleep(61.0)
    with pytest.raises(DeviceError) as caught:
        bench.feed.position_nm()
    assert caught.value.code == "device-lost"


def test_the_heartbeat_reaches_the_plc(on_wire):
    feed, twin, _ = on_wire("plc-mailbox", "tcp")
    feed.keep_alive()
    assert twin.drive.words[6] > 0
