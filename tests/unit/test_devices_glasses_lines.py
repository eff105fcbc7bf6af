"""Glasses on modem lines, the lines' self-test, and the model of the shutters."""

import itertools
import os
from contextlib import closing

import numpy as np
import pytest

from devices.clock import SystemClock
from devices.drivers.line_test import loop_test
from devices.drivers.modem_glasses import ModemGlasses, open_glasses
from devices.errors import DeviceBusy, DeviceError, LimitError
from devices.glasses_spec import GlassesSpec
from devices.glasses_timing import Edge, phase_report
from devices.registry import DeviceContext
from devices.transport.lines import ModemLines
from sim.clock import SimClock
from sim.eyewear import Shutter, leak, light
from sim.simlines import Circuit, plug

NAMES = itertools.count()


def spec(port="x", **keys):
    return GlassesSpec.model_validate({"driver": "modem-lines", "port": port, **keys})


def lines_on(circuit):
    return ModemLines(plug(f"unit-{next(NAMES)}", circuit), (), device="glasses")


def on_simulated_time(*, inverted=False, **keys):
    clock = SimClock(50.0)
    circuit = Circuit(clock, inverted=inverted)
    return ModemGlasses(lines_on(circuit), spec(**keys), clock), circuit, clock


def tended(glasses, clock, seconds):
    """Let the time pass as the driver's thread would see it."""
    end_s = clock.now() + seconds
    while clock.now() < end_s:
        clock.sleep(min(glasses.tend() + 1e-6, end_s - clock.now() + 1e-9))


@pytest.mark.parametrize(
    ("inverted", "keys", "first"),
    [
        (False, {}, "left"),
        (True, {}, "right"),
        (True, {"left": ["dtr"], "right": ["rts", "dtr"]}, "left"),
        (False, {"swap": True}, "right"),
    ],
)
def test_polarity_is_the_file_s(inverted, keys, first):
    glasses, circuit, clock = on_simulated_time(inverted=inverted, **keys)
    assert not circuit.powered
    glasses.show("left")
    clock.sleep(0.01)
    assert [edge.eye for edge in circuit.edges()] == [first]
    glasses.show("right")
    assert [edge.eye for edge in circuit.edges()][1] != first
    assert [edge.eye for edge in glasses.timing.edges] == ["left", "right"]


@pytest.mark.parametrize("max_hold_ms", [50.0, 200.0])
def test_no_state_is_held_longer_than_the_crystal_bears(max_hold_ms):
    glasses, circuit, clock = on_simulated_time(max_hold_ms=max_hold_ms)
    glasses.show("left")
    tended(glasses, clock, 2.0)
    assert len(circuit.edges()) == pytest.approx(2000 / max_hold_ms, abs=2)
    assert circuit.longest_hold_s() <= max_hold_ms / 1000 + 1e-4


def test_showing_one_eye_again_and_again_does_not_hold_it():
    glasses, circuit, clock = on_simulated_time(max_hold_ms=100.0)
    for _ in range(200):
        glasses.show("left")
        tended(glasses, clock, 0.01)
    assert circuit.longest_hold_s() <= 0.1001


def test_idle_flips_slowly_or_takes_the_power_away():
    glasses, circuit, clock = on_simulated_time()
    glasses.both_open()
    tended(glasses, clock, 1.0)
    assert circuit.longest_hold_s() <= 0.0201
    assert len(circuit.edges()) == pytest.approx(50, abs=2)
    glasses, circuit, clock = on_simulated_time(idle="off")
    glasses.show("left")
    clock.sleep(0.01)
    glasses.both_open()
    tended(glasses, clock, 1.0)
    assert not circuit.powered
    assert len(circuit.edges()) == 1


def test_a_free_run_keeps_the_turns_of_the_display():
    glasses, circuit, clock = on_simulated_time()
    flip_s = clock.now() - 0.3
    glasses.lock_to(120.0, flip_s)
    tended(glasses, clock, 2.0)
    flips = [Edge(round((flip_s + n / 120) * 1e9), "right" if n % 2 else "left") for n in range(40, 270)]
    report = phase_report(circuit.edges(), flips)
    assert report.max_ms < 0.05
    assert (report.missed, report.duplicated, report.alternation_faults) == (0, 0, 0)
    assert glasses.timing.locked
    glasses.lock_to(120.0, flip_s + 1 / 120)
    glasses.tend()
    assert circuit.edges()[-1].eye == circuit.edges()[-3].eye, "the display lost a frame: the turns changed over"


def test_a_rate_that_no_display_has_changes_nothing():
    glasses, circuit, clock = on_simulated_time()
    with pytest.raises(LimitError):
        glasses.lock_to(5.0, clock.now())
    assert circuit.edges() == []
    assert not glasses.timing.locked


def test_the_thread_takes_turns_and_closing_takes_the_power():
    circuit = Circuit(SystemClock())
    url = plug("threaded", circuit)
    glasses = open_glasses(spec(url), DeviceContext(SystemClock()))
    with closing(glasses):
        glasses.lock_to(200.0, SystemClock().now())
        while len(circuit.edges()) < 20:
            SystemClock().sleep(0.005)
        with pytest.raises(DeviceBusy, match="in use"):
            open_glasses(spec(url), DeviceContext(SystemClock()))
    assert not circuit.powered
    assert not circuit.taken
    eyes = [edge.eye for edge in circuit.edges()]
    assert all(one != next_one for one, next_one in itertools.pairwise(eyes))


def test_the_loop_reports_latency_and_lost_edges():
    clock = SimClock(50.0)
    circuit = Circuit(clock)
    good = loop_test(lines_on(circuit), clock)
    assert (good.toggles, good.lost, good.wired) == (200, 0, True)
    assert good.max_ms < 0.1


@pytest.mark.parametrize(("fault", "lost", "p50_ms"), [("slow", 0, 12.0), ("unwired", 10, 0.0), ("loose", 36, 0.0)])
def test_the_loop_of_a_bad_port(fault, lost, p50_ms):
    clock = SimClock(50.0)
    circuit = Circuit(clock)
    circuit.faults = {fault}
    report = loop_test(lines_on(circuit), clock, toggles=200)
    assert report.lost == pytest.approx(lost, abs=2)
    assert report.p50_ms == pytest.approx(p50_ms, abs=0.01)
    assert report.wired == (fault != "unwired")


def test_a_pseudo_terminal_has_no_lines():
    ends = os.openpty()
    try:
        with pytest.raises(DeviceError, match="has no modem lines") as caught:
            open_glasses(spec(os.ttyname(ends[1])), DeviceContext(SystemClock()))
        assert caught.value.code == "glasses-no-lines"
    finally:
        for end in ends:
            os.close(end)


@pytest.mark.parametrize("url", ["simlines://nobody", "/dev/ttyUSB99"])
def test_a_port_that_is_not_there(url):
    plug("somebody", Circuit(SystemClock()))
    with pytest.raises(DeviceError) as caught:
        open_glasses(spec(url), DeviceContext(SystemClock()))
    assert caught.value.code == "device-missing"


# -- shutters --------------------------------------------------------------------------------------------------------

TURNS = [Edge(round((10 + n / 120) * 1e9), "right" if n % 2 else "left") for n in range(240)]


def test_a_shutter_takes_its_time():
    edges = [Edge(10_000_000_000, "right"), Edge(10_100_000_000, "left")]
    shutter = Shutter(dark=0.0)
    after = light(edges, "left", 10.1 + np.array([-0.001, 0.0, 1.6e-3 * np.log(2) / np.log(9), 0.05]), shutter)
    assert after == pytest.approx([0, 0, 0.5, 1], abs=1e-3)
    rises = light(edges, "left", np.linspace(10.1, 10.12, 20001), shutter)
    ten, ninety = np.searchsorted(rises, [0.1, 0.9]) * 1e-6
    assert ninety - ten == pytest.approx(1.6e-3, rel=0.01)
    falls = light(edges, "right", np.linspace(10.1, 10.12, 20001), shutter)
    ninety, ten = np.searchsorted(-falls, [-0.9, -0.1]) * 1e-6
    assert ten - ninety == pytest.approx(0.3e-3, rel=0.01)


def test_silence_opens_both_eyes_of_glasses_that_listen():
    edges = [Edge(10_000_000_000, "right")]
    late = np.array([10.19, 10.3])
    assert light(edges, "left", late, Shutter()) == pytest.approx([1e-3, 1.0], abs=1e-3)
    assert light(edges, "left", late, Shutter(silence_s=None)) == pytest.approx([1e-3, 1e-3], abs=1e-3)


def test_leak_grows_with_lateness_and_shrinks_with_a_shorter_window():
    late = [Edge(edge.at_ns + 1_000_000, edge.eye) for edge in TURNS]
    at_once, a_ms_late = leak(TURNS, TURNS, Shutter()), leak(late, TURNS, Shutter())
    assert at_once < 0.03
    assert a_ms_late == pytest.approx(at_once + 1 / 8.33, abs=0.06)
    assert leak(late, TURNS, Shutter(), open_s=0.006) < 0.01
