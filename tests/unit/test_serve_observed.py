"""Two observers and a web page watch a run, the commander is killed, another takes over, and the run goes on."""

import json
import signal
import subprocess
import sys
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import cv2
import numpy as np
import pytest
from browser import browser_or_why
from served import PATIENCE_S, RECIPE

from acquire.store import RunEnd, open_run
from devices.clock import SystemClock

CLOCK = SystemClock()
COMMANDER = """
import sys
from pathlib import Path
from acquire.client import Instrument
instrument = Instrument.connect(Path(sys.argv[1]))
instrument.command("ann")
instrument.start_run(sys.argv[2], overrides=["stack.step=0.1"], out=Path(sys.argv[3]))
print("started", flush=True)
sys.stdin.read()
"""
OBSERVER = """
import json, sys
from pathlib import Path
from acquire.client import Instrument
from devices.clock import SystemClock
instrument = Instrument.connect(Path(sys.argv[1]))
received = []
viewer = instrument.viewer()
before = 0 if instrument.state.run is None else instrument.state.run.number
print("ready", flush=True)
def over(state):
    return state.run is not None and state.run.number > before and state.state == "IDLE"
while not over(instrument.state):
    if (frame := viewer.newest(0.2)) is not None and frame.header.plane >= 0:
        received.append(frame.header.plane)
    if sys.argv[2] == "sleepy" and len(received) == 1:
        print("asleep", flush=True)
        SystemClock().sleep(10)
print(json.dumps({"planes": received, "end": instrument.state.run.state}), flush=True)
instrument.close()
"""


def python(code, *arguments):
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def eventually(condition):
    """Wait, generously, until something is so, and return it."""
    deadline = CLOCK.now() + PATIENCE_S
    while not (so := condition()):
        assert CLOCK.now() < deadline, "it never came"
        CLOCK.sleep(0.05)
    return so


def page(server, place=""):
    with urlopen(server.told["page"] + place) as answer:
        return answer.read()


def status(server):
    return json.loads(page(server, "status.json"))


def test_the_commander_is_killed_and_the_run_goes_on_before_everybodys_eyes(server, tmp_path):
    folder = tmp_path / "run"
    observers = [python(OBSERVER, server.connection, how) for how in ("awake", "sleepy")]
    assert [observer.stdout.readline() for observer in observers] == ["ready\n"] * 2
    commander = python(COMMANDER, server.connection, RECIPE, folder)
    assert commander.stdout.readline() == "started\n"
    assert observers[1].stdout.readline() == "asleep\n"
    observers[1].send_signal(signal.SIGSTOP)  # and never wakes: worse than asleep
    eventually(lambda: status(server)["picture"] is not None and status(server)["picture"]["plane"] >= 0)
    commander.kill()
    commander.communicate()
    with server.client() as second:
        second.command("bob", wait_s=PATIENCE_S)
        assert second.state.run.folder == str(folder)
        assert second.wait_for(lambda state: state.holder == "bob", PATIENCE_S)
        run = second.wait_for_run(PATIENCE_S)
        assert (run.state, run.durable, run.planned) == ("COMPLETED", 201, 201)
        assert status(server)["holder"] == "bob"
    seen = json.loads(observers[0].communicate(timeout=PATIENCE_S)[0])
    assert seen["end"] == "COMPLETED"
    assert seen["planes"] == sorted(set(seen["planes"]))
    observers[1].kill()
    observers[1].communicate()
    stored = open_run(folder)
    assert (stored.state, stored.missing) == (RunEnd.COMPLETED, [])


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "HEAD"])
def test_nothing_can_be_sent_to_the_page(server, method):
    with pytest.raises(HTTPError) as refusal:
        urlopen(Request(server.told["page"], data=b"x" if method != "HEAD" else None, method=method))
    assert refusal.value.code == 405
    refusal.value.close()


@pytest.mark.parametrize(("place", "host"), [("etc/passwd", None), ("../run", None), ("", "evil.example:80")])
def test_there_is_nothing_else(server, place, host):
    with pytest.raises(HTTPError) as refusal:
        urlopen(Request(server.told["page"] + place, headers={"Host": host} if host else {}))
    assert refusal.value.code == 404
    refusal.value.close()


def test_the_picture_is_the_frame(server):
    with server.client() as instrument:
        instrument.command("ann", wait_s=PATIENCE_S)
        instrument.move(0.0)
        seen_before = status(server)["picture"]  # of an earlier test; somebody looks from now on
        pixels, _ = instrument.snap()

        def shown():
            seen = status(server)["picture"]
            return seen if seen is not None and seen != seen_before else None

        told = eventually(shown)
        grey = cv2.imdecode(np.frombuffer(page(server, "frame.jpg"), np.uint8), cv2.IMREAD_GRAYSCALE)
        expected = np.clip((pixels.astype(float) - told["black"]) * 255 / (told["white"] - told["black"]), 0, 255)
        assert grey.shape == pixels.shape
        blocks = (grey - expected).reshape(10, 8, 12, 8).mean(axis=(1, 3))  # a JPEG keeps the mean of each block
        assert np.abs(blocks).mean() < 1.0


def test_only_so_many_may_look_at_once(server):
    streams = []
    try:
        for _ in range(8):
            streams.append(urlopen(server.told["page"] + "events"))
            streams[-1].readline()
        with pytest.raises(HTTPError) as refusal:
            urlopen(server.told["page"] + "events")
        assert refusal.value.code == 503
        refusal.value.close()
    finally:
        for stream in streams:
            stream.close()
    eventually(lambda: _opens(server))


def _opens(server):
    try:
        urlopen(server.told["page"] + "events").close()
    except HTTPError as refusal:
        refusal.close()
        return False
    return True


def test_a_browser_shows_picture_place_and_state_and_says_when_they_are_old(server, tmp_path):
    with browser_or_why() as browser, server.client() as instrument:
        instrument.command("ann", wait_s=PATIENCE_S)
        z_um = instrument.move(7.25)
        instrument.start_live(20.0)
        browser.get(server.told["page"])
        text = lambda name: browser.find_element("id", name).text  # noqa: E731
        eventually(lambda: text("z") == f"z +{z_um:.2f} µm")
        eventually(lambda: "IDLE · live" in text("state"))
        assert text("instrument") == "small"
        assert text("holder") == "ann commands"
        eventually(lambda: browser.execute_script("return document.getElementById('picture').naturalWidth") == 96)
        eventually(lambda: text("caption").startswith(f"z +{z_um:.2f} µm · 96 × 80 px"))
        assert not browser.find_element("id", "warning").is_displayed()
        instrument.start_run(RECIPE, overrides=["stack.step=0.1"], out=tmp_path / "run")
        eventually(lambda: "of 201" in text("facts"))
        assert browser.find_element("id", "progress").is_displayed()
        instrument.cancel()
        instrument.wait_for_run(PATIENCE_S)
        server.process.send_signal(signal.SIGSTOP)
        try:
            eventually(lambda: "No news from the instrument" in text("warning"))
        finally:
            server.process.send_signal(signal.SIGCONT)
        eventually(lambda: not browser.find_element("id", "warning").is_displayed())
        assert browser.get_log("browser") == []
        assert browser.find_elements("css selector", "button, input, form, a[href]") == []
        eventually(lambda: not instrument.state.stopped or not instrument.clear_stop())
        instrument.stop_live()
