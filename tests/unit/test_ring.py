"""The ring in one process: what each call promises, and every way it says no."""

from __future__ import annotations

import os
import platform
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire.frame import FrameHeader
from acquire.ring import RingFull, RingReader, RingWriter, WriterGone
from acquire.ring_layout import READERS, Entry, Fence, Word, entry_word
from devices.errors import StereotomeError, StoreError

SHAPE = (6, 5)
SLOTS = 4
HEADER = FrameHeader(plane=0, setpoint_um=1.5, z_um=1.48, exposure_ms=20.0)


class ManualClock:
    """Time that passes only while somebody sleeps."""

    def __init__(self) -> None:
        self.seconds = 100.0

    def now(self) -> float:
        return self.seconds

    def sleep(self, seconds: float) -> None:
        self.seconds += seconds


@pytest.fixture
def clock():
    return ManualClock()


@pytest.fixture
def writer(clock, tmp_path):
    with RingWriter.create("test", SHAPE, "uint16", SLOTS, clock=clock, folder=tmp_path) as writer:
        yield writer


@pytest.fixture
def attach(writer, clock):
    readers = []

    def attach(kind):
        readers.append(RingReader.attach(writer.path, kind, clock=clock))
        return readers[-1]

    yield attach
    for reader in readers:
        reader.close()


def push(writer, count=1):
    for _ in range(count):
        number = writer.published
        pixels = np.full(SHAPE, number, np.uint16)
        assert writer.push(pixels, replace(HEADER, plane=number), timeout_s=0) == number


def open_files():
    return len(list(Path("/proc/self/fd").iterdir()))


def complaint(error):
    assert isinstance(error, StereotomeError)
    assert error.what
    assert error.why or error.fix
    return error.code


def test_a_lossless_reader_gets_every_frame_with_its_header(writer, attach):
    reader = attach("lossless")
    push(writer, 3)
    frames = [
        (f.number, f.header.plane, int(f.pixels.min()), int(f.pixels.max())) for f in iter(lambda: reader.read(0), None)
    ]
    assert frames == [(n, n, n, n) for n in range(3)]
    assert (reader.received, reader.lost, reader.unread) == (3, 0, 0)


def test_a_lossless_frame_is_the_slot_itself_and_cannot_be_written(writer, attach):
    reader = attach("lossless")
    push(writer)
    frame = reader.read(0)
    writer._map.pixels[0][2, 3] = 777
    assert frame.pixels[2, 3] == 777
    with pytest.raises(ValueError, match="read-only"):
        frame.pixels[0, 0] = 1
    with pytest.raises(ValueError, match="WRITEABLE"):
        frame.pixels.setflags(write=True)


def test_a_latest_reader_gets_a_copy_of_the_newest_and_counts_the_rest(writer, attach):
    reader = attach("latest")
    push(writer, 7)
    frame = reader.read(0)
    assert (frame.number, reader.received, reader.lost) == (6, 1, 6)
    push(writer, SLOTS)
    assert (frame.pixels == 6).all()
    assert not frame.pixels.flags.writeable


def test_nothing_new_is_none_after_the_timeout(writer, attach, clock):
    for kind in ("lossless", "latest"):
        before = clock.now()
        assert attach(kind).read(0.25) is None
        assert clock.now() - before == pytest.approx(0.25)


@given(
    header=st.builds(
        FrameHeader,
        **{f: st.floats(allow_nan=False) for f in ("setpoint_um", "z_um", "exposure_ms")},
        **{f: st.integers(-(2**63), 2**63 - 1) for f in ("plane", "exposure_start_ns", "utc_ns", "section", "hw_id")},
    )
)
def test_any_header_survives(header):
    clock = ManualClock()
    writer = RingWriter.create("header", (1, 1), "uint8", 2, clock=clock)
    with writer, RingReader.attach(writer.path, "lossless", clock=clock) as reader:
        writer.push(np.zeros((1, 1), np.uint8), header)
        assert reader.read(0).header == header


GEOMETRIES = [((3, 4), "uint8"), ((3, 4, 3), "uint8"), ((5, 1), "uint16"), ((2, 3, 3), "uint16")]


@pytest.mark.parametrize(("shape", "dtype"), GEOMETRIES)
def test_every_geometry_arrives_as_it_was(shape, dtype, clock, tmp_path):
    pixels = np.arange(np.prod(shape), dtype=dtype).reshape(shape)
    writer = RingWriter.create("g", shape, dtype, 2, clock=clock, folder=tmp_path)
    with writer, RingReader.attach(writer.path, "latest", clock=clock) as reader:
        writer.push(pixels, HEADER)
        np.testing.assert_array_equal(reader.read(0).pixels, pixels, strict=True)


# Full


def test_a_full_ring_refuses_the_new_frame_keeps_the_old_and_counts(writer, attach, clock):
    reader = attach("lossless")
    push(writer, SLOTS)
    before = clock.now()
    with pytest.raises(RingFull) as caught:
        writer.push(np.zeros(SHAPE, np.uint16), HEADER, timeout_s=2.0)
    assert clock.now() - before == pytest.approx(2.0, abs=0.01)
    assert complaint(caught.value) == "ring-full"
    assert f"process {os.getpid()} still needs frame 0" in caught.value.why
    assert (writer.refused, writer.published) == (1, SLOTS)
    assert [int(reader.read(0).pixels[0, 0]) for _ in range(SLOTS)] == list(range(SLOTS))


def test_a_frame_in_use_is_kept_until_it_is_released(writer, attach):
    reader = attach("lossless")
    push(writer, SLOTS)
    frame = reader.read(0)
    with pytest.raises(RingFull):
        push(writer)
    assert (frame.pixels == 0).all()
    reader.release()
    push(writer)
    assert writer.published == SLOTS + 1


def test_the_slowest_lossless_reader_decides(writer, attach):
    quick, slow = attach("lossless"), attach("lossless")
    push(writer, SLOTS)
    while quick.read(0):
        pass
    with pytest.raises(RingFull):
        push(writer)
    slow.read(0)
    slow.release()
    push(writer)


def test_a_latest_reader_may_look_back_at_the_frame_there_is(writer, attach):
    empty = attach("latest")
    empty.look_back()
    assert empty.read(0) is None
    push(writer, 3)
    reader = attach("latest")
    reader.look_back()
    reader.look_back()
    assert reader.unread == 1
    assert reader.read(0).number == 2
    reader.look_back()
    assert reader.read(0) is None
    assert (reader.received, reader.lost) == (1, 0)
    every = attach("lossless")
    every.look_back()
    assert every.read(0) is None


def test_a_latest_reader_never_holds_the_writer(writer, attach, clock):
    attach("latest")
    before = clock.now()
    push(writer, 5 * SLOTS)
    assert clock.now() == before
    assert writer.refused == 0


def test_a_closed_reader_holds_nothing(writer, attach):
    reader = attach("lossless")
    push(writer, SLOTS)
    reader.close()
    reader.close()
    push(writer)
    assert writer.readers() == ()


def test_a_reader_joins_at_the_next_frame(writer, attach):
    push(writer, 9)
    lossless, latest = attach("lossless"), attach("latest")
    push(writer, 3)
    assert lossless.read(0).number == 9
    assert latest.read(0).number == 11
    assert latest.received + latest.lost == 3


# Slots


def test_a_slot_is_filled_in_place(writer, attach):
    reader = attach("lossless")
    with writer.slot() as slot:
        slot.pixels[...] = 42
        assert reader.read(0) is None
        assert slot.publish(HEADER) == 0
    assert (reader.read(0).pixels == 42).all()


def test_an_unpublished_slot_never_was(writer, attach):
    lossless, latest = attach("lossless"), attach("latest")
    push(writer)
    with writer.slot() as slot:
        slot.pixels[...] = 99
    push(writer)
    assert latest.read(0).number == 1
    assert [(f.number, f.pixels[0, 0]) for f in iter(lambda: lossless.read(0), None)] == [(0, 0), (1, 1)]


@pytest.mark.parametrize(("shape", "dtype"), [((6, 6), "uint16"), (SHAPE, "uint8"), (SHAPE, ">u2"), ((5,), "uint16")])
def test_a_frame_of_another_geometry_is_refused(writer, shape, dtype):
    with pytest.raises(StoreError) as caught:
        writer.push(np.zeros(shape, dtype), HEADER)
    assert complaint(caught.value) == "ring-geometry"
    assert writer.published == 0


def test_another_geometry_is_another_ring(writer, clock, tmp_path):
    with RingWriter.create("test", (9, 9), "uint8", 2, clock=clock, folder=tmp_path) as other:
        assert other.path != writer.path
        assert other._words[Word.GENERATION] != writer._words[Word.GENERATION] != 0


# Torn copies: the check after the copy is what finds them


def lap_while_copying(reader, writer):
    """Make the writer pass the reader once, in the middle of its next copy."""
    duplicate = reader._duplicate

    def interrupted(pixels):
        reader._duplicate = duplicate
        upper = pixels[: SHAPE[0] // 2].copy()
        push(writer, SLOTS)
        return np.concatenate([upper, pixels[SHAPE[0] // 2 :]])

    reader._duplicate = interrupted


def test_a_torn_copy_is_thrown_away_and_the_newer_frame_read(writer, attach):
    reader = attach("latest")
    push(writer)
    lap_while_copying(reader, writer)
    frame = reader.read(0.1)
    assert frame.number == SLOTS
    assert (frame.pixels == SLOTS).all()
    assert (reader.torn, reader.received, reader.lost) == (1, 1, SLOTS)


def test_without_the_check_the_same_copy_is_torn(writer, attach):
    reader = attach("latest")
    reader._intact = lambda number, slot: True
    push(writer)
    lap_while_copying(reader, writer)
    assert set(np.unique(reader.read(0.1).pixels)) == {0, SLOTS}


def test_a_copy_overlapping_an_unfinished_frame_is_thrown_away(writer, attach):
    reader = attach("latest")
    push(writer)
    duplicate = reader._duplicate

    def interrupted(pixels):
        push(writer, SLOTS - 1)
        writer.slot(timeout_s=0).__enter__()
        reader._duplicate = duplicate
        return duplicate(pixels)

    reader._duplicate = interrupted
    assert reader.read(0.1).number == SLOTS - 1
    assert reader.torn == 1


def test_a_hopeless_chase_ends_with_the_timeout(writer, attach, clock):
    reader = attach("latest")
    push(writer)
    duplicate = reader._duplicate

    def interrupted(pixels):
        clock.sleep(0.1)
        push(writer, SLOTS)
        return duplicate(pixels)

    reader._duplicate = interrupted
    assert reader.read(1.0) is None
    assert reader.torn > 5
    assert reader.received == reader.lost == 0


def test_a_frame_overwritten_under_a_lossless_reader_is_an_error(writer, attach):
    reader = attach("lossless")
    push(writer)
    writer._words[entry_word(0) + Entry.KIND] = 0
    push(writer, SLOTS)
    with pytest.raises(StoreError) as caught:
        reader.read(0)
    assert complaint(caught.value) == "ring-overrun"


def test_other_processors_get_a_fence(monkeypatch):
    released = []
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    fence = Fence()
    real = fence._lock

    class Spy:
        def acquire(self):
            released.append("acquire")
            real.acquire()

        def release(self):
            released.append("release")
            real.release()

    fence._lock = Spy()
    fence()
    assert released == ["release", "acquire"]
    assert real.locked()


# Life and death


def test_status_tells_what_each_reader_has(writer, attach):
    lossless, latest = attach("lossless"), attach("latest")
    push(writer, 3)
    lossless.read(0)
    latest.read(0)
    first, second = writer.readers()
    assert (first.kind, first.cursor, first.received, first.lost) == ("lossless", 0, 1, 0)
    assert (second.kind, second.cursor, second.received, second.lost) == ("latest", 3, 1, 2)
    assert (first.pid, first.alive, second.alive) == (os.getpid(), True, True)
    assert writer.detach_dead() == ()


def test_readers_finish_after_the_writer_closed(writer, attach):
    lossless, latest = attach("lossless"), attach("latest")
    push(writer, 3)
    assert lossless.writer_alive
    writer.close()
    writer.close()
    assert not lossless.writer_alive
    assert [lossless.read(0).number for _ in range(3)] == [0, 1, 2]
    assert latest.read(0).number == 2
    for reader in (lossless, latest):
        with pytest.raises(WriterGone) as caught:
            reader.read(10)
        assert complaint(caught.value) == "ring-writer-gone"
        assert "frame 2" in caught.value.what


def test_pixels_outlive_the_ring(writer, attach):
    reader = attach("lossless")
    push(writer, 2)
    reader.read(0)
    frame = reader.read(0)
    reader.close()
    writer.close()
    assert (frame.pixels == 1).all()


def test_pixels_still_held_keep_no_place_taken(writer, attach):
    kept = []
    for _ in range(READERS + 1):
        reader = attach("lossless")
        push(writer)
        kept.append(reader.read(0))
        reader.close()
    assert len(kept) == READERS + 1
    assert writer.readers() == ()


def test_a_writer_whose_slot_is_still_held_is_gone_when_closed(writer, attach):
    reader = attach("lossless")
    with writer.slot() as slot:
        slot.publish(HEADER)
    writer.close()
    assert reader.read(0).number == 0
    with pytest.raises(WriterGone):
        reader.read(0)
    assert slot.pixels.shape == SHAPE


def test_the_heartbeat_shows_a_writer_at_rest(writer, attach, clock):
    reader = attach("latest")
    clock.sleep(3)
    assert reader.writer_idle_s == pytest.approx(3)
    writer.beat()
    assert reader.writer_idle_s == pytest.approx(0, abs=1e-6)
    clock.sleep(1)
    push(writer)
    assert reader.writer_idle_s == pytest.approx(0, abs=1e-6)


def test_places_for_readers_are_limited_and_come_back(writer, attach):
    readers = [attach("latest") for _ in range(READERS)]
    before = open_files()
    with pytest.raises(StoreError) as caught:
        attach("latest")
    assert complaint(caught.value) == "ring-readers"
    assert open_files() == before
    readers[5].close()
    assert attach("lossless").read(0) is None
