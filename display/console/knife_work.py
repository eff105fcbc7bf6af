"""Feed and knife worked by hand, one act at a time."""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire import replies, requests
from devices.errors import StereotomeError
from display.console.journal import words_of

if TYPE_CHECKING:
    from display.console.model import Console

ARMED_FOR_S = 10.0


class KnifeWork:
    """Feed and knife of a console's instrument.

    Attributes
    ----------
    depth_um : float
        Depth to approach, as typed.
    notice : str
        What was refused last, in words.
    """

    def __init__(self, console: Console) -> None:
        self.depth_um = 0.0
        self.notice = ""
        self._console = console
        self._armed_s = float("-inf")

    def approach(self, depth_um: float) -> None:
        """Bring the block near the knife."""
        self._by_hand(requests.ApproachSection(depth_um=depth_um))

    def home(self) -> None:
        """Let the feed search its reference."""
        self._by_hand(requests.HomeFeed())

    def retract(self) -> None:
        """Bring the knife out."""
        self._by_hand(requests.RetractKnife())

    def feed_once(self) -> None:
        """Feed by one section of the form's thickness."""
        if self._console.feed is None:
            return
        try:
            thickness_nm = self._console.form.sections.first_nm
        except ValueError as wrong:
            self.notice = f"not fed: the thickness {wrong}"
            return
        self._by_hand(requests.FeedSection(thickness_nm=thickness_nm, expect_section=self._console.feed.cuts))

    def arm(self) -> None:
        """Allow one cut within the next seconds."""
        self._armed_s = self._console.clock.now()
        self._by_hand(requests.ArmKnife())

    def cut(self) -> None:
        """Take one section with the armed knife."""
        if self._console.feed is not None:
            self._armed_s = float("-inf")
            self._by_hand(requests.CutSection(expect_section=self._console.feed.cuts))

    @property
    def armed_left_s(self) -> float:
        """How long the knife stays armed."""
        return max(0.0, self._armed_s + ARMED_FOR_S - self._console.clock.now())

    def _by_hand(self, request: requests.AnyRequest) -> None:
        self.notice = ""
        self._console.bench.ask(request, "feed", self._fed)

    def _fed(self, answer: replies.AnyReply | StereotomeError) -> None:
        if isinstance(answer, StereotomeError):
            self.notice = words_of(answer)
        elif isinstance(answer, replies.Depth):
            self._console.journal.add(
                "info", "feed", f"at {answer.depth_nm / 1000:.3f} µm, strokes counted: {answer.cuts}"
            )
