"""``devices init`` and ``devices probe`` against benches of twins, as a user starts them."""

from __future__ import annotations

import json
from pathlib import Path  # noqa: TC003

import pytest
from wires import Result, stereotome

from devices.rig import load_rig

RIG = """schema = 1
name = "twins"
camera = {{ driver = "sim", size_px = [64, 48], bit_depth = 12, pixel_um = 3.45, exposure_ms = 2.0 }}
optics = {{ magnification = 20.0, na = 0.45 }}
[stage.z]
driver = "{driver}"
port = "written by the bench"
baud = {baud}
units_per_um = {units_per_um}
limits = {{ min_um = -100.0, max_um = 100.0 }}
"""
RECIPE = """schema = 1
name = "three"
[stack]
top_um = 2.0
bottom_um = 0.0
step = 1.0
"""
MAKERS = {
    "asi-ms2000": (9600, 10.0),
    "asi-tiger": (115200, 10.0),
    "pi-gcs2": (115200, 1.0),
    "prior-proscan": (9600, 10.0),
}


@pytest.fixture
def bench_of(lend_bench, tmp_path):
    def start(driver: str):
        baud, units_per_um = MAKERS[driver]
        path = tmp_path / f"{driver}.toml"
        path.write_text(RIG.format(driver=driver, baud=baud, units_per_um=units_per_um))
        return lend_bench(path)

    return start


def dialogue(answers: str, *arguments: object) -> Result:
    return stereotome("devices", "init", *arguments, typed=answers)


@pytest.mark.parametrize("driver", MAKERS)
def test_init_writes_a_rig_with_which_a_stack_is_taken(bench_of, tmp_path: Path, driver: str):
    bench, rig, recipe = bench_of(driver), tmp_path / "mine.toml", tmp_path / "recipe.toml"
    answers = f"{bench.told['ports']['z']}\nsim\n{bench.told['camera']}\n20\n0.45\n-50\n50\n"
    done = dialogue(answers, rig)
    assert done.code == 0, done.err
    assert "Both answer." in done.err
    spec = load_rig(rig)
    assert (spec.stage.z.driver, spec.stage.z.baud) == (driver, MAKERS[driver][0])
    assert (spec.stage.z.limits.min_um, spec.stage.z.limits.max_um, spec.optics.na) == (-50.0, 50.0, 0.45)
    recipe.write_text(RECIPE)
    run = stereotome("run", recipe, "-i", rig, "--out", tmp_path / "run", "--json")
    assert run.code == 0, run.err
    planes = [event for event in map(json.loads, run.out.splitlines()) if event["event"] == "plane"]
    assert len(planes) == 3
    assert bench.ask(do="truth")["moving"] is False


def test_options_answer_for_the_dialogue_and_a_file_is_not_replaced_unasked(bench_of, tmp_path: Path):
    bench, rig = bench_of("asi-ms2000"), tmp_path / "mine.toml"
    options = ["--port", bench.told["stage_tcp"], "--camera", "sim", "--source", bench.told["camera"]]
    optics = ["--magnification", "10", "--na", "0.3", "--min-um", "-20", "--max-um", "20"]
    done = dialogue("", rig, *options, *optics)
    assert done.code == 0, done.err
    assert "[" not in done.err.replace("[Errno", ""), "nothing was asked"
    assert (load_rig(rig).optics.magnification, load_rig(rig).camera.bit_depth) == (10.0, 12)
    again = dialogue("", rig, *options, *optics)
    assert again.code == 2
    assert "exists already" in again.err


@pytest.mark.parametrize(
    ("answers", "code", "words"),
    [
        ("/dev/no-such-port\n", 4, "no serial port /dev/no-such-port"),
        ("\n", 4, "none was named"),
        ("/dev/null\n", 4, "cannot be opened as a serial port"),
    ],
)
def test_what_init_cannot_do_it_says_and_writes_nothing(tmp_path: Path, answers: str, code: int, words: str):
    done = dialogue(answers, tmp_path / "mine.toml")
    assert done.code == code
    assert words in done.err
    assert not (tmp_path / "mine.toml").exists()


@pytest.mark.parametrize(("answer", "words"), [("twenty", "is no number"), ("-3", "cannot be"), ("0", "cannot be")])
def test_a_nonsense_answer_is_refused(bench_of, tmp_path: Path, answer: str, words: str):
    bench = bench_of("asi-tiger")
    done = dialogue(
        f"{answer}\n", tmp_path / "mine.toml", "--port", bench.told["ports"]["z"], "--camera", "folder", "--source", "x"
    )
    assert done.code == 3
    assert words in done.err


def test_a_camera_that_does_not_answer_is_named_and_the_file_stays(bench_of, tmp_path: Path):
    bench, rig = bench_of("asi-tiger"), tmp_path / "mine.toml"
    done = dialogue("", rig, "--port", bench.told["ports"]["z"], "--camera", "sim", "--source", "127.0.0.1:1")
    assert done.code == 4
    assert "z stage: it is at +0.00 µm." in done.err
    assert "nothing answers at 127.0.0.1:1" in done.err
    assert "\n# bit_depth = 12 " in rig.read_text()
    assert load_rig(rig).camera.bit_depth == 8
