"""What every pair of glasses must do, asked of every driver over its twin, on simulated time and on real wires."""

from __future__ import annotations

import contextlib
import itertools
from contextlib import closing

import pytest
from pty_twin import OnPty

from devices.clock import SystemClock
from devices.drivers import modem_glasses, open3d
from devices.drivers.modem_glasses import ModemGlasses
from devices.drivers.open3d import Open3dGlasses
from devices.errors import DeviceBusy, DeviceError, LimitError
from devices.glasses_spec import GlassesSpec
from devices.glasses_timing import Edge, phase_report
from devices.protocols import Eyewear
from devices.registry import DeviceContext
from devices.transport.lines import ModemLines
from sim.clock import SimClock
from sim.controllers.open3d import Emitter
from sim.simlines import Circuit, plug
from sim.usb_wire import UsbWire

NAMES = itertools.count()
HZ = 120.0


def emitter_spec(port="x", **keys):
    return GlassesSpec.model_validate({"driver": "open3d", "port": port, "delay_us": 0, "open_us": 6000, **keys})


def lines_spec(port="x", **keys):
    return GlassesSpec.model_validate({"driver": "modem-lines", "port": port, **keys})


def emitter_on_simulated_time():
    clock = SimClock(100.0)
    twin = Emitter(clock, drift_ppm=80.0)
    glasses = Open3dGlasses(UsbWire(twin.feed, clock), emitter_spec(), clock)
    glasses.prepare()
    yield glasses, twin, clock


def lines_on_simulated_time():
    clock = SimClock(100.0)
    circuit = Circuit(clock)
    lines = ModemLines(plug(f"conformance-{next(NAMES)}", circuit), (), device="glasses")
    yield ModemGlasses(lines, lines_spec(), clock), circuit, clock


def emitter_on_a_pty():
    clock = SystemClock()
    twin = Emitter(clock)
    with closing(OnPty(twin.feed)) as far:
        yield open3d.open_glasses(emitter_spec(far.port), DeviceContext(clock)), twin, clock


def lines_with_a_thread():
    clock = SystemClock()
    circuit = Circuit(clock)
    url = plug(f"conformance-{next(NAMES)}", circuit)
    yield modem_glasses.open_glasses(lines_spec(url), DeviceContext(clock)), circuit, clock


SIMULATED = [emitter_on_simulated_time, lines_on_simulated_time]
ALL = [*SIMULATED, emitter_on_a_pty, lines_with_a_thread]


@pytest.fixture
def eyewear(request):
    making = request.param()
    made = next(making)
    yield made
    made[0].close()
    next(making, None)


every = pytest.mark.parametrize("eyewear", ALL, indirect=True)
simulated = pytest.mark.parametrize("eyewear", SIMULATED, indirect=True)


def passes(glasses, clock, seconds):
    """Let time pass; on simulated time the driver's own thread is called here."""
    end_s = clock.now() + seconds
    while clock.now() < end_s:
        due_s = glasses.tend() if isinstance(glasses, ModemGlasses) and isinstance(clock, SimClock) else seconds
        clock.sleep(min(due_s + 1e-6, end_s - clock.now() + 1e-9))


def lock(glasses, clock):
    """Lock to a display that flips now; a busy computer may need several tries on a real wire."""
    for _ in range(100):
        with contextlib.suppress(DeviceError):
            glasses.lock_to(HZ, clock.now())
            return
    pytest.fail("never locked")


def flips_from(first_s, count):
    return [Edge(round((first_s + n / HZ) * 1e9), "right" if n % 2 else "left") for n in range(count)]


@every
def test_it_is_eyewear(eyewear):
    glasses, _, _ = eyewear
    assert isinstance(glasses, Eyewear)
    assert glasses.free_running
    assert glasses.timing.sent == len(glasses.timing.edges)


@every
def test_a_turn_reaches_the_eye_that_was_named_and_is_noted(eyewear):
    glasses, twin, clock = eyewear
    told = []
    for eye in ("left", "right", "left", "right", "left"):
        glasses.show(eye)
        told.append(eye)
        passes(glasses, clock, 0.01)
    while [edge.eye for edge in twin.edges()][-5:] != told:
        passes(glasses, clock, 0.01)  # a twin on a wire may still be listening
    assert [edge.eye for edge in glasses.timing.edges][-5:] == told
    noted = [edge.at_ns for edge in glasses.timing.edges]
    assert noted == sorted(noted)
    assert noted[-1] / 1e9 <= clock.now()


@every
def test_turns_given_one_by_one_are_no_lock(eyewear):
    glasses, _, clock = eyewear
    lock(glasses, clock)
    assert glasses.timing.locked
    glasses.show("left")
    assert not glasses.timing.locked
    lock(glasses, clock)
    assert glasses.timing.locked
    glasses.both_open()
    assert not glasses.timing.locked


@simulated
def test_a_free_run_keeps_to_the_display(eyewear):
    glasses, twin, clock = eyewear
    first_s = clock.now()
    for _ in range(24):
        glasses.lock_to(HZ, first_s)
        passes(glasses, clock, 0.25)
    flips = flips_from(first_s, round(6 * HZ))[60:]
    report = phase_report([edge for edge in twin.edges() if edge.at_ns > flips[0].at_ns - 4_000_000], flips)
    assert abs(report.bias_ms) <= 0.5
    assert report.p99_ms <= 1.5
    assert (report.alternation_faults, report.missed) == (0, 0)


@simulated
def test_a_display_that_lost_a_frame_is_followed(eyewear):
    glasses, twin, clock = eyewear
    first_s = clock.now()
    glasses.lock_to(HZ, first_s)
    passes(glasses, clock, 0.1)
    glasses.lock_to(HZ, first_s + 1 / HZ)
    passes(glasses, clock, 0.1)
    last = twin.edges()[-1]
    lefts_s = last.at_ns / 1e9 - (1 / HZ if last.eye == "right" else 0)
    assert abs((lefts_s - first_s - 1 / HZ + 1 / HZ) % (2 / HZ) - 1 / HZ) < 2e-3


@every
def test_no_rate_no_turns(eyewear):
    glasses, _, clock = eyewear
    before = len(glasses.timing.locks)
    for refresh_hz in (0.0, 1e4, float("nan")):
        with pytest.raises(LimitError):
            glasses.lock_to(refresh_hz, clock.now())
    assert len(glasses.timing.locks) == before


@every
def test_closing_ends_the_turns(eyewear):
    glasses, twin, clock = eyewear
    lock(glasses, clock)
    glasses.close()
    count = len(twin.edges())
    clock.sleep(0.1)
    assert len(twin.edges()) == count


def test_a_port_is_for_one_at_a_time():
    clock = SystemClock()
    with closing(OnPty(Emitter(clock).feed)) as far:
        first = open3d.open_glasses(emitter_spec(far.port), DeviceContext(clock))
        with closing(first), pytest.raises(DeviceBusy):
            open3d.open_glasses(emitter_spec(far.port), DeviceContext(clock))


def test_what_went_over_the_wire_is_recorded(tmp_path):
    clock = SystemClock()
    with closing(OnPty(Emitter(clock).feed)) as far:
        open3d.open_glasses(emitter_spec(far.port), DeviceContext(clock, tmp_path)).close()
    assert '"to": "device", "bytes": "0\\n"' in (tmp_path / "glasses.jsonl").read_text()
