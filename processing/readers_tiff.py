"""TIFF, OME-TIFF, ImageJ and MetaSeries files as stacks."""

from __future__ import annotations

import logging
import math
import struct
import warnings
import weakref
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import tifffile

from processing.readers import Choice, Layout, Recording, damaged, lay_out, to_um

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    Array = NDArray[Any]

OWN_CODECS = frozenset(tifffile.COMPRESSION[name] for name in ("NONE", "ADOBE_DEFLATE", "DEFLATE", "LZMA"))
MICRO_MANAGER = "MicroManagerMetadata"
logging.getLogger("tifffile").addHandler(logging.NullHandler())  # what it notices is told in our words or harmless


def read_tiff(path: Path, choice: Choice) -> Recording:
    """Read the first image series of a TIFF file as a stack.

    Raises
    ------
    InputError
        No TIFF, cut short, or a channel or time that is not there.
    """
    reader = _PlaneReader(open_tiff(path))
    file, layout = reader.file, reader.choose(choice, path)
    spacing = _spacing(reader, layout)
    notes = [*layout.notes, *spacing.pop("notes", [])]
    if len(file.series) > 1:
        notes.append(f"image 0 of the {len(file.series)} in the file is taken.")
    return Recording(layout.count, reader, notes=tuple(notes), **spacing)


def open_tiff(path: Path) -> tifffile.TiffFile:
    """Open a TIFF file whose every byte is there."""
    _check_chain(path)
    with ExitStack() as guard:
        file = guard.enter_context(tifffile.TiffFile(path))
        _check_segments(file)
        guard.pop_all()
    return file


def _check_chain(path: Path) -> None:
    """Follow the chain of images to its end: the library stops without a word where the file was cut."""
    size = path.stat().st_size
    with path.open("rb") as file:
        order = {b"II": "<", b"MM": ">"}.get(file.read(2), "")
        if not order:
            raise damaged(path, "It does not begin like a TIFF file.")
        big = struct.unpack(order + "H", file.read(2))[0] == 43
        count, entry, offset = ("Q", 20, "Q") if big else ("H", 12, "I")
        file.seek(8 if big else 4)
        after = struct.unpack(order + offset, file.read(struct.calcsize(offset)))[0]
        seen = {0}
        while after not in seen:
            seen.add(after)
            if after + 8 > size:
                raise damaged(path, f"Image {len(seen) - 2} should begin at byte {after}, the file ends at {size}.")
            file.seek(after)
            entries = struct.unpack(order + count, file.read(struct.calcsize(count)))[0]
            file.seek(entries * entry, 1)
            after = struct.unpack(order + offset, file.read(struct.calcsize(offset)))[0]


def _check_segments(file: tifffile.TiffFile) -> None:
    size = file.filehandle.size
    if not file.series or None in file.series[0].pages:
        raise damaged(file.filehandle.path, "Some of its planes are missing, or in files that are missing.")
    for k, page in enumerate(file.pages):
        end = max((o + n for o, n in zip(page.dataoffsets, page.databytecounts, strict=False)), default=0)
        if end > size:
            raise damaged(file.filehandle.path, f"Image {k} needs {end} bytes, the file ends at {size}.")
    for series in file.series:
        if series.dataoffset is not None and series.dataoffset + series.nbytes > size and not series.is_multifile:
            raise damaged(file.filehandle.path, f"{series.dataoffset + series.nbytes} bytes are needed, {size} there.")


class _PlaneReader:
    """Reads one plane at a time; the file stays open as long as the reader lives."""

    def __init__(self, file: tifffile.TiffFile) -> None:
        self.file = file
        self._series = file.series[0]
        file.filehandle.set_lock(lock=True)  # planes are read by several threads, and where to read is the file's own
        weakref.finalize(self, file.close)

    def choose(self, choice: Choice, path: Path) -> Layout:
        """Settle which planes are read, and return where they lie."""
        self._layout = lay_out(self._series.axes, self._series.shape, choice, path, _channel_names(self.file))
        return self._layout

    def __call__(self, k: int) -> Array:
        number, within = self._place(k)
        return self._layout.upright(self._pixels(number)[within])

    def _place(self, k: int) -> tuple[int, tuple[int | slice, ...]]:
        """Return the number of the page that holds plane ``k``, and where in the page it lies."""
        index, shape = self._layout.index(k), self._series.shape
        lead = len(shape) - len(self._series.keyframe.shape)  # axes that run over pages, the others lie within one
        outer = [int(i) for i in index[:lead] if not isinstance(i, slice)]
        return int(np.ravel_multi_index(outer, shape[:lead])) if outer else 0, index[lead:]

    def page(self, k: int) -> tifffile.TiffPage:
        """Return the page of plane ``k`` with all its tags."""
        page = self._series.pages[self._place(k)[0]]
        assert page is not None
        return page.aspage()

    def _pixels(self, number: int) -> Array:
        if self._series.dataoffset is None:
            return self._decoded(number)
        shape, dtype = self._series.keyframe.shape, self._series.dtype
        size = int(np.prod(shape))
        offset = self._series.dataoffset + number * size * dtype.itemsize
        stored = dtype.newbyteorder(self.file.byteorder)
        with self.file.filehandle.lock:
            flat = self.file.filehandle.read_array(stored, count=size, offset=offset)
        return flat.reshape(shape).astype(dtype, copy=False)

    def _decoded(self, number: int) -> Array:
        page = self._series.pages[number]
        assert page is not None
        if page.compression not in OWN_CODECS:
            return _by_opencv(page)
        with warnings.catch_warnings():  # further files of a set are opened for each page, and that is said each time
            warnings.filterwarnings("ignore", ".*reading array from closed file", UserWarning)
            return page.asarray()


def _by_opencv(page: tifffile.TiffPage | tifffile.TiffFrame) -> Array:
    """Decode a page in a compression that tifffile leaves to a further package: LZW, JPEG, PackBits and others."""
    path = page.parent.filehandle.path  # of a set of files it may be another one than the first
    pages = cv2.imreadmulti(path, start=page.index, count=1, flags=cv2.IMREAD_UNCHANGED)[1]
    if not pages or pages[0].size != math.prod(page.shape):
        raise ValueError(f"its compression ({page.compression!r}) cannot be read")
    pixels = np.asarray(pages[0])
    return pixels.reshape(page.shape) if pixels.ndim == 2 else pixels[:, :, [2, 1, 0, 3][: pixels.shape[2]]]


def _spacing(reader: _PlaneReader, layout: Layout) -> dict[str, Any]:
    """Return what the file says of positions and pixel size, under the names of `Recording`."""
    file = reader.file
    if file.is_ome:
        found = _ome_spacing(file, layout)
        if found["z_um"] is None and MICRO_MANAGER in file.pages.first.tags:  # it gave no unit before 2016
            told = _micromanager_spacing(reader, layout.count)
            found |= {key: value for key, value in told.items() if value is not None}
    elif file.is_imagej:
        found = _imagej_spacing(file)
    elif MICRO_MANAGER in file.pages.first.tags:
        found = _micromanager_spacing(reader, layout.count)
    elif file.is_metaseries:
        found = _metaseries_spacing(reader, layout.count)
    else:
        found = {}
    if layout.depth == "t":
        found.pop("step_um", None)
    return found


def _imagej_spacing(file: tifffile.TiffFile) -> dict[str, Any]:
    facts = file.imagej_metadata or {}
    unit = str(facts.get("unit", ""))
    spacing = {"step_um": to_um(float(facts["spacing"]), unit)} if "spacing" in facts else {}
    tag = file.pages.first.tags.get("XResolution")
    if tag is not None and tag.value[0]:
        spacing["pixel_um"] = to_um(tag.value[1] / tag.value[0], unit)
    return spacing


def _micromanager_spacing(reader: _PlaneReader, count: int) -> dict[str, Any]:
    first = reader.file.pages.first.tags[MICRO_MANAGER].value
    found = {"pixel_um": first.get("PixelSizeUm") or None}
    if not reader.file.is_ndtiff:  # whose index knows where pixels are, but not their tags
        tags = [reader.page(k).tags.get(MICRO_MANAGER) for k in range(count)]
        z_um = [None if tag is None else tag.value.get("ZPositionUm") for tag in tags]
        found["z_um"] = None if None in z_um else np.array(z_um, np.float64)
    return found


def _metaseries_spacing(reader: _PlaneReader, count: int) -> dict[str, Any]:
    try:
        pages = [_metaseries_table(reader.page(k)) for k in range(count)]
        z_um = np.array([page["z-position"] for page in pages], np.float64)
        pixel_um = to_um(float(pages[0]["spatial-calibration-x"]), str(pages[0]["spatial-calibration-units"]))
    except (KeyError, ValueError, TypeError, AttributeError, SyntaxError) as error:
        return {"notes": [f"the MetaSeries table cannot be read ({error}): no spacing from it."]}
    return {"z_um": z_um, "pixel_um": pixel_um}


def _metaseries_table(page: tifffile.TiffPage) -> dict[str, Any]:
    table: dict[str, Any] = tifffile.tifffile.metaseries_description_metadata(page.description)["PlaneInfo"]
    return table


def _ome_image(file: tifffile.TiffFile) -> dict[str, Any]:
    """Return the first image's ``Pixels`` element of the OME-XML as nested dictionaries."""
    image = tifffile.xml2dict(file.ome_metadata or "")["OME"]["Image"]
    first = image[0] if isinstance(image, list) else image
    pixels: dict[str, Any] = first["Pixels"]
    return pixels


def _listed(element: object) -> list[dict[str, Any]]:
    if element is None:
        return []
    return element if isinstance(element, list) else [element]  # type: ignore[list-item]


def _channel_names(file: tifffile.TiffFile) -> list[str]:
    channels = _listed(_ome_image(file).get("Channel")) if file.is_ome else []
    return [str(channel.get("Name", "")) for channel in channels]


def _ome_spacing(file: tifffile.TiffFile, layout: Layout) -> dict[str, Any]:
    pixels = _ome_image(file)
    sizes = {
        name: to_um(float(pixels[f"PhysicalSize{axis}"]), str(pixels.get(f"PhysicalSize{axis}Unit", "µm")))
        for name, axis in (("step_um", "Z"), ("pixel_um", "X"))
        if f"PhysicalSize{axis}" in pixels
    }
    z_um = _ome_positions(_listed(pixels.get("Plane")), layout)
    return {**sizes, "z_um": z_um}


def _ome_positions(planes: list[dict[str, Any]], layout: Layout) -> NDArray[np.float64] | None:
    """Positions of the planes of one channel and time; None unless every plane has one in a unit of length."""
    wanted = {"TheC": layout.fixed.get("c", 0), "TheT": layout.fixed.get("t", 0)}
    found = {
        int(plane["TheZ"]): to_um(float(plane["PositionZ"]), str(plane.get("PositionZUnit", "")))
        for plane in planes
        if "PositionZ" in plane and all(int(plane.get(key, 0)) == value for key, value in wanted.items())
    }
    positions = [found.get(k) for k in range(layout.count)]
    return None if None in positions else np.array(positions, np.float64)
