"""A run on disk: planes in OME-Zarr, facts in the journal. Data first, then the journal, then the published shape.

``RUN/run.json`` what was planned · ``RUN/journal.jsonl`` what happened · ``RUN/focal.ome.zarr`` the planes ·
``RUN/planes.csv`` the table of planes, made from the journal when the run ends.
"""

from __future__ import annotations

import csv
import json
import os
import shutil
import zlib
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from datetime import UTC, datetime
from enum import StrEnum
from typing import TYPE_CHECKING, Any

import numpy as np
import tensorstore

from acquire import journal as diary
from acquire.frame import Frame, FrameHeader, Missed
from acquire.ome_zarr import FocalArray, replace_json, sync_folder
from devices.errors import InputError, StoreError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable
    from concurrent.futures import Future
    from pathlib import Path
    from typing import Self

    from devices.protocols import Clock

FORMAT = "stereotome-run"
FORMAT_VERSION = 1
LAST_WORDS, LAST_WORDS_BYTES = "room-for-last-words", 32_768
SIDE_BY_SIDE, SIDE_BY_SIDE_BYTES = 4, 128 << 20  # planes in writing at one time, and what they may hold of memory
INLINE_PLANES = 2000  # above this the table of planes lives in planes.csv and the journal alone


class RunEnd(StrEnum):
    """How a run on disk ended, or that it did not."""

    COMPLETED = "COMPLETED"
    COMPLETED_WITH_GAPS = "COMPLETED_WITH_GAPS"
    CANCELLED = "CANCELLED"
    FAILED = "FAILED"
    HELD = "HELD"
    RUNNING = "RUNNING"
    INTERRUPTED = "INTERRUPTED"


@dataclass(frozen=True)
class PlaneRecord:
    """One durable plane as the journal has it."""

    header: FrameHeader
    nbytes: int

    @property
    def plane(self) -> int:
        """Index of the plane in its stack."""
        return self.header.plane


def _keep_room(folder: Path) -> None:
    """Take up room that a full disk gives back for the last record and the report: they matter most then."""
    (folder / LAST_WORDS).write_bytes(bytes(LAST_WORDS_BYTES))


def _give_room(folder: Path) -> None:
    (folder / LAST_WORDS).unlink(missing_ok=True)


def _utc_now() -> str:
    return datetime.now(UTC).isoformat()


def checksum(pixels: np.ndarray) -> int:
    """Return zlib.crc32 of the pixels in C order, little endian."""
    return zlib.crc32(np.ascontiguousarray(pixels).data)


def free_bytes(folder: Path) -> int:
    """Return the bytes free for us on the disk that holds ``folder`` or its nearest existing parent."""
    while not folder.exists():
        folder = folder.parent
    return shutil.disk_usage(folder).free


class _PlaneFiles:
    """The array on disk: writes and reads one plane, independent of the published shape."""

    def __init__(self, folder: Path, layout: FocalArray) -> None:
        spec = {
            "driver": "zarr3",
            "kvstore": {"driver": "file", "path": str(folder)},
            "metadata": layout.array_json(layout.planned),
            # an all-black plane is a plane: without its file it could not be told from a missing one
            "store_data_equal_to_fill_value": True,
        }
        self._array = tensorstore.open(spec, open=True, assume_metadata=True).result()
        self._grid = folder / "c"
        self._layout = layout

    def write(self, slot: int, pixels: np.ndarray) -> None:
        planar = pixels[np.newaxis] if self._layout.bands == 1 else np.moveaxis(pixels, -1, 0)
        section, band, plane = self._layout.place(slot)
        folder = self._grid / str(section) / str(band) / str(plane)
        # A process killed while it wrote leaves the library's half-written file, and the library would write over its
        # beginning only: what is longer stays. The run's journal is locked: nobody else writes here.
        (folder / "0" / "0.__lock").unlink(missing_ok=True)
        self._plane(slot).write(planar).result()  # the library syncs the file and its own folder
        for made in (folder, *folder.parents[: 2 if section == band == 0 else 4]):
            sync_folder(made)

    def read(self, slot: int) -> np.ndarray:
        planar = np.asarray(self._plane(slot).read().result())
        return planar[0] if self._layout.bands == 1 else np.ascontiguousarray(np.moveaxis(planar, 0, -1))

    def _plane(self, slot: int) -> Any:
        section, band, plane = self._layout.place(slot)
        colours = self._layout.bands
        return self._array[section, band * colours : (band + 1) * colours, plane]


class RunStore:
    """Writer of one run's folder. Used by one thread at a time; what is written is on the disk upon return.

    Any `OSError` or tensorstore error means the plane is not durable; the run has to end before anything
    irreversible happens.
    """

    def __init__(self, folder: Path, name: str, layout: FocalArray, journal: diary.Journal) -> None:
        self.folder = folder
        self.journal = journal
        self._layout = layout
        self._name = name
        self._image = folder / "focal.ome.zarr"
        self._writers = ThreadPoolExecutor(SIDE_BY_SIDE, "plane")
        self._under_way: deque[Future[PlaneRecord]] = deque()
        self._pending: list[PlaneRecord] = []
        self._records: dict[int, PlaneRecord] = {}
        self._published = 0
        self._committed = 0
        self._files = _PlaneFiles(self._image / "0", layout)

    @classmethod
    def create(cls, folder: Path, manifest: dict[str, Any], layout: FocalArray, clock: Clock) -> Self:
        """Make the folder of a new run; raises `InputError` if it exists."""
        name = str(manifest.get("name", folder.name))
        _make_skeleton(folder, manifest, layout, name)
        journal = diary.Journal(folder / "journal.jsonl", clock)
        sync_folder(folder)
        _keep_room(folder)
        created = {"e": "run_created", "plan_id": manifest["plan_id"], "planned": layout.planned}
        journal.append({**created, "utc": _utc_now()})
        return cls(folder, name, layout, journal)

    @classmethod
    def reopen(cls, folder: Path, clock: Clock) -> Self:
        """Go on with a run that ended early; what its journal calls durable stays as it is.

        Raises
        ------
        StoreError
            Another process is writing the run (``run-busy``), or its journal is damaged.
        """
        journal = diary.Journal(folder / "journal.jsonl", clock)  # holds the lock before anything is read
        stored = StoredRun(folder)
        with suppress(OSError):
            _keep_room(folder)
        journal.append({"e": "resumed", "durable": len(stored.planes), "utc": _utc_now()})
        store = cls(folder, str(stored.manifest.get("name", folder.name)), stored.layout, journal)
        store._records = dict(stored.planes)
        store._committed = stored.committed
        if stored.planes:
            store._publish()
        return store

    @property
    def durable(self) -> int:
        """Number of planes that are on disk, verified and in the journal."""
        return len(self._records)

    @property
    def durable_planes(self) -> frozenset[int]:
        """Which planes these are."""
        return frozenset(self._records)

    @property
    def layout(self) -> FocalArray:
        """What the array looks like."""
        return self._layout

    def put(self, frame: Frame) -> None:
        """Begin to write one plane; it counts as durable from the next `commit` on, where what failed is raised.

        Several planes are written side by side: while the disk confirms one, the next is compressed.
        """
        self._under_way.append(self._writers.submit(self._write, frame.header, np.array(frame.pixels)))
        self._collect(leave=max(1, min(SIDE_BY_SIDE, SIDE_BY_SIDE_BYTES // frame.pixels.nbytes)))

    def _collect(self, *, leave: int) -> None:
        while len(self._under_way) > leave:
            self._pending.append(self._under_way.popleft().result())

    def _write(self, header: FrameHeader, pixels: np.ndarray) -> PlaneRecord:
        """Write one plane, read it back and compare; a disk that refuses is asked once more, at the same place."""
        crc, slot = checksum(pixels), self._layout.slot_of(header)
        try:
            self._files.write(slot, pixels)
        except (OSError, ValueError):
            self._files.write(slot, pixels)
        if checksum(self._files.read(slot)) != crc:
            raise StoreError(
                f"plane {header.plane} reads back differently from what was written to {self.folder}.",
                why="The disk or the memory is failing.",
                fix="stop using this disk; the planes before are verified: --out DIR on another one",
                code="verify-failed",
            )
        return PlaneRecord(replace(header, crc32=crc), pixels.nbytes)

    @property
    def pending(self) -> int:
        """Planes put but not committed yet."""
        return len(self._under_way) + len(self._pending)

    def commit(self, *, leave: int = 0) -> None:
        """Add the journal records of all pending planes, then publish the new shape.

        The ``leave`` put last may still be under way, and stay pending.
        """
        self._collect(leave=leave)
        if not self._pending:
            return
        self.journal.append(*({"e": "plane", "nbytes": r.nbytes, **asdict(r.header)} for r in self._pending))
        self._records.update({self._layout.slot_of(record.header): record for record in self._pending})
        self._pending.clear()
        self._publish()

    def reject(self, slots: Collection[int], reason: str) -> None:
        """Take durable planes back before they are taken again: from now on they are missing."""
        section = self._layout.place(min(slots))[0] if slots else 0
        self.journal.append({"e": "reject", "section": section, "slots": sorted(slots), "reason": reason})
        for slot in slots:
            self._records.pop(slot, None)

    def commit_section(self, section: int, waived: Collection[int]) -> None:
        """Record that a section is complete but for ``waived`` planes, then show it to readers.

        Raises
        ------
        StoreError
            A plane that is not waived is missing.
        """
        first = section * self._layout.slots_each
        slots = set(range(first, first + self._layout.slots_each))
        lacking = sorted(slots - set(self._records) - set(waived))
        if lacking:
            raise StoreError(f"section {section} is not complete: planes {lacking} are not durable. Nothing is cut.")
        self.journal.append({"e": "commit", "section": section, "waived": sorted(waived)})
        self._committed = section + 1
        self._publish()

    def record(self, slot: int) -> PlaneRecord:
        """Return what is known of a durable plane."""
        return self._records[slot]

    def read(self, slot: int) -> np.ndarray:
        """Return a durable plane, checked against its checksum."""
        return _checked(self._files, slot, self._records[slot], self.folder)

    def _publish(self, *, all_of_it: bool = False) -> None:
        """Show what is durable; of a run of sections only whole ones, until the run has ended."""
        extent = self._layout.extent(self._records)
        if self._layout.sections > 1 and self._layout.interval_s is None and not all_of_it:
            extent = min(extent, self._committed)
        if extent > self._published:
            replace_json(self._image / "0" / "zarr.json", self._layout.array_json(extent))
            self._published = extent

    def finalise(self, end: RunEnd, reason: str = "") -> RunEnd:
        """Commit what is pending, write the tables, then the END record: the run's last word.

        A run that is said to be COMPLETED while planes are missing is recorded as COMPLETED_WITH_GAPS.
        """
        self.commit()
        _give_room(self.folder)
        if self._records:
            self._publish(all_of_it=True)
        missing = self._missing()
        if end is RunEnd.COMPLETED and missing:
            end = RunEnd.COMPLETED_WITH_GAPS
        ordered = [self._records[k] for k in sorted(self._records)]
        write_planes_csv(self.folder / "planes.csv", ordered)
        self._write_plane_table(ordered, missing)
        self.journal.append({"e": "end", "state": str(end), "missing": missing, "reason": reason})
        return end

    def abandon(self, reason: str) -> None:
        """End a run whose disk failed: nothing pending is trusted, and the END record is written if it can be."""
        self._writers.shutdown(cancel_futures=True)
        self._under_way.clear()
        self._pending.clear()
        with suppress(OSError):
            _give_room(self.folder)
            missing = self._missing()
            self.journal.append({"e": "end", "state": str(RunEnd.FAILED), "missing": missing, "reason": reason})

    def _missing(self) -> list[int]:
        return [k for k in range(self._layout.planned) if k not in self._records]

    def _write_plane_table(self, ordered: list[PlaneRecord], missing: list[int]) -> None:
        if len(ordered) > INLINE_PLANES:
            return
        table = [{"plane": r.plane, "z_um": r.header.z_um, "setpoint_um": r.header.setpoint_um} for r in ordered]
        for row, record in zip(table, ordered, strict=True):
            if self._layout.sections > 1 or self._layout.channels:
                row |= {"section": record.header.section, "band": record.header.band}
        group = self._layout.group_json(self._name, {"planes": table, "missing": missing})
        replace_json(self._image / "zarr.json", group)

    def close(self) -> None:
        """Close the journal. Without an END record the run is INTERRUPTED."""
        self._writers.shutdown(cancel_futures=True)
        self.journal.close()


def _make_skeleton(folder: Path, manifest: dict[str, Any], layout: FocalArray, name: str) -> None:
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        raise InputError(
            f"{folder} exists already. Nothing was started.",
            why="A run never writes into a folder that holds something.",
            fix="choose another folder: --out DIR",
            code="output-exists",
        ) from None
    grid = folder / "focal.ome.zarr" / "0" / "c" / "0" / "0"  # of the first section and band; writing makes the others
    grid.mkdir(parents=True)
    replace_json(folder / "focal.ome.zarr" / "zarr.json", layout.group_json(name))
    replace_json(folder / "focal.ome.zarr" / "0" / "zarr.json", layout.array_json(0))
    head = {"format": FORMAT, "version": FORMAT_VERSION, "array": asdict(layout)}
    replace_json(folder / "run.json", {**head, **manifest})
    # after a power cut a file is only as safe as every folder above it
    for made in (grid, *grid.parents):
        sync_folder(made)
        if made == folder.parent:
            break


def write_planes_csv(path: Path, records: Iterable[PlaneRecord]) -> None:
    """Write the table of planes, one row each."""
    part = path.with_name(path.name + ".part")
    with part.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow([field.name for field in fields(FrameHeader)])
        table.writerows(asdict(record.header).values() for record in records)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)
    sync_folder(path.parent)


class StoredRun:
    """Reader of a run's folder, finished or not. What is durable is what the journal says."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.manifest = _read_manifest(folder)
        array = dict(self.manifest["array"])
        lists = {key: tuple(array[key]) for key in ("shape", "channels", "colours") if key in array}
        self.layout = FocalArray(**{**array, **lists})
        self._files = _PlaneFiles(folder / "focal.ome.zarr" / "0", self.layout)
        self.refresh()

    def refresh(self) -> None:
        """Read the journal again: a run in progress has more planes now."""
        records, _ = diary.read(self.folder / "journal.jsonl")
        self.records = [record for record in records if record["e"] != "plane"]
        self.planes: dict[int, PlaneRecord] = {}
        missed: dict[int, str] = {}
        self.committed = 0
        for record in records:
            self._hear(record, missed)
        self.missed = {slot: reason for slot, reason in missed.items() if slot not in self.planes}
        last = next((r for r in reversed(records) if r["e"] in {"end", "resumed"}), {"e": "none"})
        self._end = last if last["e"] == "end" else None

    def _hear(self, record: diary.Record, missed: dict[int, str]) -> None:
        match record["e"]:
            case "plane":
                plane = _plane_record(record)
                self.planes[self.layout.slot_of(plane.header)] = plane
            case "missed":
                gap = Missed(record["plane"], record["reason"], record.get("section", 0), record.get("band", 0))
                missed[self.layout.slot_of(gap)] = gap.reason
            case "reject":
                for slot in record["slots"]:
                    self.planes.pop(slot, None)
            case "commit":
                self.committed = record["section"] + 1
            case _:
                pass

    @property
    def state(self) -> RunEnd:
        """How the run ended; RUNNING while a living process writes it, INTERRUPTED when that process died."""
        if self._end is not None:
            return RunEnd(self._end["state"])
        alive = diary.is_open_elsewhere(self.folder / "journal.jsonl")
        return RunEnd.RUNNING if alive else RunEnd.INTERRUPTED

    @property
    def missing(self) -> list[int]:
        """Planned planes that are not durable."""
        return [k for k in range(self.layout.planned) if k not in self.planes]

    def read(self, plane: int) -> np.ndarray:
        """Return the durable plane of a slot, (height, width[, bands]), checked against the journal's checksum.

        Raises
        ------
        StoreError
            The plane is not durable, or its pixels are not those that were taken.
        """
        if plane not in self.planes:
            raise StoreError(f"{self.folder}: plane {plane} is missing.", code="plane-missing")
        return _checked(self._files, plane, self.planes[plane], self.folder)

    def publish(self) -> None:
        """Make the OME-Zarr shape agree with the journal: a run killed between the two may lag behind."""
        extent = self.layout.extent(self.planes)
        path = self.folder / "focal.ome.zarr" / "0" / "zarr.json"
        if json.loads(path.read_text(encoding="utf-8"))["shape"][2 if self.layout.sections == 1 else 0] < extent:
            replace_json(path, self.layout.array_json(extent))


def _checked(files: _PlaneFiles, slot: int, record: PlaneRecord, folder: Path) -> np.ndarray:
    try:
        pixels = files.read(slot)
    except (OSError, ValueError) as error:  # tensorstore reports a broken shard as ValueError
        raise _damaged(folder, slot) from error
    if checksum(pixels) != record.header.crc32:
        raise _damaged(folder, slot)
    return pixels


def _damaged(folder: Path, slot: int) -> StoreError:
    return StoreError(
        f"{folder}: plane {slot} is damaged on disk.",
        why="Its checksum differs from the one in the journal.",
        fix="restore the folder from a copy; the other planes can be used",
        code="plane-damaged",
    )


def _plane_record(record: diary.Record) -> PlaneRecord:
    names = {field.name for field in fields(FrameHeader)}
    return PlaneRecord(FrameHeader(**{k: v for k, v in record.items() if k in names}), record["nbytes"])


def is_run(folder: Path) -> bool:
    """Tell whether a folder is a run of this program."""
    return (folder / "run.json").is_file() and (folder / "journal.jsonl").is_file()


def open_run(folder: Path) -> StoredRun:
    """Open a run's folder for reading."""
    return StoredRun(folder)


def _read_manifest(folder: Path) -> dict[str, Any]:
    try:
        manifest: dict[str, Any] = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(
            f"{folder} is not a run folder.", why=f"run.json: {error}", fix="name the folder a run made", code="no-run"
        ) from None
    if manifest.get("format") != FORMAT or manifest.get("version") != FORMAT_VERSION:
        raise InputError(
            f"{folder} was written in format {manifest.get('format')} {manifest.get('version')}.",
            fix=f"open it with the version of the program that wrote it; this one reads {FORMAT} {FORMAT_VERSION}",
            code="no-run",
        )
    return manifest
