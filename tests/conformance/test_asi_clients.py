"""Clients of other makers drive the Tiger twin over a pseudo-terminal, as they drive the real one."""

from __future__ import annotations

from contextlib import contextmanager

import pytest

from devices.clock import SystemClock
from devices.values import Limits
from sim.controllers.asi_tiger import Tiger
from sim.faults import Faults, FaultyTwin
from sim.motion import Axis
from sim.serial_line import SerialLine

asitiger = pytest.importorskip("asitiger.tigercontroller", reason="asitiger is not installed (group dev)")
tigerasi = pytest.importorskip("tigerasi.tiger_controller", reason="tigerasi is not installed (group dev)")


@contextmanager
def tiger():
    clock = SystemClock()
    axes = {letter: Axis(clock, Limits(-500.0, 500.0)) for letter in "XYZ"}
    twin = Tiger(axes)
    line = SerialLine(FaultyTwin(twin.feed, Faults((), clock), "z").feed, 115200, clock)
    try:
        yield twin, axes, line.port
    finally:
        line.unplug()


def test_asitiger_finds_the_axes_moves_and_halts():
    with tiger() as (_, axes, port):
        box = asitiger.TigerController.from_serial_port(port)
        try:
            assert [info.label for info in box.axes()] == ["X", "Y", "Z"]
            assert [info.address for info in box.axes()] == ["1", "1", "2"]
            box.move({"Z": 1234.5})
            assert box.is_busy()
            box.wait_until_idle()
            assert box.where(["Z"]) == {"Z": 1234.5}
            assert axes["Z"].encoder_um() == pytest.approx(123.45)
            box.move_relative({"X": -200, "Z": -34.5})
            box.wait_until_idle()
            assert box.where(["X", "Y", "Z"]) == {"X": -200.0, "Y": 0.0, "Z": 1200.0}
            (rest,) = box.rdstat(["Z"])
            assert (rest.status.value, rest.joystick.value, rest.upper_limit.value) == ("N", 1, 0)
            assert box.speed({"Z": "?"}) == {"Z": "2.000000"}
            box.disable_axes(["Z"])
            with pytest.raises(Exception, match=":N-5"):
                box.move({"Z": 0})
            box.enable_axes(["Z"])
            box.move({"Z": 5000})
            with pytest.raises(Exception, match=":N-21"):  # this client takes :N-21 for an error
                box.halt()
        finally:
            box.connection.disconnect()


def test_tigerasi_reads_the_cards_moves_and_loads_the_ring():
    with tiger() as (twin, axes, port):
        box = tigerasi.TigerController(port)
        try:
            assert box.ordered_axes == ["X", "Y", "Z"]
            assert box.axis_to_card["Z"] == ("32", 0)
            assert "RING BUFFER 250" in box._card_modules["32"]
            box.move_absolute(z=321)
            while box.is_axis_moving("z"):
                pass
            assert box.get_position("z") == {"Z": 321.0}
            assert box.get_upper_travel_limit("z") == {"Z": 0.5}
            box.setup_ring_buffer("Z")
            for place in (400, 410):
                box.queue_buffered_move(z=place)
            box.set_ttl_pin_modes(
                tigerasi.TTLIn0Mode.MOVE_TO_NEXT_ABS_POSITION, tigerasi.TTLOut0Mode.PULSE_AFTER_MOVING
            )
            for place_um in (40.0, 41.0, 40.0):
                twin.ttl_in()
                while axes["Z"].moving():
                    pass
                assert axes["Z"].encoder_um() == pytest.approx(place_um)
        finally:
            box.ser.close()
