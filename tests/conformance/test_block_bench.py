"""The block-face bench as a whole: real drivers over real wires see, section by section, the face they have cut."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from devices.clock import SystemClock
from devices.drivers.feed import ModbusFeed
from devices.rig import load_rig, open_rig
from sim.block import Face
from sim.face_sensor import BlockSpecimen
from sim.serve import DEFAULT_BLOCK
from sim.solid import Solid

if TYPE_CHECKING:
    from collections.abc import Callable

    from devices.rig import Rig
    from sim.pytest_plugin import StartBench

CORE_PX = 0.21 * 0.55 / 0.45 / 0.1725  # of the lens
SMALL = (
    DEFAULT_BLOCK.read_text(encoding="utf-8").replace("[512, 512]", "[96, 64]").replace("10.0\n\n[opt", "2.0\n\n[opt")
)


def likeness(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


def snapper(rig: Rig) -> Callable[[], np.ndarray]:
    frames: list[np.ndarray] = []
    rig.camera.arm(None, lambda pixels, stamp: frames.append(pixels.astype(float)))

    def snap() -> np.ndarray:
        rig.camera.trigger()
        return frames[-1]

    return snap


def test_sections_cut_over_the_wire_are_those_that_are_seen(sim_bench: StartBench, tmp_path):
    path = tmp_path / "block.toml"
    path.write_text(SMALL, encoding="utf-8")
    bench = sim_bench(path)
    with np.load(bench.truth) as truth:
        specimen = BlockSpecimen(Solid(int(truth["seed"])), (96, 64), float(truth["pixel_um"]))
    with open_rig(load_rig(bench.instrument), clock=SystemClock()) as rig:
        feed, snap = rig.feed, snapper(rig)
        assert isinstance(feed, ModbusFeed)
        feed.allow_cuts(lambda: None)
        feed.home()

        def section(depth_um: float) -> Face:
            feed.advance_to(1000 * depth_um)
            return stroke()

        def stroke() -> Face:
            assert isinstance(feed, ModbusFeed)
            feed.arm()
            feed.cut()
            told = bench.ask(do="truth")["counters"]["feed"]["face"]
            return Face(**{**told, "offset_um": tuple(told["offset_um"])})

        def shows(face: Face) -> bool:
            return likeness(snap(), cv2.GaussianBlur(specimen.picture(face), (0, 0), CORE_PX)) > 0.98

        assert shows(Face())
        face = section(1.5)
        assert face.depth_um == pytest.approx(1.5, abs=0.003)
        assert shows(face)
        bench.ask(do="fault", set="block.debris@1")
        face = section(3.0)
        assert face.debris == 2
        assert shows(face)
        swept = stroke()
        assert swept == Face(face.depth_um, 2)
        assert shows(swept)
        bench.ask(do="fault", set="block.miss@1")
        assert section(4.5).depth_um == face.depth_um
    counted = bench.ask(do="truth")["counters"]["feed"]
    assert counted["cuts"] == 4
    assert counted["removed_um"] == pytest.approx([0.0, 1.5, 0.0, 0.0], abs=0.003)
