"""Who does the parts of a work: threads of this process, or the workers of a Dask scheduler."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from dask.callbacks import Callback
from dask.threaded import get

from devices.errors import InputError
from processing.marked import run_part

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from processing.marked import Marked

    Show = Callable[[int], None]

ANSWER_S = 20  # a scheduler that has not answered by then is not there
ALONE_S = 120  # without any worker after which a run is given up
RETRIES = 3  # of a part whose workers died


@dataclass(frozen=True)
class Threads:
    """Threads of this process.

    Attributes
    ----------
    count : int
        How many parts are done at once.
    """

    count: int = os.cpu_count() or 1

    def run(self, work: Marked, show: Show) -> None:
        """Do all parts that are not done; ``show`` is told how many are."""
        pending = work.pending()
        total = len(work.places)
        done = total - len(pending)

        def counted(*_: object) -> None:
            nonlocal done
            done = min(done + 1, total)
            show(done)

        tasks = {("part", k): (partial(run_part, work), k) for k in pending}
        pool = ThreadPoolExecutor(self.count)
        try:
            with Callback(posttask=counted):
                get(tasks, list(tasks), pool=pool)
        finally:
            pool.shutdown(cancel_futures=True)  # a part under way is finished before anybody else may begin it


@dataclass(frozen=True)
class Cluster:
    """Workers of a Dask scheduler; one that dies has its parts done by the others."""

    client: Any
    count: int = 1

    def run(self, work: Marked, show: Show) -> None:
        """Do all parts that are not done; what is under way is given up when this is interrupted."""
        from distributed import wait  # noqa: PLC0415  an extra

        pending = work.pending()
        done = len(work.places) - len(pending)
        waiting = set(self.client.map(partial(run_part, work), pending, pure=False, retries=RETRIES))
        try:
            while waiting:
                try:
                    finished, waiting = wait(waiting, timeout=ALONE_S, return_when="FIRST_COMPLETED")
                except TimeoutError:
                    require_workers(self.client)
                    continue
                for future in finished:
                    future.result()
                done += len(finished)
                show(done)
        finally:
            self.client.cancel(list(waiting))


def require_workers(client: Any) -> None:
    """Raise `InputError` ``scheduler`` where a scheduler has no worker."""
    if not client.scheduler_info(n_workers=-1)["workers"]:
        raise InputError(
            f"the scheduler {client.scheduler.address} has no workers.",
            fix="start some: dask worker ADDRESS",
            code="scheduler",
        )


@contextmanager
def runner(scheduler: str | None, count: int) -> Iterator[Threads | Cluster]:
    """Give what does the parts.

    Raises
    ------
    InputError
        ``scheduler``: the extra ``cluster`` is not installed, nobody answers, or there are no workers.
    """
    if scheduler is None:
        yield Threads(count)
        return
    try:
        from distributed import Client  # noqa: PLC0415  an extra
    except ImportError:
        raise InputError(
            "other machines need the extra 'cluster'.", fix="pip install 'stereotome[cluster]'", code="scheduler"
        ) from None
    try:
        client = Client(scheduler, timeout=ANSWER_S)
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError(
            f"no Dask scheduler answers at {scheduler}: {error}.",
            fix="start one, and workers: dask scheduler; dask worker ADDRESS",
            code="scheduler",
        ) from None
    with client:
        require_workers(client)
        yield Cluster(client)
