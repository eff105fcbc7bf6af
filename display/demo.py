"""The command ``stereotome demo``: the whole way from a command to pictures, on a simulated bench."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tifffile
from cyclopts import Parameter

from acquire.bench import simulated_bench
from acquire.cli import run
from devices.errors import DisplayError, InputError
from display.console.app import demonstrate, needs_window

if TYPE_CHECKING:
    from numpy.typing import NDArray

DEFAULT_FOLDER = Path("stereotome-demo")
RECIPE = """\
schema = 1
name = "demo"
notes = "relief of a simulated specimen"

[stack]
top_um = 24.0
bottom_um = -24.0
step = 1.0
direction = "up"
return_to = "middle"

[process]
extended_focus = true
range_image = true
stereo_pair = { angle_deg = 8.0 }

[output]
keep_free_gb = 0.1
"""
PICTURES = ("extended_focus.png", "range.png", "anaglyph.png")


def demo(*, out: Path | None = None, headless: Annotated[bool, Parameter(negative="")] = False) -> int:
    """Take a focal stack on a simulated bench and show what it measures; needs no files and no hardware.

    Where there is a display the operator's console opens on the bench, with a stack that runs and a short tour.

    Parameters
    ----------
    out
        Folder for everything the demo makes; must not exist. Without it ./stereotome-demo, or the next free number.
        With it no window is opened.
    headless
        Open no window: take the stack, and name the pictures it made.
    """
    folder = _free_folder(out)
    if out is None and not headless and has_window():
        return demonstrate(folder)
    folder.mkdir(parents=True)
    recipe = folder / "recipe.toml"
    recipe.write_text(RECIPE, encoding="utf-8")
    with simulated_bench(None, folder / "bench") as bench:
        code = run(recipe, instrument=bench.instrument, out=folder / "run", yes=True)
    if code:
        return code
    results = folder / "run" / "focus"
    if not all((results / name).exists() for name in PICTURES):
        raise DisplayError("the pictures were not made; the warning above says why.", fix="stereotome doctor")
    for name in PICTURES:
        shutil.copyfile(results / name, folder / name)
    error = range_error(_truth_um(bench.truth), tifffile.imread(results / "range.tif"))
    report = json.loads((results / "report.json").read_text(encoding="utf-8"))
    (folder / "report.json").write_text(json.dumps({**report, "range_error": error}, indent=1), encoding="utf-8")
    sys.stdout.write(
        f"range error against the specimen's truth: {error['rms_um']:.3f} µm rms, "
        f"{error['median_um']:.3f} µm median, bias {error['bias_um']:+.3f} µm\n"
        + "".join(f"{folder / name}\n" for name in (*PICTURES, "report.json"))
    )
    return 0


def has_window() -> bool:
    """Tell whether the console can be opened here."""
    try:
        needs_window()
    except DisplayError:
        return False
    return True


def range_error(truth_um: NDArray[np.float32], range_um: NDArray[np.float32]) -> dict[str, float]:
    """Return how far a range image is from the truth, in µm.

    Parameters
    ----------
    truth_um, range_um : ndarray, shape (y, x), float32
        Heights of the specimen as they are, and as they were measured; every pixel counts.
    """
    error_um = range_um.astype(np.float64) - truth_um
    return {
        "rms_um": float(np.sqrt(np.mean(error_um**2))),
        "median_um": float(np.median(np.abs(error_um))),
        "bias_um": float(np.mean(error_um)),
    }


def _truth_um(path: Path) -> NDArray[np.float32]:
    with np.load(path) as truth:
        height_um: NDArray[np.float32] = truth["height_um"]
        return height_um


def _free_folder(out: Path | None) -> Path:
    if out is None:
        candidates = [DEFAULT_FOLDER, *(Path(f"{DEFAULT_FOLDER}-{n}") for n in range(2, 1000))]
        return next(folder for folder in candidates if not folder.exists())
    if out.exists():
        raise InputError(
            f"{out} exists already. Nothing was started.", fix="choose another folder: --out DIR", code="output-exists"
        )
    return out
