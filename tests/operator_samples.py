"""A small input for every operator, and the slow but plain computation of those that have one.

A new operator gets a line in `SAMPLES`: what it is tried on in test_operators.py.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from scipy import ndimage

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Layers = dict[str, Any]
    Sample = Callable[[], tuple[Layers, dict[str, Any]]]


def relief(*, holes: bool = True) -> Layers:
    """A tilted, rough surface with two pits, its confidence, and a hole."""
    rng = np.random.default_rng(5)
    y, x = np.mgrid[0:48, 0:64].astype(np.float32)
    height = 0.1 * x - 0.05 * y + cv2.GaussianBlur(rng.normal(size=x.shape).astype(np.float32), (0, 0), 2)
    height[10:14, 20:24] -= 5
    confidence = np.full(x.shape, 2, np.float32)
    if holes:
        height[30:36, 40:44] = np.nan
        confidence[30:36, 40:44] = 0
    return {"range": height, "confidence": confidence, "pixel_um": 0.5}


def opened_by_definition(layers: Layers, params: dict[str, Any]) -> Layers:
    from processing.range_operators import half_ellipsoid

    ball = half_ellipsoid(params["radius_px"], params["height"])
    window = np.isfinite(ball)
    structure = np.where(window, ball, 0)
    eroded = ndimage.grey_erosion(
        layers["range"].astype(float), footprint=window, structure=structure, mode="constant", cval=np.inf
    )
    opened = ndimage.grey_dilation(eroded, footprint=window, structure=structure, mode="constant", cval=-np.inf)
    return {"background": opened, "range": layers["range"] - opened}


def smoothed_by_definition(layers: Layers, params: dict[str, Any]) -> Layers:
    known = np.isfinite(layers["range"])
    weight = np.where(known, layers["confidence"], 0).astype(float)
    sigma = params["sigma_px"]
    total = ndimage.gaussian_filter(weight * np.where(known, layers["range"], 0), sigma, mode="mirror", truncate=4)
    return {"range": np.where(known, total / ndimage.gaussian_filter(weight, sigma, mode="mirror"), np.nan)}


def focal_stack() -> Layers:
    """Nine planes of a slope."""
    texture = np.random.default_rng(3).normal(size=(40, 56)).astype(np.float32)
    planes = [cv2.GaussianBlur(texture, (0, 0), 0.4 + 0.5 * abs(k - 4)) for k in range(9)]
    volume = np.clip(128 + 60 * np.array(planes), 0, 255).astype(np.uint8)
    return {"volume": volume, "z_um": np.arange(9) * 0.5, "pixel_um": 0.25}


def textured(side: int = 64) -> NDArray[np.float32]:
    made = cv2.GaussianBlur(np.random.default_rng(6).normal(size=(side, side)).astype(np.float32), (0, 0), 2)
    return 128 + 40 * made / made.std()


def moved_sections() -> Layers:
    """Three faces, each put down elsewhere."""
    moved = [np.roll(textured(), shift, axis=(0, 1)) for shift in ((0, 0), (2, -3), (-1, 2))]
    return {"volume": np.clip(moved, 0, 255).astype(np.uint8)}


def stereo_pair() -> Layers:
    """A flat surface two pixels of parallax above the axis."""
    view = np.clip(textured(), 0, 255).astype(np.uint8)
    return {"volume": np.stack([np.roll(view, 2, axis=1), view]), "pixel_um": 0.5}


def blurred_volume() -> Layers:
    """A bright spot and its blur."""
    z, y, x = np.mgrid[-2:3, -4:5, -4:5]
    psf = np.exp(-(z**2) / 2 - (y**2 + x**2) / 4).astype(np.float32)
    truth = np.zeros((8, 20, 24))
    truth[4, 10, 12], truth[3, 5, 6] = 9000, 5000
    light = ndimage.convolve(truth, psf / psf.sum(), mode="constant")
    seen = np.random.default_rng(8).poisson(light + 20).astype(np.uint16)
    return {"volume": seen, "psf": psf / psf.sum()}


DEBLUR = {"noise": 1.0, "background": 20.0}


def noisy_volume() -> Layers:
    """A volume that is nowhere even, its voxels twice as deep as wide, and a piece of it to be looked for."""
    grey = np.random.default_rng(8).integers(0, 256, (9, 10, 12)).astype(np.uint8)
    return {"volume": grey, "spacing_um": (1.0, 0.5, 0.5), "pattern": grey[2:5, 3:6, 4:7].copy()}


def holed_mask() -> Layers:
    """A block with a hole and a speck beside it, voxels twice as deep as wide."""
    mask = np.zeros((8, 10, 12), np.uint8)
    mask[1:7, 2:8, 1:9] = 255
    mask[3:5, 4:6, 4:6] = 0
    mask[2, 9, 11] = 255
    return {"volume": mask, "spacing_um": (1.0, 0.5, 0.5)}


def two_bands() -> Layers:
    """Two bands of the same step, one of them brighter."""
    rng = np.random.default_rng(4)
    step = np.where(np.arange(12) < 6, 20, 90)
    bands = [rng.integers(0, 9, (5, 8, 12)) + step, rng.integers(0, 9, (5, 8, 12)) + 2 * step]
    return {"bands": np.array(bands).astype(np.uint16), "spacing_um": (1.0, 0.5, 0.5)}


MORPHOLOGY = ("erode", "dilate", "open", "close", "gradient", "top_hat")
FILTERS = ("entropy", "frei_chen", "gradient", "median", "rank", "sobel", "template", "variance")
MASKS = ("mask.fill_holes", "label.components", "distance.map", "watershed.split")

SAMPLES: dict[str, Sample] = {
    "align.stack": lambda: (moved_sections(), {"model": "translation"}),
    "stereo.tilt": lambda: (stereo_pair(), {"tilt_deg": 8.0, "band_px": (-3, 5)}),
    **{f"filter.{name}": lambda: (noisy_volume(), {}) for name in FILTERS},
    **{name: lambda: (holed_mask(), {}) for name in MASKS},
    "mask.threshold": lambda: (noisy_volume(), {"method": "li"}),
    "filter.entropy": lambda: (noisy_volume(), {"low": 0.0, "high": 255.0}),
    **{f"morphology.{name}": lambda: (noisy_volume(), {"rule": 18}) for name in MORPHOLOGY},
    "mask.central": lambda: (noisy_volume(), {"neck_px": 1.0}),
    "grow.region": lambda: (holed_mask(), {"seed": (2, 3, 2), "tolerance": 10.0}),
    "grow.balloon": lambda: (holed_mask(), {"seed": (2, 3, 2), "low": 1.0, "high": 255.0, "stiffness_px": 1.0}),
    "skeleton.graph": lambda: (holed_mask(), {}),
    "bands.calculate": lambda: (two_bands(), {"formula": "(b0-b1)/(b0+b1)"}),
    "bands.ratio": lambda: (two_bands(), {"background": (10.0, 10.0)}),
    "bands.principal": lambda: (two_bands(), {}),
    "bands.boundaries": lambda: (two_bands(), {"weights": (1.0, 2.0)}),
    "deblur.psf": lambda: (
        {"spacing_um": (0.3, 0.1, 0.1)},
        {"na": 0.9, "wavelength_um": 0.5, "planes": 5, "side_px": 9},
    ),
    "deblur.richardson_lucy": lambda: (blurred_volume(), {**DEBLUR, "most_steps": 4}),
    "deblur.van_cittert": lambda: (blurred_volume(), DEBLUR),
    "deblur.wiener": lambda: (blurred_volume(), DEBLUR),
    "focus.stack": lambda: (focal_stack(), {"method": "transparent"}),
    "focus.view": lambda: (focal_stack(), {"azimuth_deg": 20.0, "tilt_deg": 50.0}),
    "volume.cubic": lambda: (focal_stack(), {"side_um": 0.3, "method": "cubic"}),
    "range.fill": lambda: (relief(), {}),
    "range.level": lambda: (relief(), {}),
    "range.median": lambda: (relief(holes=False), {"side_px": 5}),
    "range.rolling_ball": lambda: (relief(holes=False), {"radius_px": 6.0, "height": 2.0}),
    "range.smooth": lambda: (relief(), {"sigma_px": 1.5}),
}

REFERENCES: dict[str, Callable[[Layers, dict[str, Any]], Layers]] = {
    "distance.map": lambda layers, params: {
        "volume": ndimage.distance_transform_edt(layers["volume"], sampling=layers["spacing_um"])
    },
    "label.components": lambda layers, params: {"volume": ndimage.label(layers["volume"], np.ones((3, 3, 3)))[0]},
    "mask.fill_holes": lambda layers, params: {"volume": 255 * ndimage.binary_fill_holes(layers["volume"])},
    "range.median": lambda layers, params: {
        "range": ndimage.median_filter(layers["range"], params["side_px"], mode="nearest")
    },
    "range.rolling_ball": opened_by_definition,
    "range.smooth": smoothed_by_definition,
}
