"""Pairs of views before shutter glasses: a process of their own shows them, a thread of the console minds it."""

from __future__ import annotations

import threading
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from devices.errors import StereotomeError
from devices.toml_write import toml_text
from display.flip_process import FlipOptions
from display.glasses_patterns import PATTERNS, pattern
from display.page_flip import PageFlip

if TYPE_CHECKING:
    from collections.abc import Callable

    from devices.rig import RigSpec
    from display.console.journal import Journal
    from display.glasses_patterns import Picture
    from display.page_flip import Going
    from display.sync_codes import Code

REVIEW = "review"
LOOK_S = 0.2
SIZE, SIZE_WITHOUT_A_DISPLAY = (1920, 1080), (320, 180)


class Flipping:
    """Begins a show and ends it; nothing here waits for it.

    Parameters
    ----------
    rig : callable
        Returns the instrument, whose shutter glasses are told of each flip; None while it is not known.

    Attributes
    ----------
    shows : str
        A test picture of `display.glasses_patterns`, ``"review"``, or empty while nothing is shown.
    code : str
        Marks that are drawn for glasses which watch the picture.
    windowed : bool
        In a window instead of on the whole display.
    clock_hz : float or None
        No window: a clock of this rate in the display's place.
    going : Going or None
        How it goes.
    pairs : int
        Pairs of the review that were handed over.
    report : tuple of str
        What became of the last show, in lines.
    """

    def __init__(self, journal: Journal, rig: Callable[[], RigSpec | None]) -> None:
        self.shows = ""
        self.code: Code = "none"
        self.windowed = False
        self.clock_hz: float | None = None
        self.going: Going | None = None
        self.report: tuple[str, ...] = ()
        self.pairs = 0
        self.pid = 0
        self._journal = journal
        self._rig = rig
        self._pair: tuple[Picture, Picture] | None = None
        self._news = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of a view in pixels."""
        return SIZE if self.clock_hz is None else SIZE_WITHOUT_A_DISPLAY

    def begin(self, shows: str) -> None:
        """Show test pictures, or what `publish` brings."""
        self.shows = shows
        self._news.set()
        if self._thread is None or not self._thread.is_alive():
            self._thread = threading.Thread(target=self._run, name="flipping", daemon=True)
            self._thread.start()

    def publish(self, left: Picture, right: Picture) -> None:
        """Have a pair shown, (height, width, 3) uint8, if it is the review's turn; from any thread."""
        self._pair = (left, right)
        self._news.set()

    def end(self) -> None:
        """Show nothing more."""
        self.shows = ""
        self._news.set()

    def close(self) -> None:
        """End, and wait for it."""
        self.end()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        try:
            with TemporaryDirectory(prefix="stereotome-") as folder, PageFlip(self.size, self._options(folder)) as flip:
                self.pid = flip.pid
                self._mind(flip)
                self._tell(flip)
        except StereotomeError as error:
            self._journal.error("glasses", error)
        finally:
            self.shows, self.going, self.pid = "", None, 0

    def _options(self, folder: str) -> FlipOptions:
        rig, instrument = self._rig(), None
        if rig is not None and rig.glasses is not None:
            instrument = Path(folder) / "instrument.toml"
            instrument.write_text(toml_text(rig.model_dump(mode="json", by_alias=True, exclude_none=True)))
        named = None if instrument is None else str(instrument)
        return FlipOptions("", self.code, windowed=self.windowed, instrument=named, clock_hz=self.clock_hz)

    def _mind(self, flip: PageFlip) -> None:
        """Hand over what is to be shown until it is to end, or ends by itself."""
        shown = ""
        while self.shows and flip.running:
            if self.shows != shown:
                shown = self.shows
                if shown in PATTERNS:
                    flip.show(*pattern(shown, flip.size))  # type: ignore[arg-type]
            pair, self._pair = self._pair, None
            if pair is not None and shown == REVIEW:
                flip.show(*pair)
                self.pairs += 1
            self.going = flip.going
            self._news.wait(LOOK_S)
            self._news.clear()

    def _tell(self, flip: PageFlip) -> None:
        report = flip.close()
        self.report = (*flip.said, *(() if report is None else report.words().splitlines()))
        if report is None:
            self._journal.add("error", "glasses", "the process that showed pictures ended without a word")
        else:
            self._journal.add("info", "glasses", "; ".join(self.report))
