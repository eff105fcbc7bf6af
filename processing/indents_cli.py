"""The command ``stereotome process indents``."""

from __future__ import annotations

import json as notation
import math
import sys
from pathlib import Path  # noqa: TC003  the command line is made from the annotations
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tifffile
from cyclopts import Parameter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from acquire.progress import progress
from devices.errors import InputError
from processing.align_fiducials import COLUMNS as MARK_COLUMNS
from processing.indents import Indent, Removal, measured_indents, removal
from processing.indents_chain import Chain, chain, marks
from processing.outputs import versions
from processing.pictures import DOTS_PER_INCH, png_bytes, preview
from processing.readers import reading
from processing.readers_folder import is_tiff
from processing.result_folder import check_results, csv_bytes, json_bytes, plain, write_results
from processing.stack import open_stack

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

COLUMNS = ("picture", "indent", "shape", "x_um", "y_um", "diagonal_1_um", "error_1_um", "diagonal_2_um", "error_2_um",
           "depth_um", "depth_error_um")  # fmt: skip
FORMAT, FORMAT_VERSION = "stereotome-indents", 1
METRE_UM = 1e6
WIDTH_INCH = 10.0
Switch = Parameter(negative="")


def indents(
    before: Path,
    *after: Path,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    pixel_um: float | None = None,
    feed_um: list[float] | None = None,
    feed_error_um: float = 0.1,
    overwrite: Annotated[bool, Switch] = False,
    json: Annotated[bool, Switch] = False,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")] = False,
) -> int:
    """Measure Vickers and Knoop indents, and the depth removed between two or more pictures of a face.

    Two files lead on to a volume of the faces: stereotome process align FACES --fiducials marks.csv --depths chain.csv

    Parameters
    ----------
    before
        Picture of the face with its indents.
    after
        The same face after polishing, once or many times, in order; leave it out to measure one picture. New indents
        may be pressed on the way.
    output
        Folder for table, pictures with the outlines that were found, and report.
    pixel_um
        Size of a pixel in µm; goes before what the file says.
    feed_um
        What the feed counter says was removed before each further picture, in µm; once for each.
    feed_error_um
        Its standard error.
    overwrite
        Replace results that are in the folder.
    json
        Write the report as one JSON object to standard output.
    quiet
        Show no progress and no notes.
    """
    names = named(before, after)
    files_there = files_of(names)
    check_results(output, files_there, overwrite=overwrite)
    feeds = feed_um or []
    check_feed(feeds, feed_error_um, len(after))
    faces = {name: opened_face(path, pixel_um) for name, path in names.items()}
    found = {}
    with progress("measuring indents", len(faces), quiet=quiet) as show:
        for name, (image, pixel) in faces.items():
            found[name] = measured_indents(image, pixel)
            show(len(found))
    if not found["before"]:
        raise no_indent(before)
    listed = list(found.values())
    feed = feeds[0] if feeds else None
    lost = removal(listed[0], listed[1], feed_um=feed, feed_error_um=feed_error_um) if len(listed) == 2 else None
    sums = chain(listed, feeds, feed_error_um) if len(listed) > 2 else None
    said = report(found, lost, compared=len(listed) == 2) | chain_report(sums)
    said |= {"input": names, "pixel_um": {name: face[1] for name, face in faces.items()}, "versions": versions()}
    files = {"indents.csv": csv_bytes(COLUMNS, rows(found))}
    files |= {f"{name}.png": png_bytes(outlined(faces[name][0], found[name])) for name in names}
    if after:
        sizes = [pixel for _, pixel in faces.values()]
        files["marks.csv"] = csv_bytes(MARK_COLUMNS, [list(line) for line in marks(listed, sizes)])
    if sums is not None:
        files |= {"chain.csv": chain_table(sums), "chain.png": chain_picture(sums)}
    said["files"] = [*files, "report.json"]
    write_results(output, {**files, "report.json": json_bytes(said)})
    sys.stderr.writelines([] if quiet else [f"note: {note}\n" for note in said["notes"]])
    sys.stdout.write(notation.dumps(plain(said), ensure_ascii=False) + "\n" if json else summary(said, output))
    return 0


def named(before: Path, after: tuple[Path, ...]) -> dict[str, Path]:
    """Return the pictures by the names their results carry: before and after, or numbered when there are more."""
    if len(after) <= 1:
        return dict(zip(("before", "after"), (before, *after), strict=False))
    return {"before": before, **{f"after_{k}": path for k, path in enumerate(after, start=1)}}


def files_of(names: dict[str, Path]) -> list[str]:
    """Return the names of what is written."""
    marked = ["marks.csv"] if len(names) > 1 else []
    chained = ["chain.csv", "chain.png"] if len(names) > 2 else []
    return ["indents.csv", *(f"{name}.png" for name in names), *marked, *chained, "report.json"]


def check_feed(feeds_um: list[float], error_um: float, steps: int) -> None:
    """Refuse feeds that are no numbers or not one for each step, or an error that is not positive."""
    if all(map(math.isfinite, feeds_um)) and 0 < error_um < math.inf and len(feeds_um) in {0, steps}:
        return
    raise InputError(
        f"feeds of {feeds_um} ± {error_um} µm cannot be used with {steps} further pictures.",
        fix="give one number for each further picture, the error positive: --feed-um 1.5 --feed-error-um 0.1",
        code="indents-feed",
    )


def chain_report(sums: Chain | None) -> dict[str, Any]:
    """Return what a chain of faces says, for the report."""
    if sums is None:
        return {}
    return {
        "chain": {
            "removed_um": sums.removed_um,
            "errors_um": sums.errors_um,
            "tracks": sums.tracks,
            "chi_square_per_freedom": sums.chi_square_per_freedom,
        },
        "notes": list(sums.notes),
    }


def chain_table(sums: Chain) -> bytes:
    """Encode what was removed up to each face."""
    steps = [0.0, *np.diff(sums.removed_um)]
    lines = zip(
        range(len(steps)), map(float, sums.removed_um), map(float, sums.errors_um), map(float, steps), strict=True
    )
    return csv_bytes(("face", "removed_um", "error_um", "since_last_um"), [list(line) for line in lines])


def chain_picture(sums: Chain) -> bytes:
    """Draw what was removed up to each face, and which indents bridge which faces."""
    figure = Figure(figsize=(8.0, 4.5), dpi=DOTS_PER_INCH, layout="constrained")
    removed, seen = figure.subplots(1, 2)
    removed.errorbar(range(len(sums.removed_um)), sums.removed_um, sums.errors_um, fmt="o-", capsize=3)
    removed.set(title="Removed since the first face", xlabel="face", ylabel="µm")
    for row, track in enumerate(sums.tracks):
        seen.plot([face for face, _ in track], [row] * len(track), "o-")
    seen.set(title="Indents that bridge faces", xlabel="face", ylabel="indent")
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    return png_bytes(np.asarray(canvas.buffer_rgba(), np.uint8)[..., :3].copy())


def no_indent(path: Path) -> InputError:
    """Return the error for a picture without indents."""
    return InputError(
        f"no indent was found in {path}.",
        why="Four facets of a pyramid, crossed diagonals at right angles, nearly equal or about 7 : 1.",
        fix="give a picture that shows whole indents, at least 40 pixels across, on a face that is plain otherwise.",
        code="indents-none",
    )


def opened_face(path: Path, pixel_um: float | None) -> tuple[Array, float]:
    """Read a picture, (height, width), without the bar of data a microscope puts below it, and its pixel size.

    Raises
    ------
    InputError
        The file cannot be read, or no sensible pixel size is known.
    """
    fei = fei_facts(path)
    stack = open_stack(path)
    if len(stack) > 1:
        raise InputError(
            f"{path} holds {len(stack)} planes; a face is one picture.",
            fix="give a file for each face, in the order of polishing",
            code="stereo-planes",
        )
    image = stack[0] if stack[0].ndim == 2 else stack[0].mean(axis=2)
    rows = int(fei.get("Image", {}).get("ResolutionY", image.shape[0]))
    from_fei = fei.get("Scan", {}).get("PixelWidth")
    known = METRE_UM * float(from_fei) if from_fei else stack.pixel_um
    size = known if pixel_um is None else pixel_um
    if size is None or not (math.isfinite(size) and size > 0):
        words = "no pixel size is known" if size is None else f"a pixel of {size:g} µm cannot be"
        raise InputError(f"{path}: {words}.", fix="give it in µm: --pixel-um 0.065", code="stereo-pixel")
    return image[:rows], size


def fei_facts(path: Path) -> dict[str, Any]:
    """Return what an FEI or Thermo Fisher microscope wrote into its TIFF (tag 34682); empty for other files."""
    if not (path.is_file() and is_tiff(path)):
        return {}
    with reading(path), tifffile.TiffFile(path) as file:
        return dict(file.fei_metadata or {})


def rows(found: dict[str, list[Indent]]) -> list[list[object]]:
    """Return a line of the table for every indent."""
    return [
        [name, k, i.shape, *i.centre_um, i.diagonals_um[0], i.diagonal_errors_um[0], i.diagonals_um[1],
         i.diagonal_errors_um[1], i.depth_um, i.depth_error_um]
        for name, listed in found.items()
        for k, i in enumerate(listed)
    ]  # fmt: skip


def report(found: dict[str, list[Indent]], lost: Removal | None, *, compared: bool) -> dict[str, Any]:
    """Return what was measured, in numbers."""
    listed = {
        name: [
            {
                "shape": i.shape,
                "centre_um": i.centre_um,
                "corners_px": i.corners_px,
                "diagonals_um": i.diagonals_um,
                "diagonal_errors_um": i.diagonal_errors_um,
                "depth_um": i.depth_um,
                "depth_error_um": i.depth_error_um,
                "notes": i.notes,
            }
            for i in indents_there
        ]
        for name, indents_there in found.items()
    }
    notes = ["no indent of the first picture is seen in the second."] if compared and lost is None else []
    return {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "indents": listed,
        "removal": None if lost is None else {**vars(lost), "tilt_deg": lost.tilt_deg},
        "notes": [*notes, *(lost.notes if lost is not None else ())],
    }


def summary(said: dict[str, Any], folder: Path) -> str:
    """Return the lines a person reads at the end."""
    lines = [
        f"{name} {k}: {i['shape']}, diagonals {i['diagonals_um'][0]:.2f} ± {i['diagonal_errors_um'][0]:.2f} and "
        f"{i['diagonals_um'][1]:.2f} ± {i['diagonal_errors_um'][1]:.2f} µm, depth {i['depth_um']:.3f} ± "
        f"{i['depth_error_um']:.3f} µm"
        for name, listed in said["indents"].items()
        for k, i in enumerate(listed)
    ]
    lost = said["removal"]
    if lost is not None:
        tilt = "" if lost["tilt_deg"] is None else f", tilted by {lost['tilt_deg']:.4f}°"
        lines.append(f"removed {lost['blended_um']:.3f} ± {lost['blended_error_um']:.3f} µm{tilt}")
    summed = said.get("chain")
    if summed is not None:
        ends = summed["removed_um"][-1], summed["errors_um"][-1]
        lines.append(f"removed in {len(summed['removed_um'])} faces: {ends[0]:.3f} ± {ends[1]:.3f} µm")
    return "\n".join([*lines, *(str(folder / name) for name in said["files"])]) + "\n"


def outlined(image: Array, listed: list[Indent]) -> Array:
    """Draw the outlines that were found, their diagonals and numbers over a picture; RGB (h, w, 3) uint8."""
    height, width = image.shape
    figure = Figure(figsize=(WIDTH_INCH, WIDTH_INCH * height / width), dpi=DOTS_PER_INCH)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.imshow(preview(image.astype(np.uint16)), cmap="gray", aspect="auto")
    for k, indent in enumerate(listed):
        corners = indent.corners_px
        axes.plot(*np.vstack([corners, corners[:1]]).T, color="tab:red", linewidth=1)
        for diagonal in (0, 1):
            axes.plot(*corners[[diagonal, diagonal + 2]].T, color="tab:orange", linewidth=0.7, linestyle="--")
        words = f"{k}: {indent.diagonals_um[0]:.2f} / {indent.diagonals_um[1]:.2f} µm, {indent.depth_um:.3f} µm deep"
        style = {"facecolor": "black", "alpha": 0.6, "pad": 2}
        x, y = (float(v) for v in (corners[:, 0].mean(), corners[:, 1].max() + 0.02 * height))
        axes.text(x, y, words, color="white", fontsize=9, bbox=style, ha="center", va="top")
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    axes.set_axis_off()
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba(), np.uint8)[..., :3].copy()
