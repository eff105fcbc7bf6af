"""Loops in machine code: compiled on first call, kept on disk, free of the interpreter's lock."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numba

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import TypeVar

    Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Compile to machine code on first call and keep it on disk."""
    return cast("Function", numba.njit(cache=True, nogil=True)(function))
