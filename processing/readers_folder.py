"""Folders of images, one plane each: which files belong together, in which order, and what their names say."""

from __future__ import annotations

import re
import zlib
from collections import defaultdict
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from devices.errors import InputError
from processing.readers import Choice, Recording, choose_channel, choose_time, damaged, reading
from processing.readers_mm import beside
from processing.readers_tiff import read_tiff

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    Array = NDArray[Any]

TIFFS = frozenset({".tif", ".tiff"})
PICTURES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".webp"})
NUMBER = re.compile(r"(\d+(?:\.\d+)?)")
DEPTH_WORDS = ("z", "plane", "slice", "focus", "depth")  # a number after one of these counts planes
JPEG, PNG = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
JPEG_PLAIN = frozenset({0x01, *range(0xD0, 0xD8)})  # markers without a length


@dataclass(frozen=True)
class Name:
    """A file name taken apart: words and the numbers between them."""

    path: Path
    words: tuple[str, ...]
    numbers: tuple[str, ...]

    def with_hole(self, column: int) -> str:
        """Return the name with ``#`` in place of one number."""
        numbers = [*self.numbers[:column], "#", *self.numbers[column + 1 :], ""]
        return "".join(word + number for word, number in zip(self.words, numbers, strict=True))


@dataclass(frozen=True)
class Series:
    """Files that differ in one number alone."""

    name: str
    files: tuple[Path, ...]
    numbers: tuple[float, ...] = ()


def read_folder(folder: Path, choice: Choice) -> Recording:
    """Read a folder of images as a stack, one plane a file, in natural order.

    Raises
    ------
    InputError
        No images, several series and none chosen, or what `read_files` raises.
    """
    files = [path for path in folder.iterdir() if is_image(path) and not path.name.startswith(".")]
    if not files:
        raise _no_images(folder)
    return read_files(files, choice, folder)


def is_image(path: Path) -> bool:
    """Tell from its name whether a file is an image."""
    return path.suffix.lower() in TIFFS | PICTURES and path.is_file()


def _no_images(folder: Path) -> InputError:
    inside = sorted(child.name for child in folder.iterdir() if child.is_dir() and any(map(is_image, child.iterdir())))
    return InputError(
        f"{folder} holds no images.",
        why=f"There are images in its folders {', '.join(inside)}." if inside else "",
        fix=f"name one of them: {folder / inside[0]}" if inside else "name a folder of PNG, JPEG or TIFF images.",
        code="stack-empty",
    )


def read_files(files: Sequence[Path], choice: Choice, source: Path) -> Recording:
    """Read image files as a stack, one plane each.

    Raises
    ------
    InputError
        Several series and none chosen, a file that is damaged or holds more than one plane.
    """
    if len(files) == 1 and is_tiff(files[0]):
        return read_tiff(files[0], choice)
    choose_time(1, choice, source)
    series, left_out = choose_series(series_of(files), choice, source)
    notes = [f"left out, not of the series {series.name}: {', '.join(left_out)}."] if left_out else []
    places, gap = _places(series)
    notes += [gap] if gap else []
    tiffs = [_one_plane(path) for path in series.files] if all(map(is_tiff, series.files)) else []
    told = beside(series.files[0].parent)
    own_um = _positions(tiffs)
    return Recording(
        count=len(series.files),
        read=_reader(series.files),
        z_um=told.positions(series.files) if own_um is None else own_um,
        pixel_um=(tiffs[0].pixel_um if tiffs else None) or told.pixel_um,
        places=places,
        notes=(*notes, *told.notes),
        label=lambda k: series.files[k].name,
    )


def is_tiff(path: Path) -> bool:
    """Tell from its name whether a file is a TIFF."""
    return path.suffix.lower() in TIFFS


def _reader(files: tuple[Path, ...]) -> Callable[[int], Array]:
    return lambda k: read_picture(files[k])


def _one_plane(path: Path) -> Recording:
    with reading(path):
        recording = read_tiff(path, Choice())
    if recording.count > 1:
        raise InputError(
            f"{path} holds {recording.count} planes; in a folder every file has to be one plane.",
            fix="name the file itself, or put it elsewhere.",
            code="stack-shape",
        )
    return recording


def _positions(tiffs: list[Recording]) -> NDArray[np.float64] | None:
    known = [recording.z_um for recording in tiffs if recording.z_um is not None]
    return np.concatenate(known) if known and len(known) == len(tiffs) else None


def natural_key(path: Path) -> list[tuple[float, str]]:
    """Order names as people do: frame 2 before frame 10."""
    parts = NUMBER.split(path.stem.lower())
    return [(float(part), "") if k % 2 else (-1.0, part) for k, part in enumerate(parts)]


def series_of(files: Iterable[Path]) -> list[Series]:
    """Sort files into series: same words, one number that counts the planes."""
    alike: dict[tuple[str, ...], list[Name]] = defaultdict(list)
    for path in sorted(files, key=natural_key):
        name = take_apart(path)
        alike[name.words].append(name)
    return [series for names in alike.values() for series in _split(names)]


def take_apart(path: Path) -> Name:
    """Split a file name into words and numbers; the suffix belongs to the last word."""
    parts = NUMBER.split(path.stem)
    words = [*parts[0:-1:2], parts[-1] + path.suffix.lower()]
    return Name(path, tuple(words), tuple(parts[1::2]))


def _split(names: list[Name]) -> list[Series]:
    columns = range(len(names[0].numbers))
    varying = [c for c in columns if len({name.numbers[c] for name in names}) > 1]
    if not varying:
        return [Series(names[0].path.name, (names[0].path,))]
    named = [c for c in varying if names[0].words[c].lower().rstrip("_-. ").endswith(DEPTH_WORDS)]
    depth = (named or varying)[-1]
    series: dict[str, list[Name]] = defaultdict(list)
    for name in names:
        series[name.with_hole(depth)].append(name)
    if len(varying) > 1 and not named and not _is_grid(series, depth):
        return [Series(f"{names[0].path.name} … {names[-1].path.name}", tuple(name.path for name in names))]
    return [_series(hole, members, depth) for hole, members in series.items()]


def _is_grid(series: dict[str, list[Name]], depth: int) -> bool:
    """Tell whether every series has the same numbers: otherwise the numbers may be dates and times."""
    return len({tuple(name.numbers[depth] for name in names) for names in series.values()}) == 1


def _series(hole: str, names: list[Name], depth: int) -> Series:
    return Series(hole, tuple(name.path for name in names), tuple(float(name.numbers[depth]) for name in names))


def choose_series(found: list[Series], choice: Choice, source: Path) -> tuple[Series, list[str]]:
    """Return the series to take and the names of the files that are not part of any.

    Raises
    ------
    InputError
        There are several and none was chosen.
    """
    long = [series for series in found if len(series.files) > 1]
    if not long:
        choose_channel(1, choice, source)
        files = tuple(path for series in found for path in series.files)
        return Series("all images in the order of their names", files), []
    chosen = choose_channel(len(long), choice, source, [f"{s.name} ({len(s.files)} images)" for s in long])
    return long[chosen], sorted(path.name for s in found if len(s.files) == 1 for path in s.files)


def _places(series: Series) -> tuple[NDArray[np.float64] | None, str]:
    """Where planes lie when numbers counted one by one have gaps; numbers with wider steps are taken as they come."""
    steps = [int(b - a) for a, b in pairwise(series.numbers)]
    span = sum(steps)
    if not steps or min(steps) != 1 or span == len(steps) or span > 2 * len(steps):
        return None, ""
    missing = ", ".join(f"{a + k:.0f}" for a, b in pairwise(series.numbers) for k in range(1, int(b - a)))
    words = f"number {missing} of {series.name} is missing; with --step-um its place is kept."
    return np.array(series.numbers) - series.numbers[0], words


def read_picture(path: Path) -> Array:
    """Read an image file of one plane, colour as RGB, at its own depth.

    Raises
    ------
    InputError
        Damaged, incomplete, or no image.
    """
    if is_tiff(path):
        return _one_plane(path).read(0)
    with reading(path):
        content = path.read_bytes()
        check_whole(path, content)
        pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise damaged(path, "It cannot be decoded.")
    return np.ascontiguousarray(pixels if pixels.ndim == 2 else pixels[:, :, [2, 1, 0]])


def check_whole(path: Path, content: bytes) -> None:
    """Raise `InputError` for a JPEG or PNG that was cut or changed: decoders fill up the rest with grey."""
    if content.startswith(JPEG) and not _jpeg_ends(content):
        raise damaged(path, f"The file ends at byte {len(content)}, in the middle of the picture.")
    if content.startswith(PNG) and not _png_checks(content):
        raise damaged(path, "A part of it is missing, or differs from its checksum.")


def _png_checks(content: bytes) -> bool:
    """Tell whether all chunks up to the end chunk are there and agree with their checksums."""
    at = len(PNG)
    while at + 12 <= len(content):
        size = int.from_bytes(content[at : at + 4], "big")
        body, check = content[at + 4 : at + 8 + size], content[at + 8 + size : at + 12 + size]
        if zlib.crc32(body).to_bytes(4, "big") != check:
            return False
        if body.startswith(b"IEND"):
            return True
        at += 12 + size
    return False


def _jpeg_ends(content: bytes) -> bool:
    """Tell whether the end marker follows the pixels; the end of a thumbnail in the header does not count."""
    at = 2
    while at + 4 <= len(content) and content[at] == 0xFF:
        marker = content[at + 1]
        at += 2 if marker in JPEG_PLAIN else 2 + int.from_bytes(content[at + 2 : at + 4], "big")
        if marker == 0xDA:
            return content.find(b"\xff\xd9", at) >= 0
    return False
