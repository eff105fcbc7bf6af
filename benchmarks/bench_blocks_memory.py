"""A stack several times larger than the memory that is allowed: focus and range, deblurring, cubic voxels by blocks.

``python benchmarks/bench_blocks_memory.py`` makes the stack (float64, rough ground out of focus, TIFF) in a
temporary folder, runs each command with ``--memory`` as a process of its own, and prints its peak over the limit. With
``--beside`` each is done in memory, too, and told how far the results are apart.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from scipy import ndimage

from processing.psf import Optics, modelled

SIDE = 2048  # rows and columns
OPTICS, SPACING, PSF = Optics(1.0, 0.525, 1.33), (0.3, 0.12, 0.12), (9, 17, 17)
SIZES = ["--pixel-um", str(SPACING[2]), "--step-um", str(SPACING[0])]
RESULTS = {
    "focus": ("extended_focus.tif", "range.tif", "confidence.tif", "width.tif"),
    "deblur": ("deblurred.ome.tif",),
    "resample": ("resampled.ome.tif",),
}


def make(path: Path, size: float) -> None:
    """Write a stack of ``size`` bytes: noise that is sharp at a height which rises to the right."""
    rng = np.random.default_rng(5)
    texture = rng.normal(size=(SIDE, SIDE))
    levels = np.stack([ndimage.gaussian_filter(texture, s, mode="wrap") for s in (0.5, 1, 2, 4)])
    count = int(size / (SIDE * SIDE * 8)) + 1
    height = np.linspace(0.1, 0.9, SIDE) * count
    with tifffile.TiffWriter(path, bigtiff=True) as file:
        for z in range(count):
            off = np.minimum(np.abs(height - z) / 3, 2.999)
            shares = [np.maximum(1 - np.abs(off - k), 0) for k in range(len(levels))]
            sharp = sum(share * level for share, level in zip(shares, levels, strict=True))
            file.write(500 + 100 * sharp + 3 * np.roll(texture, 17 * z, 0), contiguous=True)


def done(command: str, data: Path, out: Path, *words: str) -> dict[str, Any]:
    """Run a command in a process of its own; returns its report."""
    program = [sys.executable, "-c", "import sys; from devices.cli import main; sys.exit(main())"]
    asked = [*program, "process", command, str(data), "-o", str(out), "--json", "-q", *words]
    return json.loads(subprocess.run(asked, check=True, stdout=subprocess.PIPE, text=True).stdout)


def apart(one: Path, other: Path) -> str:
    """Say how far two images are apart."""
    a, b = (tifffile.imread(path).astype(np.float32) for path in (one, other))
    away = np.abs(a - b)
    return f"{one.name}: {np.mean(away > 0):.2g} of all values differ, by at most {away.max():.3g} of {b.max():.4g}"


def main() -> int:
    """Run and print; 1 when a limit is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--limit-mb", type=float, default=700)
    parser.add_argument("--times", type=float, default=4, help="size of the stack over the limit")
    parser.add_argument("--steps", default="1", help="of Richardson-Lucy")
    parser.add_argument("--only", default="", choices=["", *RESULTS])
    parser.add_argument("--beside", action="store_true", help="do it in memory, too")
    given = parser.parse_args()
    kept = True
    with tempfile.TemporaryDirectory() as folder:
        data, psf = Path(folder) / "stack.tif", Path(folder) / "psf.tif"
        make(data, given.times * given.limit_mb * 1e6)
        tifffile.imwrite(psf, modelled(OPTICS, SPACING, PSF), photometric="minisblack")
        print(f"stack {data.stat().st_size / 1e6:.0f} MB, limit {given.limit_mb:g} MB")
        words = {
            "focus": ["--step-um", "0.3"],
            "deblur": [*SIZES, "--psf", str(psf), "--steps", given.steps],
            "resample": [*SIZES, "--side-um", "0.2"],
        }
        for command in [given.only] if given.only else RESULTS:
            out = Path(folder) / command
            report = done(command, data, out / "blocks", *words[command], "--memory", f"{given.limit_mb:g}MB")
            peak = report["peak_memory_mb"]
            kept &= peak <= given.limit_mb
            print(f"{command}: peak {peak:.0f} MB, {peak / given.limit_mb:.2f} of the limit; {report['seconds']:.0f} s")
            if given.beside:
                done(command, data, out / "memory", *words[command])
                for name in RESULTS[command]:
                    print("  " + apart(out / "blocks" / name, out / "memory" / name))
    return 0 if kept else 1


if __name__ == "__main__":
    sys.exit(main())
