"""Instrument files: read whole, or refused with every problem, its line and a guess."""

import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import RigError
from devices.rig import RigSpec, load_rig
from devices.toml_lines import key_lines
from devices.toml_model import load_text

GOOD = """schema = 1
name = "bench-2"
[camera]
driver = "opencv"
source = "0"
size_px = [2048, 1024]
[optics]
magnification = 20.0
na = 0.75
[stage.z]
driver = "asi-ms2000"
port = "/dev/ttyUSB0"
baud = 115200
limits = { min_um = -2500.0, max_um = 1200 }
park_um = -2500.0
[microtome]
driver = "modbus"
limits = { feed_um_max = 4000.0 }
profile = "leadshine-rs"
port = "/dev/ttyUSB1"
[input.axes]
z = { from = "tz" }
[sim]
faults = ["z.late@3"]
"""


def refused(text: str) -> str:
    with pytest.raises(RigError) as caught:
        load_text(text, "bad.toml", RigSpec, RigError)
    assert caught.value.exit_code == 3
    return caught.value.message()


def test_a_good_file_is_read():
    spec = load_text(GOOD, "good.toml", RigSpec, RigError)
    assert spec.stage.z.baud == 115200
    assert spec.stage.z.soft_limits.max_um == 1200.0
    assert spec.camera.size_px == (2048, 1024)
    assert spec.sim.faults == ("z.late@3",)
    assert spec.object_pixel_um is None


def test_every_problem_is_found_at_once_with_its_line():
    text = GOOD.replace('port = "/dev/ttyUSB0"', 'prot = "/dev/ttyUSB0"').replace("115200", '"fast"')
    text = text.replace("na = 0.75", "na = -1.0").replace("max_um = 1200", "max_um = nan")
    assert refused(text) == (
        "error[config]: bad.toml has 5 problems:\n"
        "    bad.toml:9: optics.na: should be greater than 0, not -1.0\n"
        "    bad.toml:10: stage.z.port: missing\n"
        "    bad.toml:12: stage.z.prot: unknown key; did you mean 'port'?\n"
        "    bad.toml:13: stage.z.baud: should be a valid integer, not 'fast'\n"
        "    bad.toml:14: stage.z.limits.max_um: must be a finite number"
    )


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("na = 0.75", "na = inf", "bad.toml:9: optics.na: must be a finite number"),
        ("na = 0.75", "na = 1.2", "bad.toml:7: optics: na 1.2 must be below medium_index 1"),
        ("min_um = -2500.0", "min_um = 1500.0", "stage.z.limits: min_um 1500 must be below max_um 1200"),
        ("park_um = -2500.0", "park_um = -2600.0", "bad.toml:10: stage.z: park_um -2600 is outside the limits"),
        ('"asi-ms2000"', '"asi-ms200"', "stage.z.driver: no stage driver 'asi-ms200'; did you mean 'asi-ms2000'?"),
        ('"opencv"', '"asi-ms2000"', "bad.toml:4: camera.driver: no camera driver 'asi-ms2000'"),
        ("[2048, 1024]", "[2048]", "bad.toml:6: camera.size_px"),
        ("[2048, 1024]", "[2048, -1]", "bad.toml:6: camera.size_px[1]: should be greater than or equal to 1, not -1"),
        ("feed_um_max = 4000.0", "feed_um_max = nan", "bad.toml:18: microtome.limits.feed_um_max: must be a finite"),
        ('"opencv"', '"folder"', "bad.toml:3: camera: the driver 'folder' needs step_um"),
        ('source = "0"', "", "bad.toml:3: camera: the driver 'opencv' needs source"),
        ("schema = 1", "schema = 2", "bad.toml:1: schema: "),
        ("schema = 1", "glases = 2", "bad.toml:1: glases: unknown key; did you mean 'glasses'?"),
        ("baud = 115200", "baud = true", "bad.toml:13: stage.z.baud: should be a valid integer, not True"),
    ],
)
def test_a_problem_is_named(old: str, new: str, words: str):
    message = refused(GOOD.replace(old, new, 1))
    assert words in message
    assert "has 1 problem:" in message


@pytest.mark.parametrize(("line", "broken"), [(2, "name = "), (2, 'name = "a'), (2, "name = [1, 2")])
def test_broken_toml_is_named_with_its_line(line: int, broken: str):
    assert f"bad.toml:{line}: no valid TOML: " in refused(f"schema = 1\n{broken}")


def test_a_missing_table_stands_at_the_top():
    assert "bad.toml:1: optics: missing" in refused('name = "x"\n')


def test_a_file_that_is_not_there_or_no_text(tmp_path: Path):
    with pytest.raises(RigError, match="no such file"):
        load_rig(tmp_path / "none.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RigError, match="cannot be read as text"):
        load_rig(tmp_path / "binary.toml")


def test_an_override_replaces_adds_and_is_named_when_wrong():
    spec = load_text(GOOD, "x", RigSpec, RigError, overrides=("stage.z.baud=9600", "notes=wet", "sim.seed = 3"))
    assert (spec.stage.z.baud, spec.notes, spec.sim.seed) == (9600, "wet", 3)
    with pytest.raises(RigError) as caught:
        load_text(GOOD, "x", RigSpec, RigError, overrides=("stage.z.buad=9600", "optics.na=nan"))
    assert caught.value.what.splitlines()[1:] == [
        "    --set optics.na=nan: optics.na: must be a finite number",
        "    --set stage.z.buad=9600: stage.z.buad: unknown key; did you mean 'baud'?",
    ]


@pytest.mark.parametrize("given", ["stage", "=1", "name.first=1", "a..b=1"])
def test_an_override_that_is_none(given: str):
    with pytest.raises(RigError, match="--set "):
        load_text(GOOD, "x", RigSpec, RigError, overrides=(given,))


def test_images_are_sought_beside_the_instrument_file(tmp_path: Path):
    file = tmp_path / "rig.toml"
    file.write_text(GOOD.replace('"opencv"', '"folder"').replace('"0"', '"planes"\nstep_um = 2.0'))
    assert load_rig(file).camera.source == str(tmp_path / "planes")


KEYS = st.text("abcé. \"'\\#=[]\n", min_size=1, max_size=4)
LEAVES = st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=8)
VALUES = st.recursive(LEAVES, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3))


def quoted(text: str) -> str:
    escapes = {"\\": "\\\\", '"': '\\"'}
    plain = "".join(escapes.get(letter, letter) for letter in text)
    return '"' + "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in plain) + '"'


def written(value: object) -> str:
    match value:
        case bool():
            return str(value).lower()
        case str():
            return quoted(value)
        case list():
            return "[" + ",".join("\n " + written(inner) for inner in value) + "\n]"
        case dict():
            return "{" + ", ".join(f"{quoted(key)} = {written(inner)}" for key, inner in value.items()) + "}"
        case float():
            return repr(value) if "." in repr(value) or "e" in repr(value) or "inf" in repr(value) else f"{value!r}.0"
    return repr(value)


def paths(value: object, path: tuple = ()):
    pairs = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in pairs:
        yield (*path, key)
        yield from paths(inner, (*path, key))


@given(st.dictionaries(KEYS, VALUES, max_size=5))
def test_every_key_of_any_file_has_its_line(data: dict):
    text = "# first\n" + "".join(f"\n{quoted(key)} = {written(value)} # note" for key, value in data.items())
    lines = key_lines(text)
    assert set(lines) == set(paths(tomllib.loads(text)))
    rows = text.split("\n")
    assert all(quoted(path[0]) in rows[line - 1] for path, line in lines.items() if len(path) == 1)


def test_lines_of_dotted_keys_tables_and_arrays_of_tables():
    text = 'a.b = 1\n[c.d]\ne = """\nx\n"""\nf.g = {h = [1,\n 2]}\n[[k]]\nl = 1\n'
    text += "[[k]]\n[k.m]\nn = 2\n[[k.o]]\np = 1979-05-27 07:32:00\n"
    lines = key_lines(text)
    assert lines["a", "b"] == 1
    assert lines["c", "d", "e"] == 3
    assert lines["c", "d", "f", "g", "h", 1] == 7
    assert lines["k", 0, "l"] == 9
    assert lines["k", 1, "m", "n"] == 12
    assert lines["k", 1, "o", 0, "p"] == 14
