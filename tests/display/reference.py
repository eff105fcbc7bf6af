"""Slow float64 versions of the techniques, written from their formulas: what both executors are held to."""

import numpy as np
from scipy import ndimage

from display.resolve import Camera
from display.scene import Volume


class Reference:
    """Samples of every ray of a camera through one band, at the middles of equal steps.

    Attributes
    ----------
    v : array (steps, height, width)
        Values between 0 and 1; NaN beyond the end of a ray.
    t, ds : arrays
        Place behind the screen plane and length of the steps, µm.
    """

    def __init__(self, volume: Volume, camera: Camera, step_um: float) -> None:
        self.band, self.volume, self.camera = volume.bands[0], volume, camera
        width, height = camera.size
        j, i = np.mgrid[:height, :width]
        start = camera.corner + i[..., None] * camera.right + j[..., None] * camera.down
        way = np.broadcast_to(camera.along, start.shape) if camera.eye is None else start - camera.eye
        reach = np.linalg.norm(way, axis=-1)
        self.start, self.way = start, way / reach[..., None]
        half = volume.size_um / 2
        with np.errstate(divide="ignore"):
            one, two = (-half - start) / self.way, (half - start) / self.way
        near, far = np.minimum(one, two).max(axis=-1), np.maximum(one, two).min(axis=-1)
        near = near if camera.eye is None else np.maximum(near, -reach)
        length = np.maximum(far - near, 0)
        self.hit, self.near, self.length = length > 0, near, length
        steps = np.ceil(length / step_um)
        self.ds = np.where(self.hit, length / np.maximum(steps, 1), 0)
        k = np.arange(int(steps.max()))[:, None, None]
        self.t = np.where(k < steps, near + (k + 0.5) * self.ds, np.nan)
        self.v = self.value(self.t)

    def points(self, t):
        return self.start + t[..., None] * self.way

    def value(self, t):
        index = self.points(t) / self.volume.voxel_um + (np.array(self.volume.shape[::-1]) - 1) / 2
        flat = np.moveaxis(index[..., ::-1], -1, 0)
        low, high = self.band.limits
        raw = ndimage.map_coordinates(self.band.values.astype(float), np.nan_to_num(flat), order=1, mode="nearest")
        return np.where(np.isnan(t), np.nan, np.clip((raw - low) / (high - low), 0, 1))

    def maximum(self):
        return np.where(self.hit, np.nanmax(np.where(self.hit, self.v, 0), axis=0), 0)

    def minimum(self):
        return np.where(self.hit, np.nanmin(np.where(self.hit, self.v, 0), axis=0), 0)

    def emission(self, fade_per_um=0.0, front_um=0.0):
        faded = np.exp(-fade_per_um * np.maximum(self.t - front_um, 0))
        return np.nansum(self.v * faded, axis=0) * self.ds

    def translucent(self, table):
        """Light (height, width, 3) and what comes through, by the table (256, 4) of light and absorption."""
        light, left = np.zeros((*self.ds.shape, 3)), np.ones(self.ds.shape)
        grid = np.linspace(0, 1, len(table))
        for v in self.v:
            seen = ~np.isnan(v)
            mu = np.where(seen, np.interp(np.nan_to_num(v), grid, table[:, 3]), 0)
            through = np.exp(-mu * self.ds)
            for c in range(3):
                light[..., c] += left * (1 - through) * np.interp(np.nan_to_num(v), grid, table[:, c]) * seen
            left = left * through
        return light, left

    def first(self, threshold):
        """Distance of the first sample that is not below the threshold, NaN without one."""
        reached = self.v >= threshold
        k = reached.argmax(axis=0)
        return np.where(reached.any(axis=0), np.take_along_axis(self.t, k[None], 0)[0], np.nan)
