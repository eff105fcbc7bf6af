"""``stereotome section check|show|home|approach|feed|cut|retract|stop``: a microtome's feed by hand."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from devices.clock import SystemClock
from devices.errors import RigError, Unsafe

if TYPE_CHECKING:
    from collections.abc import Iterator

    from devices.drivers.feed import ModbusFeed
    from devices.feed_spec import FeedSpec
    from devices.profile import Profile
    from devices.wire.modbus_map import RegisterWrite

NM_PER_UM = 1000
Kind = Literal["rtu", "tcp", "rtu_over_tcp"]
Instrument = Annotated[Path, Parameter(name=["--instrument", "-i"])]
Flag = Annotated[bool, Parameter(negative="")]


def check(profile: str, /, *, step_um: float = 1.0, unit: int | None = None, link: Kind | None = None) -> None:
    """Print every frame of a profile, to compare with the drive's manual before anything is connected.

    Parameters
    ----------
    profile
        A shipped register map, or the path of one.
    step_um
        Length of the move shown, from 0.
    unit
        Number of the drive on the line, in place of the profile's.
    link
        rtu (with CRC), tcp (with header) or rtu_over_tcp, in place of the profile's.
    """
    from devices.profile import load_profile  # noqa: PLC0415  other commands do without

    chosen = load_profile(profile)
    changes = {name: value for name, value in (("unit", unit), ("kind", link)) if value is not None}
    chosen = chosen.model_copy(update={"link": chosen.link.model_copy(update=changes)})
    _say(f"{chosen.profile}: unit {chosen.link.unit}, {chosen.link.kind}. From: {chosen.source}")
    for name, frames in _frames(chosen, step_um):
        for index, frame in enumerate(frames):
            _say(f"  {name if index == 0 else '':<20} {frame}")


def show(*, instrument: Instrument, reset: Flag = False) -> None:
    """Say where feed and knife stand. Nothing moves.

    Parameters
    ----------
    reset
        Clear the drive's alarm first.
    """
    with _open(instrument, look=not reset) as feed:
        if reset:
            feed.reset_alarm()
        _report(feed)


def home(*, instrument: Instrument, yes: Flag = False) -> None:
    """Move the feed to its home switch.

    Parameters
    ----------
    yes
        Do it: the feed may travel its whole length.
    """
    check_homing_wanted(yes)
    with _open(instrument) as feed:
        feed.home()
        _report(feed)


def approach(depth_um: float, /, *, instrument: Instrument, homed: Flag = False) -> None:
    """Go forward to an absolute depth in one go, to bring the block near the knife.

    Parameters
    ----------
    depth_um
        From the home position.
    homed
        This drive cannot tell; I homed it since its power came on.
    """
    with _open(instrument, homed=homed) as feed:
        refuse_direction(depth_um * NM_PER_UM < feed.position_nm(), "backwards", "section retract")
        feed.approach_to(depth_um * NM_PER_UM)
        _report(feed)


def feed(thickness_nm: float, /, *, instrument: Instrument, homed: Flag = False) -> None:
    """Feed forward by the thickness of one section; sent once, whatever happens on the line.

    Parameters
    ----------
    thickness_nm
        Of the section.
    homed
        This drive cannot tell; I homed it since its power came on.
    """
    with _open(instrument, homed=homed) as device:
        device.advance_to(device.position_nm() + thickness_nm)
        _report(device)


def cut(*, instrument: Instrument, stage_is_parked: Flag = False, homed: Flag = False) -> None:
    """Take one section with the knife, once.

    Parameters
    ----------
    stage_is_parked
        I looked: the microscope is out of the knife's way.
    homed
        This drive cannot tell; I homed it since its power came on.
    """
    with _open(instrument, homed=homed) as device:
        if stage_is_parked:
            device.allow_cuts(lambda: None)
        device.arm()
        device.cut()
        _report(device)


def retract(
    depth_um: float | None = None, /, *, instrument: Instrument, knife: Flag = False, homed: Flag = False
) -> None:
    """Bring the knife out, or draw the feed back to an absolute depth.

    Parameters
    ----------
    depth_um
        From the home position; left out with --knife.
    knife
        Bring the knife out of the specimen; the feed stays.
    homed
        This drive cannot tell; I homed it since its power came on.
    """
    with _open(instrument, homed=homed) as device:
        if knife:
            device.abort()
            device.resolve()
        elif depth_um is None:
            raise Unsafe("section retract: how far? Nothing was sent.", fix="give a depth in µm, or --knife.")
        else:
            refuse_direction(depth_um * NM_PER_UM > device.position_nm(), "forwards", "section approach")
            device.approach_to(depth_um * NM_PER_UM)
        _report(device)


def stop(*, instrument: Instrument) -> None:
    """Stop feed and knife at once, also while another program holds the port."""
    from devices.halt_rig import halt_feed  # noqa: PLC0415  the Modbus library takes its time

    halt_feed(_spec(instrument))
    _say("feed and knife were told to stop.")


def _frames(profile: Profile, step_um: float) -> Iterator[tuple[str, list[str]]]:
    from devices.transport.modbus import frame, frames_of  # noqa: PLC0415  the Modbus library takes its time

    rtu = profile.link.kind != "tcp"
    actions = [(f"do {name}", action) for name, action in profile.do if action]
    actions += [(f"jog {name}", action) for name, action in profile.jog or () if isinstance(action, list)]
    actions += [(f"knife {name}", action) for name, action in profile.knife or () if isinstance(action, list)]
    for name, action in actions:
        yield name, frames_of(profile, _writes(profile, action, step_um), rtu=rtu)
    for name, reg in profile.reg.items():
        if reg.t != "block":
            yield f"read {name}", [frame(profile.link.unit, profile.read_of(name), rtu=rtu).hex(" ").upper()]


def _writes(profile: Profile, action: list, step_um: float) -> tuple[RegisterWrite, ...]:  # type: ignore[type-arg]
    axis = profile.axis
    sense = -1 if axis.invert else 1
    supplied = {
        "pos": round(sense * step_um * axis.counts_per_um),
        "speed": round(axis.speed_um_s * axis.speed_per_um_s),
        "acc": axis.acc,
        "dec": axis.dec,
        "min": round(axis.min_um * axis.counts_per_um),
        "max": round(axis.max_um * axis.counts_per_um),
        "seq": 1,
        "beat": 1,
    }
    try:
        return profile.writes(action, supplied)
    except ValueError as cause:
        raise RigError(
            f"{profile.profile}: {cause}", fix="check counts_per_um, speed_per_um_s and --step-um."
        ) from None


@contextmanager
def _open(instrument: Path, *, look: bool = True, homed: bool = False) -> Iterator[ModbusFeed]:
    from devices.drivers.feed import open_feed  # noqa: PLC0415  `section check` does without
    from devices.registry import DeviceContext  # noqa: PLC0415

    feed = open_feed(_spec(instrument), DeviceContext(SystemClock()), look=look)
    try:
        if homed:
            feed.trust_reference()
        yield feed
    finally:
        feed.close()


def _spec(instrument: Path) -> FeedSpec:
    from devices.feed_spec import MicrotomeFile  # noqa: PLC0415
    from devices.toml_model import load_model  # noqa: PLC0415

    table = load_model(instrument, MicrotomeFile, RigError).microtome
    if table is None:
        raise RigError(f"{instrument}: there is no [microtome] in it.", fix="add the table: see docs/microtome.md")
    return table


def check_homing_wanted(yes: bool) -> None:  # noqa: FBT001
    """Raise `Unsafe` unless the operator said yes."""
    if not yes:
        raise Unsafe("feed: homing may move it through its whole travel. Nothing was sent.", fix="say so: --yes")


def refuse_direction(wrong: bool, way: str, command: str) -> None:  # noqa: FBT001
    """Raise `Unsafe` if a depth lies on the wrong side; ``command`` goes to it."""
    if wrong:
        raise Unsafe(f"feed: that is {way}. Nothing was sent.", fix=f"use stereotome {command}")


def _report(feed: ModbusFeed) -> None:
    _say(f"feed: {feed.state}, at {feed.position_nm() / NM_PER_UM:.3f} µm")
    if feed.has_knife:
        _say(f"knife: {feed.knife_state()}, {feed.cut_count()} cuts counted")


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
