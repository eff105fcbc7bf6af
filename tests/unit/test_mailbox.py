"""Pairs between two processes: always complete, always the newest, whoever is slow and whoever dies."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import DisplayError
from display.mailbox import PAGE, Mailbox

SIZE = (64, 48)
WRITER = """
import sys, numpy as np
from pathlib import Path
from display.mailbox import Mailbox
box = Mailbox.open(Path(sys.argv[1]))
print("go", flush=True)
k = 0
while not box.stopped:
    k += 1
    view = np.full((48, 64, 3), k % 256, np.uint8)
    box.publish(view, 255 - view)
"""


@pytest.fixture
def box():
    made = Mailbox.create(SIZE)
    yield made
    made.remove()


def view(k: int) -> np.ndarray:
    return np.full((SIZE[1], SIZE[0], 3), k, np.uint8)


def test_the_newest_pair_comes_and_nothing_before_the_first(box):
    with box.newest() as pair:
        assert pair is None
    for k in range(1, 6):
        box.publish(view(k), view(100 + k))
    with box.newest() as pair:
        assert pair is not None
        assert (pair[0] == 5).all()
        assert (pair[1] == 105).all()
        assert box.intact
    assert box.pairs == 5


@given(writes_while_read=st.lists(st.integers(0, 5), min_size=1, max_size=6))
@settings(max_examples=20, deadline=None)
def test_a_pair_that_is_being_read_is_left_alone(writes_while_read):
    box = Mailbox.create((4, 3))
    try:
        k = 0
        for writes in writes_while_read:
            k += 1
            box.publish(view(k)[:3, :4], view(k)[:3, :4])
            with box.newest() as pair:
                assert pair is not None
                for _ in range(writes):
                    k += 1
                    box.publish(view(k)[:3, :4], view(k)[:3, :4])
                assert len(np.unique(pair)) == 1
                assert pair[0][0, 0, 0] == k - writes
                assert box.intact
    finally:
        box.remove()


def test_a_reader_who_was_overtaken_is_told(box):
    box.publish(view(1), view(1))
    with box.newest():
        box._words[24] = 0  # as if the claim came a moment too late
        for k in range(3):
            box.publish(view(k), view(k))
        assert not box.intact


def test_every_pair_from_a_hurrying_process_is_complete(box):
    writer = subprocess.Popen([sys.executable, "-c", WRITER, str(box.path)], stdout=subprocess.PIPE, text=True)
    try:
        assert writer.stdout is not None
        assert writer.stdout.readline() == "go\n"
        seen, torn, last = set(), 0, 0
        while len(seen) < 60:
            with box.newest() as pair:
                if pair is None:
                    continue
                left, right = pair[0].copy(), pair[1].copy()
                intact = box.intact
            if not intact:
                torn += 1
                continue
            assert len(np.unique(left)) == 1
            assert np.array_equal(right, 255 - left)
            last = int(left[0, 0, 0])
            seen.add(last)
        assert torn <= len(seen)
    finally:
        os.kill(writer.pid, signal.SIGKILL)
        writer.communicate()
    with box.newest() as pair:
        assert pair is not None
        assert np.array_equal(pair[1], 255 - pair[0])


def test_words_go_both_ways(box):
    other = Mailbox.open(box.path)
    assert other.size == SIZE
    box.swap = True
    other.tell([7, 8, 9])
    box.stop()
    assert (other.swap, other.stopped, box.told(3)) == (True, True, (7, 8, 9))
    other.close()


@pytest.mark.parametrize("content", [b"", b"x" * 10, b"x" * PAGE, b"\0" * (PAGE + 6 * 100)])
def test_a_file_that_is_no_mailbox_is_refused(tmp_path, content):
    path = tmp_path / "box"
    path.write_bytes(content)
    with pytest.raises(DisplayError, match="no pairs to show"):
        Mailbox.open(path)
    with pytest.raises(DisplayError, match="no pairs to show"):
        Mailbox.open(Path(tmp_path / "none"))


def test_the_file_goes_with_its_maker(box):
    made = Mailbox.create((2, 2))
    assert made.path.stat().st_mode & 0o077 == 0
    made.remove()
    assert not made.path.exists()


MAKER = """
from display.mailbox import Mailbox
box = Mailbox.create((2, 2))
print(box.path, flush=True)
input()
"""


def test_the_file_of_a_killed_maker_is_swept_and_no_other(box):
    maker = subprocess.Popen([sys.executable, "-c", MAKER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert maker.stdout is not None
    left = Path(maker.stdout.readline().strip())
    Mailbox.create((2, 2)).remove()
    assert left.exists()  # its maker lives
    maker.kill()
    maker.communicate()
    Mailbox.create((2, 2)).remove()
    assert not left.exists()
    assert box.path.exists()
