"""From the ring to the disk: everything handed over is durable at the end, and a disk that refuses is heard."""

import json
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from acquire.frame import FrameHeader, Missed
from acquire.ome_zarr import FocalArray
from acquire.recorder import (
    MAX_SLOTS,
    MAX_SLOTS_AT_CAMERA_RATE,
    MIN_SLOTS,
    RING_BYTES,
    Recorder,
    disk_failed,
    ring_slots,
)
from acquire.ring import RingWriter
from acquire.store import RunEnd, RunStore, open_run
from devices.clock import SystemClock
from devices.errors import StoreError

SHAPE = (64, 80)


def recorder(folder, planned, **options):
    clock = SystemClock()
    layout = FocalArray(planned, SHAPE, "uint16", start_um=0.0, step_um=1.0, pixel_um=None)
    ring = RingWriter.create("test", SHAPE, "uint16", 4, clock=clock)
    return Recorder(RunStore.create(folder, {"plan_id": "x"}, layout, clock), ring, clock, **options)


def header(plane):
    return FrameHeader(plane=plane, setpoint_um=float(plane), z_um=float(plane), exposure_ms=1.0)


def pixels(plane):
    return np.random.default_rng(plane).integers(0, 4096, SHAPE).astype(np.uint16)


def test_more_planes_than_the_ring_holds_all_become_durable(tmp_path):
    out = recorder(tmp_path / "run", 40)
    for plane in range(40):
        out.put(pixels(plane), header(plane))
    assert out.finish(RunEnd.COMPLETED) is RunEnd.COMPLETED
    run = open_run(tmp_path / "run")
    assert (run.state, run.missing) == (RunEnd.COMPLETED, [])
    for plane in range(40):
        np.testing.assert_array_equal(run.read(plane), pixels(plane))


def test_a_missed_plane_keeps_its_place_and_its_reason(tmp_path):
    out = recorder(tmp_path / "run", 3)
    out.put(pixels(0), header(0))
    out.missed(Missed(1, "camera-timeout"))
    out.put(pixels(2), header(2))
    assert out.finish(RunEnd.COMPLETED) is RunEnd.COMPLETED_WITH_GAPS
    run = open_run(tmp_path / "run")
    assert (run.missing, run.missed) == ([1], {1: "camera-timeout"})
    np.testing.assert_array_equal(run.read(2), pixels(2))


def take_until_refused(out, planes):
    for plane in range(planes):
        try:
            out.check()
        except StoreError as refusal:
            return plane, refusal
        out.put(pixels(plane), header(plane))
    return planes, None


def test_a_disk_below_its_reserve_stops_the_next_exposure_and_keeps_what_was_taken(tmp_path, monkeypatch):
    out = recorder(tmp_path / "run", 300, keep_free_bytes=2**40)
    fill = iter([2**41] * 20)
    monkeypatch.setattr("acquire.recorder.free_bytes", lambda _: next(fill, 2**30))
    taken, refusal = take_until_refused(out, 300)
    assert (refusal.code, refusal.exit_code) == ("disk-full", 6)
    out.finish(RunEnd.FAILED)
    run = open_run(tmp_path / "run")
    assert run.state is RunEnd.FAILED
    assert len(run.planes) == taken > 0


FULL_DISK = """
import json, pathlib, resource, sys
sys.path.insert(0, sys.argv[2])
from test_recorder import header, pixels, recorder
from acquire.store import RunEnd
from devices.errors import StoreError

out = recorder(pathlib.Path(sys.argv[1]) / "run", 40)
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
error = None
try:
    for plane in range(40):
        out.put(pixels(plane), header(plane))
except StoreError as refused:
    error = refused
try:
    out.finish(RunEnd.COMPLETED)
except StoreError as refused:
    error = error or refused
print(json.dumps({"code": error and error.code, "text": str(error)}))
"""


def test_a_write_the_disk_refuses_ends_the_run_and_nothing_is_called_complete(tmp_path):
    """A file size limit stands for the full disk: it refuses the same writes and needs no mount."""
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(tmp_path), str(Path(__file__).parent)], capture_output=True, text=True
    )
    assert done.stderr == ""
    told = json.loads(done.stdout)
    assert told["code"] in {"disk-failed", "disk-full"}
    run = open_run(tmp_path / "run")
    assert run.state is RunEnd.FAILED
    assert run.missing == list(range(40))
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[0] != 4096


def test_no_space_left_is_told_as_such():
    assert disk_failed(OSError(28, "No space left on device")).code == "disk-full"
    assert disk_failed(OSError(5, "Input/output error")).code == "disk-failed"


@given(st.integers(1, 2**28), st.integers(0, 2**36), st.booleans())
def test_the_ring_is_as_large_as_memory_allows(frame_bytes, free_bytes, camera_waits):
    slots = ring_slots(frame_bytes, free_bytes, camera_waits=camera_waits)
    assert MIN_SLOTS <= slots <= (MAX_SLOTS if camera_waits else MAX_SLOTS_AT_CAMERA_RATE)
    assert slots == MIN_SLOTS or slots * frame_bytes <= min(RING_BYTES, free_bytes // 2)
