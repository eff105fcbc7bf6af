"""A folder of results that appears whole or not at all: files are written aside and renamed at the end."""

from __future__ import annotations

import csv
import json
import tempfile
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.ome_zarr import sync_folder
from devices.errors import InputError
from processing.outputs import disk_error, write_durably

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence


def check_results(folder: Path, names: Iterable[str], *, overwrite: bool) -> None:
    """Refuse a folder that holds such results already; asked before the work, not after.

    Raises
    ------
    InputError
        ``output-exists``: the path is a file, or holds one of ``names`` and ``overwrite`` is False.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is a file.", fix="name a folder: -o DIR", code="output-exists")
    there = [name for name in names if (folder / name).exists()]
    if there and not overwrite:
        raise InputError(
            f"{folder} holds results already: {', '.join(there)}. Nothing was started.",
            fix=("choose another folder: -o DIR", "replace them: --overwrite"),
            code="output-exists",
        )


def write_results(folder: Path, contents: Mapping[str, bytes]) -> None:
    """Write files so that all of them are durable before the first appears under its name.

    Raises
    ------
    StoreError
        ``disk-full`` or ``store``: the disk refused; earlier results are as they were.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".part-", dir=folder) as aside:
            for name, content in contents.items():
                write_durably(Path(aside) / name, content)
            for name in contents:
                (Path(aside) / name).replace(folder / name)
        sync_folder(folder)
    except OSError as error:
        raise disk_error(folder, error) from None


def json_bytes(report: Mapping[str, Any]) -> bytes:
    """Encode a report; numbers that are none become null."""
    return (json.dumps(plain(report), indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()


def plain(value: Any) -> Any:
    """Turn numpy's numbers and arrays, paths and tuples into what JSON knows."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, Path):
        return str(value)
    return None if isinstance(value, float) and not np.isfinite(value) else value


def csv_bytes(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> bytes:
    """Encode a table with a line of names."""
    file = StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([f"{item:.6g}" if isinstance(item, float) else item for item in row] for row in rows)
    return file.getvalue().encode()
