"""OME-Zarr images (0.4 and 0.5) as stacks."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import tensorstore

from devices.errors import InputError
from processing.readers import Choice, Layout, Recording, lay_out, to_um

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import zarr
    from numpy.typing import NDArray

    Array = NDArray[Any]

MARKS = ("zarr.json", ".zgroup", ".zarray")
AXIS_OF_TYPE = {"channel": "c", "time": "t"}
EARLY_AXES = "tczyx"  # of OME-Zarr before 0.3, which did not say
RGB = ("red", "green", "blue")


@dataclass(frozen=True)
class Image:
    """One multiscale image: its full-resolution array and what is said about it."""

    path: Path
    folder: Path
    array: zarr.Array[Any]
    axes: str
    units: tuple[str, ...]
    channels: tuple[str, ...]
    transformations: tuple[dict[str, Any], ...]
    table: dict[str, Any]

    def affine(self, axis: str) -> tuple[float, float]:
        """Return scale and offset of an axis: position = scale * index + offset."""
        scale, offset, at = 1.0, 0.0, self.axes.index(axis)
        for step in self.transformations:
            factor = float(step["scale"][at]) if step["type"] == "scale" else 1.0
            shift = float(step["translation"][at]) if step["type"] == "translation" else 0.0
            scale, offset = scale * factor, offset * factor + shift
        return scale, offset

    def in_um(self, axis: str) -> tuple[float, float] | None:
        """Return scale and offset of an axis in µm; None where it is absent or has no unit of length."""
        if axis not in self.axes:
            return None
        scale, offset = (to_um(value, self.units[self.axes.index(axis)]) for value in self.affine(axis))
        return None if scale is None or offset is None else (scale, offset)


def is_zarr(folder: Path) -> bool:
    """Tell whether a folder is a Zarr group or array."""
    return any((folder / mark).is_file() for mark in MARKS)


def read_zarr(path: Path, choice: Choice) -> Recording:
    """Read the full resolution of an OME-Zarr image as a stack.

    Raises
    ------
    InputError
        No image or several, metadata that make no sense, a channel or time that is not there.
    """
    image = find_image(path)
    layout = _lay_out(image, choice)
    absent = image.array.nchunks - image.array.nchunks_initialized
    depth, lateral = image.in_um("z"), image.in_um("x")
    notes = [*layout.notes, *([_absent(absent, image.array.nchunks)] if absent else [])]
    recording = Recording(
        layout.count,
        _reader(image, layout),
        step_um=depth[0] if depth else None,
        start_um=depth[1] if depth else 0.0,
        pixel_um=lateral[0] if lateral else None,
        notes=tuple(notes),
    )
    return _with_table(recording, image.table)


def _absent(absent: int, chunks: int) -> str:
    return f"{absent} of {chunks} pieces of the array are not on disk; they read as its fill value."


def find_image(path: Path) -> Image:
    """Find the one image at ``path`` or in the collection there."""
    import zarr  # noqa: PLC0415  half a second that other files do without

    node = zarr.open(path, mode="r")
    if not isinstance(node, zarr.Group):
        raise _no_image(path, f"It is a bare array; the image is the folder above: {path.parent}")
    attributes = node.attrs.asdict()
    ome = _dictionary(attributes.get("ome", attributes))
    if "multiscales" in ome:
        return _image(path, node, ome, _dictionary(attributes.get("stereotome", {})))
    members = sorted(name for name, child in node.groups() if _is_image(child))
    if len(members) == 1:
        return find_image(path / members[0])
    why = f"It holds the images {', '.join(members)}." if members else "It has no multiscales."
    raise _no_image(path, "It is a plate." if "plate" in ome else why)


def _is_image(group: zarr.Group) -> bool:
    attributes = group.attrs.asdict()
    return "multiscales" in _dictionary(attributes.get("ome", attributes))


def _no_image(path: Path, why: str) -> InputError:
    return InputError(
        f"{path} is not one OME-Zarr image.", why=why, fix="name the folder of one image.", code="input-unknown"
    )


def _dictionary(value: object) -> dict[str, Any]:
    if isinstance(value, dict):
        return value
    raise ValueError(f"expected a table, found {json.dumps(value, default=str)[:60]}")


def _image(path: Path, group: zarr.Group, ome: dict[str, Any], table: dict[str, Any]) -> Image:
    scales = ome["multiscales"][0]
    level = scales["datasets"][0]
    array: Any = group[level["path"]]
    if not hasattr(array, "shape"):
        raise TypeError(f"{level['path']} is no array")
    listed = scales.get("axes", list(EARLY_AXES[-array.ndim :]))
    axes = [axis if isinstance(axis, dict) else {"name": axis} for axis in listed]
    steps = (*level.get("coordinateTransformations", []), *scales.get("coordinateTransformations", []))
    return Image(
        path,
        path / level["path"],
        array,
        axes="".join(_letter(axis) for axis in axes),
        units=tuple(str(axis.get("unit", "")) for axis in axes),
        channels=tuple(str(channel.get("label", "")) for channel in ome.get("omero", {}).get("channels", [])),
        transformations=steps,
        table=table,
    )


def _letter(axis: dict[str, Any]) -> str:
    name = str(axis["name"]).lower()
    return name if len(name) == 1 else AXIS_OF_TYPE.get(axis.get("type", ""), "q")


def _lay_out(image: Image, choice: Choice) -> Layout:
    """Three channels called red, green and blue are one colour picture."""
    colour = tuple(name.lower() for name in image.channels) == RGB
    axes = image.axes.replace("c", "s") if colour else image.axes
    return lay_out(axes, image.array.shape, choice, image.path, image.channels)


def _reader(image: Image, layout: Layout) -> Callable[[int], Array]:
    """Read through tensorstore: zarr-python takes a chunk of blosc or zstd that was cut for a whole one."""
    driver = "zarr3" if image.array.metadata.zarr_format == 3 else "zarr"
    spec = {"driver": driver, "kvstore": {"driver": "file", "path": str(image.folder.resolve())}}
    pixels = tensorstore.open(spec, open=True, read=True).result()
    return lambda k: layout.upright(np.asarray(pixels[layout.index(k)].read().result()))


def _with_table(recording: Recording, table: dict[str, Any]) -> Recording:
    """Take position and presence of each plane from the table this program keeps beside the array."""
    planes = [(int(row["plane"]), float(row["z_um"])) for row in table.get("planes", [])]
    if not planes or planes[-1][0] >= recording.count:
        return recording
    there, read = [k for k, _ in planes], recording.read
    missing = sorted(set(range(recording.count)) - set(there))
    note = f"planes {', '.join(map(str, missing))} were not taken and are left out."
    return replace(
        recording,
        count=len(there),
        read=lambda k: read(there[k]),
        z_um=np.array([z_um for _, z_um in planes]),
        notes=(*recording.notes, *([note] if missing else [])),
        label=lambda k: f"plane {there[k]}",
    )
