"""The vendor's own library drives the twin of the E-709 over TCP, unaware that it is none."""

from __future__ import annotations

import socket
import threading
from contextlib import closing

import pytest

from devices.clock import SystemClock
from devices.values import Limits
from sim.controllers.pi_gcs import PiE709
from sim.motion import Axis

pipython = pytest.importorskip("pipython", reason="pipython is not installed: it is in the dev group")


class Server:
    """The twin on a TCP port for one client."""

    def __init__(self, twin: PiE709) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port = self.listener.getsockname()[1]
        self.twin = twin
        self.thread = threading.Thread(target=self.serve)
        self.thread.start()

    def serve(self) -> None:
        connection, _ = self.listener.accept()
        with connection:
            while data := connection.recv(4096):
                for reply in self.twin.feed(data):
                    connection.sendall(reply)

    def close(self) -> None:
        self.thread.join(10)
        self.listener.close()


@pytest.fixture(scope="module")
def axis() -> Axis:
    return Axis(SystemClock(), Limits(0.0, 400.0))


@pytest.fixture(scope="module")
def device(axis: Axis):
    """Connect once: the library calls back to every connection there ever was in the process."""
    from pipython.pidevice.gcscommands import GCSCommands
    from pipython.pidevice.gcsmessages import GCSMessages
    from pipython.pidevice.interfaces.pisocket import PISocket

    with closing(Server(PiE709(axis))) as server, PISocket("127.0.0.1", server.port) as gateway:
        yield GCSCommands(GCSMessages(gateway))


def test_it_moves_waits_and_reads(device, axis: Axis):
    from pipython import pitools

    assert device.qIDN().startswith("(c)2013 Physik Instrumente(PI) Karlsruhe, E-709.CHG")
    assert device.axes == ["1"]
    assert (device.qTMN("1")["1"], device.qTMX("1")["1"]) == (0.0, 400.0)
    device.SVO("1", 1)
    device.MOV("1", 123.456)
    pitools.waitontarget(device, axes="1", timeout=10, polldelay=0.005)
    assert device.qPOS("1")["1"] == pytest.approx(123.456)
    assert axis.encoder_um() == pytest.approx(123.456)


def test_it_gets_our_refusals_in_its_own_words(device, axis: Axis):
    before_um = axis.encoder_um()
    device.SVO("1", 1)
    with pytest.raises(pipython.GCSError) as caught:
        device.MOV("1", 500.0)
    assert caught.value.val == 7
    assert axis.encoder_um() == before_um


def test_it_stops_a_move(device, axis: Axis):
    device.SVO("1", 1)
    device.VEL("1", 20.0)
    device.MOV("1", 400.0)
    assert device.IsMoving("1")["1"]
    with pytest.raises(pipython.GCSError) as caught:
        device.STP()
    assert caught.value.val == 10
    assert axis.encoder_um() < 400
