"""Recipes from useq-schema ``MDASequence`` files, the plans of Micro-Manager's Python world, in YAML or JSON.

What a sequence asks for and this program cannot do is refused, all of it in one message: a run that quietly leaves
something out is not what was planned.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

from acquire.recipe import Recipe
from devices.errors import PlanError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from useq import MDASequence

SUFFIXES = {".yaml", ".yml", ".json"}
ORDERS = {"tcz": "stack", "tzc": "plane"}


def is_useq(path: Path) -> bool:
    """Tell from its name whether a file is an MDASequence."""
    return path.suffix.lower() in SUFFIXES


def read_useq(path: Path) -> Recipe:
    """Return the recipe that does what an ``MDASequence`` file says.

    Its channels are bands of the instrument file, by name. Relative z plans go around where the stage is when the run
    begins.

    Raises
    ------
    PlanError
        The file cannot be read, or asks for something this program cannot do; everything of it is named.
    """
    sequence = _load(path)
    cannot = list(_cannot(sequence))
    if cannot:
        raise PlanError(
            f"{path}: this program cannot honour {len(cannot)} part{'s' * (len(cannot) > 1)} of the sequence: "
            f"{'; '.join(cannot)}.",
            why="A run that leaves something out would not be what was planned.",
            fix="take these parts out of the file.",
            code="useq-cannot",
        )
    told: dict[str, Any] = {"schema": 1, "name": str(sequence.metadata.get("name") or path.stem)}
    told["stack"] = _stack(sequence)
    if sequence.time_plan is not None:
        told["series"] = _series(sequence)
    return Recipe.model_validate(told)


def _load(path: Path) -> MDASequence:
    from useq import MDASequence  # noqa: PLC0415  other runs do without

    try:
        return MDASequence.from_file(path)
    except OSError as error:
        raise PlanError(f"{path}: {error.strerror}.", fix="check the name.") from None
    except Exception as error:  # noqa: BLE001  whatever its parsers say to a file they do not understand
        raise PlanError(
            f"{path} is no MDASequence.", why=" ".join(str(error).split())[:400], fix="see useq-schema's documentation."
        ) from None


CANNOT = {
    "stage_positions": "there is no xy stage",
    "grid_plan": "there is no xy stage",
    "autofocus_plan": "there is no hardware autofocus",
    "keep_shutter_open_across": "there is no shutter",
}


def _cannot(sequence: MDASequence) -> Iterator[str]:
    """Name what cannot be honoured."""
    for part, why in CANNOT.items():
        if getattr(sequence, part):
            yield f"{part} ({why})"
    for channel in sequence.channels:
        yield from _cannot_channel(channel)
    order = "".join(axis for axis in sequence.axis_order if axis in "tcz")
    if not _same_order(order, _used(sequence)):
        yield f"axis_order {order} (time has to come first)"
    if len(_steps_s(sequence)) > 1:
        yield "a time_plan with intervals of different length"


def _cannot_channel(channel: Any) -> Iterator[str]:
    for part, usual in (("do_stack", True), ("acquire_every", 1), ("z_offset", 0.0)):
        if getattr(channel, part) != usual:
            yield f"{part} of channel {channel.config}"


def _used(sequence: MDASequence) -> set[str]:
    return {axis for axis, size in sequence.sizes.items() if size}


def _same_order(order: str, used: set[str]) -> bool:
    """Tell whether an order of the axes in use is one of those that can be."""
    wanted = [axis for axis in order if axis in used]
    return any([axis for axis in known if axis in used] == wanted for known in ORDERS)


def _steps_s(sequence: MDASequence) -> set[float]:
    times = [float(seconds) for seconds in sequence.time_plan or ()]
    return {round(b - a, 6) for a, b in pairwise(times)}


def _series(sequence: MDASequence) -> dict[str, Any]:
    times = [float(seconds) for seconds in sequence.time_plan or ()]
    return {"count": len(times), "interval_s": next(iter(_steps_s(sequence)), 0.0)}


def _stack(sequence: MDASequence) -> dict[str, Any]:
    stack: dict[str, Any] = {"return_to": "start"}
    plan = sequence.z_plan
    if plan is None:
        stack |= {"around_um": 0.0, "planes": 1}
    elif plan.is_relative:
        stack |= {"offsets_um": [float(z_um) for z_um in plan]}
    else:
        stack |= {"positions_um": [float(z_um) for z_um in plan]}
    bands = [_band(channel) for channel in sequence.channels]
    if bands:
        stack["bands"] = bands
        order = "".join(axis for axis in sequence.axis_order if axis in "cz")
        stack["order"] = "plane" if order == "zc" else "stack"
    return stack


def _band(channel: Any) -> dict[str, Any]:
    exposure = {} if channel.exposure is None else {"exposure_ms": float(channel.exposure)}
    return {"name": channel.config, **exposure}
