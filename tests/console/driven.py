"""What the tests do with the console, each function in a process of its own: see `hand`."""

import json
import os
import signal
import tomllib
from pathlib import Path

import msgspec
import numpy as np
from hand import KEY, MENU
from imgui_bundle import imgui

from acquire.frame import FrameHeader
from acquire.watchdog import DEAD_AFTER_S
from display.console.eyes import look
from display.console.keys import PANELS
from display.console.moving import Marks
from display.console.sticks import Scripted
from display.console.tour import Tour

SHORT = 41 if os.environ.get("STEREOTOME_PICTURES") else 6  # planes


def first_start(hand):
    """Find out who is at a port, describe the bench, and see its live picture."""
    setup, bench = hand.console.setup, tomllib.loads(Path("bench.toml").read_text())
    hand.click("//First start/Look for ports")
    hand.enter("//First start/port", bench["stage"]["z"]["port"])
    hand.click("//First start/Ask who is there")
    hand.wait(lambda: "driver asi-ms2000" in setup.words)
    hand.choose("//First start/camera", "sim")
    hand.enter("//First start/Address of the simulated camera", bench["camera"]["address"])
    hand.shot("console_first_start")
    hand.click("//First start/Write and start")
    hand.wait(lambda: hand.console.bench.commands or (setup.words and not setup.doing))
    hand.click("//Camera/Live")
    hand.wait(lambda: hand.console.eyes.seen)
    lost_and_back(hand)


def lost_and_back(hand):
    """Lose the stage, then the process; start it anew: the stage is back, and frames come from another ring."""
    console, before = hand.console, hand.console.bench.ring
    hand.bench(do="unplug", device="z")
    hand.key(KEY.page_up)
    hand.wait(lambda: console.notice)
    assert "[device-lost] z stage" in console.notice
    hand.shot("console_lost")
    hand.bench(do="replug", device="z")
    served = console.setup.later.served
    served.process.kill()
    hand.wait(lambda: any("fell silent" in line.words for line in console.journal.lines("error")))
    hand.ctx.window_focus("//Session")
    hand.click("//Session/Start the instrument anew")
    hand.wait(lambda: console.bench.commands)
    console.eyes.seen = None
    hand.click("//Camera/Live")
    hand.wait(lambda: console.eyes.seen)
    assert console.bench.ring != before
    z_um = console.state.z_um
    for key, there_um in ((KEY.page_up, z_um + 2.0), (KEY.page_down, z_um)):
        hand.key(key)
        hand.at(there_um)


def first_run(hand):
    """Find the focus, set marks, take a stack; pause, go on, abort; STOP while typing; a panel that fails; a crash."""
    console = hand.console
    hand.click("//Camera/Live")
    hand.wait(lambda: console.eyes.seen)
    hand.click("//Stage/Up")
    hand.at(2.0)
    hand.key(KEY.page_up)
    hand.at(4.0)
    hand.ctx.mouse_move("//Live/picture")
    hand.ctx.mouse_wheel_y(-3)
    hand.at(-2.0)
    hand.key(KEY.l)
    part_of_the_frame(hand)
    assert console.line
    hand.key(KEY.l)
    troubles(hand)
    hand.key(KEY.f2)
    hand.click("//Alarms/Seen")
    hand.enter("//Stage/µm", 50_000.0)
    hand.click("//Stage/Go")
    hand.wait(lambda: "[limit]" in console.notice)
    for z_um, key in ((-10.0, KEY.b), (10.0, KEY.t)):
        hand.enter("//Stage/µm", z_um)
        hand.at(z_um)
        hand.key(key)
    assert console.form.marks.complete
    hand.click("//Stage/bottom/Visit")
    hand.at(-10.0)
    hand.enter("//Stack/planes", 400)
    hand.ctx.item_uncheck("//Stack/extended focus and range")
    hand.wait(lambda: getattr(console.planned, "planes", 0) == 400)
    hand.shot("console")
    hand.click("//Stack/Review and start...")
    hand.wait(lambda: console.reviewing)
    hand.shot("console_before")
    hand.click("//Review before the start/Start now")
    hand.wait_state("RUNNING")
    hand.click("//Stack/Pause")
    hand.wait_state("PAUSED")
    hand.shot("console_paused")
    hand.click("//Stack/Resume")
    hand.wait_state("RUNNING")
    hand.click("//Stack/Abort")
    hand.wait_state("CANCELLED")
    assert 0 < console.run.durable < 400
    hand.wait(lambda: not console.running)
    hand.at(0.0)
    hand.enter("//Stack/planes", SHORT)
    hand.wait(lambda: getattr(console.planned, "planes", 0) == SHORT)  # until then what is below may move
    hand.ctx.item_check("//Stack/extended focus and range")
    hand.click("//Stack/Queue")
    hand.click("//Stack/Start the queue")
    hand.wait(lambda: console.run.number == 2 and console.run.state == "COMPLETED" and not console.running)
    range_image(hand)
    hand.ctx.item_uncheck("//Stack/extended focus and range")
    by_stick(hand)
    files(hand)
    stops(hand)
    console.tour = Tour("", started=True, lively=True)
    hand.click("//Tour/Next")
    hand.wait(lambda: console.tour.step == 1)
    hand.shot("console_tour")
    console.tour = None
    hand.window._draws["Log"] = lambda _: 1 / 0
    hand.wait(lambda: any("ZeroDivisionError" in line.words for line in console.journal.lines("error")))
    hand.click("//Camera/Stop live")
    hand.wait(lambda: not console.state.live)
    glasses(hand)
    crash(hand)


def range_image(hand):
    """Measure along a line through the range image of the last run, by the keyboard."""
    console, reviewer = hand.console, hand.window.review.reviewer
    hand.key(KEY._3)
    hand.wait(lambda: reviewer.problem or (reviewer.drawn and reviewer.drawn.wish.shown == console.viewing.shown))
    assert not reviewer.problem
    hand.key(KEY.l)
    hand.wait(lambda: "height" in console.measured)
    rig = console.bench.rig
    wide_um = rig.object_pixel_um * (rig.camera.size_px[0] - 1)
    assert console.measured.startswith(f"{wide_um:.2f} µm")
    picked_points(hand)
    hand.shot("console_range")
    hand.key(KEY._1)


def picked_points(hand):
    """Pick three points of the range image, by its key and by a click, and save them."""
    picks = hand.console.viewing.picks
    hand.ctx.mouse_move("//Review/drawn")
    x, y = imgui.get_mouse_pos()
    for k, (right, down) in enumerate(((0, 0), (60, 0), (60, 45)), start=1):
        hand.ctx.mouse_move_to_pos(imgui.ImVec2(x + right, y + down))
        if k < 3:
            hand.key(KEY.p)
        else:
            hand.ctx.key_down(KEY.mod_ctrl)
            hand.ctx.mouse_click()
            hand.ctx.key_up(KEY.mod_ctrl)
        hand.wait(lambda k=k: len(picks.points) == k)
    apart = np.diff(np.array(picks.points)[:, :2], axis=0)
    um = hand.window.review.reviewer.drawn.pixel_um
    np.testing.assert_allclose(apart, [[60 * um, 0], [0, 45 * um]], atol=um)
    hand.click("//Review/Save points")
    hand.wait(lambda: list(Path("snapshots").glob("*-range-mono.csv")))


def part_of_the_frame(hand):
    """Choose a part of the frame by the mouse, and go back to the whole."""
    console, ctx = hand.console, hand.ctx
    width, height = console.bench.rig.camera.size_px
    ctx.mouse_move("//Live/picture")
    ctx.key_down(KEY.mod_ctrl)
    ctx.mouse_drag_with_delta(imgui.ImVec2(40, 30))
    ctx.key_up(KEY.mod_ctrl)
    hand.wait(lambda: console.eyes.seen.pixels.shape == console.camera.roi[:1:-1])
    assert console.camera.roi[0] in range(width // 2 - 2, width // 2 + 2)
    assert console.camera.roi[2] < width / 2
    hand.key(KEY.w)
    hand.wait(lambda: console.eyes.seen.pixels.shape == (height, width))


def troubles(hand):
    """Have a server that stands still, frames of other kinds, and a plan that cannot be."""
    console = hand.console
    server = json.loads(hand.connection.read_text())["pid"]
    os.kill(server, signal.SIGSTOP)
    woken_s = console.clock.now() + DEAD_AFTER_S + 1
    hand.wait(lambda: console.clock.now() > woken_s)  # its watchdog halted the stage
    assert not console.bench.connected
    hand.key(KEY.page_up)
    hand.wait(lambda: "does not answer" in console.notice)
    hand.key(KEY.escape)
    hand.wait(lambda: console.stopped)
    hand.shot("console_silent")
    os.kill(server, signal.SIGCONT)
    hand.wait(lambda: console.bench.commands and console.state.stopped and not console.bench.stop_asked)
    assert "watchdog" in console.state.why_stopped
    hand.click(MENU, "Release")
    hand.wait(lambda: not console.stopped)
    other_frames(hand)
    console.form.marks.top_um, console.form.marks.bottom_um = 9000.0, 0.0
    hand.wait(lambda: "soft limits" in console.why_no_start())
    console.form.marks = Marks()


def other_frames(hand):
    """Show frames of other sizes, depths and colours between those of the camera."""
    console, rng = hand.console, np.random.default_rng(1)
    for number, (shape, dtype) in enumerate([((40, 60), "u1"), ((50, 30, 3), "u1"), ((70, 90), "u2")], start=1):
        pixels = rng.integers(0, 255, shape).astype(dtype)
        console.eyes.seen = look(-number, pixels, FrameHeader(-1, 0.0, 0.0, 1.0), 255)
        hand.ctx.yield_()
    assert not any("[bug]" in line.words for line in console.journal.lines("error"))


def by_stick(hand):
    """Move the stage by a scripted stick: up while its button is held, and no more when it falls silent."""
    console = hand.console
    now_s, from_um = console.clock.now(), console.state.z_um
    console.stick.top_um_s = 60.0
    console.stick.use(Scripted([(now_s, 0.0, False), (now_s + 0.5, 1.0, True), (now_s + 1.5, None, True)]))
    hand.wait(lambda: "let its button go" in console.stick.still or "heard" in console.stick.still)
    hand.wait(lambda: not console.jogger.under_way)
    console.stick.use(None)
    hand.wait(lambda: console.state.z_age_s < 0.2)
    assert from_um + 3 < console.state.z_um < from_um + 90


def files(hand):
    """Edit the form's recipe as a file: wrong, told where, then good and saved."""
    editor = hand.console.files
    hand.ctx.window_focus("//Files")
    hand.click("//Files/The form as a recipe")
    hand.wait(lambda: editor.good)
    hand.ctx.item_input("//Files/##text")
    hand.ctx.key_chars("planes")
    hand.ctx.item_click("//Files/Check")
    hand.wait(lambda: not editor.good)
    assert "recipe.toml:1" in editor.words
    hand.shot("console_files")
    hand.click("//Files/The form as a recipe")
    hand.click("//Files/Save")
    assert Path("recipe.toml").read_text() == editor.text
    hand.click("//Files/Into the form")
    hand.wait(lambda: editor.words == "it is in the form now")
    hand.ctx.window_focus("//Stack")


def stops(hand):
    """Press Esc when idle, while typing, with a list open, while jogging, while a stack runs and while it is paused."""
    console = hand.console
    hand.stop()
    hand.ctx.item_input("//Stage/µm")
    hand.ctx.key_chars("12")
    hand.stop(shot="console_stopped")
    hand.ctx.item_click("//Stage/step")
    hand.wait(lambda: imgui.is_popup_open("", imgui.PopupFlags_.any_popup))
    hand.stop()
    console.jogger.steps[-1], console.jogger.chosen = ("farther", 450.0), len(console.jogger.steps) - 1
    from_um = console.state.z_um
    hand.key(KEY.page_up | KEY.mod_ctrl)
    hand.wait(lambda: console.state.z_um > from_um + 1)
    hand.stop()
    assert from_um + 1 < console.state.z_um < from_um + 4499  # it never got there
    hand.enter("//Stack/planes", 400)
    for paused in (False, True):
        hand.start()
        hand.wait(lambda: console.run.taken > 1)
        if paused:
            hand.click("//Stack/Pause")
            hand.wait_state("PAUSED")
        hand.stop()
        assert console.run.state == "CANCELLED"
        assert 0 < console.run.durable < 400


def glasses(hand):
    """Show test pictures through shutter glasses, then the last run, and end that by another choice."""
    flipping = hand.console.flipping
    flipping.clock_hz = 100.0
    hand.ctx.window_focus("//Glasses")
    hand.click("//Glasses/Whose eye?")
    hand.wait(lambda: flipping.going is not None and flipping.going.flips > 30)
    hand.click("//Glasses/Crosstalk")
    assert flipping.shows == "crosstalk"
    hand.shot("console_glasses")
    hand.click("//Glasses/End")
    hand.wait(lambda: not flipping.shows and flipping.report)
    assert "refreshes" in flipping.report[0]
    hand.ctx.window_focus("//Review")
    hand.click("//Review/Last run")
    hand.choose("//Review/##stereo", "page-flip")
    hand.wait(lambda: flipping.pairs)


def crash(hand):
    """Start a run; the process that flips dies, the run and the console go on; then die as a crash does."""
    console = hand.console
    hand.ctx.window_focus("//Stack")
    hand.enter("//Stack/planes", 600)  # a run that lasts
    hand.wait(lambda: getattr(console.planned, "planes", 0) == 600)
    hand.start()
    hand.wait(lambda: console.run.taken > 5)
    os.kill(console.flipping.pid, signal.SIGKILL)
    hand.wait(lambda: any("without a word" in line.words for line in console.journal.lines("error")))
    hand.wait(lambda: console.viewing.shown.stereo.mode == "mono")
    assert console.running
    os.kill(os.getpid(), signal.SIGKILL)


def picks_up(hand):
    """See the run that another console began and a script paused, and let it go on to its end."""
    hand.wait_state("PAUSED")
    hand.wait(lambda: hand.console.eyes.seen)
    hand.shot("console_200")
    console, before = hand.console, hand.console.eyes.seen
    met = console.eyes._instrument()
    met.meeting = msgspec.structs.replace(met.meeting, pid=0)  # as one named by its address
    console.eyes._ring = lambda: "/on/another/computer"
    hand.wait(lambda: console.eyes.afar and console.eyes.seen is not before)
    assert console.eyes.seen.pixels.shape == before.pixels.shape
    hand.click("//Stack/Resume")
    hand.wait_state("RUNNING")


def sections(hand):
    """Home, approach, feed, arm and cut by hand; then a run that asks about debris; then look at what was taken."""
    console = hand.console
    hand.ctx.window_focus("//Sections")
    hand.click("//Stage/Park")
    hand.at(-90.0)
    hand.click("//Sections/Home feed")
    hand.wait(lambda: console.feed is not None and console.feed.state == "ready")
    hand.enter("//Sections/µm deep", 20.0)
    hand.click("//Sections/Approach")
    hand.wait(lambda: abs(console.feed.depth_nm - 20_000) < 100)
    hand.enter("//Sections/nm thick", "1-2: 500, 3-: 250")
    hand.click("//Sections/Feed one")
    hand.wait(lambda: abs(console.feed.depth_nm - 20_500) < 100)
    hand.click("//Sections/Arm knife")
    hand.click("//Sections/Cut one")
    hand.wait(lambda: console.feed.cuts == 1)
    hand.ctx.item_check("//Sections/cut sections, a stack of each face")
    hand.enter("//Sections/sections", 3)
    hand.enter("//Sections/wipes at debris (0 asks)", 0)
    hand.shot("console_sections")
    console.form.marks.top_um, console.form.marks.bottom_um, console.form.planes = 2.0, -2.0, 3
    hand.wait(lambda: getattr(console.planned, "planes", 0) == 9 and not console.why_no_start())
    hand.start(shot="console_sections_review")
    hand.wait(lambda: console.run.question is not None)
    hand.shot("console_hold")
    assert "HOLD" in console.alarms.unseen[0].words
    hand.key(KEY.f2)
    hand.shot("console_alarm")
    hand.click("//Alarms/Seen")
    assert not console.alarms.unseen
    hand.click("//The run asks/accept")
    hand.wait_state("COMPLETED")
    hand.wait(lambda: not console.running)
    watched(hand)
    reviews(hand)
    by_keys(hand)
    stops_sections(hand)


def watched(hand):
    """Look at the slice across the sections that was drawn as they came, and set limits around them."""
    monitor = hand.console.monitor
    assert sorted(monitor.steps) == [0, 1, 2]
    hand.ctx.window_focus("//Monitor")
    hand.click("//Monitor/Limits around these")
    hand.enter("//Monitor/…##low mean", 1)
    assert monitor.limits["mean"][0] == 1
    assert monitor.limits["mean"][1] > monitor.steps[2].mean
    hand.shot("console_monitor")


def reviews(hand):
    """Look at the last run in three kinds of picture and two of stereo."""
    hand.ctx.window_focus("//Review")
    hand.click("//Review/Last run")
    viewing, reviewer = hand.console.viewing, hand.window.review.reviewer
    for mode, stereo in (("slice", "mono"), ("orthogonal", "anaglyph-grey"), ("mip", "parallel")):
        viewing.kind(mode)
        viewing.eyes(mode=stereo)
        hand.wait(lambda: reviewer.problem or (reviewer.drawn and reviewer.drawn.wish.shown == viewing.shown))
        assert not reviewer.problem
        assert reviewer.drawn.picture.std() > 5
        hand.shot(f"console_review_{mode}")
    viewing.frames = 8
    hand.click("//Review/Movie")
    hand.wait(lambda: list(Path("snapshots").glob("*.mp4")) and not reviewer.filming)


def by_keys(hand):
    """Reach every field of every panel by Tab, the views and the whole screen by their keys."""
    console = hand.console
    for number, panel in enumerate(PANELS, start=1):
        hand.key(getattr(KEY, f"_{number % 10}") | KEY.mod_ctrl)
        hand.ctx.yield_(2)
        assert not hand.fields(panel) - hand.tabbed(), panel
    hand.key(KEY._1)
    hand.wait(lambda: console.shows == "Live")
    hand.key(KEY._5)
    hand.wait(lambda: console.shows == "Review")
    before, swap, angle_deg = console.viewing.shown.mode, *eyes(console)
    hand.key(KEY.x)
    hand.key(KEY.period)
    assert (before, *eyes(console)) == ("orthogonal", not swap, angle_deg + 0.5)
    hand.key(KEY.x)
    hand.key(KEY.comma)
    assert eyes(console) == (swap, angle_deg)
    hand.key(KEY.f1)
    hand.wait(lambda: console.shows_keys)
    hand.shot("console_keys")
    hand.key(KEY.f1)
    hand.wait(lambda: not console.shows_keys)
    size = tuple(imgui.get_io().display_size)
    for wanted in ((2560, 1440), size):
        hand.key(KEY.f11)
        hand.wait(lambda wanted=wanted: tuple(imgui.get_io().display_size) == wanted)


def eyes(console):
    return console.viewing.shown.stereo.swap, console.viewing.shown.stereo.vergence_deg


def stops_sections(hand):
    """Press Esc while a run asks, and while sections are cut."""
    console = hand.console
    hand.ctx.window_focus("//Sections")
    hand.start()
    hand.wait(lambda: console.run.question is not None)
    hand.stop()
    assert console.run.state == "CANCELLED"
    hand.start()
    hand.wait(lambda: console.run.taken > 0)
    hand.stop()
    assert console.run.state == "CANCELLED"
    assert console.run.section < 3
