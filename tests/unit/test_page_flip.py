"""The process that flips, with the real driver and the emitter's twin behind a pseudo-terminal."""

from __future__ import annotations

import json
import os
import signal
import threading
from itertools import pairwise

import numpy as np
import pytest

from devices.cli import run
from devices.clock import SystemClock
from devices.errors import DisplayError
from display.flip_process import FlipOptions, Show
from display.flip_screens import ClockedScreen
from display.mailbox import Mailbox
from display.page_flip import PageFlip

SIZE = (32, 24)
HZ = 100.0


def view(k):
    return np.full((SIZE[1], SIZE[0], 3), k, np.uint8)


def until(condition, tries=400):
    for _ in range(tries):
        if condition():
            return True
        threading.Event().wait(0.05)
    return False


def test_pairs_are_flipped_and_it_is_told_how_it_goes():
    with PageFlip(SIZE, FlipOptions("", clock_hz=HZ)) as flip:
        flip.show(view(10), view(20))
        assert until(lambda: flip.going.flips >= 90)
        flip.swap = True
        assert flip.running
        report = flip.close()
    assert report is not None
    assert report.pace.flips >= 90
    assert report.pace.refreshes >= report.pace.flips
    assert report.phase is None
    assert not flip.running


def test_the_emitter_hears_of_every_flip(emitter, rig):
    twin, glasses = emitter
    path = rig(glasses + '\ndrive = "per-frame"\nopen_us = 4000\ndelay_us = 500')
    with PageFlip(SIZE, FlipOptions("", clock_hz=HZ, instrument=path)) as flip:
        flip.show(view(10), view(20))
        assert until(lambda: flip.going.flips >= 120)
        report = flip.close()
    assert report is not None
    assert report.phase is not None
    edges = twin.edges()
    assert len(edges) == report.pace.flips + 1
    assert report.phase.edges == pytest.approx(len(edges), abs=4)
    assert {edge.eye for edge in edges} == {"left", "right"}


def test_a_free_run_is_locked_to_the_flips(emitter, rig):
    twin, glasses = emitter
    path = rig(glasses + '\ndrive = "free-run"\nopen_us = 4000\ndelay_us = 500')
    with PageFlip(SIZE, FlipOptions("", clock_hz=HZ, instrument=path)) as flip:
        assert until(lambda: len(twin.edges()) >= 100)
        report = flip.close()
    assert report is not None
    edges = twin.edges()
    alone = [b.eye != a.eye for a, b in pairwise(edges[20:61])]
    assert sum(alone) > 30, "the turns alternate"
    if report.phase is not None:
        assert report.phase.edges > 8


def test_the_command_reports_as_json(emitter, rig, capsys):
    _, glasses = emitter
    path = rig(glasses + '\ndrive = "per-frame"')
    code = run(["glasses", "pattern", "crosstalk", "-i", path, "--clock-hz", str(HZ), "--seconds", "1.5", "--json"])
    assert code == 0
    found = json.loads(capsys.readouterr().out)
    assert found["flips"] > 8
    assert {"wrong_eye", "late", "glasses_bias_ms", "glasses_crosstalk", "glasses_alternation_faults"} <= set(found)


def test_what_keeps_pictures_from_being_shown_is_said(capsys, monkeypatch):
    with pytest.raises(DisplayError, match="60 pictures a second") as refused:
        PageFlip(SIZE, FlipOptions("", clock_hz=60.0))
    assert refused.value.code == "refresh-too-slow"
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert run(["glasses", "pattern"]) == 10
    said = capsys.readouterr().err
    assert "error[no-display]: no window can be opened here." in said
    assert "fix: log in at the display" in said
    assert "Traceback" not in said


def test_a_process_that_is_killed_is_noticed_and_leaves_nothing():
    with PageFlip(SIZE, FlipOptions("", clock_hz=HZ)) as flip:
        os.kill(flip._process.pid, signal.SIGKILL)
        assert flip.wait(20.0)
        flip.show(view(1), view(2))
        assert flip.close() is None
    assert not flip._mailbox.path.exists()


def test_a_display_that_is_unplugged_ends_the_show_in_words(monkeypatch, capsys):
    mailbox = Mailbox.create(SIZE)
    try:
        show = Show(FlipOptions(str(mailbox.path), clock_hz=HZ), SystemClock())
        monkeypatch.setattr(ClockedScreen, "unplugged", True)
        report = show.run(lambda: None)
        show.close()
    finally:
        mailbox.remove()
    assert report.pace.wrong_eye == 0
    assert "the display was unplugged" in capsys.readouterr().err
