"""What is shown, as frozen data: layers, how each looks, from where, and in what stereo.

Space is (x, y, z) in µm around the middle of the volume: x to the right, y down, z away from the viewer who looks along
the planes' axis, so that the picture of a plane is the plane. Arrays stay (z, y, x).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from devices.errors import DisplayError
from display.light import linear_of
from display.stereo import Stereo

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]
    Vector = tuple[float, float, float]

TABLE_ENTRIES = 256
Interpolation = Literal["nearest", "trilinear"]


@dataclass(frozen=True, eq=False)
class Band:
    """One band of a volume.

    Attributes
    ----------
    values : array (z, y, x)
        uint8 or uint16, contiguous, read-only.
    limits : (float, float)
        Values shown as nothing and as full.
    name, unit : str
        For the colour bar.
    colour : str or tuple of (value, r, g, b)
        Colour table by name, the colour of full as ``#rrggbb`` (nothing is black), or sRGB colours, 0 to 1, of values,
        with straight lines between.
    stand_for : (float, float), optional
        What the limits stand for, where values are codes of something else; the colour bar shows these.
    """

    values: Array
    limits: tuple[float, float]
    name: str = "grey level"
    unit: str = ""
    colour: str | tuple[tuple[float, float, float, float], ...] = "gray"
    stand_for: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class Volume:
    """What was taken: bands of equal shape on one grid.

    Attributes
    ----------
    spacing_um : (float, float, float)
        Along (z, y, x), in ``unit``.
    unit : str
        "µm", or "voxels" where no size is known.
    depth : str
        What the first axis is: "z", or "t" for a series in time.
    notes : tuple of str
        What was assumed.
    """

    bands: tuple[Band, ...]
    spacing_um: Vector = (1.0, 1.0, 1.0)
    unit: str = "µm"
    depth: str = "z"
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        shapes = {band.values.shape for band in self.bands}
        if len(shapes) != 1 or 0 in self.shape or len(self.shape) != 3:
            raise DisplayError(f"there is no volume in bands of {sorted(shapes)}.", fix="give bands of one shape.")
        if not all(np.isfinite(s) and s > 0 for s in self.spacing_um):
            raise DisplayError(f"voxels of {self.spacing_um} µm cannot be shown.", fix="give positive sizes.")

    @property
    def shape(self) -> tuple[int, ...]:
        """(z, y, x)."""
        return tuple(self.bands[0].values.shape)

    @property
    def voxel_um(self) -> NDArray[np.float64]:
        """Size of a voxel along (x, y, z)."""
        return np.array(self.spacing_um[::-1], np.float64)

    @property
    def size_um(self) -> NDArray[np.float64]:
        """Size of the whole along (x, y, z)."""
        return np.asarray(self.voxel_um * self.shape[::-1])


@dataclass(frozen=True)
class Light:
    """A distant light and how a surface answers it (ambient, diffuse, specular, breadth as an exponent)."""

    azimuth_deg: float = -35.0
    "Direction the light comes from: to the right of the viewer."
    elevation_deg: float = 40.0
    "And above."
    ambient: float = 0.15
    "Light from everywhere."
    diffuse: float = 0.75
    "Share scattered in all directions."
    specular: float = 0.25
    "Share mirrored."
    shininess: float = 20.0
    "Exponent of the mirrored lobe; large is narrow."


@dataclass(frozen=True)
class Transfer:
    """Opacity against value.

    Attributes
    ----------
    points : tuple of (value, opacity)
        Value in the band's own numbers, rising; opacity over one ``unit_um``, 0 to 1; straight lines between.
    unit_um : float, optional
        Depth over which the opacities are meant; the smallest side of a voxel when left out.
    """

    points: tuple[tuple[float, float], ...] = ()
    unit_um: float | None = None


@dataclass(frozen=True)
class VolumeLook:
    """How a volume is cast; every mode takes from it what it needs.

    Attributes
    ----------
    interpolation : {"trilinear", "nearest"}
    step : float
        Distance of samples along a ray, in smallest sides of a voxel.
    threshold : float, optional
        Value a surface has; midway between the band's limits when left out.
    contrast : float, optional
        Absorption of a full value, per µm: I/I0 = exp(-contrast · Σ value · length). So that the densest columns
        let 5 % through when left out.
    fade : float
        Share of the light lost from the front of the data to its back, 0 to below 1.
    transfer : Transfer
    light : Light
    surface : float
        Opacity of a lit surface within a translucent volume; 0 is no surface.
    shadow : {"none", "rear", "self", "both"}
        Shadow on a plane behind, of features on each other.
    cut : tuple of (low, high)
        What is shown along x, y and z, as shares of the whole.
    """

    interpolation: Interpolation = "trilinear"
    step: float = 1.0
    threshold: float | None = None
    contrast: float | None = None
    fade: float = 0.0
    transfer: Transfer = Transfer()
    light: Light = Light()
    surface: float = 0.0
    shadow: Literal["none", "rear", "self", "both"] = "none"
    cut: tuple[tuple[float, float], ...] = ((0.0, 1.0), (0.0, 1.0), (0.0, 1.0))


@dataclass(frozen=True)
class SliceLook:
    """How planes through a volume are shown.

    Attributes
    ----------
    interpolation : {"trilinear", "nearest"}
        Between voxels, or voxels shown as thick as they are.
    at : (x, y, z)
        Place of the planes, as shares of the whole.
    turn_deg, tilt_deg : float
        Direction of an oblique plane: its normal as that of a viewer who moves to the right, and up.
    transparent : float, optional
        Values below are not drawn.
    tint : bool
        Planes are tinted by their orientation.
    gap : float
        Distance of parallel planes, as a multiple of the true one.
    planes : int
        How many parallel planes.
    light : Light
    """

    interpolation: Interpolation = "trilinear"
    at: Vector = (0.5, 0.5, 0.5)
    turn_deg: float = 0.0
    tilt_deg: float = 0.0
    transparent: float | None = None
    tint: bool = False
    gap: float = 2.0
    planes: int = 6
    light: Light = Light()


@dataclass(frozen=True)
class View:
    """Where the viewer stands.

    Attributes
    ----------
    azimuth_deg, elevation_deg : float
        Viewer moves to the right, and up; 0, 0 looks along the planes' axis.
    roll_deg : float
        Turns the picture clockwise.
    zoom : float
        1 fits the whole.
    perspective_deg : float
        Angle of view over the shorter side; 0 is a parallel view.
    centre_um : (float, float, float)
        Point (x, y, z) in the middle of the picture, from the middle of the volume.
    pixel_um : float, optional
        Size of a pixel in the screen plane; goes before ``zoom``.
    """

    azimuth_deg: float = 0.0
    elevation_deg: float = 0.0
    roll_deg: float = 0.0
    zoom: float = 1.0
    perspective_deg: float = 0.0
    centre_um: Vector = (0.0, 0.0, 0.0)
    pixel_um: float | None = None


@dataclass(frozen=True, eq=False)
class Layer:
    """Data drawn in one mode.

    Attributes
    ----------
    data : object
        `Volume`, or what else the mode takes.
    mode : str
        A name from `display.modes`.
    look : object, optional
        Frozen options of the mode's kind; the mode's own when left out.
    """

    data: Any
    mode: str
    look: Any = None

    def __post_init__(self) -> None:
        if self.look is None:
            from display.modes import find_mode  # noqa: PLC0415  modes are made of scenes

            object.__setattr__(self, "look", find_mode(self.mode).look())

    @property
    def size_um(self) -> NDArray[np.float64]:
        """Size along (x, y, z) of a box around the origin that holds what is drawn."""
        size: NDArray[np.float64] = self.data.size_um
        return size * (1.0, 1.0, self.look.gap) if self.mode == "exploded" else size


@dataclass(frozen=True, eq=False)
class Scene:
    """All there is to see."""

    layers: tuple[Layer, ...]
    view: View = field(default_factory=View)
    stereo: Stereo = field(default_factory=Stereo)
    background: Vector = (0.0, 0.0, 0.0)

    @property
    def size_um(self) -> NDArray[np.float64]:
        """Size along (x, y, z) of a box around the origin that holds everything."""
        return np.asarray(np.max([layer.size_um for layer in self.layers], axis=0))


def colour_table(colour: str) -> NDArray[np.float32]:
    """Return 256 sRGB colours, (256, 3), from nothing to full, of a table's name or of ``#rrggbb``.

    Raises
    ------
    DisplayError
        ``colours-unknown``: no such table or colour.
    """
    ramp = np.linspace(0, 1, TABLE_ENTRIES)
    if colour == "gray":
        return np.repeat(ramp[:, None], 3, axis=1).astype(np.float32)
    from matplotlib import colormaps  # noqa: PLC0415  half a second that most programs do not need
    from matplotlib.colors import to_rgb  # noqa: PLC0415

    if colour in colormaps:
        return np.asarray(colormaps[colour](ramp)[:, :3], np.float32)
    try:
        return np.asarray(ramp[:, None] * np.array(to_rgb(colour)), np.float32)
    except ValueError:
        raise DisplayError(
            f"there is no colour table {colour!r}.",
            fix="gray, viridis, magma, hot, turbo or another of matplotlib's names, or a colour such as #00ff80",
            code="colours-unknown",
        ) from None


def band_colours(band: Band) -> NDArray[np.float32]:
    """Return 256 sRGB colours, (256, 3), of the values between a band's limits. Errors as `colour_table`."""
    if isinstance(band.colour, str):
        return colour_table(band.colour)
    values, given = np.linspace(*band.limits, TABLE_ENTRIES), np.array(band.colour)
    return np.stack([np.interp(values, given[:, 0], given[:, 1 + c]) for c in range(3)], axis=1).astype(np.float32)


def transfer_table(band: Band, transfer: Transfer, unit_um: float) -> NDArray[np.float32]:
    """Return linear light and absorption of 256 values between the band's limits, (256, 4): r, g, b, per µm.

    An opacity a over the depth d is the absorption μ = -ln(1 - a) / d, so that it does not depend on steps
    (Max 1995, IEEE TVCG 1, 99). Without points, opacity rises in a straight line from 0 to 0.1.
    """
    values = np.linspace(*band.limits, TABLE_ENTRIES)
    points = np.array(transfer.points or ((band.limits[0], 0.0), (band.limits[1], 0.1)), np.float64)
    opacity = np.clip(np.interp(values, points[:, 0], points[:, 1]), 0, 1 - 1e-6)
    colours = band_colours(band)
    absorption = -np.log1p(-opacity) / (transfer.unit_um or unit_um)
    return np.column_stack([linear_of(colours), absorption]).astype(np.float32)
