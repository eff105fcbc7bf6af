"""A camera that replays images: each is the plane at one z, and a trigger takes the one nearest to the stage."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import tifffile

from devices.drivers.cropping import Crop, check_exposure
from devices.errors import DeviceError, InputError, RigError
from devices.values import CameraCaps, FrameStamp

if TYPE_CHECKING:
    from collections.abc import Callable

    from devices.protocols import Clock, FrameSink
    from devices.registry import DeviceContext
    from devices.rig import CameraSpec
    from devices.values import Roi

TIFF = frozenset({".tif", ".tiff"})
SUFFIXES = TIFF | {".png", ".jpg", ".jpeg"}


class FolderCamera:
    """Replays one image per plane.

    Parameters
    ----------
    images : list of (name, reader)
        In the order of their z.
    spec : CameraSpec
        ``z0_um`` and ``step_um`` say which z they stand for.
    position_um : callable
        Where the stage is.
    clock : Clock
        Time.

    Raises
    ------
    InputError
        An image cannot be read, is of another size or kind than the first, or is no camera frame.
    """

    def __init__(
        self,
        images: list[tuple[str, Callable[[], np.ndarray]]],
        spec: CameraSpec,
        position_um: Callable[[], float],
        clock: Clock,
    ) -> None:
        if spec.step_um is None or spec.step_um == 0:
            raise RigError("camera: step_um must say how far apart the images are.", fix="set step_um = 1.0, say.")
        self._images = images
        self._z0_um, self._step_um = spec.z0_um, spec.step_um
        self._position_um = position_um
        self._clock = clock
        self._crop = Crop(_common_caps(images, spec))
        self._sink: FrameSink | None = None
        self._frames_left: int | None = None
        self._taken = 0

    def caps(self) -> CameraCaps:
        """Return what the images look like."""
        return self._crop.caps

    def configure(self, *, exposure_ms: float, roi: Roi | None = None) -> None:
        """Accept any exposure, for the images were exposed long ago, and any part of them."""
        check_exposure(exposure_ms)
        self._crop.choose(roi)

    def arm(self, frames: int | None, sink: FrameSink) -> None:
        """Get ready for a number of frames."""
        self._sink, self._frames_left = sink, frames

    def trigger(self) -> None:
        """Hand the image nearest to the stage to the sink.

        Raises
        ------
        DeviceError
            No image stands for a z within half a step of the stage.
        """
        if self._sink is None or self._frames_left == 0:
            raise DeviceError("camera: triggered without being armed for another frame.")
        start_ns = int(self._clock.now() * 1e9)
        pixels = self._crop(_read(*self._images[self._index_at(self._position_um())]))
        pixels.flags.writeable = False
        now_ns = int(self._clock.now() * 1e9)
        self._taken += 1
        self._frames_left = None if self._frames_left is None else self._frames_left - 1
        self._sink(pixels, FrameStamp(now_ns, self._taken, start_ns, now_ns))

    def stop(self, timeout_s: float) -> None:  # noqa: ARG002  nothing is under way between triggers
        """End the delivery."""
        self._sink = None

    def close(self) -> None:
        """Nothing to release."""
        self._sink = None

    def _index_at(self, z_um: float) -> int:
        index = round((z_um - self._z0_um) / self._step_um)
        if not 0 <= index < len(self._images):
            last_um = self._z0_um + (len(self._images) - 1) * self._step_um
            raise DeviceError(
                f"camera: there is no image for z = {z_um:+.2f} µm: "
                f"the {len(self._images)} images stand for {self._z0_um:g} … {last_um:g} µm.",
                fix="take the stack inside this range, or change z0_um and step_um in the instrument file.",
                code="no-image",
            )
        return index


def open_camera(table: CameraSpec, context: DeviceContext) -> FolderCamera:
    """Find the images of ``source`` and look at each of them.

    Raises
    ------
    InputError
        As `FolderCamera`; or there are no images.
    """
    if table.source is None or context.stage_position_um is None:
        raise RigError("camera: the driver 'folder' needs a source and a z stage.")
    return FolderCamera(find_images(Path(table.source)), table, context.stage_position_um, context.clock)


def find_images(source: Path) -> list[tuple[str, Callable[[], np.ndarray]]]:
    """Return name and reader of each image of a folder, in natural order, or of each page of a TIFF file."""
    if source.is_file():
        return _pages(source)
    if not source.is_dir():
        raise InputError(f"{source}: no such folder or file.", fix="correct source in the instrument file.")
    files = sorted((file for file in source.iterdir() if _is_image(file)), key=_natural)
    if not files:
        raise InputError(f"{source}: holds no PNG, JPEG or TIFF image.", fix="correct source in the instrument file.")
    return [(str(file), partial(_decode, file)) for file in files]


def _is_image(file: Path) -> bool:
    return file.suffix.lower() in SUFFIXES and not file.name.startswith(".")


def _natural(file: Path) -> list[tuple[int, str]]:
    """Sort key that puts z2 before z10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", file.name.lower())]


def _pages(source: Path) -> list[tuple[str, Callable[[], np.ndarray]]]:
    with _opened(source) as tiff:
        count = len(tiff.pages)
    return [(f"{source}, page {page + 1}", partial(_tiff_page, source, page)) for page in range(count)]


def _decode(file: Path) -> np.ndarray:
    if file.suffix.lower() in TIFF:
        return _tiff_page(file, 0, of=1)
    data = file.read_bytes()
    if _is_cut_off(data):
        raise ValueError("the file is cut off")
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ValueError("it does not decode")
    return _rgb(pixels)


def _is_cut_off(data: bytes) -> bool:
    """Tell whether a JPEG or PNG lacks its end: it would decode all the same, to a picture partly made up.

    In a JPEG the end mark must come after the last start of scan: a preview inside the file has marks of its own.
    """
    if data.startswith(b"\xff\xd8"):
        return data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda")
    return data.startswith(b"\x89PNG") and b"IEND\xaeB`\x82" not in data


def _rgb(pixels: np.ndarray) -> np.ndarray:
    """Return OpenCV's BGR or BGRA as RGB; grey as it is."""
    if pixels.ndim == 2:
        return pixels
    return np.ascontiguousarray(pixels[:, :, 2::-1])


def _opened(file: Path) -> tifffile.TiffFile:
    try:
        return tifffile.TiffFile(file)
    except (tifffile.TiffFileError, OSError, ValueError) as cause:
        raise InputError(f"{file}: cannot be read as TIFF: {cause}") from cause


def _tiff_page(file: Path, page: int, of: int | None = None) -> np.ndarray:
    with _opened(file) as tiff:
        if of is not None and len(tiff.pages) != of:
            raise ValueError(f"it holds {len(tiff.pages)} pages; give the file itself as source")
        pixels = tiff.pages[page].asarray()
    if pixels.ndim == 3 and pixels.shape[0] in (3, 4) and pixels.shape[2] not in (3, 4):
        pixels = np.moveaxis(pixels, 0, 2)
    return np.ascontiguousarray(pixels[:, :, :3]) if pixels.ndim == 3 else pixels


def _read(name: str, reader: Callable[[], np.ndarray]) -> np.ndarray:
    try:
        pixels = reader()
    except (OSError, ValueError, cv2.error, tifffile.TiffFileError, IndexError) as cause:
        raise InputError(
            f"{name}: cannot be read as an image: {cause}", fix="copy the file again, or take it out of the folder."
        ) from cause
    if pixels.dtype not in (np.uint8, np.uint16) or pixels.ndim not in (2, 3) or pixels.shape[2:] not in ((), (3,)):
        raise InputError(f"{name}: {pixels.shape} {pixels.dtype} is no camera frame: 8 or 16 bit, grey or RGB only.")
    return pixels


def _common_caps(images: list[tuple[str, Callable[[], np.ndarray]]], spec: CameraSpec) -> CameraCaps:
    """Read every image once, so that a bad one is known before anything moves."""
    first_name, first = images[0][0], _read(*images[0])
    for name, reader in images[1:]:
        pixels = _read(name, reader)
        if (pixels.shape, pixels.dtype) != (first.shape, first.dtype):
            raise InputError(
                f"{name}: {_kind(pixels)}, but {first_name}: {_kind(first)}.",
                fix="the planes of a stack are all of one size and kind: take the odd ones out.",
            )
    height, width = first.shape[:2]
    if spec.size_px is not None and spec.size_px != (width, height):
        raise RigError(f"camera: size_px is {list(spec.size_px)}, but the images are {width} x {height} px.")
    depth = 8 if first.dtype == np.uint8 else spec.bit_depth if spec.bit_depth > 8 else 16
    bands = 1 if first.ndim == 2 else 3
    return CameraCaps("folder", height, width, bands, str(first.dtype), depth, timed=True, numbered=True)


def _kind(pixels: np.ndarray) -> str:
    return f"{pixels.shape[1]} x {pixels.shape[0]} px {'grey' if pixels.ndim == 2 else 'RGB'} {pixels.dtype}"
