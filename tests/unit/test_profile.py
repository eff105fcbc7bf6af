"""Register maps: the shipped ones, the frames they make, and every mistake one can write."""

import pytest

from devices.errors import RigError
from devices.profile import load_profile, parse_profile, shipped_profiles
from devices.transport.modbus import frame, frames_of
from devices.wire.modbus_map import RegisterWrite

SUPPLIED = {"pos": 5000, "speed": 600, "acc": 100, "dec": 100, "seq": 1, "beat": 1, "min": 0, "max": 10_000_000}
LEADSHINE_FRAMES = {
    "home": "01 06 60 02 00 20 37 D2",
    "zero": "01 06 60 02 00 21 F6 12",
    "stop": "01 06 60 02 00 40 37 FA",
    "run": "01 06 60 02 00 10 37 C6",
    "reset": "01 06 18 01 11 11 12 F6",
    "move_abs": "01 10 62 00 00 08 10 00 01 00 00 13 88 02 58 00 64 00 64 00 00 00 10 BB 1B",
}
MINIMAL = """
schema = 1
profile = "own"
source = "a manual"
[axis]
counts_per_um = 10.0
max_um = 100.0
max_step_um = 5.0
speed_um_s = 10.0
speed_per_um_s = 1.0
[reg]
status = { a = 0, t = "u16" }
alarm = { a = 1, t = "u16" }
position = { a = 2, t = "i32" }
target = { a = 4, t = "i32" }
[state]
fault = { reg = "status", mask = 1 }
moving = { reg = "status", mask = 2 }
[do]
move_abs = [ { reg = "target", v = "pos" } ]
stop = [ { reg = "status", v = 4 } ]
"""


def test_the_shipped_maps():
    assert shipped_profiles() == ["applied-motion-scl", "leadshine-rs", "oriental-az", "plc-mailbox"]
    for name in shipped_profiles():
        assert load_profile(name).profile == name


@pytest.mark.parametrize(("action", "expected"), LEADSHINE_FRAMES.items())
def test_ready_frames_of_leadshine_byte_for_byte(action: str, expected: str):
    profile = load_profile("leadshine-rs")
    assert frames_of(profile, profile.writes(getattr(profile.do, action), SUPPLIED), rtu=True) == [expected]


@pytest.mark.parametrize(
    ("register", "expected"),
    [
        ("status", "01 03 10 03 00 01 70 CA"),
        ("alarm", "01 03 22 03 00 01 7E 72"),
        ("path_position", "01 03 60 2C 00 02 1B C2"),
    ],
)
def test_ready_reads_of_leadshine_byte_for_byte(register: str, expected: str):
    profile = load_profile("leadshine-rs")
    assert frame(1, profile.read_of(register)).hex(" ").upper() == expected


def test_ready_jog_of_leadshine_byte_for_byte():
    profile = load_profile("leadshine-rs")
    assert profile.jog is not None
    assert frames_of(profile, profile.writes(profile.jog.plus, SUPPLIED), rtu=True) == ["01 06 18 01 40 01 2E AA"]


def test_a_frame_the_manual_prints_with_a_wrong_crc():
    """Peak current 3.2 A: the manual has DD 7B at its end."""
    assert frame(1, RegisterWrite(0x0191, (0x0020,), single=True)).hex(" ").upper() == "01 06 01 91 00 20 D8 03"


def test_a_manual_that_counts_from_40001():
    profile = load_profile("applied-motion-scl")
    assert [profile.address_of(name) for name in ("alarm", "status", "position", "target", "opcode")] == [
        *(0, 1, 6, 30, 124)
    ]


def test_all_words_of_an_oriental_move():
    profile = load_profile("oriental-az")
    (write,) = profile.writes(profile.do.move_abs, SUPPLIED | {"pos": -70000})
    assert write.address == 0x58
    assert write.values == (0, 0, 0, 1, 0xFFFE, 0xEE90, 0, 600, 0, 100, 0, 100, 0, 1000, 0, 1)


def test_a_value_that_does_not_fit_is_never_wrapped():
    profile = load_profile("leadshine-rs")
    with pytest.raises(ValueError, match="70000 does not fit into u16"):
        profile.writes(profile.do.move_abs, SUPPLIED | {"speed": 70_000})


def test_word_order():
    little = parse_profile(MINIMAL + '[address]\nword_order = "little"\n', "own.toml")
    assert little.writes(little.do.move_abs, {"pos": 1})[0].values == (1, 0)
    assert little.number_in("position", [1, 0]) == 1


BROKEN = [
    ('target = { a = 4, t = "i32" }', 'target = { a = 3, t = "i32" }', "own.toml:15: reg.target: overlaps 'position'"),
    ('target = { a = 4, t = "i32" }', 'target = { a = 4, t = "u16" }', "'pos' has 32 bits: write hi(pos) and lo(pos)"),
    ('reg = "target", v = "pos"', 'reg = "taget", v = "pos"', "no register 'taget' in [reg]; did you mean 'target'?"),
    ('v = "pos"', 'v = "poss"', "'poss' is no name the driver supplies; did you mean 'pos'?"),
    ("counts_per_um = 10.0", "count_per_um = 10.0", "own.toml:6: axis.count_per_um: unknown key; did you mean"),
    ("max_um = 100.0", "max_um = -100.0", "axis.min_um: must be below max_um"),
    ('alarm = { a = 1, t = "u16" }', "", "a profile needs the register 'alarm'"),
    ('status = { a = 0, t = "u16" }', 'status = { a = 70000, t = "u16" }', "is not between 0 and 65535"),
    ('status = { a = 0, t = "u16" }', 'status = { a = 0, t = "u17" }', "should be 'u16', 'i16'"),
    ("[state]", "[address]\nfunctions = [3, 6]\n[state]", "'target' needs function 16"),
    ("[state]", "[address]\nfunctions = [1, 16]\n[state]", "[1] are not used here"),
    ("[state]", "[address]\nbase = 40001\n[state]", "address 0 with base 40001 is not between"),
    ("[state]", "[address]\npair_even = true\n[state]", None),
    ('position = { a = 2, t = "i32" }', 'position = { a = 2, t = "i32", n = 2 }', "n belongs to a block"),
    ('reg = "status", v = 4', 'reg = "status", v = 70000', "70000 does not fit into 16 bits"),
    ('reg = "status", v = 4', 'reg = "status", v = [4, 5]', "'status' is no block: give one value"),
    ("[state]", '[alarms]\nE0x = "overcurrent"\n[state]', "alarms.E0x: is no number"),
    ('fault = { reg = "status", mask = 1 }', 'fault = { reg = "stats", mask = 1 }', "did you mean 'status'?"),
    ('fault = { reg = "status", mask = 1 }', 'fault = { reg = "status", mask = 0 }', "greater than or equal to 1"),
    ("[state]", "[link]\nunit = 0\n[state]", "link.unit"),
    ("[state]", "[jog]\nplus = []\nminus = []\nrelease = []\nrepeat_ms = 51\n[state]", "jog.repeat_ms"),
]


@pytest.mark.parametrize(("good", "bad", "words"), BROKEN)
def test_mistakes_in_a_map(good: str, bad: str, words: str | None):
    assert good in MINIMAL
    text = MINIMAL.replace(good, bad)
    if words is None:
        assert parse_profile(text, "own.toml").profile == "own"
        return
    with pytest.raises(RigError) as caught:
        parse_profile(text, "own.toml")
    assert words in caught.value.message()


def test_pairs_at_odd_addresses():
    text = MINIMAL.replace("[state]", "[address]\npair_even = true\n[state]").replace("a = 4", "a = 5")
    with pytest.raises(RigError, match=r"own.toml:15: reg.target: a 32-bit pair starts at an even address"):
        parse_profile(text, "own.toml")


def test_all_mistakes_are_told_at_once():
    text = (
        MINIMAL.replace("a = 4", "a = 3").replace('v = "pos"', 'v = "poss"').replace("max_um = 100.0", "max_um = -1.0")
    )
    with pytest.raises(RigError, match=r"own.toml has 3 problems"):
        parse_profile(text, "own.toml")


def test_no_such_map(tmp_path):
    with pytest.raises(RigError, match=r"no profile 'leadshin'; did you mean 'leadshine-rs'"):
        load_profile("leadshin")
    (tmp_path / "bad.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(RigError, match="cannot be read as text"):
        load_profile(str(tmp_path / "bad.toml"))


def test_a_map_of_ones_own(tmp_path):
    (tmp_path / "own.toml").write_text(MINIMAL)
    assert load_profile(str(tmp_path / "own.toml")).axis.counts_per_um == 10.0
