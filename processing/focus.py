"""Extended focus and range image of a focal stack, measured plane by plane as it is taken.

Where a surface is in focus its image is sharpest. `FocusSweep` follows the sharpness of every pixel through the planes
and keeps only what is needed to place the peak between planes; `gather` then composes the picture that is sharp
everywhere. `focus_stack` does both for a whole stack and gives the same bits as planes added one by one.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from devices.errors import InputError
from processing.focus_kernels import BLOCK, blend, mean_of
from processing.focus_pyramid import SoftPyramid
from processing.focus_tracks import Measured, Method, Options, mean_light, one_band, read_only, track_for
from processing.focus_windows import CONFIDENT, HALO, WINDOWS
from processing.registration import SMALLEST_SIDE, RegisteredPlanes, placements, typical_step

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from processing.registration import Planes

    Array = NDArray[Any]

REGISTER_FROM_PX = 1.0
GATHER_SHARE = 0.45  # depth over which planes are averaged, to either side, as a share of the focus curve's width
SHARPNESS = frozenset({"brightfield", "transparent"})
SMALLEST_STACK = 3  # with fewer planes there is no peak to speak of
NOISE_SAMPLES = 32768  # responses of the mask from which the camera's noise is estimated
MASK_GAIN = 6.0  # of the mask [1 -2 1]⊗[1 -2 1] for white noise
WEAKER_HALF = 0.3247  # mean absolute value of the weaker half of normal deviates
ROUNDING = 12**-0.5


@dataclass(frozen=True)
class RangeImage:
    """What a focal stack says about depth; all arrays (height, width).

    Attributes
    ----------
    range_ : array float32
        Position of best focus in the unit of ``z``: µm, or planes counted from 0.
    confidence : array float32
        (max - mean) / mean of the sharpness through the stack; for confocal stacks (max - mean) / (mean + 6 noise) of
        the brightness; for a threshold, by how much the brightest value passes it over 6 noise. 0 where nothing is
        known.
    plane : array uint16
        Plane nearest to the best focus; the brightest plane of a confocal stack; the first one over the threshold.
    width : array float32
        Width of the focus curve at half its height, in the unit of ``z``; 0 where it has none.
    edge : array bool
        Best focus in the first or last plane: the surface may lie outside the stack.
    noise : float
        Camera noise (rms) in grey levels.
    z : array (planes,) float64
        Position of every plane.
    """

    range_: NDArray[np.float32]
    confidence: NDArray[np.float32]
    plane: NDArray[np.uint16]
    width: NDArray[np.float32]
    edge: NDArray[np.bool_]
    noise: float
    z: NDArray[np.float64]


@dataclass(frozen=True)
class FocusResult:
    """Everything `focus_stack` finds out.

    Attributes
    ----------
    extended_focus : array like a plane
        Every pixel from the planes where it is in focus.
    range, confidence, plane, width
        As in `RangeImage`.
    unit : {"um", "plane"}
        Unit of ``range``.
    noise : float
        Camera noise (rms) in grey levels.
    share_confident : float
        Share of pixels with a confidence of at least ``parameters["confident"]``.
    parameters : dict
        Every choice that was made, also the ones made by the program.
    filled : array bool, optional
        Where the range was filled from around.
    """

    extended_focus: Array
    range: NDArray[np.float32]
    confidence: NDArray[np.float32]
    plane: NDArray[np.uint16]
    width: NDArray[np.float32]
    unit: Literal["um", "plane"]
    noise: float
    share_confident: float
    parameters: dict[str, Any]
    filled: NDArray[np.bool_] | None = None


class FocusSweep:
    """Measures focus plane by plane; keeps a state of fixed size and none of the planes.

    Parameters
    ----------
    shape : (height, width)
        Size of a plane in pixels.
    method : Method
        brightfield: sharpness of opaque surfaces; transparent: the same, with a picture of its own for specimens that
        have no one depth; confocal: brightness of optical sections; threshold: first plane that is bright enough.
    threshold : float, optional
        Grey level for the method threshold.
    band : int, optional
        The band of colour planes that decides; all of them together when left out.

    Raises
    ------
    InputError
        ``focus-threshold``: the method threshold without one, or one without the method.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        *,
        method: Method = "brightfield",
        threshold: float | None = None,
        band: int | None = None,
    ) -> None:
        self.shape = shape
        self.method = method
        self.count = 0
        self.noise = np.inf
        self._blank: list[int] = []
        self._band = band
        self._threshold = threshold
        self._track = track_for(method, shape, threshold)
        self._soft = SoftPyramid(shape) if method == "transparent" else None

    @property
    def _noise_so_far(self) -> float:
        return self.noise if np.isfinite(self.noise) else ROUNDING

    @property
    def state_bytes_per_pixel(self) -> float:
        """Bytes of state for every pixel of a plane, work space included."""
        held = self._track.nbytes + (self._soft.nbytes if self._soft else 0)
        return held / (self.shape[0] * self.shape[1])

    def add(self, plane: Array, about: PlaneFacts | None = None) -> None:
        """Take the next plane, (height, width) or (height, width, 3), uint8 or uint16.

        Parameters
        ----------
        plane : array
        about : PlaneFacts, optional
            Where this is a part of a plane: what is to be known of all of it.
        """
        check_plane(plane, self.shape)
        plane = read_only(plane)
        about = plane_facts(plane, self._band) if about is None else about
        if about.noise is None:
            self._blank.append(self.count)
        else:
            self.noise = min(self.noise, about.noise)
        self._track.add(one_band(plane, self._band), self.count, about.light)
        if self._soft:
            self._soft.add(plane, self._noise_so_far)
        self.count += 1

    def preview(self) -> RangeImage:
        """Return the range so far, in planes."""
        return self.finish()

    def finish(self, z_um: Array | None = None) -> RangeImage:
        """Return the range image of the planes taken so far; more may be added afterwards.

        Parameters
        ----------
        z_um : array (planes,), optional
            Position of every plane, rising or falling, evenly spaced or not; plane numbers when left out.

        Raises
        ------
        InputError
            No plane was added, or the positions are no strictly rising or falling sequence of finite numbers.
        """
        z = plane_positions(z_um, self.count)
        noise = self._noise_so_far
        measured = self._track.measured(z, noise)
        if self.count < SMALLEST_STACK:
            measured = nothing_known(measured, z)
        position, confidence, width, plane = measured
        edge = (plane == 0) | (plane == self.count - 1)
        return RangeImage(position, confidence, plane, width, edge, noise, z)

    def compose(self, planes: Iterable[Array], image: RangeImage, *, unit: Literal["um", "plane"]) -> FocusResult:
        """Make the extended focus for a finished range image and sum up what was found.

        Parameters
        ----------
        planes : iterable of arrays
            All planes again, in order; not looked at by the method transparent.
        image : RangeImage
            What `finish` returned.
        unit : {"um", "plane"}
            Unit of its positions.
        """
        reach = gather_reach(image) if self.method == "brightfield" else 0.0
        picture = gather(planes, image, reach) if self._soft is None else self.soft_picture()
        return FocusResult(
            extended_focus=picture,
            range=image.range_,
            confidence=image.confidence,
            plane=image.plane,
            width=image.width,
            unit=unit,
            noise=image.noise,
            share_confident=float(np.mean(image.confidence >= CONFIDENT)),
            parameters=made_choices(
                {"method": self.method, "threshold": self._threshold, "band": self._band},
                planes=image.z.size,
                blank=self._blank,
                width=curve_width(image),
                reach=reach,
                share_in_end_planes=float(np.mean(image.edge)),
            ),
        )

    def soft_picture(self) -> Array:
        """Return the extended focus of the method transparent, of the planes taken so far."""
        assert self._soft is not None
        return self._soft.picture()


def made_choices(
    options: Options, *, planes: int, blank: Sequence[int], width: float, reach: float, share_in_end_planes: float
) -> dict[str, Any]:
    """Return every choice that was made, for a report."""
    return {
        "method": options["method"],
        "planes": planes,
        "threshold": options.get("threshold"),
        "band": options.get("band"),
        "confident": CONFIDENT,
        "focus_curve_width": width,
        "gather_reach": reach,
        "blank_planes": list(blank),
        "share_in_end_planes": share_in_end_planes,
        **({"windows": [asdict(w) for w in WINDOWS], "halo": HALO} if options["method"] in SHARPNESS else {}),
    }


def nothing_known(measured: Measured, z: NDArray[np.float64]) -> Measured:
    """Keep the better plane of two, and claim nothing about what lies between them."""
    _, confidence, width, plane = measured
    return Measured(z[plane].astype(np.float32), np.zeros_like(confidence), np.zeros_like(width), plane)


def gather(planes: Iterable[Array], image: RangeImage, reach: float) -> Array:
    """Compose the picture in focus everywhere: the mean of the planes near the surface.

    Parameters
    ----------
    planes : iterable of arrays
        All planes again, in order.
    image : RangeImage
        Where the surface is.
    reach : float
        Distance in the unit of ``image.z`` at which a plane has no more weight, (1 - (distance / reach)²)² before;
        0 takes the nearest plane alone.

    Returns
    -------
    array
        Like a plane.
    """
    position, nearest = image.range_.reshape(-1), image.plane.reshape(-1)
    bounds = block_bounds(position, image.z, reach)
    sums = out = np.empty((0, 0), np.float32)
    for k, plane in enumerate(planes):
        pixels = read_only(plane).reshape(position.size, -1)
        if not k:
            sums = np.zeros((pixels.shape[0], pixels.shape[1] + 1), np.float32)
            out = np.empty_like(plane)
        blend(pixels, position, nearest, bounds, k, image.z[k], reach, sums)
    mean_of(sums, out.reshape(position.size, -1))
    return out


def block_bounds(position: Array, z: NDArray[np.float64], reach: float) -> Array:
    """Lowest and highest z that matter to every block of pixels, (2, blocks)."""
    starts = np.arange(0, position.size, BLOCK)
    widest_gap = float(np.abs(np.diff(z)).max()) if z.size > 1 else 0.0
    margin = max(reach, widest_gap)
    return np.stack([np.minimum.reduceat(position, starts) - margin, np.maximum.reduceat(position, starts) + margin])


def focus_stack(
    planes: Planes,
    *,
    z_um: Array | None = None,
    method: Method = "brightfield",
    register: bool | Literal["auto"] = "auto",
    threshold: float | None = None,
    band: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> FocusResult:
    """Make the extended focus and the range image of a whole stack.

    Parameters
    ----------
    planes : sequence of arrays (height, width[, 3]) uint8 or uint16
        Read one at a time, each of them twice.
    z_um : array (planes,), optional
        Position of every plane in µm; the range is in planes counted from 0 when left out.
    method, threshold, band
        As in `FocusSweep`.
    register : bool or "auto"
        Match the planes by translation and scale first. ``"auto"`` does it where sharpness is measured and planes move
        by a pixel or more from one to the next throughout; ``parameters["registration"]`` says what was done.
    progress : callable, optional
        Is told the share of the work done, 0 to 1.

    Raises
    ------
    InputError
        No planes, planes of different size, or positions that make no sense.
    """
    plane_positions(z_um, len(planes))
    height, width = planes[0].shape[:2]
    shape = (height, width)
    checked = CheckedPlanes(planes, shape)
    placed, registration = registered(checked, wanted=register if method in SHARPNESS else register is True)
    sweep = FocusSweep(shape, method=method, threshold=threshold, band=band)
    for plane in told(placed, progress, 0.0):
        sweep.add(plane)
    unit: Literal["um", "plane"] = "plane" if z_um is None else "um"
    result = sweep.compose(told(placed, progress, 0.5), sweep.finish(z_um), unit=unit)
    result.parameters["registration"] = registration
    return result


class CheckedPlanes:
    """Planes of a sequence, each refused with a clear error when it is read and does not fit the others."""

    def __init__(self, planes: Planes, shape: tuple[int, int]) -> None:
        self._planes, self._shape = planes, shape

    def __len__(self) -> int:
        return len(self._planes)

    def __getitem__(self, k: int) -> Array:
        plane = self._planes[k]
        check_plane(plane, self._shape)
        return plane


def registered(planes: Planes, *, wanted: bool | Literal["auto"]) -> tuple[Planes, dict[str, Any]]:
    """Return the planes, registered if ``wanted`` and needed, and words and numbers on what was done."""
    if not wanted:
        return planes, {"applied": False, "why": "not asked for"}
    if min(planes[0].shape[:2]) < SMALLEST_SIDE:
        return planes, {"applied": False, "why": f"planes under {SMALLEST_SIDE} pixels show too little to be matched"}
    step_px = typical_step(planes)
    if wanted == "auto" and step_px < REGISTER_FROM_PX:
        why = f"planes move by less than {REGISTER_FROM_PX:g} pixel from one to the next"
        return planes, {"applied": False, "why": why, "step_px": step_px}
    reference, places = placements(planes)
    return RegisteredPlanes(planes, places), {
        "applied": True,
        "step_px": step_px,
        "reference_plane": reference,
        "scale": [p.scale for p in places],
    }


def curve_width(image: RangeImage) -> float:
    """Typical width of the focus curve where it is known with confidence, 0 when it is nowhere."""
    known = sure_widths(image.confidence, image.width)
    return float(np.median(known)) if known.size else 0.0


def sure_widths(confidence: Array, width: Array) -> Array:
    """Return the widths of the focus curve that are known with confidence."""
    return width[(confidence >= CONFIDENT) & (width > 0)]


def gather_reach(image: RangeImage) -> float:
    """Depth over which planes are equally sharp; 0 where they are too far apart for any averaging but a softening."""
    return reach_of(curve_width(image), image.z)


def reach_of(width: float, z: NDArray[np.float64]) -> float:
    """Return the reach that goes with a typical width of the focus curve."""
    spacing = float(np.median(np.abs(np.diff(z)))) if z.size > 1 else 0.0
    reach = GATHER_SHARE * width
    return reach if reach >= spacing else 0.0


def told(planes: Planes, progress: Callable[[float], None] | None, start: float) -> Iterator[Array]:
    """Yield the planes and tell the progress from ``start`` through one half of the work."""
    for k in range(len(planes)):
        yield planes[k]
        if progress:
            progress(start + 0.5 * (k + 1) / len(planes))


def plane_positions(z_um: Array | None, count: int) -> NDArray[np.float64]:
    """Return the position of every plane, checked; plane numbers when ``z_um`` is None."""
    if not count:
        raise InputError("There is no plane to measure.", fix="give a stack of at least one plane.", code="stack-empty")
    if z_um is None:
        return np.arange(count, dtype=np.float64)
    z = np.asarray(z_um, np.float64)
    if z.shape != (count,):
        raise InputError(f"{z.size} z positions for {count} planes.", fix="give one position for each plane.")
    steps = np.diff(z)
    if not np.isfinite(z).all() or not ((steps > 0).all() or (steps < 0).all()):
        raise InputError(
            "The z positions are not a strictly rising or falling sequence of numbers.",
            fix="sort the planes by z, and leave out --step-um or the metadata that is wrong.",
            code="stack-z",
        )
    return z


def check_plane(plane: Array, shape: tuple[int, int]) -> None:
    """Raise `InputError` unless ``plane`` is a grey or colour image of ``shape``, uint8 or uint16."""
    if plane.shape[:2] != shape or plane.ndim > 3 or plane.shape[2:] not in {(), (3,)}:
        raise InputError(
            f"A plane is {plane.shape}, the stack {shape[0]}×{shape[1]} pixels.",
            fix="give planes of one size, grey or RGB.",
            code="stack-shape",
        )
    if plane.dtype not in (np.uint8, np.uint16):
        raise InputError(f"A plane is {plane.dtype}.", fix="give 8 or 16 bit unsigned planes.", code="stack-dtype")


class PlaneFacts(NamedTuple):
    """What must be known of a whole plane: its noise in grey levels, None where it shows nothing, and its mean."""

    noise: float | None
    light: float


def plane_facts(plane: Array, band: int | None) -> PlaneFacts:
    """Return what must be known of a plane of which a band decides."""
    noise = None if plane.min() == plane.max() else plane_noise(plane)
    return PlaneFacts(noise, mean_light(one_band(plane, band)))


def plane_noise(plane: Array) -> float:
    """Estimate the camera's noise (rms, grey levels) in one plane, rounding to whole grey levels included.

    From the weaker half of the responses of the mask [1 -2 1]⊗[1 -2 1] (after Immerkær 1996, Comput. Vis. Image Und.
    64:300, who takes the mean of all): texture that fills less than half of the plane hardly counts.
    """
    if min(plane.shape[:2]) < 3:
        return ROUNDING
    every = max(1, plane.shape[0] * plane.shape[1] // NOISE_SAMPLES)
    above, row, below = (plane[i : plane.shape[0] - 2 + i : every].astype(np.float32) for i in range(3))
    down = above - 2 * row + below
    response = np.abs(down[:, :-2] - 2 * down[:, 1:-1] + down[:, 2:]).reshape(-1)
    half = max(1, response.size // 2)
    weaker = np.partition(response, half - 1)[:half]
    return max(ROUNDING, float(weaker.mean()) / (MASK_GAIN * WEAKER_HALF))
