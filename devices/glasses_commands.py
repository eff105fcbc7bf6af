"""``stereotome glasses …``: try the shutter glasses of an instrument, exchange the eyes, choose who gives the turns."""

from __future__ import annotations

import json as json_text
import sys
from contextlib import closing, contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from devices.clock import SystemClock
from devices.errors import InputError, RigError
from devices.glasses_timing import Edge, phase_report
from devices.registry import DeviceContext
from devices.rig import load_rig
from devices.wire.open3d import DriveMode

if TYPE_CHECKING:
    from collections.abc import Iterator

    from devices.drivers.modem_glasses import ModemGlasses
    from devices.drivers.open3d import Open3dGlasses
    from devices.glasses_spec import GlassesSpec
    from devices.glasses_timing import Eye
    from devices.protocols import Clock, Eyewear

Instrument = Annotated[Path, Parameter(name=["--instrument", "-i"])]
Json = Annotated[bool, Parameter(name="--json", negative="")]
Save = Annotated[bool, Parameter(name="--save", negative="")]
ROUND_TRIPS = 50
JITTER_FOR_TURNS_MS = 1.0


def show(eye: Literal["left", "right", "both"], /, *, instrument: Instrument, seconds: float = 5.0) -> None:
    """Let one eye see, or both, for a while.

    Parameters
    ----------
    eye
        Which. One eye alone flickers: no shutter is held in one state for long.
    instrument
        The instrument file.
    seconds
        For how long.
    """
    clock = SystemClock()
    with _glasses(instrument, clock) as (glasses, spec):
        end_s = clock.now() + seconds
        if eye == "both":
            glasses.both_open()
            clock.sleep(seconds)
            return
        while clock.now() < end_s:
            glasses.show(eye)
            clock.sleep(1 / spec.refresh_hz)


def measure(*, instrument: Instrument, seconds: float = 2.0, json: Json = False) -> None:
    """Measure how fast the link to the glasses is and how evenly this computer gives turns; says what that allows.

    Modem lines are tested as a loop: wire RTS to CTS, pins 7 and 8 of a nine-way connector.

    Parameters
    ----------
    instrument
        The instrument file.
    seconds
        For how long turns are given, at refresh_hz of the file.
    json
        One JSON object instead of words.
    """
    clock = SystemClock()
    with _glasses(instrument, clock) as (glasses, spec):
        found = {"driver": spec.driver, **_link_of(glasses, spec, clock), **_turns(glasses, spec, clock, seconds)}
    _say(json_text.dumps(found) if json else _in_words(found))


def swap(*, instrument: Instrument, save: Save = False) -> None:
    """Exchange the eyes, in the emitter; for glasses on modem lines the instrument file says it.

    Parameters
    ----------
    instrument
        The instrument file.
    save
        Keep it in the emitter's EEPROM, else it lasts until the power goes.
    """
    with _emitter(instrument, "swap = true", "swap") as emitter:
        settings = emitter.swap_eyes()
        _keep(emitter, save=save)
        _say(f"The eyes are {'exchanged' if settings.flip_eyes else 'as delivered'}{_for_how_long(save=save)}.")


def mode(
    mode: Literal["free-run", "per-frame", "optical", "vesa"], /, *, instrument: Instrument, save: Save = False
) -> None:
    """Choose what gives the emitter its turns when nobody drives it; for modem lines the instrument file says it.

    Parameters
    ----------
    mode
        Its own clock, the computer, its light sensor at the display, or the display's synchronisation plug.
    instrument
        The instrument file.
    save
        Keep it in the emitter's EEPROM, else it lasts until the power goes.
    """
    chosen = {
        "free-run": DriveMode.FREE_RUN,
        "per-frame": DriveMode.PC_SERIAL,
        "optical": DriveMode.OPTICAL,
        "vesa": DriveMode.MINIDIN3,
    }[mode]
    with _emitter(instrument, 'drive = "free-run" or "per-frame"', "drive") as emitter:
        emitter.store(replace(emitter.settings(), drive_mode=int(chosen)))
        _keep(emitter, save=save)
        emitter.leave()
        _say(f"The emitter's turns are given by: {mode}{_for_how_long(save=save)}.")


@contextmanager
def _glasses(instrument: Path, clock: Clock) -> Iterator[tuple[Eyewear, GlassesSpec]]:
    spec = spec_of(instrument)
    with closing(open_eyewear(spec, clock)) as glasses:
        yield glasses, spec


def spec_of(instrument: Path) -> GlassesSpec:
    """Return the table ``[glasses]`` of an instrument file; raises `RigError` when there is none or it is wrong."""
    table = load_rig(instrument).glasses
    if table is None:
        raise RigError(
            f"{instrument}: has no glasses.",
            fix='add a table: [glasses] with driver = "open3d" and port = "…"; see docs/glasses.md.',
        )
    return table


def open_eyewear(spec: GlassesSpec, clock: Clock) -> Open3dGlasses | ModemGlasses:
    """Open the glasses of an instrument file; errors as their driver's `open_glasses`."""
    if spec.driver == "open3d":
        from devices.drivers import open3d  # noqa: PLC0415  each driver only when it is used

        return open3d.open_glasses(spec, DeviceContext(clock))
    from devices.drivers import modem_glasses  # noqa: PLC0415

    return modem_glasses.open_glasses(spec, DeviceContext(clock))


@contextmanager
def _emitter(instrument: Path, line: str, key: str) -> Iterator[Open3dGlasses]:
    """Open an emitter whose settings a command changes: not against what the instrument file says."""
    from devices.drivers import open3d  # noqa: PLC0415

    spec = spec_of(instrument)
    if spec.driver != "open3d" or (key == "swap" and spec.swap is not None):
        raise InputError(
            f"{instrument}: {key} of these glasses is set by the instrument file.",
            fix=f"write there under [glasses]: {line}",
        )
    with closing(open3d.open_glasses(spec, DeviceContext(SystemClock()))) as emitter:
        yield emitter


def _keep(emitter: Open3dGlasses, *, save: bool) -> None:
    if save:
        emitter.save()


def _for_how_long(*, save: bool) -> str:
    return ", also after a power failure" if save else " until the power goes; --save keeps it"


def _link_of(glasses: Eyewear, spec: GlassesSpec, clock: Clock) -> dict[str, Any]:
    from devices.drivers.open3d import Open3dGlasses  # noqa: PLC0415

    if isinstance(glasses, Open3dGlasses):
        took_ms = sorted(1000 * glasses.round_trip_s() for _ in range(ROUND_TRIPS))
        return {"round_trip_p50_ms": took_ms[ROUND_TRIPS // 2], "round_trip_max_ms": took_ms[-1]}
    from devices.drivers.line_test import loop_test  # noqa: PLC0415
    from devices.transport.lines import ModemLines  # noqa: PLC0415

    glasses.close()
    with closing(ModemLines(spec.port, spec.off, device="glasses")) as lines:
        return asdict(loop_test(lines, clock))


def _turns(glasses: Eyewear, spec: GlassesSpec, clock: Clock, seconds: float) -> dict[str, Any]:
    """Give turns at the display's rate, as if it flipped exactly then, and compare what was sent with what was meant.

    The time from call to glasses is not in it: that is the link's.
    """
    if spec.driver == "modem-lines":
        with closing(open_eyewear(spec, clock)) as again:
            return _turns_of(again, spec, clock, seconds)
    return _turns_of(glasses, spec, clock, seconds)


def _turns_of(glasses: Eyewear, spec: GlassesSpec, clock: Clock, seconds: float) -> dict[str, Any]:
    glasses.show("left")
    first_s, count = clock.now() + 0.05, round(seconds * spec.refresh_hz)
    eyes: tuple[Eye, Eye] = ("left", "right")
    flips = [Edge(round((first_s + n / spec.refresh_hz) * 1e9), eyes[n % 2]) for n in range(count)]
    for flip in flips:
        clock.sleep(flip.at_ns / 1e9 - clock.now())
        glasses.show(flip.eye)
    report = phase_report(glasses.timing.edges, flips)
    wanted = ("bias_ms", "p99_ms", "max_ms", "missed", "alternation_faults")
    return {f"turns_{name}": getattr(report, name) for name in wanted}


def _in_words(found: dict[str, Any]) -> str:
    lines = [
        f"{key:>26}  {value:.3f}" if isinstance(value, float) else f"{key:>26}  {value}" for key, value in found.items()
    ]
    return "\n".join([*lines, _advice(found)])


def _advice(found: dict[str, Any]) -> str:
    if found.get("lost") and found["lost"] == found["toggles"]:
        return "Nothing came back on CTS: wire RTS to CTS for this test, or the port has no such lines."
    if found.get("lost"):
        return f"{found['lost']} of {found['toggles']} edges were lost: do not trust these lines."
    slowest_ms = found.get("round_trip_max_ms", found.get("p99_ms", 0.0)) + found["turns_p99_ms"]
    if slowest_ms > JITTER_FOR_TURNS_MS:
        return f'Up to {slowest_ms:.1f} ms late: drive = "free-run" is the right choice.'
    return "Quick and even: both ways to drive these glasses will do."


def _say(words: str) -> None:
    sys.stdout.write(f"{words}\n")
