"""What Micro-Manager writes beside a folder of images, ``metadata.txt``: where each plane is, and the size of a pixel.

Micro-Manager 1.4 has an entry ``FrameKey-T-C-Z`` for each image, which names its file; 2.0 has
``Metadata-FOLDER/FILE``. An acquisition that ended early leaves the file without its last brace.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

NAME = "metadata.txt"
FRAME, METADATA = "FrameKey-", "Metadata-"


@dataclass(frozen=True)
class Beside:
    """What stands beside the images of a folder.

    Attributes
    ----------
    z_um : dict of str to float
        Position of the stage, by file name.
    pixel_um : float or None
        Size of a pixel in the specimen.
    notes : tuple of str
        What could not be read.
    """

    z_um: dict[str, float] = field(default_factory=dict)
    pixel_um: float | None = None
    notes: tuple[str, ...] = ()

    def positions(self, files: Sequence[Path]) -> NDArray[np.float64] | None:
        """Return the position of every file, None unless all are known."""
        known = [self.z_um.get(file.name) for file in files]
        return None if None in known else np.array(known, np.float64)


def beside(folder: Path) -> Beside:
    """Read ``metadata.txt`` of a folder; empty where there is none, or where another program wrote one."""
    path = folder / NAME
    if not path.is_file():
        return Beside()
    try:
        table = _whole(path.read_text(encoding="utf-8", errors="replace"))
        told = dict(_of_file(key, entry) for key, entry in table.items() if key.startswith((FRAME, METADATA)))
        z_um = {name: float(entry["ZPositionUm"]) for name, entry in told.items() if "ZPositionUm" in entry}
        sizes = {float(entry["PixelSizeUm"]) for entry in told.values() if entry.get("PixelSizeUm")}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        return Beside(notes=(f"{path} cannot be read ({error}): no spacing from it.",))
    return Beside(z_um, sizes.pop() if len(sizes) == 1 else None)


def _whole(text: str) -> dict[str, Any]:
    try:
        table: dict[str, Any] = json.loads(text)
    except ValueError:
        table = json.loads(text.rstrip().rstrip(",") + "}")
    return table


def _of_file(key: str, entry: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    named = entry["FileName"] if key.startswith(FRAME) else key.removeprefix(METADATA)
    return PurePosixPath(named).name, entry
