"""How right elevation from stereo pairs and depth from indents are, beside OpenCV's SGBM in the same run.

Run: ``STEREOTOME_DATA=DIR python benchmarks/bench_elevation.py``. Prints a table and a line of JSON; ends with 1 when a
limit is missed. Bad pixels are those more than 2 px from the truth, among pixels that were matched and have a truth.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from processing.elevation import Geometry, elevation
from processing.indents import measured_indents
from processing.indents_cli import opened_face
from processing.stereo_geometry import tilted_pair
from processing.stereo_match import match_area

if TYPE_CHECKING:
    from collections.abc import Callable

Row = tuple[str, float, str]
RELIEF_UM = 34.951


def main() -> int:
    data = os.environ.get("STEREOTOME_DATA")
    if not data:
        print("STEREOTOME_DATA does not name the folder of example data")
        return 1
    rows = [*motorcycle(Path(data)), *tilted(Path(data)), *indent(Path(data))]
    print(f"{'what':<58} {'measured':>10}  limit")
    for name, value, limit in rows:
        print(f"{name:<58} {value:>10.4g}  {limit}{'' if kept(value, limit) else '  MISSED'}")
    print(json.dumps({"benchmark": "elevation", **{name: value for name, value, _ in rows}}))
    return 0 if all(kept(value, limit) for _, value, limit in rows) else 1


def kept(value: float, limit: str) -> bool:
    if not limit:
        return True
    relation, number = limit.split()
    return value <= float(number) if relation == "<=" else value >= float(number)


def timed(work: Callable[[], np.ndarray]) -> tuple[np.ndarray, float]:
    work()
    start = time.process_time()
    return work(), time.process_time() - start


def motorcycle(data: Path) -> list[Row]:
    folder = data / "stereo_motorcycle"
    views = [cv2.imread(str(folder / f"motorcycle_{side}.png")) for side in ("left", "right")]
    with np.load(folder / "truth" / "disparity_left.npz") as file:
        truth = file[file.files[0]]
    block = {"minDisparity": 0, "numDisparities": 80, "blockSize": 5, "P1": 600, "P2": 2400}
    checks = {"disp12MaxDiff": 1, "uniquenessRatio": 10, "speckleWindowSize": 100, "speckleRange": 2}
    sgbm = cv2.StereoSGBM_create(**block, **checks)
    ours, our_s = timed(lambda: match_area(*views, band_px=(0, 80)).parallax_px)
    raw, their_s = timed(lambda: sgbm.compute(*views))
    theirs = np.where(raw > 0, raw / 16, np.nan)
    (our_share, our_bad), (their_share, their_bad) = (judged(found, truth) for found in (ours, theirs))
    return [
        ("motorcycle: share of known pixels matched", our_share, ">= 0.85"),
        ("motorcycle: bad pixels", our_bad, "<= 0.064"),
        ("motorcycle: share matched by SGBM", their_share, ""),
        ("motorcycle: bad pixels of SGBM", their_bad, ""),
        ("motorcycle: bad pixels, ratio to SGBM", our_bad / their_bad, "<= 1"),
        ("motorcycle: CPU time, ratio to SGBM", our_s / their_s, ""),
    ]


def judged(found: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    known = np.isfinite(truth)
    both = known & np.isfinite(found)
    return both.sum() / known.sum(), float(np.mean(np.abs(found - truth)[both] > 2))


def tilted(data: Path) -> list[Row]:
    folder = data / "stereo_tilt"
    names = ("al3d_left_plus4deg.png", "al3d_right_minus4deg.png")
    views = [cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED) for name in names]
    with np.load(folder / "truth" / "al3d_height_um.npz") as truth:
        height = truth["height_um"] - float(truth["mean_height_um"])
        pixel_um, half_deg = float(truth["pixel_um"]), float(truth["half_angle_deg"])
    x = np.arange(height.shape[1])
    middle, half = (x.size - 1) / 2, np.radians(half_deg)
    seen = middle + (x - middle) * np.cos(half) + height / pixel_um * np.sin(half)
    on_left = np.array([np.interp(x, *row) for row in zip(seen, height, strict=True)])
    rows = []
    for method in ("area", "points"):
        found = elevation(*views, Geometry(tilted_pair(2 * half_deg), pixel_um), method=method)
        error = (found.elevation_um - on_left)[found.valid]
        rms_um = float(np.sqrt(np.mean(error**2)))
        rows.append((f"tilted surface, {method}: rms error / relief", rms_um / RELIEF_UM, "<= 0.01"))
        rows.append((f"tilted surface, {method}: share of pixels known", float(found.valid.mean()), ""))
    return rows


def indent(data: Path) -> list[Row]:
    rows = []
    for detector in "ABC":
        (path,) = (data / "sem_vickers").glob(f"*multiBSE_{detector}_05.tif")
        (found,) = measured_indents(*opened_face(path, None))
        off = np.abs(np.array(found.diagonals_um) - (18.93, 18.77))
        allowed = np.hypot(found.diagonal_errors_um, 0.15)
        rows.append((f"Vickers, detector {detector}: furthest diagonal off, µm", float(off.max()), ""))
        rows.append((f"Vickers, detector {detector}: the same over its error", float((off / allowed).max()), "<= 1"))
    return rows


if __name__ == "__main__":
    sys.exit(main())
