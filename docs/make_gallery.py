"""Draw ``docs/gallery.md``: a picture for every technique of slices, volumes, stereo, range images and surfaces.

``python docs/make_gallery.py`` draws simulated specimens, which are grown here from the same seed each time. Where
STEREOTOME_DATA names a folder of measured data, ``python docs/make_gallery.py FOLDER`` draws those into FOLDER instead.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import tifffile
from scipy import ndimage

from devices.cli import run
from display.glasses_patterns import pattern
from display.load import load_volume
from display.sync_codes import marks
from sim.solid import Solid
from sim.specimen import make_specimen, tiled

Array = Any
HERE = Path(__file__).parent
SIDE, PIXEL_UM, STEP_UM = 96, 0.2, 0.25
SIZE = "360x270"
WIDE = 240  # px of a picture on the page
SEED = 5
CASES = {"E": "Slices", "F": "Volumes", "G": "Stereo", "H": "Range images", "I": "Surfaces"}


class Row(NamedTuple):
    """A technique and the command that draws it; ``{volume}`` and so on stand for a specimen's file."""

    id: str
    words: str
    command: str


VIEW = "--view 30,25"
ROWS = (
    Row("E1", "planes as a movie", "render {cells} --mode slice --movie planes --frames 8 --bounce"),
    Row("E2", "slice along z", "render {cells} --mode slice --axis z"),
    Row("E2", "slice along y", "render {cells} --mode slice --axis y"),
    Row("E2", "slice along x", "render {cells} --mode slice --axis x"),
    Row("E3", "thick voxels extended", "render {thick} --mode slice --axis y --rule nearest"),
    Row("E3", "thick voxels interpolated", "render {thick} --mode slice --axis y"),
    Row("E4", "three planes together", f"render {{cells}} --mode orthogonal {VIEW}"),
    Row("E5", "oblique plane, fixed volume", f"render {{cells}} --mode oblique {VIEW} --plane 75,10"),
    Row("E6", "frontal plane, turned volume", "render {cells} --mode slice --view 50,30"),
    Row("E7", "cut voxels as cubes", f"render {{coarse}} --mode cubes {VIEW} --plane 40,20 --threshold {{low}}"),
    Row("E8", "transparent under a threshold", f"render {{cells}} --mode orthogonal {VIEW} --threshold {{low}}"),
    Row("E8", "planes pulled apart", "render {cells} --mode exploded --view 60,15 --gap 3 --threshold {low}"),
    Row("E9", "tint by orientation", f"render {{cells}} --mode orthogonal {VIEW} --tint"),
    Row("E10", "colour table", "render {cells} --mode slice --colours viridis"),
    Row("E10", "three bands as colours", "render {bands} --mode slice --planes-are-bands"),
    Row("E10", "ratio of bands", "render {bands} --mode slice --planes-are-bands --ratio 0/1"),
    Row("E11", "x–t section", "render {time} --mode slice --axis y"),
    Row("F1", "absorption", f"render {{volume}} --mode absorption {VIEW}"),
    Row("F2", "emission, fading with depth", f"render {{volume}} --mode emission {VIEW} --fade 0.6"),
    Row("F3", "emission and absorption by tables", f"render {{volume}} --mode translucent {VIEW} --opacity {{table}}"),
    Row("F4", "maximum", f"render {{volume}} --mode mip {VIEW}"),
    Row("F4", "minimum", f"render {{cells}} --mode minip {VIEW} --cut x=.3:.7,y=.3:.7,z=.3:.7"),
    Row("F5", "first over a threshold", f"render {{volume}} --mode first {VIEW} --threshold {{high}}"),
    Row("F5", "last over a threshold", f"render {{volume}} --mode last {VIEW} --threshold {{high}}"),
    Row("F5", "steepest change", f"render {{volume}} --mode edge {VIEW}"),
    Row("F5", "depth of the maximum", f"render {{volume}} --mode depth {VIEW}"),
    Row("F6", "shifted planes", "render {volume} --mode shift --view 20,10"),
    Row("F7", "perspective", f"render {{volume}} --mode first {VIEW} --threshold {{high}} --perspective 40"),
    Row("F8", "shadow on a plane behind", f"render {{volume}} --mode first {VIEW} --threshold {{high}} --shadow rear"),
    Row(
        "F8", "shadows on each other", f"render {{volume}} --mode translucent {VIEW} --opacity {{table}} --shadow both"
    ),
    Row("F9", "bands in emission", f"render {{pair}} --mode emission --channels 0,1 {VIEW}"),
    Row(
        "F10",
        "surface within a volume",
        f"render {{volume}} --mode translucent {VIEW} --surface 0.6 --threshold {{high}} --opacity {{faint}}",
    ),
    Row("F11", "movie of a rotation", "render {volume} --mode mip --movie rotation --frames 16"),
    Row("F12", "cellophane", f"render {{volume}} --mode cellophane {VIEW}"),
    Row("F12", "glowing edges", f"render {{volume}} --mode glow {VIEW}"),
    *(
        Row(id_, f"{kind.replace('-', ' ')}{words}", f"render {{volume}} --mode {mode} {VIEW} --stereo {kind}")
        for id_, kind, mode, words in (
            ("G1", "parallel", "mip", ""),
            ("G1", "crossed", "emission", ""),
            ("G1", "over-under", "mip", ""),
            ("G2", "anaglyph-grey", "mip", ""),
            ("G2", "anaglyph-colour", "first", ""),
            ("G2", "anaglyph-half-colour", "depth", ""),
            ("G2", "anaglyph-optimised", "translucent", ""),
            ("G2", "anaglyph-dubois", "emission", ""),
            ("G2", "anaglyph-dubois-lcd", "absorption", ""),
            ("G2", "anaglyph-red-green", "mip", ""),
            ("G2", "anaglyph-red-blue", "mip", ""),
            ("G2", "anaglyph-green-magenta", "mip", ""),
            ("G2", "anaglyph-amber-blue", "first", ""),
            ("G4", "rows", "mip", ""),
            ("G4", "columns", "mip", ""),
            ("G4", "checkerboard", "mip", ""),
            ("G4", "frame-packed", "first", ""),
        )
    ),
    Row("G3", "two refreshes, with the line that tells the glasses whose", ""),
    Row(
        "G5",
        "eyes 65 mm apart at 600 mm, depth halved",
        f"render {{volume}} --mode mip {VIEW} --stereo anaglyph-grey --interocular-mm 65 --distance-mm 600 --depth 0.5",
    ),
    Row("G6", "specimen turned for each eye", f"render {{volume}} --mode mip {VIEW} --stereo parallel --eyes rotate"),
    Row("G6", "off-axis frusta", f"render {{volume}} --mode mip {VIEW} --stereo parallel --perspective 40"),
    Row("G6", "planes shifted for each eye", "render {volume} --mode shift --stereo parallel"),
    Row(
        "G7",
        "slices pulled apart",
        "render {cells} --mode exploded --view 60,15 --threshold {low} --stereo anaglyph-grey",
    ),
    Row("G7", "surfaces of features", "surface {labels} --opacity 0.6 --stereo parallel --view 30,25"),
    Row("G8", "crosstalk seen by each eye", ""),
    Row("H4", "profiles", "relief {heights} --mode profile"),
    Row("H4", "stacked profiles", "relief {heights} --mode stacked"),
    Row("H5", "contours, interpolated", "relief {heights} --mode contour"),
    Row("H5", "contours along edges of pixels", "relief {few} --mode contour --edges pixels"),
    Row("H6", "grid", "relief {heights} --mode grid"),
    Row("H6", "isometric, grey", "relief {heights} --mode isometric --paint heights --colours gray"),
    Row("H6", "isometric, rapidly varying colours", "relief {heights} --mode isometric --paint cycles --colours hsv"),
    Row("H7", "flat", "relief {few} --shading flat"),
    Row("H7", "Gouraud", "relief {few} --shading gouraud --answer 0.1,0.5,0.6,30"),
    Row("H7", "Phong", "relief {few} --shading phong --answer 0.1,0.5,0.6,30"),
    Row("H7", "light moved", "relief {heights} --movie light --frames 8"),
    Row("H8", "image draped over it", "relief {heights} --drape {drape}"),
    Row("H9", "stereo", "relief {heights} --stereo anaglyph-grey --drape {drape}"),
    Row("I4", "partial transparency", "surface {labels} --opacity 0.5"),
    Row("I4", "others dimmed", "surface {labels} --bright {names} --dimmed 0.15"),
    Row("I5", "a colour for each feature", "surface {labels}"),
    Row("I5", "outlines of sections", "surface {labels} --mode outlines"),
)


def simulated(folder: Path) -> dict[str, str]:
    """Grow the specimens: an embedded lump of cells, a moving one, and a rough surface."""
    solid, half = Solid(SEED), SIDE / 2
    z, y, x = (np.mgrid[:SIDE, :SIDE, :SIDE] - half + 0.5) / half
    lump = np.clip((0.92 - np.sqrt(z * z + y * y + 0.7 * x * x)) / 0.06, 0, 1)
    faces = np.stack([solid.face((SIDE, SIDE), PIXEL_UM, k * STEP_UM) for k in range(SIDE)])
    cells = np.rint(250 * faces * lump).astype(np.uint8)
    depths_um = STEP_UM * (np.arange(SIDE) - half)[:, None, None]
    volume = np.zeros(faces.shape)
    for sheet in make_specimen("depth", (SIDE, SIDE), PIXEL_UM, seed=SEED, reach_um=0.4 * SIDE * STEP_UM).sheets:
        glow = tiled(sheet.texture, faces.shape[1:]) * np.exp(-(((depths_um - sheet.height_um) / (2 * STEP_UM)) ** 2))
        volume = np.maximum(volume, glow)  # filaments and beads, each at its depth
    volume = np.rint(250 * volume / volume.max()).astype(np.uint8)
    specimen = make_specimen("relief", (192, 144), 0.5, seed=SEED, reach_um=8.0)
    heights, texture = specimen.height_um(), tiled(specimen.sheets[0].texture, (144, 192))
    drift = np.stack([np.roll(cells[SIDE // 2], k, axis=1) for k in range(48)])
    return written(folder, volume, cells, (STEP_UM, PIXEL_UM), (heights, specimen.pixel_um, texture), drift)


def measured(folder: Path, data: Path) -> dict[str, str]:
    """Take the same from measured data: a head, a relief of the land, tissue of three stains, a dividing cell."""
    head = load_volume(next((data / "vol_colin27").glob("*.nii*")))
    with np.load(next((data / "dem_jacksboro").glob("*.npz"))) as file:
        land = np.ascontiguousarray(file["elevation"], np.float32)
    slope = np.hypot(*np.gradient(land))
    stains = tifffile.imread(next((data / "multiband_bpae").glob("*.tif")))
    values, step = head.bands[0].values, head.spacing_um
    relief = (land, 83.0, 1 / (1 + slope / slope.mean()))  # 3 seconds of arc: 92.6 m, and 74.4 m across at 36.6° N
    made = written(folder, values, values, (step[0], step[1]), relief, values)
    np.save(folder / "bands.npy", stains[:, ::2, ::2])
    return {**made, "heights": made["heights"] + " --unit m", "few": made["few"] + " --unit m"}


def written(
    folder: Path,
    volume: Array,
    cells: Array,
    spacing_um: tuple[float, float],
    relief: tuple[Array, float, Array],
    drift: Array,
) -> dict[str, str]:
    """Write what all commands read; return their words."""
    heights, pixel_um, texture = relief
    step_um, side_um = spacing_um

    def stack(name: str, values: Array, z_um: float, xy_um: float, axes: str = "ZYX") -> str:
        path = folder / f"{name}.ome.tif"
        where = {"axes": axes, "PhysicalSizeX": xy_um, "PhysicalSizeY": xy_um, "PhysicalSizeZ": z_um}
        tifffile.imwrite(path, values, metadata=where, ome=True)
        return str(path)

    full = float(np.percentile(volume, 99.9))
    smooth = ndimage.gaussian_filter(cells.astype(np.float32), 2)
    labels, count = ndimage.label(smooth > 0.7 * smooth.max())
    edges = np.rint(255 * np.clip(ndimage.gaussian_gradient_magnitude(cells.astype(np.float32), 1) / (full / 4), 0, 1))
    bands = np.stack([cells[len(cells) // 2], edges[len(cells) // 2].astype(cells.dtype), volume[len(volume) // 2]])
    np.save(folder / "bands.npy", bands)
    np.savez(folder / "heights.npz", height_um=heights, pixel_um=pixel_um)
    np.savez(folder / "few.npz", height_um=heights[::4, ::4], pixel_um=4 * pixel_um)
    cv2.imwrite(str(folder / "drape.png"), np.rint(255 * texture / texture.max()).astype(np.uint8))
    (folder / "table.csv").write_text(
        f"value,opacity,red,green,blue\n0,0,0,0,0\n{0.35 * full},0,.2,.3,1\n"
        f"{0.6 * full},.08,1,.6,.3\n{full},.35,1,1,.9\n"
    )
    (folder / "faint.csv").write_text(f"value,opacity\n{0.2 * full},0\n{full},0.03\n")
    both = np.stack([volume, edges.astype(volume.dtype)], axis=1)
    sizes = ndimage.sum_labels(labels > 0, labels, np.arange(1, count + 1))
    largest = np.argsort(sizes)[::-1][:3] + 1
    return {
        "volume": stack("volume", volume, step_um, side_um),
        "cells": stack("cells", cells, step_um, side_um),
        "thick": stack("thick", np.ascontiguousarray(cells[::6]), 6 * step_um, side_um),
        "coarse": stack("coarse", np.ascontiguousarray(cells[::5, ::5, ::5]), 5 * step_um, 5 * side_um),
        "time": stack("time", drift, 1.0, side_um, "TYX"),
        "pair": stack("pair", both, step_um, side_um, "ZCYX"),
        "labels": stack("labels", labels.astype(np.uint16), step_um, side_um),
        "bands": str(folder / "bands.npy"),
        "heights": str(folder / "heights.npz"),
        "few": str(folder / "few.npz"),
        "drape": str(folder / "drape.png"),
        "table": str(folder / "table.csv"),
        "faint": str(folder / "faint.csv"),
        "low": f"{0.15 * full:.0f}",
        "high": f"{0.45 * full:.0f}",
        "names": ",".join(str(k) for k in sorted(largest)),
    }


def drawn(row: Row, sources: dict[str, str], out: Path, number: int) -> Path:
    """Draw a row; return the picture as the page shows it."""
    made = out / f"{number:02d}-{row.id}.{'gif' if '--movie' in row.command else 'png'}"
    if row.command:
        words = row.command.format(**sources).split()
        size = "200x150" if made.suffix == ".gif" else SIZE
        if code := run([*words, "--size", size, "-o", str(made), "--overwrite"]):
            raise SystemExit(f"{row.id} {row.words}: ended with {code}")
    else:
        cv2.imwrite(str(made), for_glasses(row.id)[..., ::-1])
    return made if made.suffix == ".gif" else smaller(made)


def for_glasses(id_: str) -> Array:
    """Return what a screen shows to shutter glasses at two refreshes, side by side."""
    size = (360, 270)
    left, right = pattern("eyes" if id_ == "G3" else "crosstalk", size)
    for picture, code in ((left, marks("white-line", "left", 0, size)), (right, marks("white-line", "right", 1, size))):
        for mark in code:
            picture[mark.y : mark.y + mark.height, mark.x : mark.x + mark.width] = 255 * np.array(mark.colour)
    return np.hstack([left, right])


def smaller(made: Path) -> Path:
    """Replace a PNG by a small JPEG."""
    picture = cv2.imread(str(made))
    high = round(picture.shape[0] * WIDE / picture.shape[1])
    wide, high = (WIDE, high) if high <= WIDE else (round(WIDE * WIDE / high), WIDE)
    made.unlink()
    made.with_suffix(".csv").unlink(missing_ok=True)
    cv2.imwrite(
        str(made.with_suffix(".jpg")),
        cv2.resize(picture, (wide, high), interpolation=cv2.INTER_AREA),
        [cv2.IMWRITE_JPEG_QUALITY, 82],
    )
    return made.with_suffix(".jpg")


def page(pictures: list[Path]) -> str:
    """Return the page: three pictures to a line, and under each what it is and how it is made."""
    lines = [
        "# Gallery",
        "",
        "Made by `python docs/make_gallery.py` from simulated specimens. Words in braces stand for files.",
        "",
    ]
    for letter, title in CASES.items():
        lines += [f"## {letter}. {title}", "", "| | | |", "|---|---|---|"]
        cells = [
            f"![{row.words}](gallery/{path.name})<br>**{row.id}** {row.words}<br>`{row.command or 'glasses pattern'}`"
            for row, path in zip(ROWS, pictures, strict=True)
            if row.id[0] == letter
        ]
        cells += [""] * (-len(cells) % 3)
        lines += ["| " + " | ".join(cells[k : k + 3]) + " |" for k in range(0, len(cells), 3)] + [""]
    return "\n".join(lines)


def main() -> None:
    """Draw all of it."""
    data = os.environ.get("STEREOTOME_DATA") if len(sys.argv) > 1 else None
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "gallery"
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        sources = measured(Path(folder), Path(data)) if data else simulated(Path(folder))
        pictures = [drawn(row, sources, out, k) for k, row in enumerate(ROWS)]
    if data is None:
        (out.parent / "gallery.md").write_text(page(pictures), encoding="utf-8")


if __name__ == "__main__":
    main()
