"""Drives the real console in a process of its own: ``python hand.py FUNCTION CONNECTION FOLDER SCALE``.

The function is one of `driven`, and is given a `Hand`. The program ends with 0, or with what went wrong.
"""

import faulthandler
import json
import os
import socket
import sys
from contextlib import ExitStack
from pathlib import Path

from imgui_bundle import imgui
from imgui_bundle.immapp import testing

from acquire.served import Served
from display.console import camera_work
from display.console.app import opened
from display.console.setup import Later
from display.console.window import ConsoleWindow

PATIENCE = int(os.environ.get("STEREOTOME_PATIENCE", "900"))  # frames
WAITING_HZ, ACTING_HZ = 8.0, 120.0
LIVE_HZ = 10.0
KEY = imgui.Key
MENU = "//##MainMenuBar/##MenuBar"


class Hand:
    """An operator's hand, and eyes that wait."""

    def __init__(self, ctx, console, window, folder, connection):
        self.connection = Path(connection)
        self.ctx = ctx
        self.console = console
        self.window = window
        self.folder = folder

    def wait(self, wanted):
        """Let frames pass until something holds, and return it."""
        pace = self.window.params.fps_idling
        for _ in range(PATIENCE):
            if found := wanted():
                pace.fps_max = ACTING_HZ
                return found
            pace.fps_max = WAITING_HZ  # who waits needs no more pictures than that
            self.ctx.yield_()
        told = "\n".join(map(str, self.console.journal.lines()))
        raise AssertionError(f"it did not come. State {self.console.state}, journal:\n{told}")

    def wait_state(self, *states):
        """Wait for a state of the run."""
        return self.wait(lambda: self.console.run is not None and self.console.run.state in states)

    def at(self, z_um):
        """Wait until the stage is told to be at a place."""
        self.wait(lambda: abs(self.console.state.z_um - z_um) < 0.3 and not self.console.jogger.under_way)

    def click(self, *path):
        """Click what lies at a path, once it may be clicked."""
        ref = "/".join(path)
        disabled = int(imgui.ItemFlags_.disabled)

        def able():
            found = self.ctx.item_info(ref, imgui.test_engine.TestOpFlags_.no_error)
            return found.id_ and not found.item_flags & disabled

        self.wait(able)
        self.ctx.item_click(ref)

    def choose(self, ref, item):
        """Choose an item of a list."""
        self.click(ref)
        self.ctx.item_click(f"//##Combo_00/**/{item}")

    def enter(self, ref, value):
        """Type a value into a field."""
        self.ctx.item_input_value(ref, value)

    def key(self, chord):
        """Press a key."""
        self.ctx.key_press(chord)

    def bench(self, **words):
        """Ask the bench to do something; see `sim.control`."""
        host, _, port = os.environ["STEREOTOME_BENCH"].partition(":")
        with socket.create_connection((host, int(port))) as control, control.makefile("rb") as lines:
            control.sendall(json.dumps(words).encode() + b"\n")
            assert json.loads(lines.readline())["ok"]

    def fields(self, panel):
        """Return all of a panel that can be pressed or filled in now, but for curves and what fields do as well."""
        items = imgui.test_engine.TestItemList()
        self.ctx.gather_items(items, f"//{panel}", -1)
        off = int(imgui.ItemFlags_.disabled | imgui.ItemFlags_.no_nav)
        every = (items.get_by_index(k) for k in range(items.get_size()))
        return {item.id_ for item in every if not item.item_flags & off}

    def tabbed(self):
        """Return where Tab leads, once round."""
        met = []
        while len(met) < 2 or met[-1] not in met[:-1]:
            self.key(KEY.tab)
            self.ctx.yield_()
            met.append(imgui.get_current_context().nav_id)
            assert len(met) < 100
        return set(met)

    def start(self, shot=""):
        """Start what the form says, once it is planned."""
        before = 0 if self.console.run is None else self.console.run.number
        self.wait(lambda: not self.console.why_no_start())
        self.key(KEY.r | KEY.mod_ctrl)
        if shot:
            self.shot(shot)
        self.click("//Review before the start/Start now")
        self.wait(lambda: self.console.run is not None and self.console.run.number > before)

    def stop(self, shot=""):
        """Press Esc, see that everything stands, and release."""
        console = self.console
        self.key(KEY.escape)
        self.wait(lambda: console.state.stopped and not console.running)
        assert "STOP" in console.why_no_motion()
        if shot:
            self.shot(shot)
        self.click(MENU, "Release")
        self.wait(lambda: not console.stopped)

    def shot(self, name):
        """Take a picture of the window."""
        self.ctx.yield_(2)
        testing.capture(self.ctx, str(self.folder / f"{name}.png"))


def main(function, connection, folder, scale):
    import driven

    faulthandler.dump_traceback_later(float(os.environ["STEREOTOME_HANGS_S"]))  # who hangs says where
    with ExitStack() as stack:
        served = Later() if connection == "later" else Served(Path(connection))
        stack.callback(served.end)
        console = opened(served, stack)
        camera_work.LIVE_HZ = LIVE_HZ
        console.form.folder = f"{os.environ.get('STEREOTOME_RUNS', Path.cwd())}/run-{{run}}"
        window = ConsoleWindow(console, scale=float(scale), remembers=False)
        window.params.fps_idling.enable_idling = False  # what the engine does is no event: it wakes no window

        def drive(ctx):
            hand = Hand(ctx, console, window, Path(folder), connection)
            engine = imgui.test_engine.get_io(ctx.engine)
            engine.config_watchdog_warning = engine.config_watchdog_kill_test = 1e6
            if connection != "later":
                hand.wait(lambda: console.bench.commands)
            getattr(driven, function)(hand)
            assert window.canvas.context.error == "GL_NO_ERROR"

        stack.callback(window.close)
        testing.run(test_function=drive, runner_params=window.params)


if __name__ == "__main__":
    main(*sys.argv[1:])
