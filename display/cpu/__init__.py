"""The second executor: ray casting and slicing by the processor, where OpenGL itself would run on the processor."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TYPE_CHECKING, Any

from processing.compiled import kept

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import TypeVar

    Function = TypeVar("Function", bound=Callable[..., Any])

ROWS = 16  # of a picture, done by one thread at a time


OPTIONS: dict[str, Any] = {"fastmath": True, "error_model": "numpy", "_nrt": False}


def fast(function: Function) -> Function:
    """Compile to machine code that frees the interpreter, may reorder sums, and makes no arrays; kept on disk.

    Arrays that are handed on are not counted (``_nrt``): counting takes longer than a sample.
    """
    return kept(function, **OPTIONS)


def inlined(function: Function) -> Function:
    """Compile as `fast` does, into whatever calls it: to hand many arrays on takes longer than a few samples."""
    return kept(function, **OPTIONS, forceinline=True)


@cache
def _workers() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="rays")


def over_rows(height: int, do: Callable[[int, int], object]) -> None:
    """Call ``do(first, last)`` for bands of rows, on all processors; a failure in one is raised here."""
    for done in [_workers().submit(do, first, min(first + ROWS, height)) for first in range(0, height, ROWS)]:
        done.result()
