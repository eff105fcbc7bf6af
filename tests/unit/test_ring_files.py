"""The ring's file: private, whole, swept when stale; and what is said of files that are no ring."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from acquire.frame import FrameHeader
from acquire.ring import RingReader, RingWriter, shared_memory_folder, sweep_stale
from acquire.ring_layout import PAGE, Geometry, Word
from devices.clock import SystemClock
from devices.errors import StoreError

SHAPE = (6, 5)
SLOTS = 4


@pytest.fixture
def clock():
    return SystemClock()


@pytest.fixture
def writer(clock, tmp_path):
    with RingWriter.create("test", SHAPE, "uint16", SLOTS, clock=clock, folder=tmp_path) as writer:
        yield writer


def open_files():
    return len(list(Path("/proc/self/fd").iterdir()))


def complaint(error):
    assert error.what
    assert error.why
    assert error.fix
    return error.code


def test_the_file_is_private_whole_and_gone_after_close(clock, tmp_path):
    writer = RingWriter.create("look", SHAPE, "uint16", SLOTS, clock=clock, folder=tmp_path)
    status = writer.path.stat()
    assert status.st_mode & 0o777 == 0o600
    assert status.st_blocks * 512 >= status.st_size == writer.geometry.file_bytes
    assert writer.path.name.startswith(f"stereotome-{os.getpid()}-look-")
    writer.close()
    assert list(tmp_path.iterdir()) == []


def test_the_janitor_takes_only_what_nobody_holds(writer, tmp_path):
    stale = tmp_path / "stereotome-1-old-0123.ring"
    stale.write_bytes(bytes(PAGE))
    stranger = tmp_path / "stereotome-notes.txt"
    stranger.write_text("mine")
    (tmp_path / "stereotome-folder.ring").mkdir()
    assert sweep_stale(tmp_path) == (stale,)
    assert writer.path.exists()
    assert stranger.exists()


def test_the_janitor_leaves_readers_their_memory(writer, clock, tmp_path):
    orphan = tmp_path / "stereotome-2-orphan-0.ring"
    with RingReader.attach(writer.path, "lossless", clock=clock) as reader:
        writer.push(np.full(SHAPE, 7, np.uint16), FrameHeader(plane=0, setpoint_um=0, z_um=0, exposure_ms=1))
        os.link(writer.path, orphan)
        writer.close()
        assert sweep_stale(tmp_path) == (orphan,)
        assert (reader.read(0).pixels == 7).all()


def test_no_memory_is_one_clear_error_and_leaves_nothing(clock, tmp_path):
    folder = shared_memory_folder()
    free = os.statvfs(folder).f_bavail * os.statvfs(folder).f_frsize
    slots = 1 << 30
    assert Geometry((2048, 2048), "uint16", slots).file_bytes > 100 * free
    before = open_files()
    with pytest.raises(StoreError) as caught:
        RingWriter.create("huge", (2048, 2048), "uint16", slots, clock=clock)
    assert complaint(caught.value) == "ring-no-memory"
    assert str(slots) in caught.value.what
    assert open_files() == before
    assert list(folder.glob(f"stereotome-{os.getpid()}-huge-*")) == []


def test_a_missing_folder_is_one_clear_error(clock, tmp_path):
    with pytest.raises(StoreError) as caught:
        RingWriter.create("x", SHAPE, "uint8", 2, clock=clock, folder=tmp_path / "nowhere")
    assert complaint(caught.value) == "ring-no-memory"
    assert "No such file" in caught.value.why


@pytest.mark.parametrize(
    ("shape", "dtype", "slots"),
    [((4,), "uint8", 4), ((4, 0), "uint8", 4), ((4, 4), "float32", 4), ((4, 4), "uint8", 1)],
)
def test_impossible_rings_are_refused(shape, dtype, slots, clock, tmp_path):
    with pytest.raises(StoreError) as caught:
        RingWriter.create("x", shape, dtype, slots, clock=clock, folder=tmp_path)
    assert complaint(caught.value) == "ring-geometry"


def with_word(ring, word, value):
    words = np.frombuffer(ring, np.uint64).copy()
    words[word] = value
    return words.tobytes()


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda ring: b"", "only 0 bytes"),
        (lambda ring: b"II*\0 a picture", "only 14 bytes"),
        (lambda ring: bytes(len(ring)), "not those of a ring"),
        (lambda ring: with_word(ring, Word.LAYOUT, 1), "another version"),
        (lambda ring: ring[:-PAGE], "bytes instead of"),
    ],
)
def test_a_wrong_file_is_one_clear_error(spoil, words, writer, clock, tmp_path):
    path = tmp_path / "some.ring"
    path.write_bytes(spoil(writer.path.read_bytes()))
    with pytest.raises(StoreError) as caught:
        RingReader.attach(path, "latest", clock=clock)
    assert complaint(caught.value) == "ring-file"
    assert words in caught.value.why


def test_a_missing_file_is_one_clear_error(clock, tmp_path):
    with pytest.raises(StoreError) as caught:
        RingReader.attach(Path(tmp_path / "gone.ring"), "latest", clock=clock)
    assert complaint(caught.value) == "ring-file"
    assert "No such file" in caught.value.why
