"""Progress for people: a bar with time left on a terminal, a plain line each 5 % elsewhere."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rich.progress import Progress

PLAIN_STEP = 0.05


@contextmanager
def progress(title: str, total: int, *, quiet: bool = False) -> Iterator[Callable[[int], None]]:
    """Give a function to call with the number done so far; writes to standard error."""
    if quiet:
        yield lambda _: None
    elif sys.stderr.isatty():
        with _bars() as bars:
            bar = bars.add_task(title, total=total)
            yield lambda done: bars.update(bar, completed=done)
    else:
        yield _plain(title, total)


def _bars() -> Progress:
    from rich import progress as parts  # noqa: PLC0415  a script, which sees no bar, does without
    from rich.console import Console  # noqa: PLC0415

    columns = (
        parts.TextColumn("{task.description}"),
        parts.BarColumn(),
        parts.MofNCompleteColumn(),
        parts.TimeElapsedColumn(),
        parts.TimeRemainingColumn(),
    )
    return parts.Progress(*columns, console=Console(stderr=True))


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
