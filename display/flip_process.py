"""The process that flips: its own window, its own beat, pairs from shared memory, glasses told; nothing else.

``python -m display.flip_process OPTIONS`` (JSON of `FlipOptions`) says ``ready`` once pictures are shown, and at the
end a line of JSON about how it went. It ends when the mailbox says so, when its window is closed, after ``seconds``, or
when the process that started it is gone.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Any

from devices.clock import SystemClock
from devices.errors import DeviceError, StereotomeError
from devices.glasses_timing import turns_of
from display.mailbox import Mailbox
from display.pacing import PaceReport, Turn, check_rate
from display.presenter import Presenter
from display.shown_report import ShownReport, shown_report

if TYPE_CHECKING:
    from collections.abc import Callable

    from devices.glasses_spec import GlassesSpec
    from devices.protocols import Clock, Eyewear
    from display.flip_screens import ClockedScreen, FlipWindow, Key
    from display.sync_codes import Code

LOCK_EVERY_S = 0.25
TELL_EVERY = 30  # flips
STEP_US = 100  # by which a key moves the shutter's opening
READY = "ready"
EAGER = -5  # niceness, where the system allows it


@dataclass(frozen=True)
class FlipOptions:
    """What the process is started with.

    Attributes
    ----------
    mailbox : str
        Path of the pairs.
    code : str
        Sync code; see `display.sync_codes`.
    windowed : bool
        A window instead of the whole display.
    swap : bool
        Exchange the eyes.
    instrument : str or None
        Instrument file whose glasses are told.
    clock_hz : float or None
        No window: a clock of this rate in the display's place.
    seconds : float or None
        For how long.
    """

    mailbox: str
    code: Code = "none"
    windowed: bool = False
    swap: bool = False
    instrument: str | None = None
    clock_hz: float | None = None
    seconds: float | None = None


class Show:
    """A screen, perhaps glasses, and the loop between them."""

    def __init__(self, options: FlipOptions, clock: Clock) -> None:
        self._options = options
        self._clock = clock
        self._mailbox = Mailbox.open(Path(options.mailbox))
        self._screen = _screen(options, self._mailbox, clock)
        self._spec, self._glasses = _glasses(options, clock)
        self._ended = Event()
        self._parent = os.getppid()
        self._swapped_by_key = False
        self._keys: list[Key] = []

    def run(self, ready: Callable[[], None]) -> ShownReport:
        """Show pairs until the end, and return how it went."""
        if self._screen.quad_buffered:
            return self._run_quad_buffered(ready)
        presenter = Presenter(self._screen, self._clock, self._glasses, swap=self._options.swap)
        locker = Thread(target=self._keep_locked, args=(presenter,), name="glasses", daemon=True)
        locker.start()
        ready()
        end_s = self._end_s()
        while self._goes_on(end_s):
            presenter.step()
            self._heed(presenter)
        self._ended.set()
        locker.join()
        return self._report(presenter)

    def close(self) -> None:
        """Let go of everything."""
        if self._glasses is not None:
            self._glasses.close()
        self._screen.close()

    def _end_s(self) -> float:
        return self._clock.now() + (self._options.seconds or float("inf"))

    def _goes_on(self, end_s: float) -> bool:
        if self._screen.unplugged:
            sys.stderr.write("the display was unplugged: the show has ended, and a run goes on.\n")
            return False
        over = self._mailbox.stopped or self._screen.closed or self._clock.now() >= end_s
        return not over and os.getppid() == self._parent

    def _heed(self, presenter: Presenter) -> None:
        """Do what keys and the other process want, and tell that one how it goes."""
        for key in self._screen.keys:
            if key == "swap":
                self._swapped_by_key = not self._swapped_by_key
            else:
                self._keys.append(key)
        wanted = self._options.swap ^ self._mailbox.swap ^ self._swapped_by_key
        if wanted != presenter.swap:
            presenter.swap = wanted
        pace = presenter.pacer.report
        if pace.flips % TELL_EVERY == 0:
            period_ns = round(presenter.pacer.beat.period_s * 1e9)
            self._mailbox.tell((pace.refreshes, pace.flips, pace.late, pace.wrong_eye, pace.longest_wrong, period_ns))

    def _keep_locked(self, presenter: Presenter) -> None:
        while not self._ended.wait(LOCK_EVERY_S):
            self._adjust()
            presenter.lock_glasses()

    def _adjust(self) -> None:
        """Move the opening of an emitter's shutters as the keys say."""
        from devices.drivers.open3d import Open3dGlasses  # noqa: PLC0415  only where there are glasses

        keys, self._keys = self._keys, []
        if not keys or not isinstance(self._glasses, Open3dGlasses):
            return
        settings = self._glasses.settings()
        delay_us = settings.frame_delay_us + STEP_US * (keys.count("later") - keys.count("sooner"))
        open_us = settings.frame_duration_us + STEP_US * (keys.count("longer") - keys.count("shorter"))
        wanted = replace(settings, frame_delay_us=max(delay_us, 0), frame_duration_us=max(open_us, STEP_US))
        with contextlib.suppress(DeviceError):
            self._glasses.store(wanted)
        sys.stderr.write(f"delay_us = {wanted.frame_delay_us}, open_us = {wanted.frame_duration_us}\n")

    def _report(self, presenter: Presenter) -> ShownReport:
        hz = 1 / presenter.pacer.beat.period_s
        if self._glasses is None or self._spec is None:
            return shown_report(hz, presenter.pacer.report, presenter.flips, ())
        delay_s = (self._spec.delay_us or 0) / 1e6
        open_s = None if self._spec.open_us is None else self._spec.open_us / 1e6
        turns = turns_of(self._glasses.timing, self._clock.now(), delay_s=delay_s)
        if presenter.failure is not None:
            sys.stderr.write(presenter.failure.message() + "\n")
        return shown_report(hz, presenter.pacer.report, presenter.flips, turns, delay_s=delay_s, open_s=open_s)

    def _run_quad_buffered(self, ready: Callable[[], None]) -> ShownReport:
        """Draw pairs and leave the turns to the driver."""
        window: Any = self._screen
        check_rate(window.refresh_hz)
        ready()
        end_s, flips = self._end_s(), 0
        while self._goes_on(end_s):
            swap = self._options.swap ^ self._mailbox.swap
            left, right = Turn(flips, "left", 0.0), Turn(flips, "right", 0.0)
            window.draw_both(right if swap else left, left if swap else right)
            window.swap()
            flips += 1
        return shown_report(window.refresh_hz, PaceReport(refreshes=flips, flips=flips), (), ())


def _screen(options: FlipOptions, mailbox: Mailbox, clock: Clock) -> ClockedScreen | FlipWindow:
    from display.flip_screens import ClockedScreen, FlipWindow  # noqa: PLC0415  OpenGL only in this process

    if options.clock_hz is not None:
        return ClockedScreen(mailbox, clock, options.clock_hz, options.code)
    return FlipWindow(mailbox, options.code, windowed=options.windowed)


def _glasses(options: FlipOptions, clock: Clock) -> tuple[GlassesSpec | None, Eyewear | None]:
    if options.instrument is None:
        return None, None
    from devices.glasses_commands import open_eyewear, spec_of  # noqa: PLC0415

    spec = spec_of(Path(options.instrument))
    return spec, open_eyewear(spec, clock)


def main(arguments: list[str]) -> int:
    """Run the process; see the module."""
    with contextlib.suppress(OSError):
        os.nice(EAGER)
    gc.disable()  # a collection in the wrong moment is a late picture
    try:
        show = Show(FlipOptions(**json.loads(arguments[0])), SystemClock())
        try:
            report = show.run(_say_ready)
        finally:
            show.close()
    except StereotomeError as error:
        sys.stderr.write(error.message() + "\n")
        return error.exit_code
    sys.stdout.write(json.dumps(asdict(report)) + "\n")
    return 0


def _say_ready() -> None:
    sys.stdout.write(READY + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
