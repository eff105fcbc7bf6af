"""Surfaces as STL, PLY and glTF, each with its unit of length."""

from __future__ import annotations

import json
import struct
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh

from devices.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path

    from processing.facets import Facets

KINDS = (".stl", ".ply", ".glb")
METRES_PER_UM = 1e-6  # a unit of glTF is a metre
STL_HEADER = 80


def check_mesh_name(path: Path) -> None:
    """Raise `InputError` ``usage`` for a name that is of no kind that is written."""
    if path.suffix.lower() not in KINDS:
        raise InputError(f"{path} is of no kind that is written.", fix=f"name it {', '.join(KINDS)}", code="usage")


def mesh_bytes(facets: Facets, kind: str, unit: str = "µm") -> bytes:
    """Encode a surface.

    Parameters
    ----------
    kind : {".stl", ".ply", ".glb"}
        STL and PLY hold lengths in ``unit`` and say so in their first lines, for they have no place for it. glTF is in
        metres: its points are in ``unit`` and the node that holds them is scaled.
    """
    mesh: Any = trimesh.Trimesh(facets.points, facets.triangles, vertex_normals=facets.normals, process=False)
    ascii_unit = unit.replace("µ", "u")
    if kind == ".stl":
        data = bytes(mesh.export(file_type="stl"))
        return f"stereotome surface, unit {ascii_unit}".encode().ljust(STL_HEADER, b" ") + data[STL_HEADER:]
    if kind == ".ply":
        first, second, rest = bytes(mesh.export(file_type="ply", vertex_normal=True)).split(b"\n", 2)
        return b"\n".join([first, second, f"comment unit {ascii_unit}".encode(), rest])
    return _glb(mesh, unit)


def _glb(mesh: Any, unit: str) -> bytes:
    scale = METRES_PER_UM if unit == "µm" else 1.0
    scene: Any = trimesh.Scene()
    scene.add_geometry(mesh, node_name="surface", geom_name="surface", transform=np.diag([scale] * 3 + [1.0]))
    data = bytes(scene.export(file_type="glb", include_normals=True))
    (length,) = struct.unpack("<I", data[12:16])
    tree = json.loads(data[20 : 20 + length])
    tree["asset"]["extras"] = {"unit_of_points": unit, "metres_per_unit": scale if unit == "µm" else None}
    text = json.dumps(tree, ensure_ascii=True).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest
