"""Pictures and the console's buttons from the command line, at a real instrument process."""

import json
from contextlib import closing

import pytest
import tifffile
from served import PATIENCE_S, RECIPE, SMALL_BENCH, served
from wires import stereotome

from acquire.store import RunEnd, open_run
from sim.pytest_plugin import SimBench


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """An instrument process of these tests' own: they ask that its stage was never lost."""
    folder = tmp_path_factory.mktemp("control")
    small = folder / "small.toml"
    small.write_text(SMALL_BENCH.replace('"small"', '"control"'))
    with closing(SimBench([str(small), "--dir", str(folder / "b")])) as bench, served(bench.instrument) as server:
        yield server


@pytest.fixture
def at(server):
    """Return a function that runs a command at the served instrument; nobody commands it afterwards."""

    def run(*words):
        return stereotome(*words, "--server", server.connection)

    yield run
    run("control", "release")


def told(result):
    assert result.code == 0, result.err
    return json.loads(result.out)


def test_pictures_are_kept_with_what_is_known_about_them(at, tmp_path):
    file = tmp_path / "three.tif"
    kept = told(at("snap", "-o", file, "-n", 3, "--z", 7.5, "--exposure-ms", 3, "--json"))
    assert (kept["pictures"], kept["shape"]) == (3, [80, 96])
    assert kept["z_um"] == pytest.approx(7.5, abs=0.2)
    with tifffile.TiffFile(file) as tiff:
        about = json.loads(json.loads(tiff.pages[0].description)["Info"])
        assert tiff.asarray().shape == (3, 80, 96)
    assert about["pixel_um"] == pytest.approx(3.45 / 20)
    assert [frame["exposure_ms"] for frame in about["frames"]] == [3.0] * 3
    again = at("snap", "-o", file)
    assert (again.code, "output-exists" in again.err) == (2, True)


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["-o", "a.jpg"], 2, "usage"),
        (["-o", "a.tif", "-n", "0"], 2, "usage"),
        (["-o", "no/such/a.tif"], 2, "output-folder"),
        (["-o", "a.tif", "--roi", "0", "0", "8", "8"], 2, "usage"),
        (["-o", "a.tif", "--z", "1e9"], 5, "limit"),
        (["-o", "a.tif", "--z", "nan"], 5, "limit"),
    ],
)
def test_a_picture_that_cannot_be_taken_is_refused_in_words(at, tmp_path, monkeypatch, words, code, said):
    monkeypatch.chdir(tmp_path)
    result = at("snap", *words)
    assert (result.code, f"error[{said}]" in result.err) == (code, True)
    assert not list(tmp_path.iterdir())


def test_the_stage_moves_and_a_stop_latches(at):
    assert told(at("control", "move", "5", "--json"))["z_um"] == pytest.approx(5, abs=0.2)
    assert told(at("control", "jog", "-2", "--json"))["z_um"] == pytest.approx(3, abs=0.2)
    assert "STOPPED" in at("control", "stop").out
    refused = at("control", "move", "5")
    assert (refused.code, "error[serve-stopped]" in refused.err) == (5, True)
    assert "STOPPED" not in at("control", "release").out


def test_a_run_is_paused_annotated_resumed_and_ended(at, server, tmp_path):
    with server.client() as client:
        client.command("ann", wait_s=PATIENCE_S)
        client.start_run(RECIPE.replace("step = 2.0", "step = 0.05"), out=tmp_path / "run")
    assert at("control", "pause", "plane").code == 0
    with server.client() as client:
        client.wait_for(lambda state: state.state == "PAUSED", PATIENCE_S)
    assert "run t: PAUSED" in at("control", "note", "a scratch at the left").out
    assert at("control", "resume").code == 0
    assert at("control", "cancel").code == 0
    with server.client() as client:
        client.wait_for_run(PATIENCE_S)
    assert open_run(tmp_path / "run").state is RunEnd.CANCELLED
    assert "a scratch at the left" in (tmp_path / "run" / "journal.jsonl").read_text()
    assert "error[no-run-active]" in at("control", "answer", "yes").err
