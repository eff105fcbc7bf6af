"""The run command as a user meets it: real processes, a real serial line, and everything that can go wrong."""

import json
import os
import random
import re
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
import zarr
from wires import PROGRAM, stereotome

from acquire.store import RunEnd, open_run
from acquire.words import ranges

SMALL_BENCH = """
schema = 1
name = "small"
[camera]
driver = "sim"
size_px = [96, 80]
bit_depth = 12
pixel_um = 3.45
exposure_ms = 2.0
[optics]
magnification = 20.0
na = 0.45
[stage.z]
driver = "asi-ms2000"
port = "filled in by the bench"
baud = 115200
limits = { min_um = -100.0, max_um = 100.0 }
speed_um_s = 5000.0
"""

RECIPE = """
schema = 1
name = "t"
[output]
keep_free_gb = 0.001
[stack]
top_um = 10.0
bottom_um = -10.0
step = 2.0
"""


@pytest.fixture
def small(tmp_path):
    path = tmp_path / "small.toml"
    path.write_text(SMALL_BENCH)
    return path


@pytest.fixture
def recipe(tmp_path):
    path = tmp_path / "recipe.toml"
    path.write_text(RECIPE)
    return path


LONG = ["--set", "stack.step=0.1", "--set", 'stack.return_to="middle"']


def one_clear_error(result, code):
    """Exactly one error, with its code, and no traceback."""
    assert result.err.count("error[") == 1, result.err
    assert f"error[{code}]" in result.err, result.err
    assert "Traceback" not in result.err


def test_a_stack_lands_on_disk_with_readback_beside_setpoint(lend_bench, small, recipe, tmp_path):
    bench = lend_bench(small)
    result = stereotome("run", recipe, "-i", bench.instrument, "--out", tmp_path / "run")
    assert result.code == 0, result.err
    assert "11 of 11 planes are durable and verified" in result.err
    run = open_run(tmp_path / "run")
    assert (run.state, run.missing) == (RunEnd.COMPLETED, [])
    headers = [run.planes[k].header for k in range(11)]
    assert [h.setpoint_um for h in headers] == [-10.0 + 2 * k for k in range(11)]
    assert [h.z_um for h in headers] == pytest.approx([h.setpoint_um for h in headers], abs=0.2)
    starts = [h.exposure_start_ns for h in headers]
    assert starts == sorted(starts)
    assert all(h.exposure_start_ns > 0 for h in headers)
    planes = np.stack([run.read(k) for k in range(11)])
    np.testing.assert_array_equal(zarr.open_array(run.folder / "focal.ome.zarr/0", mode="r")[0, 0], planes)
    assert len({plane.tobytes() for plane in planes}) == 11


def test_json_tells_everything_one_object_a_line(lend_bench, small, recipe, tmp_path):
    bench = lend_bench(small)
    result = stereotome("run", recipe, "-i", bench.instrument, "--out", tmp_path / "run", "--json")
    events = [json.loads(line) for line in result.out.splitlines()]
    assert [e["plane"] for e in events if e["event"] == "plane"] == list(range(11))
    assert events[-1] == {"event": "done", "state": "COMPLETED", "folder": str(tmp_path / "run"), "missing": []}


def test_the_bench_in_one_command(small, recipe, tmp_path):
    result = stereotome("run", recipe, "-i", small, "--sim", "--out", tmp_path / "run", "--set", "stack.step=10")
    assert result.code == 0, result.err
    assert len(open_run(tmp_path / "run").planes) == 3


def test_values_set_for_a_simulated_run_hold_for_the_bench(small, recipe, tmp_path):
    few = ["--set", "stack.step=10", "--set", "camera.size_px=[40, 32]", "--set", "camera.bit_depth=8"]
    result = stereotome("run", recipe, "-i", small, "--sim", "--out", tmp_path / "run", *few)
    assert result.code == 0, result.err
    pixels = open_run(tmp_path / "run").read(0)
    assert (pixels.shape, pixels.dtype) == ((32, 40), np.uint8)


def test_dry_run_lists_every_plane_and_moves_nothing(lend_bench, small, recipe, tmp_path):
    bench = lend_bench(small)
    result = stereotome("run", recipe, "-i", bench.instrument, "--dry-run", "--out", tmp_path / "run")
    assert result.code == 0
    assert len(result.out.splitlines()) == 11
    assert "nothing was moved" in result.err
    assert not (tmp_path / "run").exists()


def interrupted(lend_bench, small, recipe, folder, planes, how):
    """Start a long run, send it a signal after ``planes`` planes, and return its exit code and words."""
    bench = lend_bench(small)
    process = subprocess.Popen(
        [*PROGRAM, *f"run {recipe} -i {bench.instrument} --out {folder} --json".split(), *LONG],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        stdin=subprocess.DEVNULL,
    )
    seen = 0
    for line in process.stdout:
        seen += json.loads(line)["event"] == "plane"
        if seen == planes:
            how(process, bench)
            break
    out, err = process.communicate()
    return bench, process.returncode, out, err


@pytest.mark.parametrize("planes", [1, 7, "any"])
def test_kill_9_leaves_exactly_the_durable_planes(lend_bench, small, recipe, tmp_path, planes):
    planes = random.Random().randrange(2, 60) if planes == "any" else planes
    folder = tmp_path / "run"
    _, code, _, _ = interrupted(lend_bench, small, recipe, folder, planes, lambda process, _: process.kill())
    assert code == -signal.SIGKILL
    told = stereotome("run", "--dry-run", folder)
    assert told.code == 0, told.err
    assert told.out.startswith("INTERRUPTED: ")
    run = open_run(folder)
    durable = sorted(run.planes)
    assert durable == list(range(len(durable)))
    assert f"{len(durable)} of 201 planes" in told.out
    assert f"missing: {ranges(run.missing)}" in told.out
    array = zarr.open_array(folder / "focal.ome.zarr/0", mode="r")
    assert array.shape[2] == len(durable)
    for plane in durable:
        np.testing.assert_array_equal(array[0, 0, plane], run.read(plane))
    assert planes - 8 <= len(durable)


def test_ctrl_c_ends_after_the_plane_keeps_the_data_and_goes_back(lend_bench, small, recipe, tmp_path):
    folder = tmp_path / "run"
    bench, code, out, err = interrupted(
        lend_bench, small, recipe, folder, 5, lambda process, _: process.send_signal(signal.SIGINT)
    )
    assert code == 7, err
    run = open_run(folder)
    assert run.state is RunEnd.CANCELLED
    assert 5 <= len(run.planes) < 201
    assert json.loads(out.splitlines()[-1])["state"] == "CANCELLED"
    assert "Traceback" not in err
    assert stage_position_um(bench) == pytest.approx(0.0, abs=0.2)


def killed_run(lend_bench, small, recipe, folder, planes=9):
    bench, *_ = interrupted(lend_bench, small, recipe, folder, planes, lambda process, _: process.kill())
    return bench, open_run(folder).planes


def test_a_killed_run_goes_on_where_it_was(lend_bench, small, recipe, tmp_path):
    folder = tmp_path / "run"
    bench, before = killed_run(lend_bench, small, recipe, folder)
    result = stereotome("run", "--resume", folder, "-i", bench.instrument)
    assert result.code == 0, result.err
    run = open_run(folder)
    assert (run.state, run.missing) == (RunEnd.COMPLETED, [])
    assert {plane: run.planes[plane] for plane in before} == before
    assert [run.planes[k].header.z_um for k in range(201)] == pytest.approx(
        [-10 + 0.1 * k for k in range(201)], abs=0.2
    )
    for plane in run.planes:
        run.read(plane)
    again = stereotome("run", "--resume", folder, "-i", bench.instrument)
    assert again.code == 2
    one_clear_error(again, "nothing-missing")


def test_a_run_does_not_go_on_over_another_specimen(lend_bench, small, recipe, tmp_path):
    folder = tmp_path / "run"
    killed_run(lend_bench, small, recipe, folder)
    journal = (folder / "journal.jsonl").read_bytes()
    other = small.with_name("other.toml")
    other.write_text(SMALL_BENCH + "[sim]\nseed = 8\n")
    result = stereotome("run", "--resume", folder, "-i", lend_bench(other).instrument)
    assert result.code == 5, result.err
    one_clear_error(result, "other-view")
    assert (folder / "journal.jsonl").read_bytes() == journal


@pytest.mark.parametrize(
    "change", [("na = 0.45", "na = 0.3"), ("[96, 80]", "[64, 64]"), ("max_um = 100.0", "max_um = 50.0")]
)
def test_a_run_does_not_go_on_with_another_instrument(lend_bench, small, recipe, tmp_path, change):
    folder = tmp_path / "run"
    killed_run(lend_bench, small, recipe, folder, planes=2)
    other = small.with_name("other.toml")
    other.write_text(SMALL_BENCH.replace(*change))
    result = stereotome("run", "--resume", folder, "-i", lend_bench(other).instrument)
    assert result.code == 5, result.err
    one_clear_error(result, "other-instrument")


def test_a_run_does_not_go_on_with_another_recipe(lend_bench, small, recipe, tmp_path):
    folder = tmp_path / "run"
    bench, _ = killed_run(lend_bench, small, recipe, folder, planes=2)
    result = stereotome("run", recipe, "--resume", folder, "-i", bench.instrument)
    assert result.code == 3
    one_clear_error(result, "other-recipe")


def stage_position_um(bench):
    """Ask the twin over the network, past the program."""
    import socket

    host, port = bench.told["stage_tcp"].removeprefix("socket://").rsplit(":", 1)
    with socket.create_connection((host, int(port))) as line:
        line.sendall(b"W Z\r")
        reply = b""
        while not reply.endswith(b"\n"):
            reply += line.recv(64)
    return float(reply.split()[1]) / 10


def test_a_twin_that_dies_mid_run_ends_it_with_the_data_kept(start_bench, small, recipe, tmp_path):
    folder = tmp_path / "run"
    _, code, _, err = interrupted(start_bench, small, recipe, folder, 6, lambda _, bench: bench.kill())
    assert code == 9, err
    assert err.count("error[") == 1
    assert "Traceback" not in err
    assert "missing:" in err
    run = open_run(folder)
    assert run.state is RunEnd.FAILED
    assert len(run.planes) >= 6


@pytest.mark.parametrize(
    ("change", "code", "exit_code"),
    [
        (("--set", "stage.z.port=/dev/ttyNONE"), "device-missing", 4),
        (("--set", "stage.z.baud=9600"), "device-", 4),
        (("--set", "stack.top_um=500"), "limit", 5),
        (("--set", "output.keep_free_gb=1e9"), "disk-full", 6),
        (("--set", "stack.step=nan"), "config", 3),
        (("--set", "stack.step=0"), "config", 3),
        (("--set", "stack.stepp=1"), "config", 3),
        (("--set", "camera.address=127.0.0.1:1"), "device-", 4),
        (("--set", "camera.exposure_ms=1e9"), "", 5),
    ],
)
def test_bad_input_is_one_clear_line_and_nothing_is_written(
    lend_bench, small, recipe, tmp_path, change, code, exit_code
):
    bench = lend_bench(small)
    result = stereotome("run", recipe, "-i", bench.instrument, "--out", tmp_path / "run", *change)
    assert result.code == exit_code, result.err
    assert result.err.count("error[") == 1, result.err
    assert f"error[{code}" in result.err
    assert "Traceback" not in result.err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("fault", ["z.garble@8", "z.late@8", "z.silent@8"])
def test_noise_and_silence_on_the_line_never_shift_a_plane(lend_bench, small, recipe, tmp_path, fault):
    """One bad reply is asked again; a line that stays silent ends the run. Either way planes are where they say."""
    bench = lend_bench(small)
    bench.ask(do="fault", set=fault)
    result = stereotome("run", recipe, "-i", bench.instrument, "--out", tmp_path / "run")
    assert "Traceback" not in result.err
    assert result.code in {0, 4, 9}, result.err
    if (tmp_path / "run").exists():
        for record in open_run(tmp_path / "run").planes.values():
            assert record.header.z_um == pytest.approx(record.header.setpoint_um, abs=0.2)


def test_an_output_folder_that_exists_is_refused(lend_bench, small, recipe, tmp_path):
    bench = lend_bench(small)
    result = stereotome("run", recipe, "-i", bench.instrument, "--out", tmp_path)
    assert result.code == 2
    one_clear_error(result, "output-exists")


def test_all_problems_are_said_at_once(lend_bench, small, recipe, tmp_path):
    bench = lend_bench(small)
    result = stereotome("run", recipe, "-i", bench.instrument, "--out", tmp_path, "--set", "stack.top_um=500")
    assert "error[limit]" in result.err
    assert "error[output-exists]" in result.err


def test_no_instrument_is_said_with_both_ways_out(recipe):
    result = stereotome("run", recipe)
    assert result.code == 3
    assert "--sim" in result.err


def test_neither_recipe_nor_run_is_said(small):
    result = stereotome("run", "-i", small)
    assert result.code == 2
    one_clear_error(result, "usage")


def test_a_folder_that_is_no_run(tmp_path):
    result = stereotome("run", "--dry-run", tmp_path)
    assert result.code == 2
    one_clear_error(result, "no-run")


def test_a_stack_of_one_plane(lend_bench, small, recipe, tmp_path):
    bench = lend_bench(small)
    one = ("--set", "stack.top_um=0", "--set", "stack.bottom_um=0")
    result = stereotome("run", recipe, "-i", bench.instrument, "--out", tmp_path / "run", *one)
    assert result.code == 0, result.err
    assert len(open_run(tmp_path / "run").planes) == 1


def test_a_second_program_at_the_same_bench_is_told_it_is_busy(lend_bench, small, recipe, tmp_path):
    import serial

    bench = lend_bench(small)
    with serial.Serial(bench.told["stage_pty"], exclusive=True):
        result = stereotome("run", recipe, "-i", bench.instrument, "--out", tmp_path / "run")
    assert result.code == 8, result.err
    one_clear_error(result, "device-busy")


def test_ranges_in_words():
    assert ranges([]) == ""
    assert ranges([3]) == "3"
    assert ranges([0, 1, 2, 7, 9, 10]) == "0-2, 7, 9-10"


def test_runs_of_a_template_count_up(small, recipe, tmp_path):
    template = ("--set", 'output.folder="{name}-{run:02d}"', "--set", "stack.step=10")
    for expected in ("t-01", "t-02"):
        result = stereotome("run", recipe, "-i", small, "--sim", *template, cwd=tmp_path)
        assert (result.code, result.out.strip()) == (0, expected), result.err


UNCOMPRESSED = ["--set", "output.compression=none", "--set", "stack.step=0.8"]  # 26 planes, 400 kB and their folders
ON_A_SMALL_DISK = """
set -u
mkdir disk && mount -t tmpfs -o size=412k none disk || exit 99
"$@" --out disk/run
echo "exit $?"
shift_to_dry_run() { "$1" "$2" "$3" run --dry-run disk/run; }
shift_to_dry_run "$@"
"""


def test_a_disk_that_fills_up_ends_the_run_with_every_durable_plane_kept(lend_bench, small, recipe, tmp_path):
    bench = lend_bench(small)
    words = [*f"run {recipe} -i {bench.instrument} --set output.keep_free_gb=0".split(), *UNCOMPRESSED]
    done = subprocess.run(
        ["unshare", "-rm", "sh", "-c", ON_A_SMALL_DISK, "sh", *PROGRAM, *words],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
    )
    if done.returncode in {1, 99} and "exit" not in done.stdout:
        pytest.skip(f"no small disk can be mounted here: {done.stderr.strip()}")
    assert "exit 6" in done.stdout, done.stdout + done.stderr
    assert done.stderr.count("error[") == 1, done.stderr
    assert "error[disk-full]" in done.stderr
    assert "Traceback" not in done.stderr
    kept = int(re.search(r"(\d+) of 26 planes are durable", done.stderr).group(1))
    assert 0 < kept < 26
    assert f"FAILED: {kept} of 26 planes are durable and verified" in done.stdout


def children_named(pid, name):
    """Processes started by ``pid`` whose command line holds ``name``."""
    tasks = Path(f"/proc/{pid}/task").iterdir()
    pids = {int(child) for task in tasks for child in (task / "children").read_text().split()}
    return [child for child in pids if name in Path(f"/proc/{child}/cmdline").read_text()]


def test_an_observer_that_dies_costs_the_run_nothing(lend_bench, small, recipe, tmp_path):
    def kill_the_observer(process, _):
        (observer,) = children_named(process.pid, "acquire.observe")
        os.kill(observer, signal.SIGKILL)

    watched = recipe.with_name("watched.toml")
    watched.write_text(RECIPE + "[process]\nrange_image = true\n")
    folder = tmp_path / "run"
    _, code, out, err = interrupted(lend_bench, small, watched, folder, 5, kill_the_observer)
    assert code == 0, err
    assert json.loads(out.splitlines()[-1])["state"] == "COMPLETED"
    assert "warning: focus failed" in err
    assert len(open_run(folder).planes) == 201
