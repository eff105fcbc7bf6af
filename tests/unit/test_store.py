"""The store: what it calls durable is readable by strangers, and nothing else is."""

import dataclasses
import shutil

import numpy as np
import pytest
import zarr
from yaozarrs import validate_zarr_store

from acquire.frame import Frame, FrameHeader
from acquire.ome_zarr import FocalArray
from acquire.store import RunEnd, RunStore, open_run
from devices.clock import SystemClock
from devices.errors import InputError, StoreError

LAYOUT = FocalArray(planned=6, shape=(40, 56), dtype="uint16", start_um=-10.0, step_um=2.0, pixel_um=0.25)


def pixels_of(plane, layout=LAYOUT):
    rng = np.random.default_rng(plane)
    return rng.integers(0, 4096 if layout.dtype == "uint16" else 256, layout.shape).astype(layout.dtype)


def frame_of(plane, layout=LAYOUT):
    header = FrameHeader(plane=plane, setpoint_um=-10 + 2 * plane, z_um=-10 + 2 * plane + 0.01, exposure_ms=5.0)
    return Frame(plane, header, pixels_of(plane, layout))


@pytest.fixture
def store(tmp_path):
    return RunStore.create(tmp_path / "run", {"name": "t", "plan_id": "x"}, LAYOUT, SystemClock())


def published(store):
    return zarr.open_array(store.folder / "focal.ome.zarr" / "0", mode="r")


def test_a_stranger_reads_what_was_committed_and_no_more(store):
    assert published(store).shape == (1, 1, 0, 40, 56)
    store.put(frame_of(0))
    store.put(frame_of(1))
    assert published(store).shape[2] == 0
    store.commit()
    array = published(store)
    assert array.shape == (1, 1, 2, 40, 56)
    for plane in (0, 1):
        np.testing.assert_array_equal(array[0, 0, plane], pixels_of(plane))


def test_colour_planes_become_channels(tmp_path):
    layout = dataclasses.replace(LAYOUT, shape=(40, 56, 3), dtype="uint8")
    store = RunStore.create(tmp_path / "run", {"plan_id": "x"}, layout, SystemClock())
    store.put(frame_of(0, layout))
    store.commit()
    np.testing.assert_array_equal(np.moveaxis(published(store)[0, :, 0], 0, -1), pixels_of(0, layout))
    np.testing.assert_array_equal(open_run(store.folder).read(0), pixels_of(0, layout))
    store.close()


def test_a_black_plane_is_a_plane(store):
    black = Frame(0, frame_of(0).header, np.zeros(LAYOUT.shape, np.uint16))
    store.put(black)
    store.commit()
    assert (store.folder / "focal.ome.zarr/0/c/0/0/0/0/0").is_file()


def test_metadata_states_positions_in_micrometres(store):
    for plane in range(6):
        store.put(frame_of(plane))
    assert store.finalise(RunEnd.COMPLETED) is RunEnd.COMPLETED
    group = zarr.open_group(store.folder / "focal.ome.zarr", mode="r")
    image = group.attrs["ome"]["multiscales"][0]
    assert [axis["name"] for axis in image["axes"]] == list("tczyx")
    assert {axis.get("unit") for axis in image["axes"][2:]} == {"micrometer"}
    scale, translation = image["datasets"][0]["coordinateTransformations"]
    assert scale["scale"] == [1, 1, 2.0, 0.25, 0.25]
    assert translation["translation"] == [0, 0, -10.0, 0, 0]
    assert [p["z_um"] for p in group.attrs["stereotome"]["planes"]] == pytest.approx([-9.99 + 2 * k for k in range(6)])


@pytest.mark.parametrize("step_um", [2.0, -2.0])
def test_an_independent_checker_accepts_it_empty_growing_and_finished(tmp_path, step_um):
    layout = dataclasses.replace(LAYOUT, step_um=step_um)
    store = RunStore.create(tmp_path / "run", {"plan_id": "x"}, layout, SystemClock())
    validate_zarr_store(str(store.folder / "focal.ome.zarr"))
    store.put(frame_of(0))
    store.commit()
    validate_zarr_store(str(store.folder / "focal.ome.zarr"))
    store.finalise(RunEnd.CANCELLED)
    validate_zarr_store(str(store.folder / "focal.ome.zarr"))


def test_a_run_with_a_hole_is_never_called_completed(store):
    for plane in (0, 1, 3, 4, 5):
        store.put(frame_of(plane))
    assert store.finalise(RunEnd.COMPLETED) is RunEnd.COMPLETED_WITH_GAPS
    run = open_run(store.folder)
    assert run.missing == [2]
    with pytest.raises(StoreError, match="plane 2 is missing"):
        run.read(2)
    np.testing.assert_array_equal(run.read(3), pixels_of(3))


def test_a_flipped_byte_on_disk_is_noticed(store):
    store.put(frame_of(0))
    store.commit()
    shard = store.folder / "focal.ome.zarr/0/c/0/0/0/0/0"
    data = bytearray(shard.read_bytes())
    data[len(data) // 3] ^= 1
    shard.write_bytes(data)
    with pytest.raises(StoreError, match="plane 0 is damaged"):
        open_run(store.folder).read(0)


def test_a_vanished_plane_is_noticed(store):
    store.put(frame_of(0))
    store.commit()
    shutil.rmtree(store.folder / "focal.ome.zarr/0/c/0/0/0")
    with pytest.raises(StoreError, match="plane 0 is damaged"):
        open_run(store.folder).read(0)


def test_states_of_a_run_on_disk(store):
    store.put(frame_of(0))
    store.commit()
    assert open_run(store.folder).state is RunEnd.RUNNING
    store.close()
    run = open_run(store.folder)
    assert (run.state, run.missing) == (RunEnd.INTERRUPTED, [1, 2, 3, 4, 5])


def test_the_shape_catches_up_with_the_journal(store):
    store.put(frame_of(0))
    store.commit()
    before = (store.folder / "focal.ome.zarr/0/zarr.json").read_text()
    store.put(frame_of(1))
    store.commit()
    (store.folder / "focal.ome.zarr/0/zarr.json").write_text(before)
    open_run(store.folder).publish()
    assert published(store).shape[2] == 2


def test_a_folder_that_exists_is_never_written_into(tmp_path):
    (tmp_path / "run").mkdir()
    with pytest.raises(InputError, match="exists already"):
        RunStore.create(tmp_path / "run", {"plan_id": "x"}, LAYOUT, SystemClock())
    assert list((tmp_path / "run").iterdir()) == []


def test_something_else_is_not_a_run(tmp_path):
    with pytest.raises(InputError, match="is not a run folder"):
        open_run(tmp_path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run of six planes taken without interruption, without its last word."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    store = RunStore.create(folder, {"name": "t", "plan_id": "x"}, LAYOUT, SystemClock())
    for plane in range(LAYOUT.planned):
        store.put(frame_of(plane))
        store.commit()
    store.close()
    return folder


@pytest.mark.parametrize("torn_bytes", [0, 1, 60])
@pytest.mark.parametrize("records", range(1, LAYOUT.planned + 2))
def test_killed_at_any_record_a_run_goes_on_to_the_same_end(tmp_path, whole, records, torn_bytes):
    folder = tmp_path / "run"
    shutil.copytree(whole, folder)
    lines = (folder / "journal.jsonl").read_bytes().splitlines(keepends=True)
    torn = lines[records][:torn_bytes] if records < len(lines) else b""
    (folder / "journal.jsonl").write_bytes(b"".join(lines[:records]) + torn)
    assert open_run(folder).missing == list(range(records - 1, LAYOUT.planned))
    store = RunStore.reopen(folder, SystemClock())
    for plane in sorted(set(range(LAYOUT.planned)) - store.durable_planes):
        store.put(frame_of(plane))
    assert store.finalise(RunEnd.COMPLETED) is RunEnd.COMPLETED
    store.close()
    run = open_run(folder)
    assert (run.state, run.missing) == (RunEnd.COMPLETED, [])
    for plane in range(LAYOUT.planned):
        np.testing.assert_array_equal(run.read(plane), pixels_of(plane))
    assert published(store).shape[2] == LAYOUT.planned


def test_a_run_that_goes_on_is_not_ended(store):
    store.put(frame_of(0))
    store.finalise(RunEnd.CANCELLED)
    store.close()
    again = RunStore.reopen(store.folder, SystemClock())
    assert open_run(store.folder).state is RunEnd.RUNNING
    again.close()
    assert open_run(store.folder).state is RunEnd.INTERRUPTED


def test_what_a_killed_process_left_half_written_is_not_written_over_but_away(store):
    store.close()
    half = store.folder / "focal.ome.zarr/0/c/0/0/0/0/0.__lock"
    half.parent.mkdir(parents=True)
    half.write_bytes(b"longer than a plane" * 10_000)
    again = RunStore.reopen(store.folder, SystemClock())
    again.put(frame_of(0))
    again.commit()
    again.close()
    np.testing.assert_array_equal(open_run(store.folder).read(0), pixels_of(0))
    assert not half.exists()
