"""Moving the stage from the console: named steps, wishes that add up while a move is under way, marks."""

from __future__ import annotations

from dataclasses import dataclass, field

STEPS = (("very fine", 0.1), ("fine", 0.5), ("medium", 2.0), ("coarse", 10.0), ("far", 50.0))
FASTER = 10.0


@dataclass
class Jogger:
    """Adds up what wheel and keys ask for and sends it in one go, one move at a time.

    Attributes
    ----------
    steps : list of (name, µm)
        From small to large.
    chosen : int
        The step in use.
    wanted_um : float
        Asked for and not sent yet.
    under_way : bool
        A move was sent and is not answered.
    """

    steps: list[tuple[str, float]] = field(default_factory=lambda: list(STEPS))
    chosen: int = 2
    wanted_um: float = 0.0
    under_way: bool = False

    @property
    def step_um(self) -> float:
        """The step in use, in µm."""
        return self.steps[self.chosen][1]

    def choose(self, by: int) -> None:
        """Take a smaller or a larger step."""
        self.chosen = min(max(self.chosen + by, 0), len(self.steps) - 1)

    def jog(self, steps: float, *, faster: bool = False) -> None:
        """Ask for so many steps, tenfold if ``faster``."""
        self.wanted_um += steps * self.step_um * (FASTER if faster else 1.0)

    def drive(self, by_um: float, most_um: float) -> None:
        """Ask for a little more, as a stick does; what waits is never more than so much."""
        self.wanted_um = min(max(self.wanted_um + by_um, -most_um), most_um)

    def due_um(self) -> float:
        """Return what to send now, 0 for nothing; it counts as sent."""
        if self.under_way or not self.wanted_um:
            return 0.0
        wanted_um, self.wanted_um, self.under_way = round(self.wanted_um, 3), 0.0, True
        return wanted_um

    def done(self) -> None:
        """Note that the move was answered."""
        self.under_way = False

    def forget(self) -> None:
        """Want nothing more: a stop, or a refusal."""
        self.wanted_um, self.under_way = 0.0, False


@dataclass
class Marks:
    """Ends of the stack to come, set where the stage is; None until then."""

    top_um: float | None = None
    bottom_um: float | None = None

    @property
    def complete(self) -> bool:
        """Whether both are set."""
        return self.top_um is not None and self.bottom_um is not None

    def in_order(self) -> tuple[float, float]:
        """Return bottom and top, whichever was set as which."""
        assert self.top_um is not None
        assert self.bottom_um is not None
        return min(self.top_um, self.bottom_um), max(self.top_um, self.bottom_um)
