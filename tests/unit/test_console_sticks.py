"""What moves the stage at a rate, and everything that must stop it."""

import os
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import DeviceError
from display.console.moving import Jogger
from display.console.spacemouse import SpaceMouse, found
from display.console.sticks import WATCH_S, Scripted, Stick, shaped

TICK_S = 1 / 32


def driven(script, *, seconds=1.0, until_s=float("inf"), why_not=lambda _: "", on_move=lambda *_: None, top_um_s=100.0):
    """Tick a stick over a script; return it and the moves it made, (when, µm), each answered at once."""
    stick, jogger, moves = Stick(top_um_s), Jogger(), []
    stick.use(Scripted(script, until_s))
    for k in range(int(seconds / TICK_S)):
        now_s = k * TICK_S
        stick.tick(jogger, now_s, why_not(now_s))
        if by_um := jogger.due_um():
            moves.append((now_s, by_um))
            on_move(stick, jogger, len(moves))
            jogger.done()
    return stick, moves


READY = (0.0, 0.0, False)


def test_the_stage_goes_as_fast_as_the_stick_is_pushed_and_only_while_the_button_is_held():
    _, moves = driven([READY, (0.25, 1.0, True), (0.75, 1.0, False)])
    assert sum(by for _, by in moves) == pytest.approx(50.0, abs=0.1)
    assert all(0.25 <= when < 0.75 for when, _ in moves)
    _, down = driven([READY, (0.25, -0.5, True)])
    assert sum(by for _, by in down) == pytest.approx(75 * shaped(-0.5), abs=0.1)


def test_a_device_that_falls_silent_moves_nothing_after_the_watchdog_and_not_again_before_its_button_was_let_go():
    stick, moves = driven([READY, (0.25, 1.0, True), (0.5, None, True), (1.0, 1.0, True)], seconds=2.0)
    assert max(when for when, _ in moves) <= 0.5 + WATCH_S
    assert "let its button go" in stick.still
    _, moves = driven([READY, (0.25, 1.0, True), (0.5, None, True), (1.0, 0.0, False), (1.2, 1.0, True)], seconds=2.0)
    assert max(when for when, _ in moves) > 1.2


def test_an_unplugged_device_stops_at_once():
    stick, moves = driven([READY, (0.25, 1.0, True)], until_s=0.5)
    assert max(when for when, _ in moves) < 0.5
    assert "gone" in stick.still


def test_a_button_held_from_the_start_moves_nothing():
    assert driven([(0.0, 1.0, True)])[1] == []


@pytest.mark.parametrize("why", ["a run has the devices", "the console's window is not in front"])
def test_what_speaks_against_motion_stops_it_until_the_button_was_let_go(why):
    stick, moves = driven([READY, (0.25, 1.0, True)], why_not=lambda now_s: why if 0.5 <= now_s < 0.6 else "")
    assert max(when for when, _ in moves) < 0.5
    assert "let its button go" in stick.still


def test_a_stop_or_a_refusal_blocks():
    def refuse(stick, jogger, count):
        if count == 3:
            jogger.forget()
            stick.block()

    assert len(driven([READY, (0.25, 1.0, True)], on_move=refuse)[1]) == 3


def test_a_slow_stage_is_never_asked_for_more_than_the_watchdog_allows():
    stick, jogger = Stick(100.0), Jogger()
    stick.use(Scripted([READY, (0.1, 1.0, True)]))
    jogger.under_way = True
    for k in range(64):
        stick.tick(jogger, k * TICK_S, "")
    assert jogger.wanted_um == pytest.approx(100 * WATCH_S)
    stick.tick(jogger, 10.0, "STOP is latched")
    assert jogger.wanted_um == 0


def test_a_console_that_stood_still_makes_no_long_move_of_it():
    stick, jogger = Stick(100.0), Jogger()
    stick.use(Scripted([READY, (0.1, 1.0, True)]))
    for now_s in (0.0, 0.1, 5.0):
        stick.tick(jogger, now_s, "")
    assert jogger.wanted_um <= 100 * WATCH_S


@given(st.floats(-1.5, 1.5))
def test_small_ways_of_the_stick_are_fine_ways_of_the_stage(rate):
    made = shaped(rate)
    assert abs(made) <= min(abs(rate), 1.0)
    assert made * rate >= 0
    assert shaped(0.1) == shaped(-0.1) == 0


def report(down):
    return struct.pack("<Bhhh", 1, 5, -7, down)


@pytest.fixture
def mouse(tmp_path):
    path = tmp_path / "hidraw0"
    os.mkfifo(path)
    held = SpaceMouse(path)
    writer = os.open(path, os.O_WRONLY)
    yield held, writer
    held.close()
    if writer >= 0:
        os.close(writer)


def test_a_3d_mouse_tells_its_way_and_its_button(mouse):
    device, writer = mouse
    os.write(writer, bytes([3, 1, 0]))
    assert device.read(4.0).held
    os.write(writer, report(-350))
    told = device.read(5.0)
    assert (told.rate, told.held, told.told_s) == (1.0, True, 5.0)
    assert device.read(5.5).told_s == 5.0  # displaced and silent: the watchdog sees how old that is
    os.write(writer, report(0) + b"\x00" * 6)
    assert (device.read(6.0).rate, device.read(7.0).told_s) == (0.0, 7.0)


@given(st.binary(min_size=1, max_size=20))
def test_no_report_breaks_it(report):
    device = SpaceMouse.__new__(SpaceMouse)
    device._rate, device._held, device._told_s = 0.0, False, 0.0
    device._take(report, 1.0)
    assert -1 <= device._rate <= 1


def test_3d_mice_are_found_by_their_maker(tmp_path):
    for name, told in {
        "hidraw0": "HID_ID=0003:0000046D:0000C52B\n",  # a mouse by the same maker
        "hidraw1": "DRIVER=hid-generic\nHID_ID=0003:0000256F:0000C635\n",
        "hidraw2": "HID_ID=0003:0000046D:0000C626\n",
        "hidraw3": "HID_ID=nonsense\n",
    }.items():
        (tmp_path / name / "device").mkdir(parents=True)
        (tmp_path / name / "device" / "uevent").write_text(told)
    (tmp_path / "hidraw4").mkdir()
    assert [path.name for path in found(tmp_path)] == ["hidraw1", "hidraw2"]
    assert found(tmp_path / "none") == []
    with pytest.raises(DeviceError, match="cannot be opened"):
        SpaceMouse(tmp_path / "none")


def test_the_axis_of_a_pad_is_learnt_by_pushing_it():
    pytest.importorskip("imgui_bundle", exc_type=ImportError)
    from display.console.gamepad import Mapping, learnt

    rest = [0.0, 0.1, -1.0]
    assert learnt(rest, [0.2, -0.1, -1.0], [0, 1]) is None
    assert learnt(rest, [0.0, -0.9, -1.0], [0, 0]) is None
    assert learnt(rest, [0.0, -0.9, -1.0], [0, 1]) == Mapping(1, 1, flipped=True)
    found = learnt(rest, [0.0, 0.1, 1.0], [1, 0])
    assert Mapping.of(found.stored()) == found == Mapping(2, 0, flipped=False)
