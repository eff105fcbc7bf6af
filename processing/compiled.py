"""Loops in machine code: compiled on first call, kept on disk, free of the interpreter's lock.

The library that compiles looks at a function's own file to see whether what it kept still holds. Kernels call kernels
of other files and are compiled with the numbers and tuples these define; here all of that counts.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, cast
from zlib import crc32

import numba
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import TypeVar

    Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Compile to machine code on first call and keep it on disk."""
    return kept(function)


def kept(function: Function, **options: Any) -> Function:
    """Compile as `compiled` does, with further options of `numba.njit`."""
    made = numba.njit(**{"cache": True, "nogil": True, **options})(function)
    file = _cache_file(made)
    if file is not None:
        file._source_stamp = (file._source_stamp, *_rests_on(function))  # noqa: SLF001  there is no other way in
        file._load_index = partial(_index_or_nothing, file._load_index)  # noqa: SLF001
    return cast("Function", made)


def _cache_file(made: Any) -> Any:
    """Return what keeps the machine code of a kernel; None where nothing does, or for anything else."""
    return getattr(getattr(made, "_cache", None), "_cache_file", None)


def _rests_on(function: Callable[..., Any]) -> list[tuple[str, object]]:
    """Return what the machine code of a function rests on beside its own text: other kernels, numbers, tuples."""
    names = {*function.__code__.co_names, *map(str, function.__annotations__.values())}
    known = [(name, _state(function.__globals__.get(name))) for name in sorted(names)]
    return [(name, state) for name, state in known if state is not None]


def _state(value: Any) -> object:
    """Return what changes when a global that a kernel uses does; None for what is no part of its machine code."""
    if isinstance(value, tuple):
        return tuple(map(_state, value))
    if isinstance(value, int | float | str | np.number):
        return repr(value)
    if isinstance(value, np.ndarray):
        return crc32(value.tobytes())
    file = _cache_file(value)
    return getattr(value, "_fields", None) if file is None else file._source_stamp  # noqa: SLF001


def _index_or_nothing(load: Callable[[], dict[Any, str]]) -> dict[Any, str]:
    """Return the list of what is kept; of an earlier version it may name types that are gone, or be cut short."""
    try:
        return load()
    except Exception:  # noqa: BLE001  whatever is wrong with it, compiling again mends it
        return {}
