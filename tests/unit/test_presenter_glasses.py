"""Pictures on a simulated display, the real driver over a simulated wire, and the emitter's twin: all in step."""

from __future__ import annotations

from contextlib import closing

import pytest

from devices.drivers.modem_glasses import ModemGlasses
from devices.drivers.open3d import Open3dGlasses
from devices.glasses_spec import GlassesSpec
from devices.glasses_timing import EyewearTiming, turns_of
from devices.transport.lines import ModemLines
from display.pacing import PaceReport
from display.presenter import Presenter
from display.shown_report import shown_report
from sim.clock import SimClock
from sim.controllers.open3d import Emitter
from sim.display import SimDisplay, longest_wrong
from sim.eyewear import Shutter, leak
from sim.simlines import Circuit, plug
from sim.usb_wire import UsbWire

SECONDS = 10.0
DELAY_US, OPEN_US = 1300, 5600
WINDOW = {"delay_s": DELAY_US / 1e6, "open_s": OPEN_US / 1e6}
LOCK_EVERY = 30  # pictures: a quarter of a second


class Beside:
    """The time of a thread that may wait without holding up the one it was started from."""

    def __init__(self, clock: SimClock) -> None:
        self._clock = clock
        self._own_s = clock.now()

    def now(self) -> float:
        return max(self._own_s, self._clock.now())

    def sleep(self, seconds: float) -> None:
        self._own_s = self.now() + max(seconds, 0.0)


def emitter(clock, *, drive, drift_ppm=0.0):
    twin = Emitter(clock, drift_ppm=drift_ppm)
    spec = GlassesSpec(driver="open3d", port="usb", delay_us=DELAY_US, open_us=OPEN_US, swap=False, drive=drive)
    glasses = Open3dGlasses(UsbWire(twin.feed, clock), spec, clock)
    glasses.prepare()
    return twin, glasses


def show(glasses, clock, **display):
    screen = SimDisplay(clock, late_share=0.004, seed=5, **display)
    shown = Presenter(screen, clock, glasses)
    shown.lock_glasses()
    begin_s = clock.now()
    for k in range(round(SECONDS * 120)):
        shown.step()
        if k % LOCK_EVERY == 0:
            shown.lock_glasses()
    return screen, shown, begin_s + 0.2


def reported(shown, turns, begin_s, **options):
    begin_ns = round(begin_s * 1e9)
    flips = [flip for flip in shown.flips if flip.at_ns > begin_ns]
    turns = [edge for edge in turns if edge.at_ns > begin_ns]
    return shown_report(1 / shown.pacer.beat.period_s, shown.pacer.report, flips, turns, **options)


@pytest.mark.parametrize("drift_ppm", [-100, 0, 100])
def test_a_free_running_emitter_keeps_to_the_display(drift_ppm):
    clock = SimClock(100.0)
    twin, glasses = emitter(Beside(clock), drive="free-run", drift_ppm=drift_ppm)
    screen, shown, begin_s = show(glasses, clock, off_ppm=40)
    found = reported(shown, twin.edges(), begin_s, **WINDOW)
    assert found.phase is not None
    assert abs(found.phase.bias_ms) < 0.5
    assert found.phase.crosstalk < 0.02
    wrong, longest = longest_wrong(screen.seen(), even=_even(screen))
    assert longest <= 1
    assert found.pace.wrong_eye >= wrong
    assert found.phase.alternation_faults <= found.pace.wrong_eye + 1
    edges = [edge for edge in twin.edges() if edge.at_ns > begin_s * 1e9]
    flips = [flip for flip in screen.flips() if flip.at_ns > begin_s * 1e9]
    assert leak(edges, flips, Shutter(), open_s=OPEN_US / 1e6) < 0.03


def test_an_emitter_told_each_flip_never_opens_the_wrong_eye():
    clock = SimClock(100.0)
    twin, glasses = emitter(clock, drive="per-frame")
    _, shown, begin_s = show(glasses, clock)
    found = reported(shown, twin.edges(), begin_s, **WINDOW)
    assert found.phase is not None
    assert found.phase.alternation_faults <= found.pace.strays, "told late, for the computer was held up"
    assert found.phase.crosstalk < 0.01
    assert 0.1 < found.phase.bias_ms < 1.2, "the wire's own time"


def test_what_the_driver_believes_of_a_free_run_is_what_the_twin_does():
    clock = SimClock(100.0)
    beside = Beside(clock)
    twin, glasses = emitter(beside, drive="free-run")
    _, shown, begin_s = show(glasses, clock)
    believed = reported(shown, turns_of(glasses.timing, clock.now(), delay_s=DELAY_US / 1e6), begin_s, **WINDOW)
    true = reported(shown, twin.edges(), begin_s, **WINDOW)
    assert believed.phase is not None
    assert true.phase is not None
    assert believed.phase.bias_ms == pytest.approx(true.phase.bias_ms, abs=0.5)
    assert believed.phase.crosstalk == pytest.approx(true.phase.crosstalk, abs=0.01)


def test_modem_lines_follow_each_flip():
    clock = SimClock(100.0)
    circuit = Circuit(clock)
    lines = ModemLines(plug("presenter", circuit), (), device="glasses")
    with closing(ModemGlasses(lines, GlassesSpec(driver="modem-lines", port="x", drive="per-frame"), clock)) as glasses:
        _, shown, begin_s = show(glasses, clock)
        found = reported(shown, circuit.edges(), begin_s)
    assert found.phase is not None
    assert found.phase.alternation_faults <= found.pace.strays
    assert found.phase.crosstalk < 0.05


def test_exchanged_eyes_are_reported_as_crosstalk_and_said():
    clock = SimClock(100.0)
    twin, glasses = emitter(Beside(clock), drive="free-run")
    glasses.swap_eyes()
    _, shown, begin_s = show(glasses, clock)
    found = reported(shown, twin.edges(), begin_s, **WINDOW)
    assert found.phase is not None
    assert found.phase.crosstalk > 0.9
    assert "The eyes see each other's pictures" in found.words()
    assert found.as_json()["glasses_crosstalk"] == found.phase.crosstalk


def test_without_glasses_the_report_tells_of_the_pictures():
    clock = SimClock(100.0)
    _, shown, begin_s = show(None, clock)
    found = reported(shown, turns_of(EyewearTiming(), clock.now()), begin_s)
    assert found.phase is None
    assert "wrong eye in" in found.words()
    assert "too busy" in shown_report(120.0, PaceReport(refreshes=100, flips=90, late=9), [], []).words()


def _even(screen: SimDisplay) -> str:
    eyes = [eye for number, eye in screen.seen() if number % 2 == 0]
    return max(set(eyes), key=eyes.count)
