"""The folder of a bench: where it writes its files; what a killed bench left is removed by the next."""

from __future__ import annotations

import contextlib
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from devices.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

PREFIX = "stereotome-bench-"
LOCK = "bench.lock"
WRITTEN = ("instrument.toml", "truth.npz", "*.port", LOCK, f"{LOCK}.new")


@contextlib.contextmanager
def bench_folder(given: Path | None) -> Iterator[Path]:
    """Give a folder to write into: the one that is given and stays, or a new one that goes away at the end.

    A file in it is locked as long as its bench lives.

    Raises
    ------
    InputError
        The given folder cannot be written to.
    """
    _sweep(Path(tempfile.gettempdir()))
    folder = Path(tempfile.mkdtemp(prefix=PREFIX)) if given is None else _usable(given)
    lock = _lock_in(folder)
    try:
        yield folder
    finally:
        for link in folder.glob("*.port"):
            link.unlink(missing_ok=True)
        (folder / LOCK).unlink(missing_ok=True)
        os.close(lock)
        if given is None:
            _remove(folder)


def _usable(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as cause:
        raise InputError(f"--dir {folder}: {cause.strerror}.", fix="name a folder that can be written to.") from cause
    return folder.absolute()


def _lock_in(folder: Path) -> int:
    """Lock a file and give it its name only then, so that nobody finds it unlocked."""
    new = folder / f"{LOCK}.new"
    try:
        handle = os.open(new, os.O_CREAT | os.O_RDWR)
    except OSError as cause:
        raise InputError(f"--dir {folder}: {cause.strerror}.", fix="name a folder that can be written to.") from cause
    _lock(handle)
    new.rename(folder / LOCK)
    return handle


def _lock(handle: int) -> None:
    """Lock for us; raises OSError when another process has it."""
    if os.name == "posix":
        import fcntl  # noqa: PLC0415  there is none on Windows

        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _sweep(parent: Path) -> None:
    """Remove the folders of benches that were killed: those whose lock nobody holds."""
    for lock in parent.glob(f"{PREFIX}*/{LOCK}"):
        with contextlib.suppress(OSError), lock.open("rb+") as file:
            _lock(file.fileno())
            _remove(lock.parent)


def _remove(folder: Path) -> None:
    """Remove what a bench writes, and the folder, unless somebody else put something there."""
    for pattern in WRITTEN:
        for path in folder.glob(pattern):
            path.unlink(missing_ok=True)
    with contextlib.suppress(OSError):
        folder.rmdir()
