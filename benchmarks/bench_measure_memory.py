"""A stack several times larger than the memory that is allowed: filter, label, measure; the memory that was taken.

``python benchmarks/bench_measure_memory.py`` makes the stack (float64, balls in noise, uncompressed TIFF) in a
temporary folder, runs ``stereotome measure --memory`` as a process of its own, and prints its peak over the limit. With
``--beside`` the same is measured in memory, and the tables must agree.
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
import pyarrow.parquet as pq
import tifffile
from scipy import ndimage

SIDE = 600  # rows and columns
DEEP = 40  # planes that are made anew; the stack repeats them upside down and back
SINGLE = 1e-3  # of volumes that triangles enclose far from the origin
WORDS = ["--first", "filter.median:rule=6", "--smallest", "20", "--threshold", "100"]


def block(seed: int) -> np.ndarray:
    """Make some planes of balls in noise."""
    rng = np.random.default_rng(seed)
    far = np.ones((DEEP, SIDE, SIDE), bool)
    far[tuple(rng.integers(0, n, 320) for n in far.shape)] = False
    balls = np.clip(8 - ndimage.distance_transform_edt(far), 0, 1) * 150
    return (balls + rng.normal(40, 12, far.shape)).astype(np.float64)


def make(path: Path, size: float) -> None:
    """Write a stack of ``size`` bytes."""
    planes, there = block(1), 0
    with tifffile.TiffWriter(path, bigtiff=True) as file:
        while there < size:
            for plane in planes:
                file.write(plane, contiguous=True)
            planes, there = np.roll(planes[::-1], 137, axis=2), there + planes.nbytes


def measured(data: Path, out: Path, *words: str) -> dict[str, Any]:
    """Measure in a process of its own; returns its report."""
    program = [sys.executable, "-c", "import sys; from devices.cli import main; sys.exit(main())"]
    command = [*program, "measure", str(data), "-o", str(out), "--json", "-q"]
    done = subprocess.run([*command, *WORDS, *words], check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout)


def apart(one: Path, other: Path) -> float:
    """Return the largest relative difference of two tables of features; whole numbers must be equal."""
    tables = [pq.read_table(folder / "features.parquet").to_pydict() for folder in (one, other)]
    worst = 0.0
    for name, column in tables[0].items():
        a, b = np.asarray(column), np.asarray(tables[1][name])
        if a.dtype.kind != "f":
            worst = max(worst, 0.0 if np.array_equal(a, b) else np.inf)
        else:
            known = np.isfinite(a) & (a != 0)
            worst = max(worst, float(np.max(np.abs(a[known] / b[known] - 1), initial=0)))
    return worst


def main() -> int:
    """Run and print; 1 when the limit is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--limit-mb", type=float, default=700)
    parser.add_argument("--times", type=float, default=4, help="size of the stack over the limit")
    parser.add_argument("--beside", action="store_true", help="measure in memory, too")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        data, out = Path(folder) / "stack.tif", Path(folder) / "blocks"
        make(data, given.times * given.limit_mb * 1e6)
        report = measured(data, out, "--memory", f"{given.limit_mb:g}MB")
        peak, planes = report["peak_memory_mb"], report["blocks"]["planes"]
        print(f"stack {data.stat().st_size / 1e6:.0f} MB, limit {given.limit_mb:g} MB, {planes} planes at once")
        print(f"peak {peak:.0f} MB: {peak / given.limit_mb:.2f} of the limit; {report['features']} features")
        print(f"{report['seconds']:.0f} s")
        kept = peak <= given.limit_mb
        if given.beside:
            measured(data, Path(folder) / "memory")
            worst = apart(out, Path(folder) / "memory")
            kept &= worst < SINGLE
            print(f"largest difference of the tables, relative: {worst:.1g} (triangles are summed in single precision)")
        return 0 if kept else 1


if __name__ == "__main__":
    sys.exit(main())
