"""Movies: scenes that change little by little, and files of them (H.264 in MP4, GIF)."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import TYPE_CHECKING, Any, Literal, get_args

import av
import numpy as np
from PIL import Image

from devices.errors import InputError
from display.resolve import fitting_pixel_um
from display.scene import SliceLook, Transfer, VolumeLook

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from numpy.typing import NDArray

    from display.resolve import Size
    from display.scene import Scene

    Picture = NDArray[np.uint8]

Sweep = Literal["rotation", "tilt", "opacity", "planes", "light"]
SWEEPS: tuple[str, ...] = get_args(Sweep)
KINDS = (".mp4", ".gif")
MOST_FRAMES = 10_000
SWAY_DEG = 12.0
FAINTEST, DENSEST = 0.05, 4.0  # of the opacity as given
SHARP = "18"  # constant rate factor of H.264: no difference is seen


def frames_of(scene: Scene, size: Size, sweep: Sweep, count: int, *, bounce: bool = False) -> list[Scene]:
    """Return the scenes of a movie; the size of a pixel is the same in all of them.

    Raises
    ------
    InputError
        ``movie``: no number of pictures, or nothing that this sweep changes.
    """
    if not 2 <= count <= MOST_FRAMES:
        raise InputError(f"a movie of {count} pictures is none.", fix=f"2 to {MOST_FRAMES}: --frames N", code="movie")
    cyclic = sweep in {"rotation", "tilt"}
    shares = np.arange(count) / (count if cyclic else count - 1)
    scenes = [_CHANGES[sweep](scene, float(share)) for share in shares]
    pixel_um = max(fitting_pixel_um(each, size) for each in scenes)
    fixed = [replace(each, view=replace(each.view, pixel_um=pixel_um)) for each in scenes]
    return fixed + fixed[-2:0:-1] if bounce else fixed


def write_movie(path: Path, pictures: Iterable[Picture], fps: float) -> None:
    """Write a movie; the file appears under its name when it is whole.

    Raises
    ------
    InputError
        ``movie``: no pictures a second.
    """
    if not 0.1 <= fps <= 240:
        raise InputError(f"{fps:g} pictures a second are no movie.", fix="0.1 to 240: --fps N", code="movie")
    part = path.with_name(f".part-{path.name}")
    try:
        (_write_gif if path.suffix.lower() == ".gif" else _write_mp4)(part, pictures, fps)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _write_mp4(path: Path, pictures: Iterable[Picture], fps: float) -> None:
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as file:
        stream: Any = None
        for picture in pictures:
            even = picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2]  # the format halves colour
            if stream is None:
                stream = file.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
                stream.height, stream.width = even.shape[:2]
                stream.pix_fmt, stream.options = "yuv420p", {"crf": SHARP}
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
            file.mux(stream.encode(frame))
        file.mux(stream.encode())


def _write_gif(path: Path, pictures: Iterable[Picture], fps: float) -> None:
    first, *rest = (Image.fromarray(picture).quantize(256) for picture in pictures)
    first.save(path, format="GIF", save_all=True, append_images=rest, duration=1000 / fps, loop=0)


def _rotation(scene: Scene, share: float) -> Scene:
    return replace(scene, view=replace(scene.view, azimuth_deg=scene.view.azimuth_deg + 360 * share))


def _tilt(scene: Scene, share: float) -> Scene:
    swayed = scene.view.azimuth_deg + SWAY_DEG * float(np.sin(2 * np.pi * share))
    return replace(scene, view=replace(scene.view, azimuth_deg=swayed))


def _opacity(scene: Scene, share: float) -> Scene:
    factor = FAINTEST * (DENSEST / FAINTEST) ** share

    def change(look: VolumeLook) -> VolumeLook:
        unit = look.transfer.unit_um
        smallest = min(scene.layers[0].data.spacing_um)
        thinner = Transfer(look.transfer.points, (unit or smallest) / factor)  # the same opacity over less depth
        contrast = look.contrast * factor if look.contrast else None
        return replace(look, transfer=thinner, contrast=contrast)

    return _looking(scene, VolumeLook, change)


def _planes(scene: Scene, share: float) -> Scene:
    def change(look: SliceLook) -> SliceLook:
        depth = scene.layers[0].data.shape[0]
        middle = (0.5 + share * (depth - 1)) / depth  # through the middles of planes
        return replace(look, at=(look.at[0], look.at[1], middle))

    return _looking(scene, SliceLook, change)


def _light(scene: Scene, share: float) -> Scene:
    def change(look: Any) -> Any:
        return replace(look, light=replace(look.light, azimuth_deg=-80 + 160 * share))

    return _looking(scene, object, change)


def _looking(scene: Scene, kind: type, change: Callable[[Any], Any]) -> Scene:
    layers = [replace(layer, look=change(layer.look)) for layer in scene.layers if isinstance(layer.look, kind)]
    if not layers:
        raise InputError("this movie changes nothing in this mode.", fix="--movie rotation", code="movie")
    return replace(scene, layers=tuple(layers))


_CHANGES: dict[str, Callable[[Scene, float], Scene]] = {
    "rotation": _rotation,
    "tilt": _tilt,
    "opacity": _opacity,
    "planes": _planes,
    "light": _light,
}
