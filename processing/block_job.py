"""A job that goes block by block: planned, its folder made ready, and whoever does the blocks at hand."""

from __future__ import annotations

from contextlib import contextmanager
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

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from processing.block_options import Blocks
    from processing.pipeline import Pipeline
    from processing.slabs import Stage
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
    workers = Threads().count if blocks.scheduler is None else WORKERS
    plan = plan_slabs(given, halo, amount(blocks.memory), workers)
    job = fingerprint(given, volumes, pipeline, plan) | dict(more or {})
    work = output / WORK
    prepare(work, job, resume=blocks.resume, overwrite=overwrite)
    with runner(blocks.scheduler, plan.workers) as running:

        def do(title: str, stage: Stage) -> None:
            with progress(title, len(stage.slabs), quiet=quiet) as show:
                running.run(stage, show)

        yield Blockwise(work.absolute(), volumes, plan, do)
