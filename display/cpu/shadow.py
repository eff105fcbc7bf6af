"""How much light reaches every voxel, and a plane behind: matter that shadows itself."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]


def reaching_light(
    values: Array, absorption: Array, to_light: Array, voxel_um: Array, limits: tuple[float, float]
) -> Array:
    """Return the share of a distant light that reaches the middle of each voxel, (z, y, x) uint8, 255 for all of it.

    The volume is swept plane by plane along the axis nearest to the light; what comes through one plane is shifted,
    with linear interpolation, to where it meets the next.

    Parameters
    ----------
    values : array (z, y, x)
    absorption : array (256,)
        Per µm, of values between the limits.
    to_light : array (3,)
        Unit vector (x, y, z).
    voxel_um : array (3,)
        Size of a voxel, (x, y, z).
    """
    steps = to_light / voxel_um  # voxels per µm towards the light
    axis = int(np.abs(steps).argmax())
    order = (2 - axis, *(k for k in range(3) if k != 2 - axis))  # that array axis first, rows and columns after it
    swept = np.transpose(values, order)
    reached = np.empty(swept.shape, np.uint8)
    way = steps / abs(steps[axis])
    rows, columns = (2 - k for k in order[1:])
    shift = np.array([[1, 0, -way[columns]], [0, 1, -way[rows]]], np.float64)
    lost = absorption * float(np.linalg.norm(way * voxel_um))
    scale = (len(absorption) - 1) / (limits[1] - limits[0])
    planes = range(len(swept)) if steps[axis] < 0 else range(len(swept) - 1, -1, -1)
    light: Array = np.ones(swept.shape[1:], np.float32)
    for k in planes:
        entry = np.clip((swept[k] - limits[0]) * scale, 0, len(absorption) - 1).astype(np.intp)
        half = np.exp(-0.5 * lost[entry]).astype(np.float32)
        reached[k] = np.rint(light * half * 255)
        light = cv2.warpAffine(light * half * half, shift, light.shape[::-1], flags=cv2.INTER_LINEAR, borderValue=1.0)
    return np.ascontiguousarray(np.transpose(reached, np.argsort(order)))
