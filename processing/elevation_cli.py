"""The command ``stereotome process elevation``."""

from __future__ import annotations

import json as notation
import sys
from dataclasses import dataclass, replace
from pathlib import Path  # noqa: TC003  the command line is made from the annotations
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from cyclopts import Parameter

from acquire.progress import progress
from devices.clock import SystemClock
from devices.errors import InputError
from processing.elevation import Elevation, Geometry, Method, elevation, levelled
from processing.elevation_outputs import FILES, contents, report
from processing.memory import check_memory
from processing.outputs import peak_memory_mb
from processing.result_folder import check_results, plain, write_results
from processing.stack import open_stack
from processing.stereo_geometry import further_view, shifted_pair, tilted_pair
from processing.stereo_interest import Interest  # noqa: TC001  the command line is made from the annotations
from processing.stereo_points import read_matches

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from processing.stereo_geometry import View

    Array = NDArray[Any]

BYTES_PER_PIXEL = 120  # of maps, places and errors, for each view beyond the first
Switch = Parameter(negative="")


@Parameter(name="*")
@dataclass(frozen=True)
class Taking:
    """How the pair was taken."""

    tilt_deg: float | None = None
    "Whole angle between the views."
    left_deg: float | None = None
    "Tilt of the left view: 0 if it was taken flat; half the angle when left out."
    pixel_um: float | None = None
    "Size of a pixel in µm; goes before what the file says."
    distance_um: float | None = None
    "Projection distance at low magnification, in µm; rays are parallel without it."
    shift_um: float | None = None
    "Way of the stage between the views, for a shifted stage in place of a tilted one."
    axis_px: float | None = None
    "Column of the tilt axis; the middle of the picture when left out."

    def views(self) -> tuple[View, View]:
        """Return the geometry of both views."""
        distance = float("inf") if self.distance_um is None else self.distance_um
        if (self.tilt_deg is None) == (self.shift_um is None):
            raise InputError(
                "elevation needs the angle between the views, or the way of the stage, one of both.",
                fix=("give the whole angle: --tilt-deg 8", "give the shift: --shift-um 500 --distance-um 10000"),
                code="stereo-tilt",
            )
        if self.shift_um is not None:
            return shifted_pair(self.shift_um, distance)
        assert self.tilt_deg is not None
        return tilted_pair(self.tilt_deg, left_deg=self.left_deg, distance_um=distance)

    def geometry(self, from_file_um: float | None) -> Geometry:
        """Return the geometry, with the pixel size of the file if none was given."""
        pixel = self.pixel_um if self.pixel_um is not None else from_file_um
        if pixel is None:
            raise InputError("no pixel size is known.", fix="give it in µm: --pixel-um 0.2", code="stereo-pixel")
        return Geometry(self.views(), pixel, self.axis_px)


def elevation_command(
    left: Path,
    right: Path,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    taking: Taking = Taking(),
    more: list[tuple[Path, float]] | None = None,
    method: Method = "area",
    interest: Interest = "zuniga-haralick",
    band_px: tuple[int, int] | None = None,
    relief_um: float | None = None,
    matches: Path | None = None,
    level: Annotated[bool, Switch] = False,
    overwrite: Annotated[bool, Switch] = False,
    json: Annotated[bool, Switch] = False,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")] = False,
) -> int:
    """Measure the elevation of a surface from two views, tilted about the vertical of the picture.

    Parallax is x left minus x right; up is positive. Maps lie on the pixels of the left view.

    Parameters
    ----------
    left, right
        The two views; the same point lies in the same row of both.
    output
        Folder for maps, points, pictures and report.
    more
        A further view: file, and its tilt in degrees counted like that of the left view (positive brings what is high
        to the right); once for each. Every pixel is placed by all views that show it.
    method
        area: every pixel by its surroundings; points: interesting points in order, and facets; markers: dark spots in
        a transparent volume, in any order.
    interest
        What makes a point interesting.
    band_px
        Lowest and highest parallax to look in.
    relief_um
        Largest height above and below the axis, in place of --band-px.
    matches
        A points.csv that was edited by hand; its places are taken instead of finding points.
    level
        Take away the mean plane.
    overwrite
        Replace results that are in the folder.
    json
        Write the report as one JSON object to standard output.
    quiet
        Show no progress and no notes.
    """
    check_results(output, FILES, overwrite=overwrite)
    clock = SystemClock()
    begin = clock.now()
    views, geometry, notes = opened_views(left, right, taking, more or [])
    refuse_one_twice(views)
    listed = None if matches is None else read_matches(matches)
    with progress("matching", 100, quiet=quiet) as show:
        found = elevation(
            views[0],
            views[1],
            geometry,
            method=method,
            band_px=band_px,
            relief_um=relief_um,
            more=views[2:],
            interest=interest,
            matches=listed,
            progress=lambda share: show(round(100 * share)),
        )
    if level:
        found = levelled(found, geometry)
    notes = [*notes, *found.notes]
    sys.stderr.writelines([] if quiet else [f"note: {note}\n" for note in notes])
    took = {"seconds": round(clock.now() - begin, 3), "peak_memory_mb": round(peak_memory_mb(), 1)}
    facts = {
        "method": method,
        "input": {"left": str(left), "right": str(right), "more": [str(path) for path, _ in more or []]},
        "notes": notes,
        **took,
    }
    write_results(output, contents(views[0], found, geometry, facts))
    said = {**report(found, geometry), **facts, "files": FILES}
    sys.stdout.write(notation.dumps(plain(said), ensure_ascii=False) + "\n" if json else summary(said, found, output))
    return 0


def opened_views(
    left: Path, right: Path, taking: Taking, more: list[tuple[Path, float]]
) -> tuple[list[Array], Geometry, list[str]]:
    """Read all views and work out the geometry; also returns what the files leave to be said.

    Raises
    ------
    InputError
        A file is missing or holds more than one picture; the geometry makes no sense.
    """
    taking.views()  # numbers that make no sense are refused before files are read
    stacks = [open_stack(path) for path in (left, right, *(path for path, _ in more))]
    for stack in stacks:
        if len(stack) > 1:
            raise InputError(
                f"{stack.source} holds {len(stack)} planes; a view is one picture.",
                fix="make its extended focus first: stereotome process focus STACK -o DIR",
                code="stereo-planes",
            )
    pixels = stacks[0].shape[0] * stacks[0].shape[1]
    needed = pixels * BYTES_PER_PIXEL * (len(stacks) - 1)
    check_memory(needed, f"the elevation of {stacks[0].source}", "cut the views into fields, or bin them first")
    notes = [note for stack in stacks for note in stack.notes if not note.startswith("one plane")]
    geometry = taking.geometry(stacks[0].pixel_um)
    further = tuple(further_view(tilt_deg, geometry.views[0].distance_um) for _, tilt_deg in more)
    return [stack[0] for stack in stacks], replace(geometry, views=(*geometry.views, *further)), notes


def refuse_one_twice(views: Sequence[Array]) -> None:
    """Refuse a picture given as both views: all heights would come out as nothing."""
    if np.array_equal(views[0], views[1]) and np.ptp(views[0]) > 0:
        raise InputError(
            "both views are the same picture, pixel by pixel.",
            why="Two pictures of a tilted specimen never are.",
            fix="give the two views.",
            code="stereo-same",
        )


def summary(said: dict[str, Any], found: Elevation, folder: Path) -> str:
    """Return the lines a person reads at the end."""
    span, error = said["elevation_um"], said["median_error_um"]
    words = (
        f"elevation {span['p1']:.4g} … {span['p99']:.4g} µm"
        + (f" ± {error:.2g} µm" if error is not None else "")
        + f", known in {said['share_valid']:.1%} of the pixels; {said['points']} points; "
        f"mean plane inclined by {found.plane.tilt_deg:.2f}°; {said['seconds']:.1f} s"
    )
    return "\n".join([words, *(str(folder / name) for name in FILES)]) + "\n"
