"""The journal keeps every whole record, drops a torn tail, and notices what was changed behind its back."""

import json
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire import journal
from acquire.journal import Journal
from devices.clock import SystemClock
from devices.errors import StoreError

json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.text()
    | st.floats(allow_nan=False, allow_infinity=False),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
)


@given(st.dictionaries(st.text(min_size=1).filter(lambda k: k != "crc"), json_values, min_size=1, max_size=5))
def test_a_record_survives_its_line(record):
    whole = journal.decode(journal.encode(record))
    assert whole == record


@given(st.integers(0, 10_000), st.integers(1, 255))
def test_one_changed_byte_is_noticed(position, flip):
    line = bytearray(journal.encode({"n": 3, "e": "plane", "plane": 17, "z_um": -12.25}))
    line[position % len(line)] ^= flip
    try:
        changed = journal.decode(bytes(line))
    except (json.JSONDecodeError, UnicodeDecodeError):
        changed = None
    assert changed is None


@given(st.integers(0, 400))
def test_a_torn_tail_leaves_the_whole_records(tmp_path_factory, cut):
    path = tmp_path_factory.mktemp("j") / "journal.jsonl"
    lines = [journal.encode({"n": k, "e": "plane", "plane": k}) for k in range(6)]
    data = b"".join(lines)
    path.write_bytes(data[: len(data) - min(cut, len(data))])
    records, good = journal.read(path)
    assert [r["n"] for r in records] == list(range(len(records)))
    assert good == sum(len(line) for line in lines[: len(records)])


def test_writing_goes_on_after_a_torn_tail(tmp_path):
    path = tmp_path / "journal.jsonl"
    first = Journal(path, SystemClock())
    first.append({"e": "a"}, {"e": "b"})
    first.close()
    with path.open("ab") as file:
        file.write(b'{"n":2,"e":"to')
    again = Journal(path, SystemClock())
    again.append({"e": "c"})
    again.close()
    assert [r["e"] for r in journal.read(path)[0]] == ["a", "b", "c"]


def test_damage_in_the_middle_is_an_error(tmp_path):
    path = tmp_path / "journal.jsonl"
    path.write_bytes(journal.encode({"n": 0}) + b"rubbish\n" + journal.encode({"n": 2}))
    with pytest.raises(StoreError, match="record 1 is damaged"):
        journal.read(path)


def test_one_writer_at_a_time_and_its_death_frees_the_journal(tmp_path):
    path = tmp_path / "journal.jsonl"
    script = (
        "import sys, pathlib; from acquire.journal import Journal; from devices.clock import SystemClock\n"
        "j = Journal(pathlib.Path(sys.argv[1]), SystemClock()); j.append({'e': 'x'})\n"
        "print('open', flush=True); input()"
    )
    writer = subprocess.Popen(
        [sys.executable, "-c", script, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert writer.stdout.readline() == "open\n"
    assert journal.is_open_elsewhere(path)
    with pytest.raises(StoreError, match="another run"):
        Journal(path, SystemClock())
    writer.kill()
    writer.communicate()
    assert not journal.is_open_elsewhere(path)
    Journal(path, SystemClock()).close()
