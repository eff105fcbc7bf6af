"""``stereotome control …``: at an instrument that is being served, what the console's buttons do."""

from __future__ import annotations

import json as json_text
import sys
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path  # noqa: TC003  the command line reads the annotations
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
from cyclopts import Parameter

from acquire.client import Instrument
from acquire.words import took
from devices.errors import DeviceError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from acquire import replies

Roi = Annotated[tuple[int, int, int, int], Parameter(negative_iterable=())]
Scope = Literal["plane", "stack", "section", "before_cut"]


@Parameter(name="*")
@dataclass(frozen=True)
class At:
    """Which instrument, and how it is told.

    Parameters
    ----------
    server
        The process that serves it: its name, its connection file, or tcp://HOST:PORT; without it the only one here.
    keys
        Folder with this client's keys, for an instrument on another computer.
    json
        One JSON object instead of words.
    """

    server: str | None = None
    keys: Path | None = None
    json: Annotated[bool, Parameter(negative="")] = False


ONLY = At()


def show(*, at: At = ONLY) -> None:
    """Say how an instrument that is being served stands: stage, camera, run, and who commands it."""
    with met(at) as instrument:
        _tell(instrument, at)


def move(to_um: float, /, *, at: At = ONLY) -> None:
    """Move the z stage to a position in µm and wait until it rests there."""
    with _commanded(at) as instrument:
        instrument.move(to_um)


def jog(by_um: float, /, *, at: At = ONLY) -> None:
    """Move the z stage by a distance in µm from where it is."""
    with _commanded(at) as instrument:
        instrument.jog(by_um)


def zero(*, at: At = ONLY) -> None:
    """Call the stage's present place 0 µm; nothing moves."""
    with _commanded(at) as instrument:
        instrument.zero()


def camera(exposure_ms: float, /, *, roi: Roi | None = None, at: At = ONLY) -> None:
    """Set the exposure of live frames and pictures and, if given, the part of the frame.

    Parameters
    ----------
    exposure_ms
        A run sets its own.
    roi
        X Y WIDTH HEIGHT in pixels.
    """
    with _commanded(at) as instrument:
        instrument.set_camera(exposure_ms, roi)


def pause(scope: Scope = "plane", /, *, at: At = ONLY) -> None:
    """Have the run wait after this plane.

    Parameters
    ----------
    scope
        What is finished before.
    """
    with _commanded(at) as instrument:
        instrument.pause(scope)


def resume(*, at: At = ONLY) -> None:
    """Let a run that waits go on."""
    with _commanded(at) as instrument:
        instrument.resume()


def cancel(*, at: At = ONLY) -> None:
    """End the run after the exposure in progress; what was taken is kept."""
    with _commanded(at) as instrument:
        instrument.cancel()


def answer(choice: str, /, *, at: At = ONLY) -> None:
    """Answer what the run asks.

    Parameters
    ----------
    choice
        One of the answers that `stereotome control show` lists.
    """
    with _commanded(at) as instrument:
        instrument.answer(choice)


def note(text: str, /, *, at: At = ONLY) -> None:
    """Write a note into the journal of the run under way."""
    with _commanded(at) as instrument:
        instrument.note(text)


def stop(*, at: At = ONLY) -> None:
    """Stop all motion now and end the run; needs no command, and holds until `stereotome control release`."""
    with met(at) as instrument:
        stopped = instrument.stop()
        _tell(instrument, at)
    if stopped.failed:
        raise DeviceError(
            f"not stopped: {'; '.join(stopped.failed)}.", fix="stop it at the hardware.", code="not-stopped"
        )


def release(*, at: At = ONLY) -> None:
    """Allow motion again after a stop; nothing moves."""
    with _commanded(at) as instrument:
        instrument.clear_stop()


def met(at: At) -> Instrument:
    """Connect to an instrument."""
    return Instrument.connect(at.server, keys=at.keys)


@contextmanager
def _commanded(at: At) -> Iterator[Instrument]:
    """Command an instrument, and say how it stands afterwards."""
    with met(at) as instrument:
        instrument.command()
        yield instrument
        _tell(instrument, at)


def _tell(instrument: Instrument, at: At) -> None:
    state = instrument.refresh()
    lines = [json_text.dumps(msgspec.to_builtins(state))] if at.json else _words(state)
    sys.stdout.writelines(f"{line}\n" for line in lines)


def _words(state: replies.State) -> Iterator[str]:
    where = "unknown" if state.z_um is None else f"{state.z_um:+.2f} µm"
    yield f"{state.state}{', STOPPED' if state.stopped else ''}; commanded by {state.holder or 'nobody'}"
    yield f"z stage: {where}; camera: {state.camera}, {state.exposure_ms:g} ms{', live' if state.live else ''}"
    if state.why_stopped:
        yield f"stopped: {state.why_stopped}"
    if state.run is not None:
        yield from _run_words(state.run)


def _run_words(run: replies.RunView) -> Iterator[str]:
    left = "" if run.left_s is None else f", {took(run.left_s)} left"
    yield f"run {run.name}: {run.state}, {run.durable} of {run.planned} planes durable{left}; {run.folder}"
    if run.question is not None:
        yield f"asks: {run.question.words}"
        yield from (f"  {choice}: {does}" for choice, does in run.question.answers.items())
    if run.error is not None:
        yield f"error: {run.error.what}"
