"""Features of a volume larger than memory: told apart block by block, then measured slab by slab."""

from __future__ import annotations

import shutil
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from devices.errors import InputError
from processing.block_job import block_job
from processing.block_options import whole_needed
from processing.blockwise import amount, fitted
from processing.labels import checked_labels
from processing.measuring import Features
from processing.pipeline import Pipeline, Step
from processing.planes import SIDE, Lazy, changed
from processing.step_inputs import open_layers
from processing.thresholds import values_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from processing.block_options import Blocks
    from processing.blockwise import Blockwise
    from processing.grey_volume import GreyVolume
    from processing.measuring import Question
    from processing.step_inputs import Choices

BYTES_PER_VOXEL = 110  # of a slab that is measured: values, labels, masks, triangles; of white noise, others take 65
BYTES_PER_FEATURE = 2000  # of the tables
TABLE_SHARE = 0.2  # of the memory


def planes_at_once(shape: tuple[int, ...], memory: str | None) -> int:
    """Return how many planes are measured at once.

    Raises
    ------
    InputError
        ``memory``: not even three planes fit, or no such amount.
    """
    plane = float(shape[1] * shape[2] * BYTES_PER_VOXEL)
    sizes, what = range(SIDE, 1, -2), "the three planes that are measured at once"
    return fitted(amount(memory), sizes, lambda side: (side + 1) * plane, 1, what)[0]


@contextmanager
def by_blocks(
    stored: GreyVolume,
    question: Question,
    choices: Choices,
    first: Pipeline,
    blocks: Blocks,
    output: Path,
    *,
    overwrite: bool,
    quiet: bool,
) -> Iterator[Features]:
    """Tell features apart block by block; as long as they are needed, blocks lie in the folder of the results.

    Parameters
    ----------
    stored : GreyVolume
        Read slab by slab.
    first : Pipeline
        Steps before the threshold.

    Raises
    ------
    InputError
        ``blockwise``: holes are to be filled, or a step looks at the whole volume; ``memory``, ``blocks-left``,
        ``blocks-other``, ``scheduler``; ``threshold``, ``volume-nan``.
    """
    if question.fill:
        raise whole_needed("--fill")
    if question.labels and not first.steps:
        yield Features(stored, None, None, changed(stored.values, checked_labels))
        return
    given = open_layers(Path(stored.source), choices)
    last = Step("label.components", {"rule": question.rule, "least": question.smallest})
    planned = Pipeline((*first.steps, Step("mask.threshold", {"above": 0.0, "dark": question.dark}), last))
    about = {"threshold": question.threshold, "labels": question.labels}
    job = block_job(output, given, choices, planned, blocks, more=about, overwrite=overwrite, quiet=quiet)
    with job as going, of_no_use_when_empty(going.work):
        going.run(first)
        volume = replace(stored, values=_layer(going, stored)) if first.steps else stored
        if question.labels:
            yield Features(volume, None, None, changed(volume.values, checked_labels))
            return
        known = values_of(volume.values)
        level = known.level(question.threshold)
        going.run(Pipeline((Step("mask.threshold", {"above": level, "dark": question.dark}), last)))
        _check_table(int(going.values["count"]), blocks.memory)
        yield Features(volume, known, level, _layer(going, stored))


@contextmanager
def of_no_use_when_empty(work: Path) -> Iterator[None]:
    """Take blocks away when nothing is found in them: to go on with them would find that again."""
    try:
        yield
    except InputError as error:
        if error.code == "mask-empty":
            shutil.rmtree(work)
            with suppress(OSError):
                work.parent.rmdir()  # made for them alone
        raise


def _layer(going: Blockwise, stored: GreyVolume) -> Lazy:
    """Return the volume as it is after the steps that were taken so far."""
    volumes, planes = going.volumes, stored.values
    dtype: Any = np.dtype(going.types["volume"])
    return Lazy(planes.shape, dtype, lambda z: np.asarray(volumes.read(["volume"], z)["volume"]), planes.side)


def _check_table(count: int, memory: str | None) -> None:
    most, needed = amount(memory), count * BYTES_PER_FEATURE
    if most is not None and needed > most * TABLE_SHARE:
        raise InputError(
            f"a table of {count} features needs {needed / 1e9:.2f} GB, and may have a fifth of {most / 1e9:.2f} GB.",
            fix=("drop the smallest: --smallest N", "smooth first: --first filter.median", "allow more: --memory"),
            code="memory",
        )
