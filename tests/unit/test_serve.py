"""The instrument process: real sockets, a real serial line behind them, and clients that do everything wrong."""

import json
import os
import stat
import threading
from contextlib import contextmanager

import numpy as np
import pytest
import zmq
from served import PATIENCE_S, RECIPE, SMALL_BENCH, served, short_folder
from wires import stereotome

from acquire import messages, requests
from acquire.client import Instrument
from acquire.logs import logs_folder
from acquire.meeting import ServerGone, find_meeting
from acquire.store import RunEnd, open_run
from devices.errors import DeviceBusy, InputError, PlanError, StereotomeError, Unsafe


@pytest.fixture
def instrument(server):
    with server.client() as instrument:
        instrument.command("ann", wait_s=PATIENCE_S)
        yield instrument
        instrument.clear_stop()


def code_of(kind, call, *arguments, **options):
    with pytest.raises(kind) as caught:
        call(*arguments, **options)
    return caught.value.code


def taken(planes):
    """A condition: so many planes of the run were taken."""
    return lambda state: state.run is not None and state.state != "IDLE" and state.run.taken >= planes


def test_only_its_user_can_reach_it(server):
    assert stat.S_IMODE(server.connection.stat().st_mode) == 0o600
    assert stat.S_IMODE(server.connection.parent.stat().st_mode) == 0o700
    meeting = find_meeting(server.connection)
    assert all(address.startswith(f"ipc://{server.connection.parent}") for address in meeting.endpoints.values())


def test_it_keeps_a_log_that_the_command_line_shows(server):
    shown = stereotome("logs", "-n", "100000")
    assert (logs_folder() / "serve-small.log").exists()
    assert shown.code == 0
    assert not shown.err


def test_the_stage_moves_and_tells_where_it_rests(instrument, small_bench):
    assert instrument.move(12.5) == pytest.approx(12.5, abs=0.2)
    assert small_bench.ask(do="truth")["z_um"] == pytest.approx(12.5, abs=0.3)
    assert instrument.jog(-2.5) == pytest.approx(10.0, abs=0.2)
    assert instrument.wait_for(lambda state: state.z_um is not None and abs(state.z_um - 10) < 0.2, PATIENCE_S)


def test_errors_come_as_what_they_are(instrument):
    assert code_of(Unsafe, instrument.move, 1e6) == "limit"
    assert code_of(Unsafe, instrument.move, float("nan")) == "limit"
    assert code_of(PlanError, instrument.start_run, "this is no recipe") == "config"
    assert code_of(PlanError, instrument.approach, 5.0) == "config"
    assert code_of(Unsafe, instrument.set_camera, 2.0, (0, 0, 5000, 5000)) == "limit"
    assert code_of(InputError, instrument.pause) == "no-run-active"


def test_a_snap_is_a_frame_of_now(instrument):
    z_um = instrument.move(3.0)
    pixels, at_um = instrument.snap()
    assert (pixels.shape, pixels.dtype) == ((80, 96), np.uint16)
    assert at_um == pytest.approx(z_um, abs=0.2)
    assert pixels.std() > 0


def test_live_frames_go_through_a_ring_and_stop(instrument):
    instrument.start_live(50.0)
    with instrument.viewer() as viewer:
        frames = [viewer.newest(PATIENCE_S) for _ in range(3)]
        numbers = [frame.number for frame in frames]
        assert numbers == sorted(set(numbers))
        assert frames[0].pixels.shape == (80, 96)
        instrument.set_camera(4.0, roi=(8, 8, 32, 16))  # another geometry: another ring, found by itself
        instrument.wait_for(lambda state: state.camera.startswith("32 x 16"), PATIENCE_S)
        while viewer.newest(PATIENCE_S).pixels.shape != (16, 32):
            pass
    instrument.set_camera(2.0, roi=(0, 0, 96, 80))
    instrument.stop_live()
    assert not instrument.wait_for(lambda state: not state.live, PATIENCE_S).live


def test_a_second_commander_is_refused_with_a_clear_word_and_may_look(instrument, server):
    with server.client() as other:
        with pytest.raises(DeviceBusy, match="ann commands this instrument") as refusal:
            other.command("bob")
        assert refusal.value.code == "lease-held"
        assert code_of(DeviceBusy, other.move, 0.0) == "lease-needed"
        assert other.state.holder == "ann"


def test_a_run_from_a_recipe_ends_complete_and_live_goes_on_after_it(instrument, tmp_path):
    instrument.start_live(50.0)
    events = []
    instrument.listen(events.append)
    started = instrument.start_run(RECIPE, out=tmp_path / "run")
    assert started.planned == 11
    assert code_of(DeviceBusy, instrument.move, 0.0) == "run-active"
    run = instrument.wait_for_run(PATIENCE_S)
    assert (run.state, run.durable) == ("COMPLETED", 11)
    stored = open_run(tmp_path / "run")
    assert (stored.state, stored.missing) == (RunEnd.COMPLETED, [])
    told = [each.event for each in events if hasattr(each, "event")]
    assert [event["plane"] for event in told if event["event"] == "plane"] == list(range(11))
    assert instrument.wait_for(lambda state: state.live, PATIENCE_S)
    instrument.stop_live()


def test_a_run_pauses_goes_on_and_is_cancelled(instrument, tmp_path):
    instrument.start_run(RECIPE, overrides=["stack.step=0.05"], out=tmp_path / "run")
    instrument.pause()
    instrument.wait_for(lambda state: state.state == "PAUSED", PATIENCE_S)
    instrument.resume()
    before = instrument.wait_for(lambda state: state.state == "RUNNING", PATIENCE_S).run.taken
    instrument.wait_for(taken(before + 1), PATIENCE_S)
    instrument.cancel()
    run = instrument.wait_for_run(PATIENCE_S)
    assert run.state == "CANCELLED"
    assert 0 < run.durable < run.planned
    started = instrument.continue_run(tmp_path / "run")
    assert started.folder == str(tmp_path / "run")
    instrument.cancel()
    instrument.wait_for_run(PATIENCE_S)


def test_what_was_expected_otherwise_is_not_done(instrument):
    def ask(**expected):
        return instrument.ask(requests.MoveStage(z_um=1.0, **expected)).result()

    assert code_of(Unsafe, ask, expect_state="RUNNING") == "serve-expected"
    assert ask(expect_state="IDLE").z_um == pytest.approx(1.0, abs=0.2)


def test_anyone_may_stop_and_motion_is_refused_until_it_is_cleared(instrument, server):
    with server.client() as other:
        assert other.stop().told == ("z stage",)
    assert code_of(Unsafe, instrument.move, 0.0) == "serve-stopped"
    assert instrument.wait_for(lambda state: state.stopped, PATIENCE_S)
    instrument.clear_stop()
    instrument.move(0.0)


def test_a_stop_ends_a_move_and_a_run(instrument, server, tmp_path):
    instrument.start_run(RECIPE, overrides=["stack.step=0.02"], out=tmp_path / "run")
    instrument.wait_for(taken(3), PATIENCE_S)
    assert "run" in instrument.stop().told
    run = instrument.wait_for_run(PATIENCE_S)
    assert run.state == "CANCELLED"
    instrument.clear_stop()
    instrument.move(-90.0)
    done = instrument.ask(requests.MoveStage(z_um=90.0))
    instrument.stop()
    with pytest.raises(StereotomeError) as halted:
        done.result(PATIENCE_S)
    assert halted.value.code in {"stage-stalled", "device-halted", "serve-stopped"}


def test_the_commander_dies_and_another_takes_over(server):
    dead = server.client()
    dead.command("ann", wait_s=PATIENCE_S)
    dead._wires.lease = ""  # as if its process had been killed: it says nothing more
    with server.client() as other:
        assert code_of(DeviceBusy, other.command, "bob") == "lease-held"
        other.command("bob", wait_s=PATIENCE_S)
        other.move(1.0)
    dead.close()


@contextmanager
def raw(server):
    """A bare socket, to say anything through it."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as socket:
        socket.linger, socket.rcvtimeo = 0, int(PATIENCE_S * 1000)
        socket.connect(find_meeting(server.connection).endpoints["control"])
        yield socket


def test_garbage_and_foreigners_do_no_harm(server, instrument):
    header = messages.Header(client="x", number=1, key=instrument.meeting.key, epoch=instrument.welcome.epoch)
    with raw(server) as socket:
        socket.send(b"GET / HTTP/1.1\r\n\r\n")
        socket.send_multipart([b"x"] * 50)
        socket.send_multipart([messages.MAJOR, os.urandom(200), os.urandom(200)])
        assert messages.decode_reply(socket.recv_multipart()[2]).code == "serve-request"
        socket.send_multipart([messages.MAJOR, messages.encode(header), messages.encode(requests.GetState())])
        assert messages.decode_reply(socket.recv_multipart()[2]).state == "IDLE"


def test_a_giant_is_hung_up_on(server, instrument):
    with raw(server) as socket:
        socket.send_multipart([messages.MAJOR, b"", bytes(messages.MAX_REQUEST_BYTES + 1)])
        assert not socket.poll(300)
    assert instrument.move(0.0) == pytest.approx(0.0, abs=0.2)


def test_two_servers_on_one_instrument_are_refused(server, small_bench):
    result = stereotome("serve", "-i", small_bench.instrument, env={"XDG_RUNTIME_DIR": str(server.runtime)})
    assert result.code == 8
    assert result.err.count("error[") == 1


def test_a_server_that_is_not_there_is_told_at_once(tmp_path):
    assert code_of(ServerGone, Instrument.connect, tmp_path / "none.json") == "serve-silent"


@pytest.fixture
def recipe(tmp_path):
    path = tmp_path / "recipe.toml"
    path.write_text(RECIPE)
    return path


def run_there(server, *arguments):
    return stereotome("run", *arguments, env={"XDG_RUNTIME_DIR": str(server.runtime)})


def test_run_has_the_process_take_it_that_serves_the_instrument(server, small_bench, recipe, tmp_path):
    result = run_there(server, recipe, "-i", small_bench.instrument, "--out", tmp_path / "run", "--json")
    assert result.code == 0, result.err
    events = [json.loads(line) for line in result.out.splitlines()]
    assert [e["plane"] for e in events if e["event"] == "plane"] == list(range(11))
    assert events[-1] == {"event": "done", "state": "COMPLETED", "folder": str(tmp_path / "run"), "missing": []}
    assert open_run(tmp_path / "run").state is RunEnd.COMPLETED
    wrong = run_there(server, recipe, "--server", "--out", tmp_path / "run")
    assert (wrong.code, wrong.err.count("error[")) == (2, 1)
    assert "output-exists" in wrong.err


def test_run_does_not_push_the_commander_aside(server, instrument, recipe, tmp_path):
    result = run_there(server, recipe, "--server", "--out", tmp_path / "run")
    assert (result.code, result.err.count("error[lease-held]")) == (8, 1)


def test_run_without_a_server_says_so(recipe):
    with short_folder() as nowhere:
        result = stereotome("run", recipe, "--server", env={"XDG_RUNTIME_DIR": str(nowhere)})
    assert (result.code, result.err.count("error[serve-silent]")) == (4, 1)


def test_ctrl_c_ends_it_cleanly(tmp_path, start_bench):
    small = tmp_path / "small.toml"
    small.write_text(SMALL_BENCH.replace('"small"', '"other"'))
    with served(start_bench(small).instrument) as server:
        with server.client() as instrument:
            instrument.command("ann")
            instrument.start_run(RECIPE, overrides=["stack.step=0.02"], out=tmp_path / "run")
            instrument.wait_for(taken(2), PATIENCE_S)
        code, err = server.end()
        assert code == 0, err
        assert not server.connection.exists()
        assert "Traceback" not in err
    run = open_run(tmp_path / "run")
    assert run.state is RunEnd.CANCELLED
    assert run.planes


def test_threads_may_share_a_client(instrument):
    results = []
    threads = [threading.Thread(target=lambda: results.append(instrument.move(2.0))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results == pytest.approx([2.0] * 4, abs=0.2)
