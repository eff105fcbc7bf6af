"""What the tests do with the console, each function in a process of its own: see `hand`."""

import os
import signal

from hand import KEY, MENU


def first_run(hand):
    """Find the focus, set the marks, take a stack; pause, go on, abort; STOP while typing; a panel that fails."""
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
    hand.enter("//Stage/µm", 500.0)
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
    hand.shot("console_review")
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
    hand.at(-10.0)
    hand.enter("//Stack/planes", 6)
    hand.wait(lambda: getattr(console.planned, "planes", 0) == 6)
    hand.key(KEY.r | KEY.mod_ctrl)
    hand.click("//Review before the start/Start now")
    hand.wait(lambda: console.run.number == 2 and console.run.state == "COMPLETED" and not console.running)
    hand.ctx.item_input("//Stage/µm")
    hand.ctx.key_chars("12")
    hand.key(KEY.escape)
    hand.wait(lambda: console.state.stopped)
    assert "STOP" in console.why_no_motion()
    hand.shot("console_stopped")
    hand.click(MENU, "Release")
    hand.wait(lambda: not console.stopped)
    hand.window._draws["Log"] = lambda _: 1 / 0
    hand.wait(lambda: any("ZeroDivisionError" in line.words for line in console.journal.lines("error")))
    hand.click("//Camera/Stop live")
    hand.wait(lambda: not console.state.live)


def crashes(hand):
    """Start a run, then die as a crash does."""
    console = hand.console
    hand.enter("//Stack/planes", 600)
    hand.ctx.item_uncheck("//Stack/extended focus and range")
    hand.wait(lambda: getattr(console.planned, "planes", 0) == 600)
    hand.click("//Stack/Review and start...")
    hand.click("//Review before the start/Start now")
    hand.wait(lambda: console.running and console.run.taken > 5)
    os.kill(os.getpid(), signal.SIGKILL)


def picks_up(hand):
    """See the run that another console began, and command it."""
    hand.wait(lambda: hand.console.running and hand.console.eyes.seen)
    hand.shot("console_200")
    hand.wait_state("COMPLETED")
