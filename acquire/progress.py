"""Progress for people: a bar with time left on a terminal, a plain line each 5 % elsewhere."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

PLAIN_STEP = 0.05


@contextmanager
def progress(title: str, total: int, *, quiet: bool = False) -> Iterator[Callable[[int], None]]:
    """Give a function to call with the number done so far; writes to standard error."""
    if quiet:
        yield lambda _: None
    elif sys.stderr.isatty():
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=Console(stderr=True)) as bars:
            bar = bars.add_task(title, total=total)
            yield lambda done: bars.update(bar, completed=done)
    else:
        yield _plain(title, total)


def _plain(title: str, total: int) -> Callable[[int], None]:
    said = 0.0

    def show(done: int) -> None:
        nonlocal said
        share = done / total if total else 1.0
        if share - said >= PLAIN_STEP - 1e-9 or (done == total and said < 1.0):
            said = share
            sys.stderr.write(f"{title}: {done} of {total} ({share:.0%})\n")
            sys.stderr.flush()

    return show
