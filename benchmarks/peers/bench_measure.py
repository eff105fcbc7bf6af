"""Statistics of regions beside SciPy, scikit-image and ITK: CPU seconds of one run, interleaved, results compared.

``python benchmarks/peers/bench_measure.py [SIDE [ROUNDS]]``; SimpleITK is in the development environment. Each gives
for every region voxels, box, centroid, second moments, mean and sum of the grey values; ours gives more.
Ends with 1 when ours is less than ten times faster than the best of the others.
"""

from __future__ import annotations

import sys
import time

import numpy as np
import SimpleITK as sitk  # noqa: N813  its own short name
from scipy import ndimage
from skimage.measure import regionprops_table

from processing.features import add_up, measured
from processing.labels import components

SIDE = int(sys.argv[1]) if len(sys.argv) > 1 else 256
ROUNDS = int(sys.argv[2]) if len(sys.argv) > 2 else 3
LIMIT = 10.0
PROPERTIES = ("area", "bbox", "centroid", "inertia_tensor", "intensity_mean")


def specimen() -> tuple[np.ndarray, np.ndarray]:
    grey = ndimage.gaussian_filter(np.random.default_rng(4).random((SIDE, SIDE, SIDE)).astype(np.float32), 2.6)
    labels, count = components(grey > np.quantile(grey, 0.92), rule=26)
    print(f"{SIDE}³ voxels, {count} regions, {np.mean(labels > 0):.1%} inside")
    return labels.astype(np.int32), grey


def of_scikit_image(labels, grey):
    table = regionprops_table(labels, grey, properties=PROPERTIES)
    return table["area"], table["centroid-0"], table["intensity_mean"]


def of_itk(labels, grey):
    shape, light = sitk.LabelShapeStatisticsImageFilter(), sitk.LabelIntensityStatisticsImageFilter()
    numbers, values = sitk.GetImageFromArray(labels), sitk.GetImageFromArray(grey)
    shape.ComputePerimeterOff()
    shape.Execute(numbers)
    light.Execute(numbers, values)
    found = shape.GetLabels()
    sizes = np.array([shape.GetNumberOfPixels(k) for k in found])
    return sizes, np.array([shape.GetCentroid(k)[2] for k in found]), np.array([light.GetMean(k) for k in found])


def of_scipy(labels, grey):
    index = np.arange(1, labels.max() + 1)
    ndimage.find_objects(labels)
    sizes = np.bincount(labels.ravel())[1:]
    mean = ndimage.mean(grey, labels, index)
    grid = np.meshgrid(*(np.arange(SIDE, dtype=np.float32),) * 3, indexing="ij", sparse=True)
    first = [ndimage.mean(np.broadcast_to(axis, labels.shape), labels, index) for axis in grid]
    for a in range(3):
        for b in range(a + 1):
            ndimage.mean(grid[a] * grid[b] * np.ones(labels.shape, np.float32), labels, index)
    return sizes, first[0], mean


def of_ours(labels, grey):
    found = add_up(labels, grey)
    found.spread((1.0, 1.0, 1.0))
    return found.sums[:, 0], found.middles[:, 0], found.sums[:, 10] / found.sums[:, 0]


def whole_table(labels, grey):
    table = measured(labels, grey)
    return table["voxels"], table["z_um"], table["mean_density"]


WAYS = {
    "ours (with Euler number and surface)": of_ours,
    "ours, whole table (with length, breadth, shape)": whole_table,
    "scikit-image": of_scikit_image,
    "ITK": of_itk,
    "SciPy": of_scipy,
}


def main() -> int:
    labels, grey = specimen()
    whole_table(labels[:8], grey[:8])  # compile
    spent: dict[str, list[float]] = {name: [] for name in WAYS}
    results = {}
    for _ in range(ROUNDS):
        for name, way in WAYS.items():
            begin = time.process_time()
            results[name] = way(labels, grey)
            spent[name].append(time.process_time() - begin)
    mine, *others = results.values()
    for other in others:
        for one, same in zip(mine, other, strict=True):
            np.testing.assert_allclose(one, same, rtol=1e-4)
    least = {name: min(times) for name, times in spent.items()}
    for name, seconds in least.items():
        print(f"{name:50s} {seconds:7.3f} s CPU")
    names = list(WAYS)
    ratio = min(least[name] for name in names[2:]) / least[names[0]]
    print(f"best peer over ours: {ratio:.1f} (limit {LIMIT:g})")
    return 0 if ratio >= LIMIT else 1


if __name__ == "__main__":
    raise SystemExit(main())
