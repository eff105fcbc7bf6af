"""The emitter's codec and driver, and the spec, on simulated time."""

import contextlib
import json
from dataclasses import astuple, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from devices.drivers.open3d import Open3dGlasses
from devices.errors import DeviceError, LimitError, MalformedReply
from devices.glasses_spec import GlassesSpec
from devices.wire import open3d
from devices.wire.open3d import DriveMode, Settings
from sim.clock import SimClock
from sim.controllers.open3d import Emitter
from sim.usb_wire import UsbWire

FACTORY = Settings(2, 500, 7000, 30, 6500, 10, 128, 0, 0, 0, 0, 0, 0, 32, 0, 8333, 0)
TOLD = b"parameters 22,2,500,7000,30,6500,10,128,0,0,0,0,0,0,32,0,8333,0\r\n"
numbers = st.tuples(*[st.integers(0, 65535)] * 17)


def spec(**keys):
    return GlassesSpec.model_validate({"driver": "open3d", "port": "x", **keys})


def opened(emitter_keys=None, wire_keys=None, **keys):
    clock = SimClock(100.0)
    twin = Emitter(clock, **(emitter_keys or {}))
    glasses = Open3dGlasses(UsbWire(twin.feed, clock, **(wire_keys or {})), spec(**keys), clock)
    glasses.prepare()
    return glasses, twin, clock


def emitter_now(twin):
    return open3d.query().decode(twin.feed(b"0\n")[-1].removesuffix(open3d.TERMINATOR))


def test_settings_have_names():
    assert open3d.query().decode(TOLD) == FACTORY
    assert open3d.store(FACTORY).payload == b"0,2,500,7000,30,6500,10,128,0,0,0,0,0,0,32,0,8333,0\n"
    assert not open3d.store(FACTORY).repeatable
    assert (open3d.turn("left"), open3d.turn("right")) == (b"9,0\n", b"9,1\n")
    assert open3d.view(open3d.Glasses.LEFT_TO_BOTH).payload == b"7,2\n"
    assert open3d.stream(on=True).payload == b"10,1\n"


@given(numbers)
def test_settings_survive_the_wire(values):
    settings = Settings(*values)
    reply = f"parameters 22,{','.join(map(str, astuple(settings)))}\r\n".encode()
    assert open3d.query().decode(reply) == settings


def test_events_and_the_banner_are_no_replies():
    assert (
        open3d.query().decode(b"+d 1\r\neeprom read_settings\r\ninit complete\r\n" + TOLD + b"+stats x:1\r\n")
        == FACTORY
    )
    open3d.save().decode(b"+d 0\r\n")


@given(st.binary(max_size=120))
def test_any_bytes_decode_or_are_malformed(data):
    for request in (open3d.query(), open3d.save(), open3d.store(FACTORY)):
        with contextlib.suppress(MalformedReply):
            assert request.decode(data) is None, "nothing but settings means anything, and these are none"


def test_another_firmware_is_named():
    with pytest.raises(MalformedReply, match="version 19"):
        open3d.query().decode(TOLD.replace(b"22,", b"19,"))


def test_the_file_s_settings_reach_the_emitter_and_not_its_eeprom():
    _, twin, _ = opened(family="sharp", delay_us=700, open_us=5600, swap=True)
    now = emitter_now(twin)
    assert (now.ir_protocol, now.frame_delay_us, now.frame_duration_us, now.flip_eyes) == (3, 700, 5600, 1)
    assert twin.saves == 0


def test_what_the_file_leaves_open_stays_as_it_is():
    _, twin, _ = opened()
    assert emitter_now(twin) == FACTORY


def test_nothing_is_ever_said_at_1200_baud():
    assert open3d.BAUD == 115200
    with pytest.raises(ValidationError):
        spec(baud=1200)


def test_a_setting_that_is_not_taken():
    glasses, _, _ = opened()
    with pytest.raises(DeviceError, match="signal_spacing_us 300 became 44") as caught:
        glasses.store(replace(FACTORY, signal_spacing_us=300))
    assert caught.value.code == "glasses-settings"
    assert glasses.settings().signal_spacing_us == 44


def test_swap_and_save_are_what_a_person_asked_for():
    glasses, twin, _ = opened()
    assert glasses.swap_eyes().flip_eyes == 1
    twin.power_cycle()
    assert glasses.settings().flip_eyes == 0
    glasses.swap_eyes()
    glasses.save()
    twin.power_cycle()
    assert glasses.settings().flip_eyes == 1
    assert twin.saves == 1
    glasses.set_view(open3d.Glasses.RIGHT_TO_BOTH)
    assert twin.view == 1


def test_a_lock_begins_with_a_flip_of_the_left_eye():
    glasses, twin, clock = opened(wire_keys={"jitter_s": 0.0})
    flip_s = clock.now() - 0.123
    glasses.lock_to(120.0, flip_s)
    (lock,) = glasses.timing.locks
    assert abs(lock.phase_s(flip_s)) < 1e-6
    first = twin.edges()[0]
    assert first.eye == "left"
    assert first.at_ns / 1e9 - 500e-6 == pytest.approx(lock.left_s, abs=1e-6)
    assert glasses.timing.locked


def test_a_lock_that_fits_is_left_alone_and_one_that_does_not_is_made_anew():
    glasses, _, clock = opened(wire_keys={"jitter_s": 0.0}, relock_s=1.0)
    flip_s = clock.now()
    glasses.lock_to(100.0, flip_s)
    for _ in range(3):
        clock.sleep(0.2)
        glasses.lock_to(100.0, flip_s)
    assert len(glasses.timing.locks) == 1
    glasses.lock_to(100.0, flip_s + 0.01)  # the display lost a frame: left is now where right was
    assert len(glasses.timing.locks) == 2
    clock.sleep(1.1)
    glasses.lock_to(100.0, flip_s + 0.01)
    assert len(glasses.timing.locks) == 3, "due again"
    glasses.lock_to(120.0, flip_s)
    assert len(glasses.timing.locks) == 4, "another rate"


def test_showing_ends_a_free_run_and_notes_each_turn():
    glasses, twin, clock = opened()
    glasses.lock_to(120.0, clock.now())
    glasses.show("left")
    assert not glasses.timing.locked
    assert emitter_now(twin).drive_mode == DriveMode.PC_SERIAL
    clock.sleep(0.01)
    glasses.show("right")
    sent, got = glasses.timing.edges, twin.edges()[-2:]
    assert [edge.eye for edge in sent] == [edge.eye for edge in got] == ["left", "right"]
    for ours, theirs in zip(sent, got, strict=True):
        assert 0.2e-3 <= (theirs.at_ns - ours.at_ns) / 1e9 - 500e-6 <= 1.2e-3
    assert glasses.timing.sent == 2


def test_both_open_and_close_end_all_turns():
    glasses, twin, clock = opened()
    for end in (glasses.both_open, glasses.close):
        glasses.lock_to(120.0, clock.now())
        end()
        count = len(twin.edges())
        clock.sleep(1.0)
        assert len(twin.edges()) == count


def test_an_emitter_that_lost_its_power_gets_its_settings_again():
    glasses, twin, clock = opened(delay_us=900)
    glasses.show("left")
    twin.power_cycle()
    glasses.show("right")
    assert len(twin.edges()) == 1, "it forgot that the host gives the turns"
    clock.sleep(0.01)
    glasses.show("right")
    assert emitter_now(twin).frame_delay_us == 900
    assert twin.edges()[-1].eye == "right"


@pytest.mark.parametrize("refresh_hz", [0.0, 29.9, 400.0, float("nan"), -120.0])
def test_a_rate_that_no_display_has(refresh_hz):
    glasses, twin, clock = opened()
    with pytest.raises(LimitError, match="Nothing was sent"):
        glasses.lock_to(refresh_hz, clock.now())
    assert twin.edges() == []


def test_a_busy_computer_is_told_from_a_lock():
    glasses, _, clock = opened()
    glasses._quickest_s = -1.0
    with pytest.raises(DeviceError, match="not locked") as caught:
        glasses.lock_to(120.0, clock.now())
    assert caught.value.code == "glasses-unlocked"
    assert not glasses.timing.locked


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"driver": "open3d", "left": ["rts"]}, "left: not for the driver 'open3d'"),
        ({"driver": "modem-lines", "delay_us": 3}, "delay_us: not for the driver 'modem-lines'"),
        ({"driver": "modem-lines", "left": ["rts"], "right": ["rts"]}, "must differ"),
        ({"driver": "modem-lines", "port": "socket://h:1"}, "quick enough"),
        ({"driver": "modem-lines", "max_hold_ms": 5000.0}, "less than or equal to 1000"),
        ({"driver": "open3d", "refresh_hz": 5.0}, "greater than or equal to 30"),
        ({"driver": "elsa"}, "'open3d' or 'modem-lines'"),
    ],
)
def test_what_a_file_may_not_say(keys, words):
    with pytest.raises(ValidationError, match=words):
        GlassesSpec.model_validate({"port": "x", **keys})


def test_a_family_has_the_emitter_s_number():
    for number, family in enumerate(GlassesSpec.model_json_schema()["properties"]["family"]["anyOf"][0]["enum"]):
        assert spec(family=family).ir_protocol == number
    assert json.loads(spec().model_dump_json())["drive"] == "free-run"
