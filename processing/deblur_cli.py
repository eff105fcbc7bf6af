"""The commands ``stereotome process deblur`` and ``stereotome process psf``."""

from __future__ import annotations

import json as notation
import shutil
import sys
from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path  # noqa: TC003  the command line is made from the annotations
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tifffile
from cyclopts import Parameter

from acquire.ome_zarr import FocalArray
from acquire.progress import progress
from devices.clock import SystemClock
from devices.errors import InputError
from processing.block_options import IN_MEMORY, WORK, Blocks
from processing.block_source import Source
from processing.deblur_known import Known, known_of
from processing.deblur_tiles import NAME, TITLE, Course, Deblurring, deblur
from processing.memory import check_memory, free_bytes
from processing.outputs import about_stack, peak_memory_mb, versions, write_durably
from processing.pictures import png_bytes
from processing.psf import Optics, checked_psf, from_beads, modelled, support
from processing.readers import reading
from processing.result_folder import check_results, json_bytes, write_results
from processing.stack import Stack, open_stack
from processing.volume_files import (
    MiddleCuts,
    middle_cuts,
    publish,
    pyramid,
    settle_volume,
    side_by_side,
    volume_names,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Array = NDArray[Any]
    Spacing = tuple[float, float, float]

Switch = Parameter(negative="")
Method = Literal["richardson-lucy", "wiener", "van-cittert"]
FILES = (*volume_names(NAME), "psf.tif", "deblurred.png", "psf.png", "report.json")
PSF_FILES = ("psf.tif", "psf.png", "report.json")
EVEN = 0.2  # of the step: planes further from their places are not evenly spaced; the depth of focus hides less
SATURATED = 1e-3
UNEXPLAINED = 3.0  # times the noise
FEWEST_PLANES = 3


def deblur_command(
    stack: Path,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    method: Method = "richardson-lucy",
    psf: Path | None = None,
    na: float | None = None,
    wavelength_um: float | None = None,
    index: float = 1.0,
    specimen_index: float | None = None,
    depth_um: float = 0.0,
    steps: int = 30,
    background: float | None = None,
    pixel_um: float | None = None,
    step_um: float | None = None,
    channel: int | None = None,
    time: int | None = None,
    blocks: Blocks = IN_MEMORY,
    overwrite: Annotated[bool, Switch] = False,
    json: Annotated[bool, Switch] = False,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")] = False,
) -> int:
    """Take the blur out of a widefield stack of fluorescence, as far as its noise allows.

    Parameters
    ----------
    stack
        Run folder, OME-Zarr, TIFF, a folder of PNG, JPEG or TIFF images (or a quoted pattern of their names), NPY,
        NPZ or NIfTI; evenly spaced, grey.
    output
        Folder for the volume, pictures and report.
    method
        richardson-lucy: best for fluorescence; wiener: one step, quick; van-cittert: from a few neighbouring planes.
        The first and the last end by themselves when the noise is reached.
    psf
        Point spread function as TIFF: what process psf measures; computed from the optics when left out.
    na, wavelength_um
        Aperture of the objective; wavelength of the light that is seen.
    index, specimen_index, depth_um
        Refractive index the objective is made for; index of the specimen; how deep below its cover the stack lies.
    steps
        Iterations at most.
    background
        Grey level of no light; estimated when left out.
    pixel_um, step_um
        Size of a pixel and distance of planes; go before what the file says.
    channel
        Channel, or series of images, to take when there are several; counted from 0.
    time
        Time point to take when there are several; counted from 0.
    overwrite
        Replace results that are in the folder.
    json
        Write the report as one JSON object to standard output.
    quiet
        Show no progress and no notes.
    """
    check_results(output, FILES, overwrite=overwrite)
    source = Source(stack, step_um, channel, time)
    opened = source.stack
    spacing = even_spacing(opened, pixel_um)
    if psf:
        spread, origin = read_psf(psf, spacing), {"file": str(psf)}
    else:
        optics = optics_of(na, wavelength_um, index, specimen_index, depth_um)
        spread, origin = modelled(optics, spacing, support(optics, spacing, len(opened))), asdict(optics)
    work = Work(source, spacing, spread, method, steps, background)
    made: Array | Path
    if blocks.wanted:
        made, report = work.by_blocks(blocks, output, overwrite=overwrite, quiet=quiet)
    else:
        made, report = work.in_memory(quiet=quiet)
    report |= {"psf": {**origin, "shape": spread.shape}}
    work.write(output, made, report)
    shutil.rmtree(output / WORK, ignore_errors=True)
    for note in [] if quiet else report["notes"]:
        sys.stderr.write(f"note: {note}\n")
    sys.stdout.write(json_bytes(report).decode() if json else summary(report, output))
    return 0


def optics_of(
    na: float | None, wavelength_um: float | None, index: float, specimen_index: float | None, depth_um: float
) -> Optics:
    """Return the optics, or say what is missing to compute a point spread function."""
    if na is None or wavelength_um is None:
        raise InputError(
            "the point spread function is not known.",
            fix=("compute it: --na 0.8 --wavelength-um 0.525", "measure it: stereotome process psf BEADS, then --psf"),
            code="deblur-optics",
        )
    return Optics(na, wavelength_um, index, specimen_index, depth_um)


def even_spacing(stack: Stack, pixel_um: float | None) -> Spacing:
    """Return (dz, dy, dx) in µm of a stack that can be deblurred.

    Raises
    ------
    InputError
        ``deblur-planes``: colour, or too few planes; ``deblur-spacing``: unknown or uneven.
    """
    if stack.colour or len(stack) < FEWEST_PLANES:
        raise InputError(
            f"{stack.source} has {len(stack)} {'colour' if stack.colour else 'grey'} planes.",
            why="The blur of a plane is known from its neighbours, and from one wavelength.",
            fix=f"give a grey stack, or one channel of it, of at least {FEWEST_PLANES} planes.",
            code="deblur-planes",
        )
    pixel = pixel_um if pixel_um is not None else stack.pixel_um
    if stack.z_um is None or pixel is None or not (np.isfinite(pixel) and pixel > 0):
        raise InputError(
            "deblurring needs the size of the voxels in µm.",
            fix="give what the file lacks: --step-um 0.3 --pixel-um 0.1",
            code="deblur-spacing",
        )
    steps = np.abs(np.diff(stack.z_um))
    places = np.linspace(stack.z_um[0], stack.z_um[-1], len(stack))
    if np.abs(stack.z_um - places).max() > EVEN * steps.mean():
        raise InputError(
            f"the planes are {steps.min():g} … {steps.max():g} µm apart.",
            why="One point spread function serves evenly spaced planes alone.",
            fix="space them evenly first: stereotome process resample STACK -o DIR --method linear",
            code="deblur-spacing",
        )
    return float(steps.mean()), pixel, pixel


def read_psf(path: Path, spacing: Spacing) -> NDArray[np.float32]:
    """Read a point spread function; refuse one that was measured at another spacing.

    Raises
    ------
    InputError
        ``input-missing``, ``input-damaged``, ``deblur-psf`` or ``deblur-spacing``.
    """
    if not path.is_file():
        raise InputError(f"there is no {path}.", fix="check the name.", code="input-missing")
    with reading(path), tifffile.TiffFile(path) as file:
        psf, words = file.asarray(), file.pages.first.description
    said = notation.loads(words).get("spacing_um") if words.startswith("{") else None
    if said is not None and not np.allclose(said, spacing, rtol=0.02):
        raise InputError(
            f"{path} was made for voxels of {said} µm; the stack has {list(spacing)}.",
            fix="measure or compute it for this stack",
            code="deblur-spacing",
        )
    return checked_psf(psf)


def blank_planes(flat: Sequence[int], reach: int) -> list[str]:
    """Name the planes that show a single grey value, which no camera takes: their light is missing around them, too."""
    if not flat:
        return []
    which = f"planes {', '.join(map(str, flat))} are" if len(flat) > 1 else f"plane {flat[0]} is"
    return [f"{which} one grey value everywhere: do not believe the planes up to {reach} from there."]


@dataclass(frozen=True)
class Work:
    """A stack to be deblurred and how."""

    source: Source
    spacing: Spacing
    psf: NDArray[np.float32]
    method: Method
    steps: int
    background: float | None

    @property
    def stack(self) -> Stack:
        """The stack, opened."""
        return self.source.stack

    @property
    def layout(self) -> FocalArray:
        """Of the volume that is made."""
        stack = self.stack
        assert stack.z_um is not None
        step = float(stack.z_um[-1] - stack.z_um[0]) / (len(stack) - 1)
        first = float(stack.z_um[0])
        return pyramid(FocalArray(len(stack), stack.shape, str(stack.dtype), first, step, self.spacing[1]))

    def in_memory(self, *, quiet: bool) -> tuple[Array, dict[str, Any]]:
        """Deblur the stack as a whole; returns the volume and the report."""
        begin = SystemClock().now()
        volume = read_volume(self.stack)
        known = known_of(volume)
        how = self.settled(known)
        with progress("deblurring", 1000, quiet=quiet) as show:
            tell = lambda share: show(round(1000 * share))  # noqa: E731
            restored = deblur(volume, self.psf, how, memory=free_bytes() / 3, tell=tell)
        return restored.volume, self._report(how, known, restored.course, begin)

    def by_blocks(self, blocks: Blocks, output: Path, *, overwrite: bool, quiet: bool) -> tuple[Path, dict[str, Any]]:
        """Deblur the stack tile by tile; returns where the image is, and the report."""
        from processing.deblur_blocks import deblur_by_blocks  # noqa: PLC0415  dask takes a second

        begin = SystemClock().now()
        told = {"method": self.method, "steps": self.steps, "background": self.background, "spacing": self.spacing}
        how = (self.source, self.psf, self.settled, self.layout, blocks, output)
        image, settled, known, course = deblur_by_blocks(*how, told=told, overwrite=overwrite, quiet=quiet)
        return image, {**self._report(settled, known, course, begin), "blocks": {"memory": blocks.memory}}

    def settled(self, known: Known) -> Deblurring:
        """Return how the stack is deblurred, once it is known.

        Raises
        ------
        InputError
            ``deblur-blank``: it shows nothing; ``deblur-optics``: no steps.
        """
        if known.low == known.high:
            raise InputError(
                f"{self.stack.source} is {known.low} everywhere.",
                fix="give a stack that shows something.",
                code="deblur-blank",
            )
        if self.steps < 1:
            raise InputError(f"{self.steps} steps are none.", fix="--steps 30", code="deblur-optics")
        background = known.background if self.background is None else self.background
        return Deblurring(self.method, known.noise, background, self.steps, brightest=float(known.high))

    def _report(self, how: Deblurring, known: Known, course: Course, begin: float) -> dict[str, Any]:
        share = known.saturated
        notes = [f"{share:.1%} of the voxels are saturated: they and their surroundings come out too dark."]
        notes = [*(notes if share > SATURATED else []), *blank_planes(known.flat, len(self.psf) // 2), *misfit(course)]
        return {
            "format": "stereotome-deblur",
            "version": 1,
            **about_stack(self.stack),
            "notes": [*self.stack.notes, *notes],
            "spacing_um": self.spacing,
            **asdict(how),
            "steps": course.steps,
            "stopped": course.stopped,
            "residual_over_noise": [round(r, 4) for r in course.residual],
            "tiles": course.tiles,
            "halo_px": course.halo_px,
            "seconds": round(SystemClock().now() - begin, 3),
            "peak_memory_mb": round(peak_memory_mb(), 1),
            "versions": versions(),
            "files": list(FILES),
        }

    def write(self, folder: Path, made: Array | Path, report: dict[str, Any]) -> None:
        """Write all results; of an image that is there already, all but that."""
        stack, deep = self.stack, self.spacing[0] / self.spacing[1]
        before, after = MiddleCuts(len(stack)), MiddleCuts(len(stack))
        words = f"left as taken, right {self.method}, {report['steps']} steps; below x-z, {deep:.3g} px a plane"

        def fill(part: Path) -> None:
            settle_volume(part, NAME, TITLE, self.layout, made, after.seen)
            for _ in before.seen(stack[k] for k in range(len(stack))):
                pass
            write_durably(part / "psf.tif", psf_tiff(self.psf, self.spacing))
            write_durably(part / "psf.png", png_bytes(psf_picture(self.psf, deep)))
            write_durably(
                part / "deblurred.png", png_bytes(side_by_side(before.picture(deep), after.picture(deep), words))
            )
            write_durably(part / "report.json", json_bytes(report))

        publish(folder, fill)


def misfit(course: Course) -> list[str]:
    """Tell of a stack that the point spread function does not explain."""
    left = course.residual[-1] if course.residual else 1.0
    if left < UNEXPLAINED:
        return []
    words = (
        f"what stays unexplained is {left:.1f} times the noise: optics, spacing or background are not those of this "
        "stack, or it shows light from beyond its planes. Do not believe the result before that is found."
    )
    return [words]


def read_volume(stack: Stack) -> Array:
    """Read all planes; refuse what memory cannot hold twice."""
    needed = 2 * len(stack) * int(np.prod(stack.shape)) * stack.dtype.itemsize
    check_memory(needed, f"{stack.source}, before and after,", "go tile by tile: --memory 2GB")
    return np.stack([stack[k] for k in range(len(stack))])


def psf_tiff(psf: Array, spacing: Spacing) -> bytes:
    """Encode a point spread function with its spacing."""
    file = BytesIO()
    words = notation.dumps({"what": "point spread function", "spacing_um": [round(s, 9) for s in spacing]})
    tifffile.imwrite(file, psf, photometric="minisblack", description=words, metadata=None)
    return file.getvalue()


def psf_picture(psf: Array, deep: float) -> Array:
    """Show the middle cuts of a point spread function; the square root lets the rings be seen."""
    scaled = np.rint(65535 * np.sqrt(np.maximum(psf, 0) / psf.max())).astype(np.uint16)
    enlarged = scaled.repeat(4, 1).repeat(4, 2)
    return middle_cuts(enlarged, 4 * deep)


def measure_psf(
    beads: Path,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    half: tuple[int, int, int] = (8, 12, 12),
    pixel_um: float | None = None,
    step_um: float | None = None,
    channel: int | None = None,
    time: int | None = None,
    overwrite: Annotated[bool, Switch] = False,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")] = False,
) -> int:
    """Measure the point spread function on a stack of beads.

    Parameters
    ----------
    beads
        A stack as for process deblur, of small bright beads apart from each other.
    output
        Folder for psf.tif, picture and report.
    half
        Half of its size: planes, rows, columns.
    pixel_um, step_um
        Size of a pixel and distance of planes; go before what the file says.
    channel, time
        Which to take when there are several; counted from 0.
    overwrite
        Replace results that are in the folder.
    quiet
        Show no notes.
    """
    check_results(output, PSF_FILES, overwrite=overwrite)
    opened = open_stack(beads, step_um=step_um, channel=channel, time=time)
    spacing = even_spacing(opened, pixel_um)
    psf, count = from_beads(read_volume(opened), half)
    report = {"format": "stereotome-psf", "version": 1, **about_stack(opened), "beads": count, "spacing_um": spacing}
    picture = png_bytes(psf_picture(psf, spacing[0] / spacing[1]))
    contents = dict(zip(PSF_FILES, (psf_tiff(psf, spacing), picture, json_bytes(report)), strict=True))
    write_results(output, contents)
    for note in [] if quiet else opened.notes:
        sys.stderr.write(f"note: {note}\n")
    sys.stdout.write("\n".join([f"{count} beads", *(str(output / name) for name in PSF_FILES)]) + "\n")
    return 0


def summary(report: dict[str, Any], folder: Path) -> str:
    """Return the lines a person reads at the end."""
    why = {"noise": "the noise was reached", "still": "nothing more came", "rises": "the misfit rose", "most": "as set"}
    words = (
        f"{report['method']}: {report['steps']} steps, {why[report['stopped']]}; {report['tiles']} tiles; "
        f"{report['seconds']:.1f} s, {report['peak_memory_mb']:.0f} MB at most"
    )
    return "\n".join([words, *(str(folder / name) for name in report["files"])]) + "\n"
