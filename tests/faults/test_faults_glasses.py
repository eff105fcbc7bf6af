"""Glasses × faults: a named error or a recovery, and never a lock that is none."""

from __future__ import annotations

import contextlib
import itertools

import pytest

from devices.drivers.modem_glasses import ModemGlasses
from devices.drivers.open3d import Open3dGlasses
from devices.errors import DeviceError, LinkLost, MalformedReply, NoReply
from devices.glasses_spec import GlassesSpec
from devices.transport.lines import ModemLines
from sim.clock import SimClock
from sim.controllers.open3d import Emitter
from sim.simlines import Circuit, plug
from sim.usb_wire import UsbWire

NAMES = itertools.count()
REFRESH_HZ = 120.0
RIGHT_WITHIN_S = 1.3e-3  # of the bound the driver allows itself, and the bus's jitter


class BadWire(UsbWire):
    """A USB wire on which something goes wrong, once or until it is mended."""

    def __init__(self, feed, clock):
        super().__init__(feed, clock)
        self.fault, self.lasting = None, False

    def write(self, data):
        fault = self.fault
        if not self.lasting:
            self.fault = None
        if fault == "unplugged":
            self.fault = fault
            raise LinkLost("glasses: the connection broke.")
        if fault == "deaf":
            return
        super().write(data)
        self._spoil(fault)

    def read(self, wait_s):
        if self.fault == "unplugged":
            raise LinkLost("glasses: the connection broke.")
        return super().read(wait_s)

    def _spoil(self, fault):
        if fault == "drop":
            self._pending = b""
        elif fault == "late":
            self._there_s += 0.5
        elif fault == "slow":
            self._there_s += 0.05
        elif fault == "garble":
            self._pending = b"\xa5" + bytes(byte ^ 0xA5 for byte in self._pending[:-4]) + self._pending[-4:]
        elif fault == "half":
            self._pending = self._pending[: len(self._pending) // 2]
        elif fault == "event":
            self._pending = b"+d 1\r\n" + self._pending


SPEC = GlassesSpec(driver="open3d", port="x", delay_us=0, open_us=6000, swap=False)


def emitter():
    clock = SimClock(100.0)
    twin = Emitter(clock)
    wire = BadWire(twin.feed, clock)
    glasses = Open3dGlasses(wire, SPEC, clock)
    return glasses, twin, wire, clock


ACTIONS = {
    "prepare": lambda glasses, clock: glasses.prepare(),
    "lock": lambda glasses, clock: glasses.lock_to(REFRESH_HZ, clock.now()),
    "show": lambda glasses, clock: glasses.show("left"),
    "both": lambda glasses, clock: glasses.both_open(),
    "swap": lambda glasses, clock: glasses.swap_eyes(),
    "save": lambda glasses, clock: glasses.save(),
    "settings": lambda glasses, clock: glasses.settings(),
}
FAULTS = ["drop", "late", "slow", "garble", "half", "event", "deaf", "unplugged"]


def phase_is_right(glasses, twin, clock):
    """Whether the glasses do what the driver says that they do."""
    clock.sleep(0.1)
    if not glasses.timing.locked:
        return True
    last = twin.edges()[-1]
    lock = glasses.timing.locks[-1]
    shift_s = 0.0 if (last.eye == "left") != twin.flipped else 1 / REFRESH_HZ
    return abs(lock.phase_s(last.at_ns / 1e9 - shift_s)) <= RIGHT_WITHIN_S


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("action", ACTIONS)
def test_one_fault_is_named_or_overcome(action, fault):
    glasses, twin, wire, clock = emitter()
    glasses.prepare()
    wire.fault = fault
    with contextlib.suppress(NoReply, MalformedReply, LinkLost):
        ACTIONS[action](glasses, clock)
    assert phase_is_right(glasses, twin, clock)
    wire.fault = None
    clock.sleep(1.1)
    if fault == "unplugged":
        glasses = Open3dGlasses(wire, SPEC, clock)
        glasses.prepare()
    glasses.lock_to(REFRESH_HZ, clock.now())
    assert glasses.timing.locked, "mended, it works again"
    assert phase_is_right(glasses, twin, clock)
    assert twin.saves <= 1, "the EEPROM is written once at most"


@pytest.mark.parametrize("fault", ["drop", "garble", "half", "deaf", "unplugged"])
@pytest.mark.parametrize("action", [action for action in ACTIONS if action != "show"])
def test_a_lasting_fault_is_named(action, fault):
    glasses, _, wire, clock = emitter()
    glasses.prepare()
    glasses.lock_to(REFRESH_HZ, clock.now())
    clock.sleep(2.0)
    wire.fault, wire.lasting = fault, True
    with pytest.raises((NoReply, MalformedReply, LinkLost)) as caught:
        ACTIONS[action](glasses, clock)
    assert caught.value.code in ("device-silent", "device-garbled", "device-lost")
    assert caught.value.exit_code == 4
    if action in ("lock", "both") or fault == "unplugged":
        assert not glasses.timing.locked
    glasses.close()


def test_answers_that_are_always_slow_make_no_lock():
    glasses, _, wire, clock = emitter()
    glasses.prepare()
    wire.fault, wire.lasting = "slow", True
    with pytest.raises(DeviceError) as caught:
        glasses.lock_to(REFRESH_HZ, clock.now())
    assert caught.value.code == "glasses-unlocked"
    assert not glasses.timing.locked


@pytest.mark.parametrize("mode", ["lock", "show"])
def test_a_power_failure_is_overcome(mode):
    glasses, twin, _, clock = emitter()
    glasses.prepare()
    ACTIONS[mode](glasses, clock)
    twin.power_cycle()
    for _ in range(3):
        clock.sleep(1.1)
        ACTIONS[mode](glasses, clock)
    before = len(twin.edges())
    ACTIONS[mode](glasses, clock)
    assert phase_is_right(glasses, twin, clock)
    assert len(twin.edges()) > before


@pytest.mark.parametrize("drift_ppm", [-100.0, 100.0])
def test_a_clock_that_drifts_is_followed(drift_ppm):
    glasses, twin, _, clock = emitter()
    twin.set_drift(drift_ppm)
    glasses.prepare()
    flip_s = clock.now()
    for _ in range(200):
        glasses.lock_to(REFRESH_HZ, flip_s)
        assert phase_is_right(glasses, twin, clock)
    assert len(glasses.timing.locks) >= 15


# -- modem lines -----------------------------------------------------------------------------------------------------


def modem():
    clock = SimClock(100.0)
    circuit = Circuit(clock)
    spec = GlassesSpec(driver="modem-lines", port="x")
    lines = ModemLines(plug(f"fault-{next(NAMES)}", circuit), (), device="glasses")
    return ModemGlasses(lines, spec, clock), circuit, clock


LINE_ACTIONS = {
    "show": lambda glasses, clock: glasses.show("left"),
    "both": lambda glasses, clock: glasses.both_open(),
    "turn": lambda glasses, clock: (glasses.lock_to(REFRESH_HZ, clock.now()), glasses.tend()),
}


@pytest.mark.parametrize("fault", ["gone", "no-lines", "loose", "slow"])
@pytest.mark.parametrize("action", LINE_ACTIONS)
def test_lines_that_fail_are_named_and_those_that_are_bad_do_not_hold(action, fault):
    glasses, circuit, clock = modem()
    circuit.faults = {fault}
    fatal = {"gone": "device-lost", "no-lines": "glasses-no-lines"}.get(fault)
    if fatal is None:
        for _ in range(50):
            LINE_ACTIONS[action](glasses, clock)
            clock.sleep(glasses.tend() + 1e-6)
        assert circuit.longest_hold_s() < 0.85, "a lost edge is made good by one of the next"
        return
    with pytest.raises(DeviceError) as caught:
        LINE_ACTIONS[action](glasses, clock)
    assert caught.value.code == fatal
    assert not glasses.timing.locked
    with pytest.raises(DeviceError):
        LINE_ACTIONS[action](glasses, clock)
    glasses.close()


def test_lines_that_vanish_under_the_thread_end_the_free_run():
    glasses, circuit, clock = modem()
    glasses.lock_to(REFRESH_HZ, clock.now())
    assert glasses.timing.locked
    circuit.faults = {"gone"}
    clock.sleep(0.01)
    with pytest.raises(LinkLost):
        glasses.tend()
    assert not glasses.timing.locked
    with pytest.raises(LinkLost):
        glasses.show("left")
    glasses.close()
