"""Two volumes of one specimen put on each other: other voxel sizes, other ways of imaging.

Places are (x, y, z) in µm from the middle of the first voxel; a map is a 4×4 matrix from the fixed volume to the
moving one. Marks give it by least squares. Pictures give it by correlation (same kind of contrast) or by mutual
information (any contrast that goes with the material: Mattes et al. 2003), both by SimpleITK, an extra. What was found
is believed only if the two volumes say more about each other there than when shifted away from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from scipy.ndimage import affine_transform

from devices.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    Array = NDArray[Any]

Model3 = Literal["translation", "rigid", "similarity", "affine"]
Method3 = Literal["mutual-information", "correlation"]
FEWEST: dict[Model3, int] = {"translation": 1, "rigid": 3, "similarity": 3, "affine": 4}
LEVELS = ((4, 2.0), (2, 1.0), (1, 0.5))  # shrinking, and smoothing in voxels
BINS, STEPS = 32, 100
SAMPLES, SEARCH_SAMPLES = 60_000, 15_000  # voxels that have a say in the judgement, and in each step of the search
SEED = 7
AWAY = 0.15  # of the extent: shifts that must be worse
CLEARLY = 1.2  # times the mutual information of the best of these
LEAST_OVERLAP = 0.2
LEAST_VOXELS = 8


@dataclass(frozen=True)
class Volume:
    """Grey values (z, y, x) float32 and the size of a voxel in µm, (z, y, x)."""

    grey: Array
    voxel_um: tuple[float, float, float]

    @property
    def extent_um(self) -> Array:
        """Distance of the outermost voxels' middles along x, y, z."""
        return np.asarray((np.array(self.grey.shape) - 1)[::-1] * self.voxel_um[::-1], np.float64)


@dataclass(frozen=True)
class Registration:
    """Where a volume lies on another.

    Attributes
    ----------
    matrix : array (4, 4)
        From (x, y, z, 1) µm of the fixed volume to µm of the moving one.
    information : float
        Normalised mutual information less 1, over what both show.
    elsewhere : float
        The highest at places shifted by 15 % of the extent.
    overlap : float
        Share of the fixed volume the moving one covers.
    error_um : float, optional
        Of marks: expected mean error at a mark from what they disagree by.
    """

    matrix: Array
    information: float
    elsewhere: float
    overlap: float
    error_um: float | None = None

    @property
    def believed(self) -> bool:
        """Whether the volumes say clearly more of each other here than elsewhere."""
        return self.overlap >= LEAST_OVERLAP and self.information > CLEARLY * self.elsewhere


def from_marks(model: Model3, fixed_um: Array, moving_um: Array) -> tuple[Array, float | None]:
    """Return the map that brings marks (n, 3) nearest to their partners, and the error they show (Umeyama 1991).

    Raises
    ------
    InputError
        ``register-marks``: too few marks for the model, or all in a line or plane.
    """
    count = len(fixed_um)
    middle, other = fixed_um.mean(axis=0), moving_um.mean(axis=0)
    a, b = fixed_um - middle, moving_um - other
    spans = np.linalg.matrix_rank(a, tol=1e-6 * max(float(np.abs(a).max()), 1e-12))
    if count < FEWEST[model] or spans < {"translation": 0, "affine": 3}.get(model, 2):
        raise InputError(
            f"{count} marks that span {spans} dimensions do not fix {model} maps.",
            fix=("give more marks", "take a model with fewer parameters: --model rigid"),
            code="register-marks",
        )
    linear = _linear(model, a, b)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, other - linear @ middle
    off = moving_um - (fixed_um @ linear.T + matrix[:3, 3])
    unknowns = {"translation": 3, "rigid": 6, "similarity": 7, "affine": 12}[model]
    free = 3 * count - unknowns
    error = float(np.sqrt((off**2).sum() / free * unknowns / count)) if free > 0 else None
    return matrix, error


def _linear(model: Model3, a: Array, b: Array) -> Array:
    if model == "translation":
        return np.eye(3)
    if model == "affine":
        return np.asarray(np.linalg.lstsq(a, b, rcond=None)[0].T)
    left, values, right = np.linalg.svd(b.T @ a)
    flip = np.array([1, 1, np.sign(np.linalg.det(left @ right))])
    scale = float((values * flip).sum() / (a**2).sum()) if model == "similarity" else 1.0
    return np.asarray(scale * (left * flip) @ right)


def from_pictures(
    fixed: Volume, moving: Volume, model: Model3, method: Method3, show: Callable[[float], None] | None = None
) -> Array:
    """Return the map of highest mutual information or correlation, begun from the middles and from the centroids.

    Raises
    ------
    InputError
        ``register-extra``: SimpleITK is not installed.
    """
    sitk = simple_itk()
    unit = max(fixed.voxel_um)  # steps of the search are in these
    pictures = [_image(sitk, volume, unit) for volume in (fixed, moving)]
    says = show or (lambda _: None)
    coarse: list[tuple[float, Any]] = []
    starts = (sitk.CenteredTransformInitializerFilter.GEOMETRY, sitk.CenteredTransformInitializerFilter.MOMENTS)
    for k, start in enumerate(starts):
        first = sitk.CenteredTransformInitializer(*pictures, _transform(sitk, model), start)
        reached = _searched(sitk, method, pictures, first, LEVELS[:1])
        coarse.append((information(fixed, moving, _matrix(reached, unit))[0], reached))
        says((k + 1) / (len(starts) + 1))
    best = max(coarse, key=lambda pair: pair[0])[1]
    found = _matrix(_searched(sitk, method, pictures, best, LEVELS[1:]), unit)
    says(1.0)
    return found


def _searched(sitk: Any, method: Method3, pictures: list[Any], start: Any, levels: Sequence[tuple[int, float]]) -> Any:
    """Return the transform a search reaches, or its start where it ran away: too little overlapped on the way."""
    search = _search(sitk, method, pictures[0].GetNumberOfPixels(), levels)
    search.SetInitialTransform(start, inPlace=False)
    try:
        return search.Execute(*pictures)
    except RuntimeError:
        return start


def no_match(why: str) -> InputError:
    """Return the error for volumes that do not go together."""
    return InputError(
        f"the volumes do not match: {why}.",
        why="They are not of one specimen, hardly overlap, are turned by more than some 20°, or show too little.",
        fix=("check voxel sizes and orientation", "give marks: --fiducials marks.csv"),
        code="register-no-match",
    )


def simple_itk() -> Any:
    """Return SimpleITK; raise `InputError` when the extra is not installed."""
    try:
        return import_module("SimpleITK")
    except ImportError:
        raise InputError(
            "registration by the pictures needs SimpleITK, which is not installed.",
            fix=("install the extra: pip install 'stereotome[register]'", "give marks: --fiducials marks.csv"),
            code="register-extra",
        ) from None


def _image(sitk: Any, volume: Volume, unit: float) -> Any:
    image = sitk.GetImageFromArray(volume.grey.astype(np.float32))
    image.SetSpacing(tuple(float(v) / unit for v in volume.voxel_um[::-1]))
    return image


def _transform(sitk: Any, model: Model3) -> Any:
    kinds = {
        "translation": lambda: sitk.TranslationTransform(3),
        "rigid": sitk.Euler3DTransform,
        "similarity": sitk.Similarity3DTransform,
        "affine": lambda: sitk.AffineTransform(3),
    }
    return kinds[model]()


def _search(sitk: Any, method: Method3, voxels: int, levels: Sequence[tuple[int, float]]) -> Any:
    search = sitk.ImageRegistrationMethod()
    if method == "mutual-information":
        search.SetMetricAsMattesMutualInformation(BINS)
    else:
        search.SetMetricAsCorrelation()
    search.SetMetricSamplingStrategy(search.RANDOM)
    search.SetMetricSamplingPercentage(min(1.0, SEARCH_SAMPLES / voxels), SEED)
    search.SetInterpolator(sitk.sitkLinear)
    search.SetOptimizerAsRegularStepGradientDescent(
        learningRate=2.0, minStep=5e-3, numberOfIterations=STEPS, relaxationFactor=0.6
    )
    search.SetOptimizerScalesFromPhysicalShift()
    search.SetShrinkFactorsPerLevel([shrink for shrink, _ in levels])
    search.SetSmoothingSigmasPerLevel([smooth for _, smooth in levels])
    search.SmoothingSigmasAreSpecifiedInPhysicalUnitsOff()
    return search


def _matrix(transform: Any, unit: float) -> Array:
    """Return any of these transforms as a matrix in µm, by what it does to four points."""
    at = [np.array(transform.TransformPoint(p)) for p in ((0.0, 0.0, 0.0), (1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0))]
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.stack([p - at[0] for p in at[1:]], axis=1), at[0] * unit
    return matrix


def judged(fixed: Volume, moving: Volume, matrix: Array, error_um: float | None = None) -> Registration:
    """Return how much the volumes say of each other under a map, and under maps shifted away from it."""
    here, overlap = information(fixed, moving, matrix)
    away = []
    for axis in range(3):
        for sign in (-1, 1):
            shift = np.eye(4)
            shift[axis, 3] = sign * AWAY * fixed.extent_um[axis]
            away.append(information(fixed, moving, matrix @ shift)[0])
    return Registration(matrix, here, max(away), overlap, error_um)


def information(fixed: Volume, moving: Volume, matrix: Array) -> tuple[float, float]:
    """Return the normalised mutual information (Studholme et al. 1999) less 1, and the share of ``fixed`` covered."""
    stride = max(1, round((fixed.grey.size / SAMPLES) ** (1 / 3)))
    cut = (slice(None, None, stride),) * 3
    seen = resampled(moving, fixed, matrix, stride)
    both = np.isfinite(seen)
    if both.sum() < LEAST_VOXELS**3:
        return 0.0, float(both.mean())
    classes = BINS // 2
    first, second = (_ranked(v, classes) for v in (fixed.grey[cut][both], seen[both]))
    joint = np.bincount(first * classes + second, minlength=classes**2).reshape(classes, -1)
    together = _entropy(joint.ravel())
    if together <= 0:
        return 0.0, float(both.mean())
    return (_entropy(joint.sum(0)) + _entropy(joint.sum(1))) / together - 1, float(both.mean())


def _ranked(values: Array, classes: int) -> Array:
    """Return classes of equal size, from dark to bright."""
    return np.asarray(np.digitize(values, np.quantile(values, np.linspace(0, 1, classes + 1)[1:-1])))


def _entropy(counts: Array) -> float:
    share = counts[counts > 0] / counts.sum()
    return float(-(share * np.log(share)).sum())


def resampled(moving: Volume, fixed: Volume, matrix: Array, stride: int = 1) -> Array:
    """Return the moving volume on every ``stride``-th voxel of the fixed one, linear; NaN outside."""
    to_um = np.diag([*(stride * v for v in fixed.voxel_um[::-1]), 1.0])
    to_voxels = np.diag([*(1 / v for v in moving.voxel_um[::-1]), 1.0])
    whole = to_voxels @ matrix @ to_um
    turned = whole[:3, :3][::-1, ::-1]  # arrays are (z, y, x)
    shape = tuple(-(-n // stride) for n in fixed.grey.shape)
    return np.asarray(
        affine_transform(
            moving.grey.astype(np.float32), turned, whole[:3, 3][::-1], shape, order=1, mode="constant", cval=np.nan
        )
    )
