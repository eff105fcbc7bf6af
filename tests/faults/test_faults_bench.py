"""Every device of a whole bench × every fault, on real wires, switched on from outside while drivers are at work."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from typing import TYPE_CHECKING

import pytest

from devices.clock import SystemClock
from devices.errors import CameraTimeout, DeviceError, LinkError, LinkLost
from devices.feed_values import FeedState
from devices.registry import DeviceContext, factory
from devices.rig import load_rig, open_rig
from sim.pytest_plugin import StartBench

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from devices.rig import Rig
    from sim.pytest_plugin import SimBench

RIG = """schema = 1
name = "whole"
camera = {{ driver = "sim", size_px = [64, 48], bit_depth = 12, pixel_um = 3.45, exposure_ms = 2.0 }}
optics = {{ magnification = 20.0, na = 0.45 }}
[stage.z]
driver = "{driver}"
port = "written by the bench"
baud = 115200
units_per_um = {units_per_um}
limits = {{ min_um = -100.0, max_um = 100.0 }}
[microtome]
driver = "modbus"
profile = "leadshine-rs"
port = "written by the bench"
timeout_s = 0.3
limits = {{ feed_um_max = 4000.0, thickness_nm_max = 10000.0 }}
knife = {{ profile = "plc-mailbox", unit = 2, window_um = [300.0, 0.0], clearance_um = 5.0, grace_s = 1.0 }}
[glasses]
driver = "open3d"
port = "written by the bench"
"""
STAGES = {"asi-ms2000": 10.0, "asi-tiger": 10.0, "pi-gcs2": 1.0, "prior-proscan": 10.0}
PASSING = ("drop", "late", "garble", "half")
LASTING = ("silent", "die", "unplug", "power")
DEVICES = ("z", "feed", "glasses")


@contextmanager
def started(folder: Path, driver: str = "asi-ms2000"):
    path = folder / "whole.toml"
    path.write_text(RIG.format(driver=driver, units_per_um=STAGES[driver]))
    with ExitStack() as running:
        yield StartBench(folder, running)(path)


@pytest.fixture(scope="module", params=STAGES)
def bench_of_stage(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory):
    with started(tmp_path_factory.mktemp("bench"), request.param) as bench:
        yield bench


@pytest.fixture
def staged(bench_of_stage: SimBench):
    """A bench without faults, its stage at 0."""
    make_well(bench_of_stage)
    with closing(open_stage(bench_of_stage)) as stage:
        stage.move_to(0.0)
        stage.settle(10.0)
    return bench_of_stage


@pytest.fixture(scope="module")
def whole_bench(tmp_path_factory: pytest.TempPathFactory):
    with started(tmp_path_factory.mktemp("bench")) as bench:
        yield bench


@pytest.fixture
def whole(whole_bench: SimBench):
    make_well(whole_bench)
    with open_rig(load_rig(whole_bench.instrument), clock=SystemClock()) as rig:
        yield whole_bench, rig


def make_well(bench: SimBench) -> None:
    for fault in bench.ask(do="faults")["faults"]:
        bench.ask(do="fault", clear=fault)
    for device in DEVICES:
        bench.ask(do="replug", device=device)
        bench.ask(do="power", device=device, on=True)
    bench.ask(do="power-cycle", device="feed")  # no alarm outlives it
    truth_um(bench)


def strike(bench: SimBench, device: str, kind: str) -> None:
    """Let a fault strike the next reply, or from now on."""
    if kind == "unplug":
        bench.ask(do="unplug", device=device)
    elif kind == "power":
        bench.ask(do="power", device=device, on=False)
    else:
        bench.ask(do="fault", set=f"{device}.{kind}" + ("@1" if kind in PASSING else ""))


def outcome(do: Callable[[], object]) -> DeviceError | None:
    """Do it and return our error; any other exception is a failure of the test."""
    try:
        do()
    except DeviceError as error:
        return error
    return None


def truth_um(bench: SimBench) -> float:
    while True:
        told = bench.ask(do="truth")
        if not told["moving"]:
            return told["z_um"]


def open_stage(bench: SimBench):
    table = load_rig(bench.instrument).stage.z
    return factory(table.driver, "stage")(table, DeviceContext(SystemClock()))


@pytest.mark.parametrize("kind", PASSING)
def test_a_reply_of_the_stage_goes_wrong(staged: SimBench, kind: str):
    with closing(open_stage(staged)) as stage:
        strike(staged, "z", kind)
        error = outcome(lambda: stage.move_to(20.0) or stage.settle(10.0))
        assert error is None or isinstance(error, LinkError) or error.code == "position-unknown"
        if error is None:
            assert truth_um(staged) == pytest.approx(20.0, abs=0.1)
            assert stage.position_um() == pytest.approx(truth_um(staged), abs=0.1)


@pytest.mark.parametrize("fault", ["z.stall@5um", "z.limit@5um"])
def test_the_stage_cannot_go_on(staged: SimBench, fault: str):
    with closing(open_stage(staged)) as stage:
        staged.ask(do="fault", set=fault)
        assert outcome(lambda: stage.move_to(50.0) or stage.settle(20.0)) is not None
        stage.halt()
        assert truth_um(staged) < 6.0
        assert stage.position_um() == pytest.approx(truth_um(staged), abs=0.1)


@pytest.mark.parametrize("kind", LASTING)
def test_the_stage_is_gone_in_the_middle_of_a_move(staged: SimBench, kind: str):
    with closing(open_stage(staged)) as stage:
        stage.move_to(80.0)
        strike(staged, "z", kind)
        error = outcome(lambda: stage.settle(10.0))
        assert isinstance(error, LinkError if kind != "power" else DeviceError)
        if kind in ("die", "unplug"):
            assert isinstance(error, LinkLost)
            assert outcome(lambda: stage.move_to(0.0)) is not None, "nothing moves while the position is unknown"
    make_well(staged)
    with closing(open_stage(staged)) as again:
        # a controller that was off counts from where it stands, unless its sensor is an absolute one
        assert kind == "power" or again.position_um() == pytest.approx(truth_um(staged), abs=0.1)


def counters(bench: SimBench) -> dict:
    return bench.ask(do="truth")["counters"]["feed"]


def test_a_whole_bench_does_all_it_is_for(whole: tuple[SimBench, Rig]):
    bench, rig = whole
    assert rig.feed is not None
    assert rig.glasses is not None
    rig.feed.home()
    before = counters(bench)["feeds"]
    rig.feed.advance_to(2000.0)
    rig.stage.move_to(10.0)
    assert rig.stage.settle(5.0) == pytest.approx(10.0, abs=0.1)
    rig.glasses.both_open()
    seen = []
    rig.camera.arm(1, lambda pixels, stamp: seen.append(pixels.shape))
    rig.camera.trigger()
    assert seen == [(48, 64)]
    assert rig.feed.position_nm() == pytest.approx(2000.0, abs=2.0)
    assert counters(bench)["feeds"] - before == 1
    assert set(bench.told["ports"]) == {"camera", "z", "feed", "glasses"}


@pytest.mark.parametrize("kind", [*PASSING, *LASTING])
def test_a_feed_is_made_once_or_not_at_all(whole: tuple[SimBench, Rig], kind: str):
    bench, rig = whole
    rig.feed.home()
    before = counters(bench)
    strike(bench, "feed", kind)
    error = outcome(lambda: rig.feed.advance_to(2000.0))
    if error is None:
        assert counters(bench)["feeds"] - before["feeds"] == 1
        assert rig.feed.position_nm() == pytest.approx(2000.0, abs=2.0)
    make_well(bench)
    after = counters(bench)
    assert after["feeds"] - before["feeds"] <= 1
    assert after["cuts"] == before["cuts"]


def test_a_drive_that_was_off_is_not_moved_before_it_was_homed(whole: tuple[SimBench, Rig]):
    bench, rig = whole
    rig.feed.home()
    bench.ask(do="power-cycle", device="feed")
    before = counters(bench)["feeds"]
    assert outcome(lambda: rig.feed.advance_to(2000.0)) is not None
    assert counters(bench)["feeds"] == before


@pytest.mark.parametrize("fault", ["feed.stall@3um", "feed.alarm@3um"])
def test_a_feed_that_cannot_go_on_is_named(whole: tuple[SimBench, Rig], fault: str):
    bench, rig = whole
    rig.feed.home()
    before = counters(bench)
    bench.ask(do="fault", set=fault)
    assert outcome(lambda: rig.feed.advance_to(5000.0)) is not None
    after = counters(bench)
    assert after["feeds"] - before["feeds"] == 1
    assert after["position_um"] < 4.999


@pytest.mark.parametrize("kind", [*PASSING, *LASTING])
def test_the_emitter_s_line_goes_wrong(whole: tuple[SimBench, Rig], kind: str):
    bench, rig = whole
    strike(bench, "glasses", kind)
    first = outcome(rig.glasses.both_open)
    if kind in LASTING:
        assert first is not None
    make_well(bench)
    if kind not in ("unplug", "die"):
        assert outcome(rig.glasses.both_open) is None or outcome(rig.glasses.both_open) is None


def test_a_frame_is_lost(whole: tuple[SimBench, Rig]):
    bench, rig = whole
    seen = []
    rig.camera.arm(2, lambda pixels, stamp: seen.append(stamp.hw_id))
    bench.ask(do="fault", set="camera.drop@1")
    assert isinstance(outcome(rig.camera.trigger), CameraTimeout)
    rig.camera.trigger()
    assert len(seen) == 1


def test_the_camera_hangs(whole: tuple[SimBench, Rig]):
    bench, rig = whole
    rig.camera.arm(2, lambda pixels, stamp: None)
    bench.ask(do="fault", set="camera.hang")
    assert isinstance(outcome(rig.camera.trigger), CameraTimeout)
    assert isinstance(outcome(rig.camera.trigger), CameraTimeout)


def test_many_stops_of_the_feed_at_once_are_all_answered(whole: tuple[SimBench, Rig]):
    """The run's own, its server's and the console's come together, and again and again."""
    _, rig = whole
    rig.feed.home()
    with ThreadPoolExecutor(8) as stopping:
        for depth_nm in (2000.0, 4000.0, 6000.0):
            moving = stopping.submit(outcome, lambda depth_nm=depth_nm: rig.feed.advance_to(depth_nm))
            stops = [stopping.submit(outcome, rig.feed.halt) for _ in range(12)]
            assert [stop.result() for stop in stops] == [None] * len(stops)
            assert not isinstance(moving.result(), LinkLost)
    assert rig.feed.resolve() is FeedState.READY


@pytest.mark.parametrize("fault", ["feed.uncounted", "feed.jam"])
def test_a_cut_is_never_made_twice(whole: tuple[SimBench, Rig], fault: str):
    bench, rig = whole
    rig.feed.home()
    rig.feed.allow_cuts(lambda: None)
    rig.feed.advance_to(2000.0)
    rig.feed.arm()
    bench.ask(do="fault", set=fault)
    before = counters(bench)["cuts"]
    assert outcome(rig.feed.cut) is not None
    assert counters(bench)["cuts"] - before <= 1


def test_the_whole_bench_dies(whole: tuple[SimBench, Rig]):
    bench, rig = whole
    rig.stage.move_to(50.0)
    bench.kill()
    rig.camera.arm(1, lambda pixels, stamp: None)
    for do in (lambda: rig.stage.settle(5.0), rig.camera.trigger, rig.glasses.both_open, rig.feed.position_nm):
        assert isinstance(outcome(do), LinkError)
