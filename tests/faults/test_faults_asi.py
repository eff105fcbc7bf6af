"""Every fault of line and mechanics against both ASI drivers: a named error or a recovery, never a wrong position."""

from __future__ import annotations

import threading
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING

import pytest

from devices.clock import SystemClock
from devices.drivers import asi, asi_tiger, polled
from devices.errors import DeviceError
from devices.registry import DeviceContext
from devices.rig import AxisSpec
from devices.values import Limits
from sim.controllers.asi import Ms2000
from sim.controllers.asi_tiger import Tiger
from sim.faults import Faults, FaultyTwin, parse_fault
from sim.motion import Axis
from sim.serial_line import SerialLine

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

DRIVERS = {"asi-ms2000": (asi.open_stage, Ms2000), "asi-tiger": (asi_tiger.open_stage, Tiger)}
LIMITS = {"min_um": -500.0, "max_um": 500.0}
TARGETS_UM = (30.0, -12.5, 80.0, 0.0)
NAMED = {
    "recovered",
    "device-silent",
    "device-garbled",
    "device-lost",
    "device-refused",
    "device-missing",
    "stage-stalled",
    "stage-timeout",
    "position-unknown",
}
# Of the wire: each strikes some reply of the moves; those of the greeting stand in the conformance tests.
WIRE = [
    *(f"z.{kind}@{number}" for kind in ("drop", "late", "garble", "half") for number in (1, 2, 4)),
    *(f"z.{kind}@15%" for kind in ("drop", "garble", "half")),
    "z.silent",
    "z.silent@4",
    "z.die@1",
    "z.die@4",
]


class Rig:
    """A driver on a line to its twin; ``struck`` takes faults once the driver is open."""

    def __init__(self, stage, axis, twin, line, faulty) -> None:
        self.stage, self.axis, self.twin, self.line, self._faulty = stage, axis, twin, line, faulty

    def strike(self, fault: str) -> None:
        self._faulty.clear()
        self._faulty.append(FaultyTwin(self.twin.feed, Faults([parse_fault(fault)], SystemClock(), seed=3), "z").feed)

    def heal(self) -> None:
        self._faulty.clear()


@contextmanager
def rig(driver: str, monkeypatch: pytest.MonkeyPatch, link: Path | None = None):
    monkeypatch.setattr(polled, "REPLY_TIMEOUT_S", 0.15)
    clock = SystemClock()
    open_stage, make_twin = DRIVERS[driver]
    axis = Axis(clock, Limits(**LIMITS))
    twin = make_twin({"X": Axis(clock, Limits(**LIMITS)), "Y": Axis(clock, Limits(**LIMITS)), "Z": axis})
    faulty: list = []
    plain = FaultyTwin(twin.feed, Faults((), clock), "z").feed

    def feed(data: bytes):
        return (faulty or [plain])[0](data)

    line = SerialLine(feed, 115200, clock, link=link)
    table = {"driver": driver, "port": line.port, "baud": 115200, "limits": LIMITS, "speed_um_s": 2000.0}
    try:
        with closing(open_stage(AxisSpec.model_validate(table), DeviceContext(clock))) as stage:
            yield Rig(stage, axis, twin, line, faulty)
    finally:
        line.unplug()


def outcome(act: Callable[[], object]) -> str:
    """Return the name of the error an action ends in; "recovered" if it does not."""
    try:
        act()
    except DeviceError as error:
        return error.code
    return "recovered"


def go(bench: Rig, z_um: float) -> None:
    """Go there; what the driver reports as arrived has to be where the axis is."""
    bench.stage.move_to(z_um)
    told_um = bench.stage.settle(10.0)
    assert told_um == pytest.approx(z_um, abs=0.11)
    assert bench.axis.encoder_um() == pytest.approx(told_um, abs=0.06)


@pytest.mark.parametrize("fault", WIRE)
@pytest.mark.parametrize("driver", DRIVERS)
def test_a_fault_of_the_wire(driver: str, fault: str, monkeypatch: pytest.MonkeyPatch):
    with rig(driver, monkeypatch) as bench:
        bench.strike(fault)
        assert outcome(lambda: [go(bench, z_um) for z_um in TARGETS_UM]) in NAMED


@pytest.mark.parametrize("number", [1, 2, 3])
@pytest.mark.parametrize("kind", ["drop", "late", "garble", "half"])
@pytest.mark.parametrize("driver", DRIVERS)
def test_a_relative_move_is_made_once_whatever_becomes_of_its_reply(
    driver: str, kind: str, number: int, monkeypatch: pytest.MonkeyPatch
):
    with rig(driver, monkeypatch) as bench:
        bench.strike(f"z.{kind}@{number}")
        assert outcome(lambda: bench.stage.move_by(25.0)) in NAMED
        bench.heal()
        bench.stage._target_um = None
        bench.stage.settle(10.0)
        assert bench.axis.encoder_um() == pytest.approx(25.0, abs=0.06)


@pytest.mark.parametrize("driver", DRIVERS)
def test_an_obstacle_is_a_stall_where_it_is(driver: str, monkeypatch: pytest.MonkeyPatch):
    with rig(driver, monkeypatch) as bench:
        bench.axis.obstruct(17.0)
        with pytest.raises(DeviceError) as caught:
            go(bench, 40.0)
        assert caught.value.code == "stage-stalled"
        assert bench.stage.position_um() == pytest.approx(17.0, abs=0.06)


@pytest.mark.parametrize("driver", DRIVERS)
def test_a_limit_met_on_the_way_is_named(driver: str, monkeypatch: pytest.MonkeyPatch):
    with rig(driver, monkeypatch) as bench:
        bench.axis.limits = Limits(-500.0, 20.0)
        with pytest.raises(DeviceError, match="no progress") as caught:
            go(bench, 40.0)
        assert caught.value.why == "It is at the controller's upper limit."


@pytest.mark.parametrize("driver", DRIVERS)
def test_a_motor_that_is_off_refuses(driver: str, monkeypatch: pytest.MonkeyPatch):
    with rig(driver, monkeypatch) as bench:
        bench.twin.feed(b"MC Z-\r")
        with pytest.raises(DeviceError) as caught:
            go(bench, 40.0)
        assert caught.value.code == "device-refused"
        assert bench.axis.encoder_um() == 0.0


@pytest.mark.parametrize("driver", DRIVERS)
def test_a_halt_from_another_thread_ends_the_move_at_once(driver: str, monkeypatch: pytest.MonkeyPatch):
    with rig(driver, monkeypatch) as bench:
        bench.stage.set_speed_um_s(50.0)
        bench.stage.move_to(400.0)
        halting = threading.Thread(target=bench.stage.halt)
        halting.start()
        with pytest.raises(DeviceError) as caught:
            bench.stage.settle(10.0)
        halting.join()
        assert caught.value.code == "stage-stalled"
        assert bench.axis.encoder_um() < 100


@pytest.mark.parametrize("driver", DRIVERS)
def test_after_the_plug_was_pulled_nothing_moves_before_it_reconnected(
    driver: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    with rig(driver, monkeypatch, tmp_path / "z.port") as bench:
        go(bench, 30.0)
        bench.line.unplug()
        assert outcome(bench.stage.position_um) == "device-lost"
        assert outcome(lambda: bench.stage.move_to(10.0)) == "position-unknown"
        assert not bench.stage.position_known
        bench.line.plug()
        assert bench.stage.reconnect(5.0) == pytest.approx(30.0, abs=0.06)
        go(bench, 10.0)


def test_another_controller_at_the_same_port_is_not_driven(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    with rig("asi-ms2000", monkeypatch, tmp_path / "z.port") as bench:
        bench.line.unplug()
        assert outcome(bench.stage.position_um) == "device-lost"
        bench.twin.feed = Tiger({"Z": bench.axis}).feed
        bench.strike("z.drop@1000")
        bench.line.plug()
        assert outcome(lambda: bench.stage.reconnect(0.0)) == "device-other"
        assert outcome(lambda: bench.stage.move_to(10.0)) == "position-unknown"
