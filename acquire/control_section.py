"""``stereotome control section …``: feed and knife by hand at an instrument that is being served."""

from __future__ import annotations

import json as json_text
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING

import msgspec

from acquire.control_commands import ONLY, At, met
from devices.errors import DeviceError, Unsafe
from devices.section_commands import NM_PER_UM, Flag, check_homing_wanted, refuse_direction

if TYPE_CHECKING:
    from collections.abc import Iterator

    from acquire.client import Instrument
    from acquire.replies import FeedView


def show(*, at: At = ONLY) -> None:
    """Say where feed and knife of an instrument that is being served stand. Nothing moves."""
    with met(at) as instrument:
        _tell(instrument, at)


def home(*, yes: Flag = False, at: At = ONLY) -> None:
    """Move the feed to its home switch.

    Parameters
    ----------
    yes
        Do it: the feed may travel its whole length.
    """
    check_homing_wanted(yes)
    with _commanded(at) as (instrument, _):
        instrument.home_feed()


def approach(depth_um: float, /, *, at: At = ONLY) -> None:
    """Go forward to an absolute depth in one go, to bring the block near the knife.

    Parameters
    ----------
    depth_um
        From the home position.
    """
    with _commanded(at) as (instrument, feed):
        refuse_direction(depth_um * NM_PER_UM < feed.depth_nm, "backwards", "control section retract")
        instrument.approach(depth_um)


def feed(thickness_nm: float, /, *, at: At = ONLY) -> None:
    """Feed forward by the thickness of one section, once.

    Parameters
    ----------
    thickness_nm
        Of the section.
    """
    with _commanded(at) as (instrument, feed):
        instrument.feed(thickness_nm, expect_section=feed.cuts)


def cut(*, stage_is_parked: Flag = False, at: At = ONLY) -> None:
    """Take one section with the knife, once; the stage has to be at its park position, which the instrument reads.

    Parameters
    ----------
    stage_is_parked
        I looked: the microscope is out of the knife's way.
    """
    if not stage_is_parked:
        raise Unsafe(
            "knife: is the microscope out of its way? Nothing was sent.", fix="look, then say so: --stage-is-parked"
        )
    with _commanded(at) as (instrument, feed):
        instrument.arm_knife()
        instrument.cut(expect_section=feed.cuts)


def retract(depth_um: float | None = None, /, *, knife: Flag = False, at: At = ONLY) -> None:
    """Bring the knife out, or draw the feed back to an absolute depth.

    Parameters
    ----------
    depth_um
        From the home position; left out with --knife.
    knife
        Bring the knife out of the specimen; the feed stays.
    """
    if knife == (depth_um is not None):
        raise Unsafe("retract: what, and how far? Nothing was sent.", fix="give a depth in µm, or --knife.")
    with _commanded(at) as (instrument, feed):
        if depth_um is None:
            instrument.retract_knife()
            return
        refuse_direction(depth_um * NM_PER_UM > feed.depth_nm, "forwards", "control section approach")
        instrument.approach(depth_um)


@contextmanager
def _commanded(at: At) -> Iterator[tuple[Instrument, FeedView]]:
    """Command an instrument that has a feed, and say how that stands afterwards."""
    with met(at) as instrument:
        instrument.command()
        yield instrument, _feed_of(instrument)
        _tell(instrument, at)


def _feed_of(instrument: Instrument) -> FeedView:
    feed = instrument.refresh().feed
    if feed is None:
        raise DeviceError(
            "feed: this instrument has none, or it did not answer yet.",
            fix=("see what the instrument's log says", "add [microtome] to the instrument file: docs/microtome.md"),
        )
    return feed


def _tell(instrument: Instrument, at: At) -> None:
    feed = _feed_of(instrument)
    words = [
        f"feed: {feed.state or 'ready'}, at {feed.depth_nm / NM_PER_UM:.3f} µm",
        f"knife: {feed.knife}, {feed.cuts} cuts counted",
    ]
    lines = [json_text.dumps(msgspec.to_builtins(feed))] if at.json else words
    sys.stdout.writelines(f"{line}\n" for line in lines)
