"""Sections aligned while they are taken: placed on arrival, anew when taken again, and all together at the end."""

from __future__ import annotations

import csv
import json
import threading
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from acquire.frame import FrameHeader
from acquire.observe import known_observer
from acquire.ome_zarr import FocalArray
from acquire.ring import RingReader, RingWriter
from acquire.store import RunEnd, RunStore
from devices.clock import SystemClock
from devices.errors import InputError
from processing.align_live import LiveAlignment

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

SHAPE, PLANES = (96, 112), 3
SHIFTS = [(0, 0), (4, -3), (-2, 5), (6, 1), (1, -4)]
SECTIONS = len(SHIFTS)
MANIFEST = {"plan_id": "p", "name": "faces", "plan": {"sections": {"thickness_nm": 80}}}


def face(section: int) -> np.ndarray:
    x, y = SHIFTS[section]
    rng = np.random.default_rng(1)
    whole = cv2.GaussianBlur(rng.normal(size=(140, 160)), (0, 0), 2.0)
    seen = whole[20 - y : 20 - y + SHAPE[0], 20 - x : 20 - x + SHAPE[1]]
    noise = np.random.default_rng(section).normal(0, 0.01, SHAPE)
    return np.clip(2000 + 6000 * (seen + noise), 0, 4095).astype(np.uint16)


class Cutting:
    """A run of sections with three planes each, being written through a ring."""

    def __init__(self, folder: Path, sections: int = SECTIONS) -> None:
        clock = SystemClock()
        layout = FocalArray(PLANES * sections, SHAPE, "uint16", 0.0, 0.5, 0.65, sections=sections)
        self.folder, self._arrival = folder / "run", 0
        self.store = RunStore.create(self.folder, MANIFEST, layout, clock)
        self.ring = RingWriter.create("test", SHAPE, "uint16", 4, clock=clock, folder=folder)
        self.keeper = RingReader.attach(self.ring.path, "lossless", clock=clock)

    def take(self, section: int, plane: int, pixels: np.ndarray, attempt: int = 0) -> None:
        self._arrival += 1
        header = FrameHeader(plane, 0.5, 0.5, 1.0, arrival_ns=self._arrival, section=section, attempt=attempt)
        self.ring.push(pixels, header)
        frame = self.keeper.read(10.0)
        assert frame is not None
        self.store.put(frame)
        self.keeper.release()

    def end(self) -> None:
        self.store.finalise(RunEnd.COMPLETED)
        for part in (self.keeper, self.ring, self.store):
            part.close()


def until(condition: Callable[[], bool]) -> None:
    begin, clock = SystemClock().now(), SystemClock()
    while not condition():
        assert clock.now() < begin + 60
        clock.sleep(0.02)


def lines(out: Path) -> list[dict[str, str]]:
    if not (out / "live.csv").exists():
        return []
    with (out / "live.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_sections_are_placed_as_they_come_and_once_more_when_all_are_there(tmp_path):
    run, ready, out = Cutting(tmp_path), threading.Event(), tmp_path / "align"
    observe = known_observer("align").load()
    arguments = [run.ring.path, run.folder, out, {}, ready.set]
    thread = threading.Thread(target=observe, args=arguments, daemon=True)
    thread.start()
    assert ready.wait(60)
    blurred = np.full(SHAPE, 2000, np.uint16)
    for section, (x, y) in enumerate(SHIFTS):
        run.take(section, 0, blurred)
        if section == 2:  # spoilt, and taken again
            run.take(section, 1, face(0))
            run.store.commit()
            until(lambda: len(lines(out)) == 3)
        run.take(section, 1, face(section), attempt=int(section == 2))
        run.take(section, 2, blurred)
        run.store.commit()

        def told(section: int = section, x: float = x, y: float = y) -> bool:
            found = lines(out)
            return (
                len(found) == section + 1 and np.hypot(float(found[-1]["x_px"]) - x, float(found[-1]["y_px"]) - y) < 0.1
            )

        until(told)
    run.end()
    thread.join(60)
    assert not thread.is_alive()
    found = json.loads((out / "transforms.json").read_text())["sections"]
    assert [s["matrix"][0][2] for s in found] == pytest.approx([x for x, _ in SHIFTS], abs=0.3)
    assert [s["matrix"][1][2] for s in found] == pytest.approx([y for _, y in SHIFTS], abs=0.3)
    report = json.loads((out / "report.json").read_text())
    assert report["live"]
    assert report["sections"] == list(range(SECTIONS))
    assert (out / "sections.png").read_bytes().startswith(b"\x89PNG")


def test_a_run_that_is_over_is_aligned_from_the_disk(tmp_path):
    run, out = Cutting(tmp_path), tmp_path / "align"
    for section in range(4):
        run.take(section, 1, face(section))
    run.end()
    known_observer("align").load()(run.ring.path, run.folder, out, {}, lambda: None)
    report = json.loads((out / "report.json").read_text())
    found = json.loads((out / "transforms.json").read_text())["sections"]
    assert report["sections"] == [0, 1, 2, 3]
    assert [s["matrix"][0][2] for s in found] == pytest.approx([x for x, _ in SHIFTS[:4]], abs=0.3)


def test_a_run_of_one_section_is_refused(tmp_path):
    run = Cutting(tmp_path, sections=1)
    with pytest.raises(InputError, match="one section"):
        LiveAlignment(run.store, tmp_path)
    run.end()
