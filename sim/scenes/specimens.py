"""Specimens that anyone can make again, for pictures and tests: ``stereotome sim specimen knot -o knot.ome.tif``."""

from __future__ import annotations

import json
import sys
from pathlib import Path  # noqa: TC003  the command line is made from the annotations
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tifffile
from cyclopts import Parameter
from scipy import ndimage

from devices.errors import InputError
from sim.scenes.shapes import MIDDLE, Shape, ball, drawn, moved, shell, together, tube

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Array = NDArray[Any]

Name = Literal["knot", "braid", "phases", "hollow", "vessels", "dendrites"]
POINTS = 1500  # of a curve
SIDE_UM = 64.0


def knot() -> Shape:
    """Return a trefoil knot: one closed tube, one loop."""
    t = np.linspace(0, 2 * np.pi, POINTS, endpoint=False)
    curve = np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -1.6 * np.sin(3 * t)], axis=1)
    return tube(8.0 * curve, 3.0, closed=True)


def braid() -> Shape:
    """Return three fibres, each around the other two."""
    t = np.linspace(-26, 26, POINTS)
    turns = [t / 10 + k * 2 * np.pi / 3 for k in range(3)]
    curves = [np.stack([13 * np.sin(a), 6 * np.sin(2 * a), t], axis=1) for a in turns]
    return together([tube(curve, 3.0, closed=False) for curve in curves])


def hollow() -> Shape:
    """Return hollow balls of several sizes."""
    places = [(-16, -14, -12), (15, -13, 8), (-11, 15, 10), (14, 15, -13), (0, 0, 24), (-22, 2, 22)]
    shells = [shell(radius, radius / 3) for radius in (10, 9, 8, 7, 6, 5)]
    return together([moved(one, place) for one, place in zip(shells, places, strict=True)])


def vessels() -> Shape:
    """Return a tree of tubes that fork four times; thinner from fork to fork by the cube root of 2 (Murray 1926)."""
    return _tree(np.array([0.0, 0.0, -28.0]), np.array([0.0, 0.0, 1.0]), 17.0, 3.2, 4, 0)


def dendrites() -> Shape:
    """Return a cell body with six branched processes."""
    directions = np.array(
        [(1, 0.2, 0.1), (-0.9, 0.4, 0.2), (0.1, 1, -0.3), (-0.2, -1, 0.3), (0.2, 0.1, 1), (0, -0.3, -1)]
    )
    arms = [_tree(np.zeros(3), d / np.linalg.norm(d), 14.0, 1.8, 2, k) for k, d in enumerate(directions)]
    body = ball(7.0)
    parts = [body, *arms]
    return Shape(lambda p: np.min([part.distance(p) for part in parts], axis=0), SIDE_UM, {"euler": 1, "features": 1})


def _tree(start: Array, along: Array, length: float, radius: float, forks: int, seed: int) -> Shape:
    stems, ends = [], [(start, along, length, radius)]
    rng = np.random.default_rng(seed)
    for _ in range(forks + 1):
        grown = []
        for root, way, reach, thick in ends:
            tip = root + reach * way
            stems.append(tube(np.linspace(root, tip, 60), thick, closed=False))
            aside = np.cross(way, rng.normal(size=3))
            aside /= np.linalg.norm(aside)
            ways = [np.cos(turn) * way + np.sin(turn) * aside for turn in (0.6, -0.6)]
            grown += [(tip, onward, 0.75 * reach, thick / 2 ** (1 / 3)) for onward in ways]
        ends = grown
    truth = {"euler": 1.0, "features": 1.0, "branches": 2.0 ** (forks + 1) - 1, "ends": 2.0**forks + 1}
    return Shape(lambda p: np.min([stem.distance(p) for stem in stems], axis=0), SIDE_UM, truth)


def phases(side: int = 64, grain: float = 4.0, seed: int = 0) -> tuple[NDArray[np.uint8], dict[str, float]]:
    """Return two phases that run through each other, the halves of a random field, and what is expected of them.

    A Gaussian field blurred by σ has slopes of 1 / (2 σ²) squared per axis; its middle level has the surface
    (2 / π) times their root per volume.
    """
    noise = np.random.default_rng(seed).normal(size=(side,) * 3)
    field = ndimage.gaussian_filter(noise, grain, mode="wrap")
    field /= field.std()
    surface = 2 / np.pi / (np.sqrt(2) * grain)
    truth = {"volume_fraction": 0.5, "surface_per_volume_per_um": float(surface)}
    return np.asarray(np.rint(np.clip(MIDDLE + 40 * field, 0, 255)), np.uint8), truth


SHAPES: dict[str, Callable[[], Shape]] = {
    "knot": knot,
    "braid": braid,
    "hollow": hollow,
    "vessels": vessels,
    "dendrites": dendrites,
}


def specimen(
    name: Name,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    step_um: float = 1.0,
    pixel_um: float = 1.0,
    noise: float = 0.0,
    overwrite: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Make a specimen of known size as a volume of grey values; 127.5 is at its surface.

    Parameters
    ----------
    name
        knot, braid, phases, hollow, vessels, dendrites.
    output
        OME-TIFF to write; what is known of the specimen stands beside it as JSON.
    step_um, pixel_um
        Distance of planes and size of a pixel.
    noise
        Rms, grey levels.
    overwrite
        Replace files that are there.
    """
    beside = output.with_suffix(".json")
    if not overwrite and (output.exists() or beside.exists()):
        raise InputError(f"{output} is there already.", fix="replace it: --overwrite", code="output-exists")
    if name == "phases":
        grey, truth = phases()
        step_um = pixel_um = 1.0
    else:
        shape = SHAPES[name]()
        truth = shape.truth
        grey = drawn(shape, (step_um, pixel_um, pixel_um), size_um=max(shape.size_um, SIDE_UM) + 8, noise=noise)
    sizes = {"PhysicalSizeZ": step_um, "PhysicalSizeY": pixel_um, "PhysicalSizeX": pixel_um}
    units = {f"{key}Unit": "µm" for key in sizes}
    tifffile.imwrite(output, grey, ome=True, metadata={"axes": "ZYX", "Name": name, **sizes, **units})
    beside.write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
    sys.stdout.write(f"{output}\n{beside}\n")
    return 0
