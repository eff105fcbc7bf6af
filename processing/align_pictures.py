"""Pictures and tables of an alignment: cuts before and after, what each section needed, curves of mismatch."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import tifffile
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from processing.align_mismatch import AXES
from processing.pictures import png_bytes
from processing.result_folder import csv_bytes

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from processing.align_stack import Alignment, Section
    from processing.stack import Stack

    Array = NDArray[Any]

FIGURE_INCH = (9.0, 8.0)
CURVES_INCH = (9.0, 3.6)
SECTION_COLUMNS = (
    "section", "rotation_deg", "x_px", "y_px", "scale", "compression", "compression_error", "direction_deg",
    "direction_error_deg", "error_px", "flags",
)  # fmt: skip
CURVE_COLUMNS = ("first", "second", "axis", "offset", "mismatch")


def sections_table(alignment: Alignment) -> bytes:
    """Encode one line for each section: what its map does, and how sure that is."""
    return csv_bytes(SECTION_COLUMNS, [_line(section, alignment) for section in alignment.sections])


def _line(section: Section, alignment: Alignment) -> list[object]:
    bent, (error, direction) = section.deformation, alignment.compression_errors(section)
    height, width = alignment.shape[:2]
    middle = np.array([(width - 1) / 2, (height - 1) / 2, 1.0])
    moved = (section.matrix @ middle - middle)[:2]
    place = [bent.rotation_deg, float(moved[0]), float(moved[1]), bent.scale]
    return [section.index, *place, bent.compression, error, bent.direction_deg, direction, section.error_px,
            " ".join(section.flags)]  # fmt: skip


def curves_table(alignment: Alignment) -> bytes:
    """Encode the mismatch of binary sections against the offset from the best place, in pixels and degrees."""
    lines = [
        [i, j, axis, float(offset), float(value)]
        for (i, j), found in alignment.pairs.items()
        for axis, curve in (found.curves or {}).items()
        for offset, value in curve
    ]
    return csv_bytes(CURVE_COLUMNS, lines)


def curves_picture(alignment: Alignment) -> bytes:
    """Draw the mismatch of neighbours against the offset along x, y and turn."""
    figure = Figure(figsize=CURVES_INCH, dpi=100, layout="constrained")
    panels = figure.subplots(1, len(AXES), sharey=True)
    neighbours = [found for (i, j), found in alignment.pairs.items() if j == i + 1 and found.curves]
    for axes, name in zip(panels, AXES, strict=True):
        for found in neighbours:
            curve = (found.curves or {}).get(name)
            if curve is not None:
                axes.plot(*curve.T, color="tab:blue", alpha=0.5, linewidth=1)
        axes.axvline(0, color="tab:red", linewidth=0.8)
        axes.set(xlabel=f"{name}, {'degrees' if name == 'turn' else 'pixels'} from the best", ylim=(0, None))
    panels[0].set_ylabel("Ex-OR area / shared area")
    figure.suptitle(f"Mismatch of {len(neighbours)} pairs of neighbours", fontsize=11)
    return png_bytes(_drawn(figure))


def sections_picture(stack: Stack, aligned: Path, alignment: Alignment) -> bytes:
    """Draw the x–z cut through the middle before and after, and turn, shift and compression of every section."""
    row = stack.shape[0] // 2
    before = np.stack([stack[k][row] for k in range(len(stack))])
    after = np.stack([tifffile.imread(aligned, key=k)[row] for k in range(len(stack))])
    figure = Figure(figsize=FIGURE_INCH, dpi=100, layout="constrained")
    panels = figure.subplots(2, 2)
    _cut(panels[0, 0], before, "as taken")
    _cut(panels[0, 1], after, "aligned")
    _motion(panels[1, 0], alignment)
    _compression(panels[1, 1], alignment)
    return png_bytes(_drawn(figure))


def _cut(axes: Axes, cut: Array, title: str) -> None:
    shows = cut[cut > 0] if (cut > 0).any() else cut  # black is where a section does not reach
    low, high = np.percentile(shows, (0.5, 99.5))
    shown = np.clip((cut.astype(np.float32) - low) / max(float(high - low), 1.0), 0, 1)
    axes.imshow(shown, cmap="gray", aspect="auto", interpolation="nearest")
    axes.set(title=f"x–z cut through the middle, {title}", xlabel="x, pixels", ylabel="section")


def _motion(axes: Axes, alignment: Alignment) -> None:
    lines = np.array([_line(section, alignment)[:4] for section in alignment.sections], np.float64)
    axes.plot(lines[:, 0], lines[:, 2], label="x, pixels")
    axes.plot(lines[:, 0], lines[:, 3], label="y, pixels")
    axes.plot(lines[:, 0], lines[:, 1], label="turn, degrees")
    _mark_flags(axes, alignment)
    axes.set(title="Place and turn of the sections", xlabel="section")
    axes.legend(fontsize=8)


def _compression(axes: Axes, alignment: Alignment) -> None:
    found = [(s.index, s.deformation.compression, alignment.compression_errors(s)[0]) for s in alignment.sections]
    index, value, error = np.array(found, np.float64).T
    axes.errorbar(index, 100 * value, 100 * error, fmt=".", markersize=4, linewidth=0.8)
    _mark_flags(axes, alignment)
    axes.set(title=f"Compression in one direction ({alignment.model})", xlabel="section", ylabel="%")


def _mark_flags(axes: Axes, alignment: Alignment) -> None:
    for section in alignment.sections:
        if section.flags:
            axes.axvline(section.index, color="tab:red", linewidth=0.8, alpha=0.6)


def _drawn(figure: Figure) -> Array:
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba(), np.uint8)[..., :3].copy()
