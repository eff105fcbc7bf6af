"""``stereotome stage …``: look at the z stage of an instrument and move it by hand, inside its soft limits."""

from __future__ import annotations

import json as json_text
import sys
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from devices.clock import SystemClock
from devices.errors import DeviceError, RigError
from devices.halt_now import halt_now
from devices.registry import DeviceContext, factory
from devices.rig import load_rig
from devices.travel import CanZero, travel

if TYPE_CHECKING:
    from collections.abc import Iterator

    from devices.protocols import Stage
    from devices.rig import AxisSpec

Instrument = Annotated[Path, Parameter(name=["--instrument", "-i"])]
Json = Annotated[bool, Parameter(name="--json", negative="")]
MayMove = Annotated[bool, Parameter(negative="", show_default=False)]


def show(*, instrument: Instrument, json: Json = False) -> None:
    """Say where the z stage is and how far it may go; nothing moves.

    Parameters
    ----------
    instrument
        The instrument file.
    json
        One JSON object instead of words.
    """
    with _stage(instrument) as (stage, table):
        _tell(stage, table, stage.position_um(), as_json=json)


def move(to_um: float, /, *, instrument: Instrument, json: Json = False) -> None:
    """Move the z stage to a position in µm and wait until it rests there.

    Parameters
    ----------
    to_um
        Where to; refused outside the soft limits.
    instrument
        The instrument file.
    json
        One JSON object instead of words.
    """
    with _stage(instrument) as (stage, table):
        _go(stage, table, to_um, as_json=json)


def jog(by_um: float, /, *, instrument: Instrument, json: Json = False) -> None:
    """Move the z stage by a distance in µm from where it is.

    Parameters
    ----------
    by_um
        How far; negative is downwards.
    instrument
        The instrument file.
    json
        One JSON object instead of words.
    """
    with _stage(instrument) as (stage, table):
        _go(stage, table, stage.position_um() + by_um, as_json=json)


def home(*, instrument: Instrument, may_move: MayMove = False, json: Json = False) -> None:
    """Move the z stage to 0 µm.

    Parameters
    ----------
    instrument
        The instrument file.
    may_move
        An axis that does not know where it is may first search its reference, anywhere within its travel.
    json
        One JSON object instead of words.
    """
    with _stage(instrument, may_move=may_move) as (stage, table):
        _go(stage, table, 0.0, as_json=json)


def park(*, instrument: Instrument, json: Json = False) -> None:
    """Move the z stage to the safe place that the instrument file names.

    Parameters
    ----------
    instrument
        The instrument file.
    json
        One JSON object instead of words.
    """
    with _stage(instrument) as (stage, table):
        if table.park_um is None:
            raise RigError("the instrument names no safe place.", fix="set stage.z.park_um in the instrument file")
        _go(stage, table, table.park_um, as_json=json)


def zero(*, instrument: Instrument, json: Json = False) -> None:
    """Call the present place 0 µm; nothing moves, but the soft limits are distances from the new zero.

    Parameters
    ----------
    instrument
        The instrument file.
    json
        One JSON object instead of words.
    """
    with _stage(instrument) as (stage, table):
        if not isinstance(stage, CanZero):
            raise DeviceError(
                f"z stage: the driver '{table.driver}' cannot set a zero.",
                why="This controller's positions are absolute.",
                fix="choose limits and positions in its own coordinates",
                code="stage-no-zero",
            )
        stage.zero_here()
        _tell(stage, table, stage.position_um(), as_json=json)


def stop(*, instrument: Instrument) -> None:
    """Stop the z stage at once, also while another program is driving it; waits for nobody.

    Parameters
    ----------
    instrument
        The instrument file.
    """
    table = load_rig(instrument).stage.z
    sys.stdout.write(f"{halt_now(table.driver, table.port, table.baud)}\n")


@contextmanager
def _stage(instrument: Path, *, may_move: bool = False) -> Iterator[tuple[Stage, AxisSpec]]:
    """Open the stage alone; Ctrl-C during a move stops it."""
    table = load_rig(instrument).stage.z
    if may_move:
        table = table.model_copy(update={"may_move_on_enable": True})
    with closing(factory(table.driver, "stage")(table, DeviceContext(SystemClock()))) as stage:
        try:
            yield stage, table
        except KeyboardInterrupt:
            stage.halt()
            raise


def _go(stage: Stage, table: AxisSpec, to_um: float, *, as_json: bool) -> None:
    _tell(stage, table, travel(stage, table, to_um), as_json=as_json)


def _tell(stage: Stage, table: AxisSpec, z_um: float, *, as_json: bool) -> None:
    limits = stage.limits
    if as_json:
        told = {"z_um": z_um, "min_um": limits.min_um, "max_um": limits.max_um, "park_um": table.park_um}
        sys.stdout.write(json_text.dumps({**told, "driver": table.driver, "port": table.port}) + "\n")
        return
    outside = "" if limits.min_um <= z_um <= limits.max_um else "  OUTSIDE THE LIMITS"
    sys.stdout.write(f"z {z_um:+.3f} µm  (limits {limits.min_um:g} … {limits.max_um:g} µm){outside}\n")
