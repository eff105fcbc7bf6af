"""Registration of the planes of a focal stack whose magnification changes with focus (breathing) or whose field drifts.

Neighbouring planes are matched by translation and scale, chained to one reference plane, and planes are resampled as
they are read. Depth is not touched: ranges stay in planes or µm, seen in the frame of the reference plane.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Protocol

import cv2
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Array = NDArray[Any]

FINEST_SIDE = 1024  # pixels; larger planes are matched at reduced size, to some hundredths of a pixel all the same
COARSEST_SIDE = 64
SMALLEST_SIDE = 32  # smaller planes are not matched: they show too little
STEPS = 12
CONVERGED = 1e-3  # pixels
BLUR = 1.5  # takes the sharper plane a little nearer to the softer one, and the noise out
PROBES = 9  # pairs of planes looked at to decide whether a stack needs registration
ALIKE = 0.8  # correlation that planes matched to each other must reach
TUKEY = 3 * 1.4826  # times the median absolute residual


class Planes(Protocol):
    """As many planes as it has, each read when asked for."""

    def __len__(self) -> int: ...
    def __getitem__(self, k: int, /) -> Array: ...


@dataclass(frozen=True)
class Placement:
    """Where a point of one plane lies in another, both seen from the middle of the field.

    A point x (from the middle, in units of the plane's longer side) lies at ``scale * x + shift``.
    """

    scale: float = 1.0
    dx: float = 0.0
    dy: float = 0.0

    def then(self, after: Placement) -> Placement:
        """Return this placement followed by another one."""
        return Placement(after.scale * self.scale, after.scale * self.dx + after.dx, after.scale * self.dy + after.dy)

    def inverse(self) -> Placement:
        """Return the placement back."""
        return Placement(1 / self.scale, -self.dx / self.scale, -self.dy / self.scale)

    def matrix(self, shape: tuple[int, ...]) -> Array:
        """Matrix from pixel (x, y, 1) of one plane to pixel (x, y) of the other."""
        middle, side = (np.array([shape[1], shape[0]]) - 1) / 2, max(shape[:2])
        shift = np.array([self.dx, self.dy]) * side + (1 - self.scale) * middle
        return np.array([[self.scale, 0, shift[0]], [0, self.scale, shift[1]]])

    def corner_shift(self) -> float:
        """Largest movement of a point of a square field, as a share of its side."""
        return float(np.hypot(abs(self.dx) + abs(self.scale - 1) / 2, abs(self.dy) + abs(self.scale - 1) / 2))


def grey_pyramid(plane: Array) -> list[Array]:
    """Grey images from the coarsest to the finest used for matching."""
    grey = (plane if plane.ndim == 2 else cv2.cvtColor(plane, cv2.COLOR_RGB2GRAY)).astype(np.float32)
    levels = [shrunk(grey, FINEST_SIDE)]
    while max(levels[-1].shape) > 2 * COARSEST_SIDE:
        levels.append(shrunk(levels[-1], max(levels[-1].shape) // 2))
    return [cv2.GaussianBlur(level, (0, 0), BLUR) for level in reversed(levels)]


def shrunk(image: Array, side: int) -> Array:
    """Reduce to a longer side of at most ``side`` pixels by area averages."""
    ratio = side / max(image.shape)
    if ratio >= 1:
        return image
    size = [max(1, round(n * ratio)) for n in image.shape[::-1]]
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def match(first: list[Array], second: list[Array]) -> Placement:
    """Find where the points of the first pyramid lie in the second, coarse to fine."""
    placement = Placement()
    for a, b in zip(first, second, strict=True):
        for _ in range(STEPS):
            placement, moved = refined(a, b, placement)
            if moved < CONVERGED:
                break
    return placement


def refined(a: Array, b: Array, placement: Placement) -> tuple[Placement, float]:
    """One robust Gauss-Newton step on b(W x) = gain a(x) + offset; returns the movement in pixels, too.

    The gradient is the mean of both planes' (efficient second-order minimisation, Benhimane and Malis 2004).
    """
    warped = resampled(b, placement, cv2.INTER_LINEAR)
    mean = (a + warped) / 2
    gx, gy = cv2.Sobel(mean, -1, 1, 0, scale=1 / 8), cv2.Sobel(mean, -1, 0, 1, scale=1 / 8)
    x, y = ((np.arange(n, dtype=np.float32) - (n - 1) / 2) / max(a.shape) for n in (a.shape[1], a.shape[0]))
    inside = inner(a.shape)
    columns = np.stack([c[inside].ravel() for c in (gx * x + gy * y[:, None], gx, gy, a, np.ones_like(a))])
    step = robust_solution(columns, warped[inside].ravel())
    scale, dx, dy = (-step[:3] / max(a.shape)).tolist()
    new = Placement(scale=1 + scale, dx=dx, dy=dy).then(placement)
    return new, float(np.abs(step[:3]).max())


def inner(shape: tuple[int, ...]) -> tuple[slice, slice]:
    """All but the border, where a resampled plane may have nothing to show."""
    margin_y, margin_x = (max(2, n // 16) for n in shape)
    return slice(margin_y, -margin_y), slice(margin_x, -margin_x)


def robust_solution(columns: Array, value: Array) -> Array:
    """Least squares of ``value`` over ``columns``, repeated once with Tukey's weights."""
    solution = np.linalg.lstsq(columns @ columns.T, columns @ value, rcond=None)[0]
    residual = value - solution @ columns
    limit = TUKEY * np.median(np.abs(residual)) + 1e-6
    weight = np.clip(1 - (residual / limit) ** 2, 0, None) ** 2
    heavy = columns * weight
    refined_solution: Array = np.linalg.lstsq(heavy @ columns.T, heavy @ value, rcond=None)[0]
    return refined_solution


def resampled(plane: Array, placement: Placement, interpolation: int) -> Array:
    """Return the plane as seen in the other one's frame; beyond its border the border is repeated."""
    flags = interpolation | cv2.WARP_INVERSE_MAP
    size = (plane.shape[1], plane.shape[0])
    seen: Array = cv2.warpAffine(
        plane, placement.matrix(plane.shape), size, flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    return seen


class RegisteredPlanes:
    """The planes of a stack as seen in the frame of its reference plane, resampled whenever one is read."""

    def __init__(self, planes: Planes, placements: Sequence[Placement]) -> None:
        self._planes, self.placements = planes, placements

    def __len__(self) -> int:
        return len(self._planes)

    def __getitem__(self, k: int) -> Array:
        plane = self._planes[k]
        placement = self.placements[k]
        return plane if placement == Placement() else resampled(plane, placement, cv2.INTER_LANCZOS4)


def narrowest_field(chain: Sequence[Placement]) -> int:
    """Index of the most magnified plane: its whole field is seen by all others."""
    return int(np.argmax([placement.scale for placement in chain]))


def placements(planes: Planes) -> tuple[int, list[Placement]]:
    """Return the reference plane and where its points lie in every plane."""
    chain = [Placement()]
    for first, second in pairwise(grey_pyramid(planes[k]) for k in range(len(planes))):
        chain.append(chain[-1].then(match(first, second)))
    reference = narrowest_field(chain)
    back = chain[reference].inverse()
    return reference, [Placement() if k == reference else back.then(p) for k, p in enumerate(chain)]


def typical_step(planes: Planes) -> float:
    """Movement in pixels from plane to plane that goes on through the stack, as breathing and drift do.

    The median placement of a few neighbouring pairs; a pair that does not look alike once it is matched counts as
    unmoved.
    """
    count = len(planes) - 1
    if count < 1:
        return 0.0
    starts = sorted({round(k) for k in np.linspace(0, count - 1, min(PROBES, count))})
    found = [pair_placement(planes[k], planes[k + 1]) for k in starts]
    scale, dx, dy = (float(x) for x in np.median([(p.scale, p.dx, p.dy) for p in found], axis=0))
    side: int = max(planes[0].shape[:2])
    return Placement(scale, dx, dy).corner_shift() * side


def pair_placement(first: Array, second: Array) -> Placement:
    """Placement of one plane in the next, none unless they correlate once matched."""
    a, b = grey_pyramid(first), grey_pyramid(second)
    placement = match(a, b)
    moved = resampled(b[-1], placement, cv2.INTER_LINEAR)
    inside = inner(moved.shape)
    return placement if correlation(a[-1][inside], moved[inside]) >= ALIKE else Placement()


def correlation(a: Array, b: Array) -> float:
    """Correlation coefficient of two images, 0 when one of them is flat."""
    a, b = a - a.mean(), b - b.mean()
    spread = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / spread if spread > 0 else 0.0
