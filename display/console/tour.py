"""The demonstration: a stack that runs when the window opens, and a few words on what to try."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from acquire.state import FINAL
from display.console.moving import Marks

if TYPE_CHECKING:
    from display.console.model import Console

REACH_UM = 24.0
PLANES = 49


class Step(NamedTuple):
    """What to try, with its title."""

    title: str
    words: str


STEPS = (
    Step(
        "A stack is being taken",
        "A simulated microscope takes 49 planes through a relief. The picture shows each as it comes, the Stack panel "
        "and the bar at the top how far it is. Try Pause and Resume.",
    ),
    Step(
        "Find a focus",
        "When the run is over, turn the wheel over the picture, or press PgUp and PgDn. The curve below the histogram "
        "shows how sharp the picture is; [ and ] choose the step.",
    ),
    Step(
        "Take a stack of your own",
        "Press T where the top is to be and B at the bottom. The Stack panel says what it costs in time and disk; "
        "Review and start shows it all once more.",
    ),
    Step(
        "Look at it in depth",
        "In the Review panel open the last run: extended focus, range, relief, volumes, each in mono or stereo. "
        "Drag a line over the range image: its profile is in µm.",
    ),
    Step(
        "Stop everything",
        "Esc, or the red button, stops all motion at once, also while you type. It latches: Release is an act of its "
        "own. It is no emergency stop. F1 lists all keys.",
    ),
)


@dataclass
class Tour:
    """Which step is shown, and whether the first stack was started.

    Attributes
    ----------
    folder : str
        Where its runs go.
    before : int
        Number of the last run before its own.
    lively : bool
        Live frames were asked for, after its run.
    """

    folder: str
    step: int = 0
    started: bool = False
    lively: bool = False
    before: int = 0
    shown: bool = True

    def tick(self, console: Console) -> None:
        """Fill in the form, and start the stack as soon as that can be done; show live frames after it."""
        if self.started:
            self._live(console)
            return
        form = console.form
        form.name, form.planes, form.spacing = "demo", PLANES, "planes"
        form.marks = Marks(top_um=REACH_UM, bottom_um=-REACH_UM)
        form.folder, form.return_to, form.keep_free_gb = f"{self.folder}/run-{{run:03d}}", "middle", 0.1
        if not console.why_no_start() and getattr(console.planned, "planes", 0) == PLANES:
            self.started, self.before = True, 0 if console.run is None else console.run.number
            console.start_run()

    def _live(self, console: Console) -> None:
        run = console.run
        over = run is not None and run.number > self.before and run.state in FINAL and not console.running
        if over and not self.lively:
            self.lively = True
            if console.state is not None and not console.state.live:
                console.camera.live()

    def forward(self) -> None:
        """Show the next step; after the last the tour is over."""
        self.step += 1
        self.shown = self.step < len(STEPS)
        self.step = min(self.step, len(STEPS) - 1)
