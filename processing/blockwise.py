"""A pipeline on a volume larger than memory: cut into stages, each done slab by slab, resumed where it was left."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from dask.utils import parse_bytes

from acquire.ome_zarr import replace_json
from devices.errors import InputError
from processing.block_counts import Counts, Limits, Renumber, SlabLabels
from processing.block_source import when_changed
from processing.outputs import peak_memory_mb
from processing.pipeline import Pipeline, Step
from processing.result_folder import plain
from processing.slabs import LocalSteps, Stage, Volumes, kernel_type
from processing.step_outputs import layout_of
from processing.volume_files import pyramid

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from acquire.ome_zarr import FocalArray
    from processing.marked import Marked
    from processing.step_inputs import Choices, Given

    S = TypeVar("S", bound=Stage)
    Outs = tuple[tuple[str, FocalArray], ...]
    Doing = Callable[[str, Marked], None]

WORKERS = 2  # of a cluster, for which slabs are cut at least; more do no harm
JOB = "job.json"
BYTES_PER_VOXEL = 40  # that steps hold beside their input: sums and gradients of 32 and 64 bit
COMPILING_MB = 200  # for compiled loops, codecs and pictures that are not yet in memory
MOST_PLANES = 64


@dataclass(frozen=True)
class Plan:
    """How many planes a slab has, and how many are done at once.

    Attributes
    ----------
    side, workers : int
        Planes of a slab, slabs at once.
    """

    side: int
    workers: int


def opened_volumes(given: Given, choices: Choices) -> Volumes:
    """Return the input as blocks read it; raises `InputError` ``blockwise`` where it is no grey stack."""
    stacks = [stack for group in given.stacks.values() for stack in group]
    if not stacks or any(stack.colour for stack in stacks):
        raise InputError(
            f"{given.source} is no grey stack; only those go block by block.",
            fix="leave out --memory and --scheduler",
            code="blockwise",
        )
    return Volumes(given.source.absolute(), choices)


def amount(memory: str | None) -> float | None:
    """Return bytes: 2GB is 2e9; raises `InputError` ``memory`` where it is no such amount."""
    try:
        return None if memory is None else float(parse_bytes(memory))
    except ValueError:
        raise InputError(f"{memory!r} is no amount of memory.", fix="--memory 2GB", code="memory") from None


def held_bytes() -> float:
    """Return what this process takes beside its blocks."""
    return (peak_memory_mb() + COMPILING_MB) * 1e6


def plan_slabs(given: Given, halo: int, memory: float | None, workers: int) -> Plan:
    """Choose slabs that fit into memory.

    Parameters
    ----------
    given : Given
        The input.
    halo : int
        Planes around a slab, at most.
    memory : float, optional
        Bytes that this process may take in all; None for as many as wanted.
    workers : int
        Slabs at once, at most.

    Raises
    ------
    InputError
        ``memory``: not even single planes fit.
    """
    stacks = [stack for group in given.stacks.values() for stack in group]
    height, width = stacks[0].shape
    plane = height * width * (sum(stack.dtype.itemsize for stack in stacks) + BYTES_PER_VOXEL)
    wanted = max(1, min(MOST_PLANES, -(-len(stacks[0]) // (2 * workers))))
    what = f"a plane and its {2 * halo} neighbours"
    return Plan(*fitted(memory, range(wanted, 0, -1), lambda side: (side + 2 * halo) * plane, workers, what))


def fitted(
    memory: float | None, sizes: Sequence[int], each: Callable[[int], float], workers: int, what: str
) -> tuple[int, int]:
    """Choose how large parts are, and how many are done at once.

    Parameters
    ----------
    memory : float, optional
        Bytes that this process may take in all; None for as many as wanted.
    sizes : sequence of int
        That a part may have, the largest first.
    each : callable
        Returns the bytes that a part of a size takes.
    workers : int
        Parts at once, at most.
    what : str
        Names the smallest part in the message.

    Raises
    ------
    InputError
        ``memory``: not even one of the smallest fits.
    """
    if memory is None:
        return sizes[0], workers
    for count in range(workers, 0, -1):
        for size in sizes:
            if held_bytes() + count * each(size) <= memory:
                return size, count
    least = (held_bytes() + each(sizes[-1])) / 1e9 + 0.005
    raise InputError(
        f"{memory / 1e9:.2f} GB do not hold {what}; {least:.2f} GB would.",
        fix=f"--memory {least:.2f}GB",
        code="memory",
    )


GLOBAL = ("mask.threshold", "label.components")
COMMANDS = {"focus.": "focus", "deblur.": "deblur", "volume.cubic": "resample"}


def other_command(operator: str) -> list[str]:
    """Name the command that does block by block what an operator does in memory."""
    found = [command for family, command in COMMANDS.items() if operator.startswith(family)]
    return [f"do that alone: stereotome process {command} STACK -o DIR --memory 2GB" for command in found]


def check_blockwise(pipeline: Pipeline) -> int:
    """Return how many planes around a slab its steps look at, at most.

    Raises
    ------
    InputError
        ``blockwise``: a step looks at the whole volume, and there is no way round that.
    """
    halo, most = 0, 0
    for step in pipeline.steps:
        if step.halo is None and step.name not in GLOBAL:
            raise InputError(
                f"{step.name} looks at the whole volume and cannot go block by block.",
                why=f"Filters, morphology and arithmetic can, and {', '.join(GLOBAL)}.",
                fix=(
                    *other_command(step.name),
                    "leave out --memory and --scheduler",
                    "make the volume smaller first: stereotome process resample",
                ),
                code="blockwise",
            )
        halo = 0 if step.halo is None else halo + step.halo[0]
        most = max(most, halo)
    return most


def prepare(
    work: Path, job: Mapping[str, Any], plan: Mapping[str, Any], *, resume: bool, overwrite: bool
) -> dict[str, Any]:
    """Make the folder of a job ready: a new one, or that of the same job which was left.

    Parameters
    ----------
    job : dict
        What must be the same for parts to be used again.
    plan : dict
        How it is cut into parts now; a job that was left goes on as it was cut then, however much memory this process
        happens to have taken.

    Returns
    -------
    dict
        The plan to go by.

    Raises
    ------
    InputError
        ``blocks-left``: it holds parts of a job that was left, and nobody said what to do; ``blocks-other``: of another
        job than the one to be resumed.
    """
    wanted: dict[str, dict[str, Any]] = {"job": plain(dict(job)), "plan": plain(dict(plan))}
    if work.exists() and resume:
        left = left_job(work)
        if left is not None:
            check_same(work.parent, left["job"], wanted["job"])
            return dict(left["plan"])
    elif work.exists() and not overwrite:
        raise InputError(
            f"{work.parent} holds slabs of a job that was left.",
            fix=("go on with it: --resume", "begin anew: --overwrite"),
            code="blocks-left",
        )
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    replace_json(work / JOB, wanted)
    return wanted["plan"]


def left_job(work: Path) -> dict[str, Any] | None:
    """Return what a job said of itself; None where it was killed before that was written."""
    try:
        left: dict[str, Any] = json.loads((work / JOB).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return left if {"job", "plan"} <= left.keys() else None


def check_same(output: Path, left: dict[str, Any], wanted: dict[str, Any]) -> None:
    """Raise `InputError` ``blocks-other`` unless a job is the one that was left."""
    changed = [key for key in {**left, **wanted} if left.get(key) != wanted.get(key)]
    if changed:
        raise InputError(
            f"{output} was left by another job; different: {', '.join(changed)}.",
            fix=("give the same input, steps and sizes", "begin anew: --overwrite"),
            code="blocks-other",
        )


def fingerprint(given: Given, volumes: Volumes, pipeline: Pipeline) -> dict[str, Any]:
    """Return what must be the same for slabs to be used again."""
    return {
        "source": str(given.source.resolve()),
        "changed": when_changed(given.source),
        "choices": {name: getattr(volumes.choices, name) for name in volumes.choices.__dataclass_fields__},
        "steps": pipeline.tables(),
    }


@dataclass
class Blockwise:
    """A pipeline being taken over a volume, stage by stage.

    Attributes
    ----------
    work : Path
        Folder in which each stage has one.
    volumes : Volumes
        Where the layers lie so far.
    plan : Plan
        Sizes of the slabs.
    do : callable
        Has all slabs of a stage done; takes its title and the stage.
    types : dict
        Number type of each layer so far.
    values : dict
        Numbers that the steps gave.
    """

    work: Path
    volumes: Volumes
    plan: Plan
    do: Doing
    types: dict[str, str] = field(default_factory=dict)
    values: dict[str, Any] = field(default_factory=dict)
    stages: int = 0

    def run(self, pipeline: Pipeline) -> dict[str, Path]:
        """Take all steps; returns the image of each layer that was made."""
        self.types = {name: kernel_type(s[0].dtype) for name, s in self.volumes.given.stacks.items()} | self.types
        local: list[Step] = []
        for step in pipeline.steps:
            if step.halo is not None:
                local.append(step)
                continue
            if step.name == "label.components":
                self._label(step.operator.settings(step.params), local)
                local = []
            else:
                self._take(local)
                local = [self._counted(step)]
        self._take(local)
        return dict(self.volumes.made)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Of the volume."""
        stack = next(iter(self.volumes.given.stacks.values()))[0]
        return len(stack), stack.shape[0], stack.shape[1]

    def _counted(self, step: Step) -> Step:
        """Find the threshold of the whole volume; returns the step that takes it, slab by slab."""
        settings, limits = step.operator.settings(step.params), None
        if self.types["volume"] == "float32":
            limits = self._done("limits", Limits(*self._place("limits"))).limits()
        counts = self._done("counts", Counts(*self._place("counts"), limits))
        return replace(step, params={**settings, "above": counts.threshold(settings["method"])})

    def _label(self, settings: dict[str, Any], before: list[Step]) -> None:
        """Give connected parts their numbers, in what the steps before make of each slab."""
        if settings["by_value"]:  # values are looked at across slabs: they must have been written
            self._take(before)
            before = []
        made = {**self._types_of(before), "volume": "uint32"}
        how = {name: settings[name] for name in ("rule", "by_value")}
        parts = SlabLabels(*self._local("parts", before, made), **how)
        self._done(" ".join([*(step.name for step in before), "numbering parts"]), parts)
        numbers = parts.folder / "numbers.npy"
        count = parts.merge(settings["least"], numbers)
        begins = np.cumsum([0, *(said["parts"] for said in parts.found())])
        self._keep(parts, made)
        outs = (("volume", self._layout("uint32")),)
        last = Renumber(*self._place("labels", outs), numbers, tuple(begins.tolist()))
        self._keep(self._done("joining parts", last), {"volume": "uint32"})
        self.values |= {**parts.found()[0]["steps"], "count": count}

    def _take(self, steps: list[Step]) -> None:
        """Take steps that look no further than their halos."""
        if not steps:
            return
        made = self._types_of(steps)
        stage = LocalSteps(*self._local("steps", steps, made))
        self._keep(self._done(" ".join(step.name for step in steps), stage), made)
        self.values |= stage.found()[0]

    def _types_of(self, steps: list[Step]) -> dict[str, str]:
        """Return the number types of the layers that steps make."""
        made: dict[str, str] = {}
        for step in steps:
            types = {**self.types, **made}
            made |= {g.name: types.get(g.dtype, g.dtype) for g in step.operator.gives if g.shape}
        return made

    def _local(self, name: str, steps: list[Step], made: dict[str, str]) -> tuple[Any, ...]:
        """Return what a stage that takes steps is made of."""
        takes = [layer for step in steps for layer in step.operator.takes if layer in self.types] or ["volume"]
        outs = tuple((layer, self._layout(dtype)) for layer, dtype in made.items())
        return *self._place(name, outs), Pipeline(tuple(steps)), tuple(dict.fromkeys(takes))

    def _place(self, name: str, outs: Outs = ()) -> tuple[Path, tuple[int, int, int], int, Outs, Volumes]:
        """Return folder, sizes and input of the next stage."""
        self.stages += 1
        return self.work / f"{self.stages}-{name}", self.shape, self.plan.side, outs, self.volumes

    def _layout(self, dtype: str) -> FocalArray:
        given = self.volumes.given
        start_um = float(given.about["z_um"][0]) if "z_um" in given.about else 0.0
        return pyramid(layout_of(self.shape, dtype, given.spacing_um if given.scaled else None, start_um))

    def _done(self, title: str, stage: S) -> S:
        """Have a stage done."""
        self.do(title, stage)
        return stage

    def _keep(self, stage: Stage, types: dict[str, str]) -> None:
        """Let the layers that a stage made take the places of those before."""
        made = {**dict(self.volumes.made), **{name: stage.image(name) for name, _ in stage.outs}}
        self.volumes = replace(self.volumes, made=tuple(made.items()))
        self.types |= types
