"""A maker's library in a thread of its own: whoever calls it comes back in time, even when the library does not."""

from __future__ import annotations

import importlib
from concurrent.futures import CancelledError, Future
from concurrent.futures import TimeoutError as NotInTime
from queue import SimpleQueue
from threading import Thread
from typing import TYPE_CHECKING, Any, TypeVar

from devices.errors import CameraTimeout, RigError, did_you_mean

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")


def load_library(module: str, *, driver: str, extra: str) -> Any:
    """Import the library of a driver; raises `RigError` that names the extra which brings it."""
    try:
        return importlib.import_module(module)
    except ImportError as cause:
        raise RigError(
            f"camera: the driver '{driver}' needs {module}, which is not installed.",
            why=str(cause),
            fix=f"install it: pip install 'stereotome[{extra}]'",
        ) from cause


def guess(word: str, known: list[str]) -> str:
    """Return what may have been meant, and nothing rather than the hundreds of names a camera knows."""
    words = did_you_mean(word, known)
    return words if "did you mean" in words else ""


class SdkThread:
    """Does one step after the other in its thread, which dies with the program, hanging or not.

    Parameters
    ----------
    name : str
        Of the library, for messages.

    Attributes
    ----------
    ended : bool
        Whether it was told to do no more.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self.ended = False
        self._steps: SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = SimpleQueue()
        self._thread = Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def begin(self, step: Callable[[], T]) -> Future[T]:
        """Do a step as soon as those before it are done; never after `end`."""
        future: Future[T] = Future()
        if self.ended:
            future.cancel()
        self._steps.put((future, step))
        return future

    def call(self, step: Callable[[], T], *, doing: str, timeout_s: float) -> T:
        """Do a step and return what it returns.

        Raises
        ------
        CameraTimeout
            It, or one before it, was not done within ``timeout_s``; it is not begun any more, or its result is dropped.
        """
        return self.wait(self.begin(step), doing=doing, timeout_s=timeout_s)

    def wait(self, future: Future[T], *, doing: str, timeout_s: float) -> T:
        """Return the result of a step begun before; raises as `call` does."""
        try:
            return future.result(timeout_s)
        except (NotInTime, CancelledError) as cause:
            future.cancel()
            raise CameraTimeout(
                f"camera: {self._name} was not done with {doing} within {timeout_s:g} s.",
                why="The maker's software hangs, or the camera does not answer it.",
                fix="check the camera's cable and power, then start again.",
            ) from cause

    def end(self) -> None:
        """Do no more steps after those begun."""
        self.ended = True
        self._steps.put(None)

    def _work(self) -> None:
        while (next_step := self._steps.get()) is not None:
            future, step = next_step
            if future.set_running_or_notify_cancel():
                try:
                    future.set_result(step())
                except BaseException as error:  # noqa: BLE001  whoever waits for the step is told of it
                    future.set_exception(error)
