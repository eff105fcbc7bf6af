"""Deblurring: what out-of-focus light has spread is put back, as far as the noise allows.

Volumes are (planes, rows, columns); point spread functions as in `processing.psf`. Transforms are of real numbers, of
quick sizes, padded by half the point spread function, so that nothing wraps around from the other side.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from scipy.fft import irfftn, next_fast_len, rfftn

from devices.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Array = NDArray[Any]
    Tell = Callable[[int], None]

WORKERS = 2
TINY = 1e-6
LEAST_LEFT = np.float32(
    0.5
)  # of a voxel by a prediction: one that falls to nothing never comes back, here but not there
SLOWEST = 0.005  # what four steps must take from the residual: below that, they only shape the noise


@dataclass(frozen=True)
class Deblurred:
    """A restored volume and how it came about.

    Attributes
    ----------
    volume : array (planes, rows, columns) float32
    steps : int
        Iterations taken.
    stopped : str
        Why it ended: "noise" (the difference to the picture is as small as the noise), "still" (it hardly falls any
        more), "rises" (it grows), "most" (the allowed number).
    residual : tuple of float
        Root mean square of (picture − blurred estimate) over the noise, before every step.
    """

    volume: NDArray[np.float32]
    steps: int
    stopped: str
    residual: tuple[float, ...]


class Blur:
    """Convolution with a point spread function, and its transpose, on volumes of one shape.

    Parameters
    ----------
    psf : array, odd sides
    shape : (planes, rows, columns)
        Of the volumes.
    """

    def __init__(self, psf: Array, shape: tuple[int, ...]) -> None:
        self.shape = shape
        self.reach = tuple(n // 2 for n in psf.shape)
        self.padded = tuple(next_fast_len(n + 2 * r, real=True) for n, r in zip(shape, self.reach, strict=True))
        self.transfer = rfftn(in_middle(psf, self.padded), workers=WORKERS).astype(np.complex64)

    def forth(self, field: Array) -> Array:
        """Blur a padded field."""
        return self._through(field, self.transfer)

    def back(self, field: Array) -> Array:
        """Apply the transpose."""
        return self._through(field, np.conj(self.transfer))

    def _through(self, field: Array, transfer: Array) -> Array:
        spectrum = rfftn(field, workers=WORKERS)
        spectrum *= transfer
        return np.asarray(irfftn(spectrum, self.padded, overwrite_x=True, workers=WORKERS), np.float32)

    @property
    def seen(self) -> tuple[slice, ...]:
        """Part of a padded field that the volume shows."""
        return tuple(slice(r, r + n) for r, n in zip(self.reach, self.shape, strict=True))

    def padded_with(self, volume: Array, mode: str) -> Array:
        """Lay a volume into a padded field; ``mode`` as in `numpy.pad`."""
        sides = [(r, p - n - r) for r, n, p in zip(self.reach, self.shape, self.padded, strict=True)]
        return np.pad(volume, sides, mode=mode)  # type: ignore[call-overload,no-any-return]


def in_middle(psf: Array, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Lay a point spread function into a field of ``shape`` with its middle at the origin."""
    field = np.zeros(shape, np.float32)
    field[tuple(slice(0, n) for n in psf.shape)] = psf
    return np.roll(field, [-(n // 2) for n in psf.shape], axis=range(psf.ndim))


def richardson_lucy(
    volume: Array,
    psf: Array,
    *,
    noise: float,
    background: float = 0.0,
    most_steps: int = 40,
    stop: bool = True,
    tell: Tell | None = None,
) -> Deblurred:
    """Restore by the accelerated Richardson-Lucy iteration, stopped when the noise is reached.

    Parameters
    ----------
    volume : array (planes, rows, columns)
        Grey levels.
    psf : array float32
    noise : float
        Camera noise (rms) of the dark in grey levels; what the light's own noise adds is in the stop rule.
    background : float
        Grey level of no light.
    most_steps : int
        Iterations at most.
    stop : bool
        Whether the stop rule may end it before.
    tell : callable, optional
        Is told the number of steps done.

    Returns
    -------
    Deblurred

    Notes
    -----
    f ← f · Hᵀ(g / Hf) / Hᵀ1 (Richardson 1972, Lucy 1974) from a prediction along the last step, as Biggs and Andrews do
    (1997, Appl. Opt. 36:1766), by a share that grows with the number of steps (Nesterov 1983): no voxel depends on what
    is far from it. Light from beyond the picture's edge is estimated, too: voxels there are part of f and weighed by
    what of them is seen, Hᵀ of the picture's own mask. The iteration ends when the mean of the residuals, each over its
    own noise, is 1 where there is light (discrepancy), or hardly falls any more.
    """
    blur = Blur(psf, volume.shape)
    seen = np.maximum(volume.astype(np.float32) - np.float32(background), 0)
    mask = blur.padded_with(np.ones(volume.shape, np.float32), "constant")
    share = np.maximum(blur.back(mask), TINY)
    lit = np.maximum(blur.padded_with(seen, "edge"), np.float32(seen.mean() * TINY + TINY))
    estimate: Array = np.maximum(blur.forth(lit), TINY)
    before = estimate
    residual: list[float] = []
    for step in range(most_steps):
        ahead = estimate if step < 2 else np.maximum(estimate + pace(step) * (estimate - before), LEAST_LEFT * estimate)
        blurred = np.maximum(blur.forth(ahead)[blur.seen], TINY)
        residual.append(over_noise(seen, blurred, noise))
        ended = stopped(residual) if stop else ""
        if ended:
            return Deblurred(estimate[blur.seen].copy(), step, ended, tuple(residual))
        ratio = blur.padded_with(seen / blurred, "constant")
        before, estimate = estimate, ahead * np.maximum(blur.back(ratio), 0) / share
        if tell:
            tell(step + 1)
    return Deblurred(estimate[blur.seen].copy(), most_steps, "most", tuple(residual))


def pace(step: int) -> np.float32:
    """Return how far a step is predicted along the last one: the same for all parts of a volume, whatever they show."""
    return np.float32((step + 1) / (step + 4))


def over_noise(seen: Array, blurred: Array, noise: float) -> float:
    """Root mean square of the residuals, each over its noise: the camera's, and the light's at one count a grey level.

    Over the voxels brighter than the mean, because the dark ones agree from the start.
    """
    bright = blurred >= blurred.mean()
    light = blurred[bright]
    return float(np.sqrt(np.mean((seen[bright] - light) ** 2 / (np.float32(noise**2) + light))))


def stopped(residual: list[float]) -> str:
    """Return why an iteration with these residuals ends; empty while it goes on."""
    if residual[-1] <= 1:
        return "noise"
    if len(residual) > 1 and residual[-1] > (1 + SLOWEST) * residual[-2]:
        return "rises"
    if len(residual) > 5 and residual[-5] - residual[-1] < SLOWEST * residual[-1]:
        return "still"
    return ""


def wiener(volume: Array, psf: Array, *, noise_share: float) -> NDArray[np.float32]:
    """Restore by the Wiener inverse, (1 + K) H* G / (|H|² + K), which keeps the mean.

    Parameters
    ----------
    volume : array (planes, rows, columns)
    psf : array float32
    noise_share : float
        K, power of noise over power of signal; see `noise_over_signal`.

    Returns
    -------
    array float32
        May be negative beside bright features.
    """
    blur = Blur(psf, volume.shape)
    mean = np.float32(volume.mean())
    spectrum = rfftn(blur.padded_with(volume.astype(np.float32) - mean, "reflect"), workers=WORKERS)
    power = np.abs(blur.transfer) ** 2
    spectrum *= (1 + np.float32(noise_share)) * np.conj(blur.transfer) / (power + np.float32(noise_share))
    return np.asarray(irfftn(spectrum, blur.padded, workers=WORKERS)[blur.seen] + mean, np.float32)


def noise_over_signal(volume: Array, noise: float) -> float:
    """Power of the camera's and the light's noise over that of the picture's contrast."""
    light = float(np.maximum(volume, 0).mean())
    spread = float(np.var(volume, dtype=np.float64))
    power = noise**2 + light
    return float(np.clip(power / max(spread - power, TINY), 1e-5, 1.0))


def van_cittert(
    volume: Array,
    psf: Array,
    *,
    noise: float,
    background: float = 0.0,
    neighbours: int = 2,
    most_steps: int = 15,
    stop: bool = True,
    brightest: float | None = None,
    tell: Tell | None = None,
) -> Deblurred:
    """Restore by adding what the blur took, from each plane and its neighbours, with a limit to every step.

    Parameters
    ----------
    volume : array (planes, rows, columns)
        Grey levels.
    psf : array float32
    noise, background : float
        As in `richardson_lucy`.
    neighbours : int
        Planes to either side whose blur is taken into account.
    most_steps : int
        Iterations at most.
    stop : bool
        Whether the stop rule may end it before.
    brightest : float, optional
        The largest grey level of all, so that parts of a volume go alike; that of the volume when left out.
    tell : callable, optional
        Is told the number of steps done.

    Returns
    -------
    Deblurred

    Notes
    -----
    f_j ← f_j + β(f_j) [g_j − Σ_m h_m ∗ f_{j+m}], h_m being the planes of the point spread function, normalised over the
    neighbours; β = 1 − |2 f/top − 1| keeps f between 0 and the top (Jansson 1984). Without a stop it amplifies the
    noise: it ends as `richardson_lucy` does.
    """
    middle = psf.shape[0] // 2
    reach = min(neighbours, middle)
    near = psf[middle - reach : middle + reach + 1]
    blur = Blur(near / near.sum(), volume.shape)
    seen = volume.astype(np.float32) - np.float32(background)
    light = float(seen.max()) if brightest is None else brightest - background
    estimate, top = seen.copy(), np.float32(2 * max(light, TINY))
    residual: list[float] = []
    for step in range(most_steps):
        blurred = blur.forth(blur.padded_with(estimate, "edge"))[blur.seen]
        residual.append(over_noise(seen, np.maximum(blurred, 0), noise))
        ended = stopped(residual)
        if ended and stop:
            return Deblurred(estimate, step, ended, tuple(residual))
        relaxed = 1 - np.abs(2 * estimate / top - 1)
        estimate = np.clip(estimate + relaxed * (seen - blurred), 0, top)
        if tell:
            tell(step + 1)
    return Deblurred(estimate, most_steps, "most", tuple(residual))


def nearest_neighbour(
    before: Array, plane: Array, after: Array, *, disc_px: float, share: float
) -> NDArray[np.float32]:
    """Take the blur of the two neighbouring planes from one: quick enough for a live picture, for the eye alone.

    Parameters
    ----------
    before, plane, after : array (rows, columns)
        Three neighbouring planes.
    disc_px : float
        Radius of the blur over one plane's distance: dz · tan(asin(NA/n)) / pixel.
    share : float
        Of the blurred neighbours to be taken away, below 0.5.

    Returns
    -------
    array float32
        (g − share (h ∗ g₋ + h ∗ g₊)) / (1 − 2 share), not below 0 (Castleman 1979).
    """
    if not 0 <= share < 0.5 or not disc_px > 0:
        raise InputError(
            f"neighbours cannot give {share:g} of their light, over {disc_px:g} pixels.",
            fix="a share between 0 and 0.5, a radius above 0",
            code="deblur-optics",
        )
    side = 2 * int(np.ceil(disc_px)) + 1
    y, x = np.mgrid[:side, :side] - side // 2
    disc = np.clip(disc_px + 0.5 - np.hypot(y, x), 0, 1).astype(np.float32)
    sides = cv2.filter2D(before.astype(np.float32) + after, -1, disc / disc.sum(), borderType=cv2.BORDER_REPLICATE)
    return np.maximum((plane.astype(np.float32) - np.float32(share) * sides) / np.float32(1 - 2 * share), 0)
