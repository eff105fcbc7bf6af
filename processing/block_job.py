"""A job that goes block by block: planned, its folder made ready, and whoever does the blocks at hand."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from acquire.progress import progress
from processing.block_options import WORK
from processing.block_runners import Threads, runner
from processing.blockwise import (
    WORKERS,
    Blockwise,
    amount,
    check_blockwise,
    fingerprint,
    opened_volumes,
    plan_slabs,
    prepare,
)
from processing.outputs import disk_error

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from processing.block_options import Blocks
    from processing.blockwise import Doing
    from processing.marked import Marked
    from processing.pipeline import Pipeline
    from processing.step_inputs import Choices, Given


@contextmanager
def block_job(
    output: Path,
    given: Given,
    choices: Choices,
    pipeline: Pipeline,
    blocks: Blocks,
    *,
    more: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    quiet: bool = False,
) -> Iterator[Blockwise]:
    """Give what takes the steps of a pipeline block by block.

    Parameters
    ----------
    output : Path
        Folder of the results.
    given, choices
        The input.
    pipeline : Pipeline
        All steps there will be.
    blocks : Blocks
        What the user said.
    more : dict, optional
        What else must be the same for blocks to be used again.

    Raises
    ------
    InputError
        ``blockwise``, ``memory``, ``blocks-left``, ``blocks-other``, ``scheduler``.
    """
    halo = check_blockwise(pipeline)
    volumes = opened_volumes(given, choices)
    plan = plan_slabs(given, halo, amount(blocks.memory), at_once(blocks))
    job = fingerprint(given, volumes, pipeline) | dict(more or {})
    with begun(output, job, {"planes": plan.side}, plan.workers, blocks, overwrite=overwrite, quiet=quiet) as going:
        yield Blockwise(going.work, volumes, replace(plan, side=going.plan["planes"]), going.do)


def at_once(blocks: Blocks) -> int:
    """Return how many parts are done at once, at most, or for which they are cut at least."""
    return Threads().count if blocks.scheduler is None else WORKERS


@dataclass(frozen=True)
class Going:
    """A job under way.

    Attributes
    ----------
    work : Path
        Folder in which each of its works has one.
    plan : dict
        How it is cut into parts.
    do : callable
        Has all parts of a work done; takes its title and the work.
    """

    work: Path
    plan: Mapping[str, Any]
    do: Doing


@contextmanager
def begun(
    output: Path,
    job: Mapping[str, Any],
    plan: Mapping[str, Any],
    workers: int,
    blocks: Blocks,
    *,
    overwrite: bool,
    quiet: bool,
) -> Iterator[Going]:
    """Begin a job, or go on with one that was left.

    Parameters
    ----------
    output : Path
        Folder of the results.
    job, plan : dict
        As for `prepare`; how much memory was allowed is part of the job.
    workers : int
        Parts at once, on threads.
    blocks : Blocks
        What the user said.

    Raises
    ------
    InputError
        ``blocks-left``, ``blocks-other``, ``scheduler``.
    StoreError
        ``disk-full`` or ``store``: the disk refused; parts that are done stay.
    """
    work = output / WORK
    plan = prepare(work, {**job, "memory": blocks.memory}, plan, resume=blocks.resume, overwrite=overwrite)
    with runner(blocks.scheduler, workers) as running:

        def do(title: str, parts: Marked) -> None:
            try:
                parts.make_ready()
                with progress(title, len(parts.places), quiet=quiet) as show:
                    running.run(parts, show)
            except OSError as error:  # of what is written: what cannot be read is named by its reader
                raise disk_error(output, error, "What is done is kept: go on with --resume.") from None

        yield Going(work.absolute(), plan, do)
