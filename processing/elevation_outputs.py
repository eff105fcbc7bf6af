"""What ``process elevation`` leaves in a folder: maps, points, pictures and a report."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from processing.outputs import tiff_bytes, versions
from processing.pictures import DOTS_PER_INCH, MAP_SIDE_PX, MapWords, draw_map, png_bytes, preview, shown_limits
from processing.result_folder import csv_bytes, json_bytes
from processing.stereo_points import facet_contours

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from processing.elevation import Elevation, Geometry

    Array = NDArray[Any]

FILES = (
    "elevation.tif",
    "parallax.tif",
    "valid.tif",
    "elevation_error.tif",
    "points.csv",
    "network.csv",
    "elevation.png",
    "parallax.png",
    "elevation_error.png",
    "contours.png",
    "report.json",
)
FORMAT, FORMAT_VERSION = "stereotome-elevation", 1
PERCENTILES = {"min": 0, "p1": 1, "median": 50, "p99": 99, "max": 100}
COLUMNS = ("x_left", "y_left", "x_right", "y_right", "parallax_px", "x_um", "y_um", "z_um", "sigma_um", "ambiguous")
ELEVATION_COLOURS, PARALLAX_COLOURS, ERROR_COLOURS = "viridis", "cividis", "magma"
CONTOURS = 12
MARKER_DOT = 12


def contents(left: Array, found: Elevation, geometry: Geometry, facts: dict[str, Any]) -> dict[str, bytes]:
    """Encode every file of a result, by name; the report last."""
    pixel = geometry.pixel_um
    level = "the mean plane" if found.levelled else "the tilt axis"
    files = {
        "elevation.tif": tiff_bytes(found.elevation_um, pixel, f"elevation in um from {level}, NaN unknown"),
        "parallax.tif": tiff_bytes(found.parallax_px, pixel, "parallax x_left - x_right in pixels, NaN unknown"),
        "valid.tif": tiff_bytes(np.where(found.valid, np.uint8(255), np.uint8(0)), pixel, "255 where height is known"),
        "elevation_error.tif": tiff_bytes(found.sigma_um, pixel, "standard error of the elevation in um"),
        "points.csv": csv_bytes(COLUMNS, _rows(found)),
        "network.csv": csv_bytes(("from_row", "to_row", "length_um"), _links(found)),
        **_pictures(left, found, pixel, level),
    }
    files["report.json"] = json_bytes({**report(found, geometry), **facts, "versions": versions(), "files": FILES})
    return {name: files[name] for name in FILES}


def _rows(found: Elevation) -> list[list[object]]:
    p = found.points
    places = np.column_stack([p.left, p.right, p.left[:, 0] - p.right[:, 0], p.xyz_um, p.sigma_um])
    return [[*map(float, row), int(flag)] for row, flag in zip(places, p.ambiguous, strict=True)]


def _links(found: Elevation) -> list[list[object]]:
    xyz = found.points.xyz_um
    return [[int(a), int(b), float(np.linalg.norm(xyz[a] - xyz[b]))] for a, b in found.points.network]


def report(found: Elevation, geometry: Geometry) -> dict[str, Any]:
    """Return what was found, in numbers."""
    z = found.elevation_um[found.valid]
    sigma = found.sigma_um[np.isfinite(found.sigma_um)]
    spread = np.percentile(z, list(PERCENTILES.values())) if z.size else np.full(len(PERCENTILES), np.nan)
    plane = found.plane
    return {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "elevation_um": dict(zip(PERCENTILES, spread, strict=True)),
        "median_error_um": float(np.median(sigma)) if sigma.size else None,
        "share_valid": float(np.mean(found.valid)),
        "points": len(found.points.left),
        "ambiguous_points": int(found.points.ambiguous.sum()),
        "mean_plane": {
            "height_um": plane.height_um,
            "slope_x": plane.slope_x,
            "slope_y": plane.slope_y,
            "tilt_deg": plane.tilt_deg,
            "residual_rms_um": plane.rms_um,
            "taken_away": found.levelled,
        },
        "band_px": found.band_px,
        "pixel_um": geometry.pixel_um,
        "axis_px": geometry.axis_px,
        "views": [
            {"tilt_deg": v.tilt_deg, "shift_um": v.shift_um, "distance_um": v.distance_um} for v in geometry.views
        ],
        "grid": "pixels of the left view",
        "notes": found.notes,
    }


def _pictures(left: Array, found: Elevation, pixel_um: float, level: str) -> dict[str, bytes]:
    z, parallax, sigma = (_thick(found, a) for a in (found.elevation_um, found.parallax_px, found.sigma_um))
    limits = _limits(z)
    share = f"known in {np.mean(found.valid):.0%}, white elsewhere"
    words = {
        "elevation": MapWords(f"Elevation {limits[0]:.4g} … {limits[1]:.4g} µm; {share}", f"µm above {level}"),
        "parallax": MapWords("Parallax of the left view's pixels", "x left − x right, pixels"),
        "error": MapWords("Standard error of the elevation, from the matching", "µm"),
    }
    top = _limits(sigma)[1]
    return {
        "elevation.png": png_bytes(draw_map(z, limits, words["elevation"], ELEVATION_COLOURS, pixel_um)),
        "parallax.png": png_bytes(draw_map(parallax, _limits(parallax), words["parallax"], PARALLAX_COLOURS, pixel_um)),
        "elevation_error.png": png_bytes(draw_map(sigma, (0.0, top), words["error"], ERROR_COLOURS, pixel_um)),
        "contours.png": png_bytes(contour_picture(left, found, limits, pixel_um)),
    }


def _limits(values: Array) -> tuple[float, float]:
    known = values[np.isfinite(values)]
    return shown_limits(known) if known.size else (0.0, 1.0)


def _thick(found: Elevation, values: Array) -> Array:
    """Make single markers wide enough to be seen."""
    if not len(found.points.network):
        return values
    out = values.copy()
    for y, x in np.argwhere(np.isfinite(values)):
        reach = max(2, max(values.shape) // 150)
        out[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1] = values[y, x]
    return out


def contour_picture(left: Array, found: Elevation, limits: tuple[float, float], pixel_um: float) -> Array:
    """Draw contour lines over the left view: on the facets, on the map, or the network of markers; RGB uint8."""
    height, width = left.shape[:2]
    inches = MAP_SIDE_PX / DOTS_PER_INCH / max(height, width)
    figure = Figure(figsize=(width * inches + 2.2, height * inches + 1.3), dpi=DOTS_PER_INCH, layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(preview(left), cmap="gray", extent=(0.0, width * pixel_um, height * pixel_um, 0.0), alpha=0.6)
    levels = np.linspace(*limits, CONTOURS + 2)[1:-1]
    drawn = _lines(axes, found, levels, limits, pixel_um)
    axes.set(xlim=(0, width * pixel_um), ylim=(height * pixel_um, 0), xlabel="x, µm", ylabel="y, µm")
    axes.set_title(f"Contours every {levels[1] - levels[0]:.3g} µm" if not len(found.points.network) else "Markers")
    figure.colorbar(drawn, label="elevation, µm")
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba(), np.uint8)[..., :3].copy()


def _lines(axes: Axes, found: Elevation, levels: Array, limits: tuple[float, float], pixel_um: float) -> Any:
    p = found.points
    places, z = (p.left + 0.5) * pixel_um, p.xyz_um[:, 2]
    x, y = places.T
    colours: dict[str, Any] = {"cmap": ELEVATION_COLOURS, "clim": limits}
    if len(p.network):
        axes.add_collection(LineCollection(list(places[p.network]), colors="tab:red", linewidths=0.6))
        return axes.scatter(x, y, c=z, s=MARKER_DOT, cmap=ELEVATION_COLOURS, vmin=limits[0], vmax=limits[1])
    if len(p.facets):
        axes.triplot(x, y, p.facets, color="white", linewidth=0.2)
        pieces = facet_contours(places, p.facets, z, levels)
        heights = np.repeat(levels, [len(piece) for piece in pieces])
        return axes.add_collection(
            LineCollection(list(np.concatenate(pieces)), array=heights, linewidths=1.2, **colours)
        )
    height, width = found.elevation_um.shape
    across, down = ((np.arange(n) + 0.5) * pixel_um for n in (width, height))
    return axes.contour(
        across, down, np.ma.masked_invalid(found.elevation_um), levels, cmap=ELEVATION_COLOURS, linewidths=0.8
    )
