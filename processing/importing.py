"""Stacks and cut sections of other programs as runs: ``stereotome import``.

A stack is whatever `processing.stack.open_stack` reads: OME-TIFF, OME-Zarr, Micro-Manager (OME-TIFF, NDTiff, folders),
series of images. Cut sections come by a table, because nothing in their files tells which is which: images in any
order and orientation, and places for those that were lost.
"""

from __future__ import annotations

import csv
import hashlib
import json
import sys
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path  # noqa: TC003  the command line reads the annotations
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from cyclopts import Parameter

from acquire.frame import Frame, FrameHeader, Missed
from acquire.ome_zarr import FocalArray
from acquire.progress import progress
from acquire.store import RunEnd, RunStore
from devices.clock import SystemClock
from devices.errors import InputError
from processing.stack import open_stack

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from processing.stack import Stack

COLUMNS = ("section", "file", "rotation_deg", "flip", "note")
LOST = "lost"


@dataclass(frozen=True)
class CutSection:
    """One row of the table: a section that was cut, floated and imaged, or lost.

    Attributes
    ----------
    section : int
        Its place in the block, from 0.
    file : Path or None
        Its image; None when it was lost.
    rotation_deg : float
        How it lies in its image, anticlockwise; recorded, not undone: aligning comes later.
    flip : bool
        It lies face down.
    note : str
        Anything a later reader should know.
    """

    section: int
    file: Path | None
    rotation_deg: float = 0.0
    flip: bool = False
    note: str = ""


def import_(
    source: Path,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    thickness_nm: float | None = None,
    channel: Annotated[tuple[int, ...], Parameter(negative="")] = (),
    step_um: float | None = None,
    pixel_um: float | None = None,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")] = False,
) -> int:
    """Make a run of a stack of another program, or of cut sections named in a table.

    Parameters
    ----------
    source
        A stack (OME-TIFF, OME-Zarr, NDTiff, folder of images …), or a table of cut sections (.csv with the columns
        section, file and, if known, rotation_deg, flip, note; a row without file is a lost section).
    output
        Folder of the run; must not exist.
    thickness_nm
        Of cut sections.
    channel
        Channels to import, by number, each as a band; without it the only one.
    step_um
        Distance of planes, where the file does not say.
    pixel_um
        Size of a pixel, where the file does not say.
    quiet
        No progress.
    """
    if source.suffix.lower() == ".csv":
        folder = import_sections(source, output, thickness_nm=thickness_nm, pixel_um=pixel_um, quiet=quiet)
    else:
        folder = import_stack(source, output, channels=channel, step_um=step_um, pixel_um=pixel_um, quiet=quiet)
    sys.stdout.write(f"{folder}\n")
    return 0


def import_stack(
    source: Path,
    output: Path,
    *,
    channels: Sequence[int] = (),
    step_um: float | None = None,
    pixel_um: float | None = None,
    quiet: bool = False,
) -> Path:
    """Make a run of one stack, each channel a band; what the file does not say is not invented."""
    wanted: Sequence[int | None] = channels or (None,)
    stacks = [open_stack(source, channel=channel, step_um=step_um) for channel in wanted]
    first = stacks[0]
    z_um = np.arange(len(first)) if first.z_um is None else first.z_um
    pixels = first[0]
    layout = FocalArray(
        planned=len(first) * len(stacks),
        shape=pixels.shape,
        dtype=pixels.dtype.name,
        start_um=float(z_um[0]),
        step_um=float(np.ptp(z_um) / max(1, len(first) - 1)) * (1 if z_um[-1] >= z_um[0] else -1),
        pixel_um=pixel_um or first.pixel_um,
        channels=tuple(f"channel {channel}" for channel in channels) if len(channels) > 1 else (),
    )
    for note in first.notes:
        sys.stderr.write(f"note: {note}\n")

    def header(slot: int) -> FrameHeader:
        _, band, plane = layout.place(slot)
        return FrameHeader(plane, float(z_um[plane]), float(z_um[plane]), 0.0, band=band)

    told = {"from": str(source), "notes": list(first.notes), "spacing_known": first.z_um is not None}
    return _write(output, layout, told, {}, lambda slot: _plane(stacks, layout, slot), header, {}, quiet=quiet)


def _plane(stacks: Sequence[Stack], layout: FocalArray, slot: int) -> np.ndarray:
    _, band, plane = layout.place(slot)
    return stacks[band][plane]


def import_sections(
    table: Path, output: Path, *, thickness_nm: float | None, pixel_um: float | None = None, quiet: bool = False
) -> Path:
    """Make a run of the sections of a table; lost ones keep their places, smaller images are filled up with black."""
    if thickness_nm is None or not thickness_nm > 0:
        raise InputError("the thickness of the sections is not known.", fix="give it: --thickness-nm 70", code="usage")
    rows = read_table(table)
    stacks = {row.section: open_stack(row.file) for row in rows if row.file is not None}
    pictures = {section: stack[0] for section, stack in stacks.items()}
    shape = _common_shape(table, pictures)
    layout = FocalArray(
        planned=len(rows),
        shape=shape,
        dtype=next(iter(pictures.values())).dtype.name,
        start_um=0.0,
        step_um=1.0,
        pixel_um=pixel_um or next((stack.pixel_um for stack in stacks.values()), None),
        sections=len(rows),
    )
    told = {"from": str(table), "sections": [{**asdict(row), "file": row.file and row.file.name} for row in rows]}
    missing = {row.section: row.note or LOST for row in rows if row.file is None}
    plan = {"sections": {"thickness_nm": thickness_nm}}

    def header(slot: int) -> FrameHeader:
        return FrameHeader(0, 0.0, 0.0, 0.0, section=slot)

    return _write(
        output, layout, told, plan, lambda slot: _filled_up(pictures[slot], shape), header, missing, quiet=quiet
    )


def read_table(path: Path) -> list[CutSection]:
    """Read a table of cut sections, in the order of sections; those between that have no row count as lost.

    Raises
    ------
    InputError
        With every problem of the table, each with its line.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(
            f"{path} cannot be read: {error}", fix="give a table as CSV, in UTF-8.", code="table"
        ) from None
    problems: list[str] = []
    rows: dict[int, CutSection] = {}
    for number, line in enumerate(lines, start=2):
        try:
            row = _row(path.parent, line)
        except (KeyError, ValueError, TypeError) as error:
            problems.append(f"line {number}: {_said(error)}")
            continue
        if row.section in rows:
            problems.append(f"line {number}: section {row.section} stands in the table twice")
        rows[row.section] = row
    if not any(row.file for row in rows.values()):
        problems.append("it names no image")
    if problems:
        columns = ", ".join(COLUMNS)
        raise InputError(f"{path}: {'; '.join(problems)}.", fix=f"the columns are {columns}.", code="table")
    return [rows.get(k, CutSection(k, None, note="no row in the table")) for k in range(max(rows) + 1)]


def _said(error: Exception) -> str:
    return f"there is no column {error}" if isinstance(error, KeyError) else str(error)


def _row(folder: Path, line: dict[str, str | None]) -> CutSection:
    section = int(line["section"] or "")
    if not 0 <= section < MOST_SECTIONS:
        raise ValueError(f"section {section} is not within 0 … {MOST_SECTIONS - 1}")
    named = (line["file"] or "").strip()
    file = folder / named if named else None
    if file is not None and not file.exists():
        raise ValueError(f"there is no {file}")
    rotation_deg = float(line.get("rotation_deg") or 0.0)
    if not np.isfinite(rotation_deg):
        raise ValueError(f"rotation_deg {rotation_deg:g} is no angle")
    flip = (line.get("flip") or "").strip().lower() in {"1", "yes", "true"}
    return CutSection(section, file, rotation_deg, flip, (line.get("note") or "").strip())


MOST_SECTIONS = 1_000_000


def _common_shape(table: Path, pictures: dict[int, np.ndarray]) -> tuple[int, ...]:
    kinds = {(picture.shape[2:], picture.dtype.name) for picture in pictures.values()}
    if len(kinds) > 1:
        raise InputError(
            f"{table}: the images are not of one kind: {sorted(f'{dtype} {bands}' for bands, dtype in kinds)}.",
            fix="bring them to one number type and one number of bands.",
            code="stack-dtype",
        )
    rows, columns = (max(picture.shape[axis] for picture in pictures.values()) for axis in (0, 1))
    return (rows, columns, *next(iter(kinds))[0])


def _filled_up(picture: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    filled = np.zeros(shape, picture.dtype)
    filled[: picture.shape[0], : picture.shape[1]] = picture
    return filled


def _write(
    output: Path,
    layout: FocalArray,
    told: dict[str, Any],
    plan: dict[str, Any],
    read: Callable[[int], np.ndarray],
    header: Callable[[int], FrameHeader],
    missing: dict[int, str],
    *,
    quiet: bool,
) -> Path:
    """Write the run, each plane durable and verified as when it is taken."""
    plan_id = hashlib.sha256(json.dumps([plan, told], sort_keys=True).encode()).hexdigest()
    about = {"software": f"stereotome {version('stereotome')}", "plan_id": plan_id, "plan": plan, "imported": told}
    store = RunStore.create(output, {"name": output.name, **about}, layout, SystemClock())
    try:
        with progress("planes", layout.planned, quiet=quiet) as show:
            for slot in range(layout.planned):
                if slot in missing:
                    gone = Missed(0, missing[slot], section=slot)
                    store.journal.append({"e": "missed", "section": slot, "plane": gone.plane, "reason": gone.reason})
                else:
                    store.put(Frame(slot, header(slot), read(slot)))
                    store.commit()
                show(slot + 1)
        store.finalise(RunEnd.COMPLETED)
    finally:
        store.close()
    return output
