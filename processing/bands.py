"""Volumes of several bands: arithmetic and ratios between them, principal components and boundaries.

Bands are (b, z, y, x), the channels of one recording. Results are ``volume``, float32, one band.
"""

from __future__ import annotations

import ast
from typing import TYPE_CHECKING, Any

import numpy as np

from devices.errors import InputError
from processing.operators import Layer, operator
from processing.volume_filters import checked, per_um
from processing.volume_kernels import sobel_rows

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from processing.neighbours import Spacing

    Array = NDArray[Any]

FUNCTIONS: dict[str, Callable[..., Any]] = {
    "abs": np.abs, "exp": np.exp, "log": np.log, "log2": np.log2, "log10": np.log10, "max": np.maximum,
    "min": np.minimum, "sqrt": np.sqrt,
}  # fmt: skip
SIGNS: dict[type, Callable[..., Any]] = {
    ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.divide, ast.Pow: np.power,
    ast.USub: np.negative, ast.UAdd: np.positive,
}  # fmt: skip


def checked_bands(bands: Array, least: int = 1) -> Array:
    """Return bands, (b, z, y, x), of a type that kernels are compiled for.

    Raises
    ------
    InputError
        ``bands``: fewer than ``least``, or not of four axes; ``volume-shape``, ``volume-nan``.
    """
    if bands.ndim != 4 or len(bands) < least:
        raise InputError(
            f"{least} bands or more are needed, (band, z, y, x); this has {bands.shape}.",
            fix="name the channels: --bands 0,1",
            code="bands",
        )
    return np.stack([checked(band) for band in bands])


@operator("bands.calculate", gives=[Layer("volume", "bands", "float32")], halo=lambda _: (0, 0, 0))
def calculate(bands: Array, *, formula: str, fill: float = 0.0) -> Array:
    """Arithmetic between bands, voxel by voxel.

    Parameters
    ----------
    bands : array (b, z, y, x)
        Grey values.
    formula : str
        Of the bands b0, b1, …, numbers, + - * / ** and abs, exp, log, log2, log10, max, min, sqrt; such as
        ``(b0-b1)/(b0+b1)``.
    fill : float
        Value where the formula has none, as at a division by zero.

    Returns
    -------
    array (z, y, x) float32
        Computed in float32.

    Raises
    ------
    InputError
        ``operator-params``: what is no such formula; ``bands``.
    """
    planes = checked_bands(bands)
    names = {f"b{i}": band.astype(np.float32) for i, band in enumerate(planes)}
    try:
        tree = ast.parse(formula, mode="eval").body
    except SyntaxError:
        raise _formula(formula, "it cannot be read") from None
    with np.errstate(all="ignore"):
        value = _value(tree, names, formula)
    whole = np.broadcast_to(np.asarray(value, np.float32), planes.shape[1:])
    return np.where(np.isfinite(whole), whole, np.float32(fill))


def _value(node: ast.expr, names: dict[str, Array], formula: str) -> Any:
    match node:
        case ast.Constant(value=int() | float() as number):
            return np.float32(number)
        case ast.Name(id=name) if name in names:
            return names[name]
        case ast.BinOp(left, op, right) if type(op) in SIGNS:
            return SIGNS[type(op)](_value(left, names, formula), _value(right, names, formula))
        case ast.UnaryOp(op, operand) if type(op) in SIGNS:
            return SIGNS[type(op)](_value(operand, names, formula))
        case ast.Call(ast.Name(id=name), args, []) if name in FUNCTIONS and len(args) == (2 if name[0] == "m" else 1):
            return FUNCTIONS[name](*(_value(arg, names, formula) for arg in args))
    raise _formula(formula, f"{ast.unparse(node)} is not known; there are {', '.join([*names, *FUNCTIONS])}")


def _formula(formula: str, why: str) -> InputError:
    return InputError(f"formula {formula!r}: {why}.", fix="such as formula=(b0-b1)/(b0+b1)", code="operator-params")


@operator("bands.ratio", gives=[Layer("volume", "bands", "float32")], halo=lambda _: (0, 0, 0))
def ratio(
    bands: Array, *, over: int = 0, under: int = 1, background: tuple[float, ...] = (), least: float = 1.0
) -> Array:
    """Ratio of two bands above their backgrounds, 0 where the lower one is too weak to divide by.

    Parameters
    ----------
    bands : array (b, z, y, x)
        Grey values.
    over, under : int
        Which bands, counted from 0.
    background : tuple of float
        What is taken off each of the two first; nothing when left out.
    least : float
        Least value of the lower band above its background, such as three times its noise.

    Returns
    -------
    array (z, y, x) float32
        The ratio.

    Raises
    ------
    InputError
        ``bands``: no such band; ``operator-params``: not two backgrounds, or a least value that is not above 0.
    """
    planes = checked_bands(bands)
    if not (0 <= over < len(planes) and 0 <= under < len(planes)):
        raise InputError(
            f"there is no band {max(over, under)}; there are {len(planes)}, counted from 0.",
            fix="name the channels: --bands 0,1",
            code="bands",
        )
    if len(background) not in (0, 2) or not least > 0:
        raise InputError(
            "a ratio takes two backgrounds, and a least value above 0.",
            fix="bands.ratio:background=100,120:least=20",
            code="operator-params",
        )
    off = background or (0.0, 0.0)
    upper, lower = (planes[k].astype(np.float32) - np.float32(b) for k, b in zip((over, under), off, strict=True))
    strong = lower >= np.float32(least)
    return np.where(strong, upper / np.where(strong, lower, np.float32(1)), np.float32(0))


@operator("bands.principal", gives=[Layer("volume", "bands", "float32"), Layer("share", dtype="float64")])
def principal(bands: Array, *, component: int = 0) -> tuple[Array, np.float64]:
    """Principal component of the bands: the mixture in which voxels differ most, or a later one.

    Parameters
    ----------
    bands : array (b, z, y, x)
        Grey values.
    component : int
        Which one, counted from 0.

    Returns
    -------
    volume : array (z, y, x) float32
        Its value, 0 on average; the sign is such that the weights add up to more than 0.
    share : float
        Part of all variance that it has.

    Raises
    ------
    InputError
        ``bands``: fewer than two, or no such component.
    """
    planes = checked_bands(bands, least=2)
    if not 0 <= component < len(planes):
        raise InputError(f"{len(planes)} bands have no component {component}.", fix="count from 0.", code="bands")
    flat = planes.reshape(len(planes), -1).astype(np.float64)
    flat -= flat.mean(axis=1, keepdims=True)
    shares, axes = np.linalg.eigh(flat @ flat.T / flat.shape[1])
    axis = axes[:, ::-1][:, component]
    axis = axis if axis.sum() > 0 else -axis
    total = shares.sum()
    share = shares[::-1][component] / total if total else 0.0
    return (axis @ flat).reshape(planes.shape[1:]).astype(np.float32), np.float64(share)


@operator("bands.boundaries", gives=[Layer("volume", "bands", "float32")], halo=lambda _: (1, 1, 1))
def boundaries(bands: Array, spacing_um: Spacing | None = None, *, weights: tuple[float, ...] = ()) -> Array:
    """Strength of the boundaries of all bands together: how fast the colours change where they change most.

    The gradients g of the bands make the tensor Σ w² g gᵀ (Di Zenzo 1986, in three dimensions); the strength is the
    root of its largest eigenvalue. For one band that is the length of its gradient.

    Parameters
    ----------
    bands : array (b, z, y, x)
        Grey values.
    spacing_um : tuple of float, optional
        Distance of voxels along (z, y, x).
    weights : tuple of float
        Of each band, such as one over its noise; all 1 when left out.

    Returns
    -------
    array (z, y, x) float32
        Grey levels per µm (per voxel without a spacing), times the weights.

    Raises
    ------
    InputError
        ``operator-params``: not a weight for each band; ``bands``, ``spacing``.
    """
    planes = checked_bands(bands)
    if weights and len(weights) != len(planes):
        raise InputError(
            f"{len(weights)} weights for {len(planes)} bands.", fix="one for each band", code="operator-params"
        )
    tensor = np.zeros((6, *planes.shape[1:]), np.float32)
    parts = np.empty((3, *planes.shape[1:]), np.float32)
    for k, band in enumerate(planes):
        sobel_rows(band, per_um(spacing_um), parts)
        parts *= np.float32(weights[k] if weights else 1.0)
        for entry, (a, b) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
            tensor[entry] += parts[a] * parts[b]
    return np.sqrt(largest_eigenvalue(tensor))


def largest_eigenvalue(tensor: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the largest eigenvalue of symmetric 3x3 tensors, (6, …): zz, yy, xx, zy, zx, yx (Smith 1961)."""
    zz, yy, xx, zy, zx, yx = tensor.astype(np.float64)
    mean = (zz + yy + xx) / 3
    a, b, c = zz - mean, yy - mean, xx - mean
    spread = np.sqrt((a * a + b * b + c * c + 2 * (zy * zy + zx * zx + yx * yx)) / 6)
    half = (a * (b * c - yx * yx) - zy * (zy * c - yx * zx) + zx * (zy * yx - b * zx)) / 2
    cosine = np.divide(half, spread**3, out=np.zeros_like(half), where=spread > 0)
    largest = mean + 2 * spread * np.cos(np.arccos(np.clip(cosine, -1, 1)) / 3)
    return np.asarray(np.maximum(largest, 0), np.float32)
