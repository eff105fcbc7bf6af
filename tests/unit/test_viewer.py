"""A viewer follows the newest frame from ring to ring, counts what it missed, and holds nobody up."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import zmq

from acquire.frame import Frame, FrameHeader
from acquire.preview import Previews, looked_at, preview
from acquire.preview_viewer import PreviewViewer
from acquire.ring import RingWriter
from acquire.viewer import RingViewer
from sim.clock import SimClock

HEADER = FrameHeader(plane=0, setpoint_um=1.0, z_um=1.0, exposure_ms=2.0, utc_ns=7)


@pytest.fixture
def clock():
    return SimClock()


def ring(folder, clock, shape=(6, 8)):
    return RingWriter.create("view", shape, "uint16", 4, clock=clock, folder=folder)


def push(writer, count):
    for _ in range(count):
        pixels = np.full(writer.geometry.shape, writer.published, np.uint16)
        writer.push(pixels, replace(HEADER, plane=writer.published), timeout_s=0)


def test_one_that_sleeps_gets_the_newest_and_holds_nobody_up(tmp_path, clock):
    with ring(tmp_path, clock) as writer, RingViewer(lambda: str(writer.path), clock) as viewer:
        assert viewer.newest(0) is None
        push(writer, 1)
        assert viewer.newest(0).number == 0
        push(writer, 100)  # asleep meanwhile
        frame = viewer.newest(0)
        assert (frame.number, int(frame.pixels[0, 0])) == (100, 100)
        assert (viewer.received, viewer.lost, writer.published, writer.refused) == (2, 99, 101, 0)


def test_one_that_comes_late_sees_what_there_is(tmp_path, clock):
    with ring(tmp_path, clock) as writer:
        push(writer, 3)
        with RingViewer(lambda: str(writer.path), clock) as viewer:
            assert viewer.newest(0).number == 2
            assert viewer.newest(0) is None


def test_a_ring_that_is_gone_is_told_once_however_often_it_is_looked_for(tmp_path, clock, caplog):
    caplog.set_level("INFO")
    gone = [str(tmp_path / "a.ring"), str(tmp_path / "b.ring")]
    with RingViewer(lambda: gone[0], clock) as viewer:
        assert [viewer.newest(0) for _ in range(5)] == [None] * 5
        gone.pop(0)
        assert viewer.newest(0) is None
    assert [record.message.split("/")[-1].split()[0] for record in caplog.records] == ["a.ring", "b.ring"]


def test_it_follows_to_another_ring_of_another_geometry(tmp_path, clock):
    now = ""
    with RingViewer(lambda: now, clock) as viewer:
        assert viewer.newest(1.0) is None
        with ring(tmp_path, clock) as first:
            now = str(first.path)
            push(first, 1)
            assert viewer.newest(0).pixels.shape == (6, 8)
        assert viewer.newest(0.5) is None  # it ended, and its name is still told
        with ring(tmp_path, clock, (4, 4)) as second:
            now = str(second.path)
            push(second, 2)
            assert viewer.newest(1.0).pixels.shape == (4, 4)
        now = str(tmp_path / "no such ring")
        assert viewer.newest(0.5) is None
    assert (viewer.received, viewer.lost) == (2, 0)


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("shape", [(40, 60), (40, 60, 3), (3000, 1500)])
def test_a_preview_shows_the_frame_within_a_grey_level_or_two(shape, dtype):
    rows, columns = np.indices(shape[:2])
    ramp = (rows / shape[0] + columns / shape[1]) / 2
    grey = (ramp * 200 + 30) if dtype == "uint8" else (ramp * 3000 + 500)
    pixels = np.repeat(grey[..., None], 3, 2) * (1.0, 0.9, 0.8) if len(shape) == 3 else grey
    made = preview(Frame(5, HEADER, pixels.astype(dtype)))
    shown = cv2.imdecode(np.frombuffer(made.jpeg, np.uint8), cv2.IMREAD_UNCHANGED)
    assert made.shape == shape
    assert max(shown.shape) <= 1024
    expected = cv2.resize(pixels, shown.shape[1::-1], interpolation=cv2.INTER_AREA)
    expected = np.clip((expected - made.black) * 255 / (made.white - made.black), 0, 255)
    if len(shape) == 3:
        expected = expected[..., ::-1]  # red first, as cameras deliver; JPEG files are read blue first
    assert np.abs(shown - expected).mean() < 2.0


def test_a_frame_of_one_grey_is_no_trouble():
    made = preview(Frame(0, HEADER, np.full((5, 5), 7, np.uint16)))
    assert (made.black, made.white) == (7, 8)


def slope(shape, low, high):
    row = np.linspace(low, high, shape[1])
    return np.broadcast_to(row, shape).astype(np.uint16)


@pytest.mark.parametrize("shape", [(90, 120), (1200, 1600)])
def test_from_afar_a_frame_has_its_size_and_nearly_its_grey_levels(shape):
    pixels = slope(shape, 400, 2400)
    seen = looked_at(preview(Frame(5, replace(HEADER, plane=3, section=2), pixels)))
    assert (seen.number, seen.header.plane, seen.header.section, seen.header.z_um) == (5, 3, 2, 1.0)
    assert seen.pixels.shape == shape
    inner = slice(shape[1] // 50, -shape[1] // 50)  # the percentiles cut off the ends
    apart = np.abs(seen.pixels[:, inner].astype(int) - pixels[:, inner])
    assert apart.max() <= 0.03 * 2000


def test_who_looks_from_afar_gets_the_newest_of_what_is_published(tmp_path):
    from devices.clock import SystemClock

    context = zmq.Context()
    socket = context.socket(zmq.XPUB)
    socket.linger = 0
    port = socket.bind_to_random_port("tcp://127.0.0.1")
    with ring(tmp_path, SystemClock(), (16, 16)) as writer:
        previews = Previews(socket, lambda: str(writer.path), SystemClock())
        viewer = PreviewViewer(f"tcp://127.0.0.1:{port}", None)
        try:
            assert viewer.newest() is None
            push(writer, 3)
            deadline = SystemClock().now() + 60
            while (frame := viewer.newest()) is None and SystemClock().now() < deadline:
                SystemClock().sleep(0.02)
            assert (frame.number, frame.pixels.shape) == (2, (16, 16))
        finally:
            previews.close()
            viewer.close()
            socket.close(0)
            context.term()
