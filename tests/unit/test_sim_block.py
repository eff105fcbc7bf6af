"""The block: its solid against a slow reference, its face against what feed and knife really did, and its faults."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest

from devices.errors import CameraTimeout
from devices.rig import RigSpec
from sim.bench import build_bench
from sim.block import Block, Face
from sim.camera import SimCamera
from sim.clock import SimClock
from sim.face_sensor import BlockSpecimen
from sim.faults import Faults, parse_fault, parse_faults
from sim.feed import Stroke
from sim.optics import FULL_SCALE, Optics, blurred
from sim.sensor import BLACK_LEVEL, WHITE_LEVEL
from sim.solid import CELL_UM, EDGE_UM, FILLED, GRAIN, MEMBRANE, MEMBRANE_UM, NUCLEUS, ORGANELLE, Solid

if TYPE_CHECKING:
    from sim.bench import Bench

SIZE = (128, 96)
SPEC = {
    "name": "block",
    "camera": {"driver": "sim", "size_px": SIZE, "bit_depth": 12, "pixel_um": 3.45, "exposure_ms": 2.0},
    "optics": {"magnification": 20.0, "na": 0.45},
    "stage": {"z": {"driver": "asi-ms2000", "port": "twin", "limits": {"min_um": -100.0, "max_um": 100.0}}},
    "microtome": {
        "profile": "leadshine-rs",
        "port": "twin",
        "limits": {"feed_um_max": 4000.0, "thickness_nm_max": 10_000.0},
        "knife": {"profile": "plc-mailbox", "unit": 2},
    },
    "sim": {"specimen": "block", "seed": 3},
}


class Cutter:
    """A bench whose feed and knife are moved by hand, in simulated time."""

    def __init__(self, *faults: str, seed: int = 3) -> None:
        self.clock = SimClock(100.0)
        self.faults = Faults(parse_faults(faults), self.clock)
        spec = RigSpec.model_validate(SPEC | {"sim": {"specimen": "block", "seed": seed}})
        self.bench: Bench = build_bench(spec, self.clock, self.faults)
        assert self.bench.feed is not None
        self.machine, self.knife = self.bench.feed.machine, self.bench.feed.plc.knife
        self.knife.window_um, self.knife.speed_um_s = (300.0, 0.0), 3000.0
        self.machine.axis.move_to(0.0)
        self.clock.sleep(1.0)

    @property
    def specimen(self) -> BlockSpecimen:
        assert isinstance(self.bench.specimen, BlockSpecimen)
        return self.bench.specimen

    @property
    def face(self) -> Face:
        return self.machine.block.face

    def advance(self, um: float) -> None:
        self.machine.axis.move_to(self.machine.position_um + um)
        self.clock.sleep(1.0)

    def stroke(self) -> None:
        self.knife.cut()
        self.clock.sleep(1.0)
        if self.knife.state is not Stroke.JAMMED:
            self.knife.park()
            self.clock.sleep(1.0)

    def section(self, um: float = 1.0) -> None:
        self.advance(um)
        self.stroke()

    def snap(self, z_um: float = 0.0) -> np.ndarray:
        picture = np.empty(SIZE[::-1], np.uint16)
        self.bench.sensor.expose(np.array([z_um]), 2.0, picture)
        return picture

    def truth(self, face: Face) -> np.ndarray:
        """What a lens of this bench shows of a face in focus, in digits."""
        picture = self.specimen.with_margin(face)
        padded = np.zeros((256, 256), np.float32)
        padded[: picture.shape[0], : picture.shape[1]] = picture
        optics = Optics(0.45, 1.0, 0.55, self.specimen.pixel_um)
        light = blurred(padded, optics, [0.0])[0][48:-48, 48:-48][: SIZE[1], : SIZE[0]] / FULL_SCALE
        return ((WHITE_LEVEL - BLACK_LEVEL) * light + BLACK_LEVEL) * 4095


def likeness(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


# ---- the solid


def mixed(seed: int, stream: int, *box: int) -> float:
    """The random number of a box, in Python's own integers."""
    word = (1 << 64) - 1
    value = (seed + stream * 0x9E3779B97F4A7C15) & word
    for number in box:
        value = ((value ^ (number & word)) * 0xBF58476D1CE4E5B9) & word
        value = ((value ^ (value >> 29)) * 0x94D049BB133111EB) & word
        value ^= value >> 32
    return (value >> 11) / 2**53


def rise(value: float) -> float:
    part = min(max(0.5 + value / (2 * EDGE_UM), 0.0), 1.0)
    return part * part * (3 - 2 * part)


def balls(seed: int, stream: int, box_um: float, place: np.ndarray):
    """Distance to the centre of every box around, two boxes far, and the centre's own number."""
    here = np.floor(place / box_um).astype(int)
    for offset in np.ndindex(5, 5, 5):
        box = [int(number) for number in here + offset - 2]
        centre = [(box[k] + mixed(seed, stream + k, *box)) * box_um for k in range(3)]
        yield math.dist(centre, place), mixed(seed, stream + 3, *box)


def brightness(seed: int, place: np.ndarray) -> float:
    """What `sim.solid` says in words, looked up for one place."""
    (first, own), (second, _) = sorted(balls(seed, 0, CELL_UM, place))[:2]
    shade = 0.58 + 0.22 * own
    if own < FILLED:
        shade += (NUCLEUS - shade) * rise((0.24 + 0.16 * own) * CELL_UM - first)
    body = MEMBRANE + (shade - MEMBRANE) * rise(second - first - MEMBRANE_UM)
    deepest = max(0.25 + 0.5 * own - far for far, own in balls(seed, 8, 1.6, place) if own < FILLED)
    value = body + rise(deepest) * (ORGANELLE - body) if body > ORGANELLE else body
    return value + GRAIN * (grain(seed, place / 0.35) - 0.5)


def grain(seed: int, place: np.ndarray) -> float:
    low = np.floor(place).astype(int)
    return sum(
        float(np.prod(np.where(corner, place - low, 1 - (place - low)))) * mixed(seed, 16, *(low + corner).tolist())
        for corner in np.ndindex(2, 2, 2)
    )


@pytest.mark.parametrize(
    ("seed", "corner", "depth_um"), [(0, (0.0, 0.0), 0.0), (3, (-7.3, 100.2), 41.7), (9, (5.5, -60.0), -3.2)]
)
def test_a_face_is_what_lies_at_its_places(seed, corner, depth_um):
    face = Solid(seed).face((48, 40), 0.21, depth_um, corner)
    rng = np.random.default_rng(seed)
    for row, column in zip(rng.integers(0, 40, 25), rng.integers(0, 48, 25), strict=True):
        place = np.array([corner[0] + 0.21 * column, corner[1] + 0.21 * row, depth_um])
        assert face[row, column] == pytest.approx(brightness(seed, place), abs=1e-5)


def test_neighbouring_faces_are_alike_and_far_ones_are_not():
    first, *deeper = (Solid(5).face((256, 256), 0.17, depth) for depth in (10.0, 10.05, 10.5, 30.0))
    near, half, far = (likeness(first, face) for face in deeper)
    assert near > 0.95
    assert 0.3 < half < 0.8
    assert abs(far) < 0.1
    assert abs(likeness(first, Solid(6).face((256, 256), 0.17, 10.0))) < 0.1


# ---- the face


def test_the_camera_sees_the_face_that_was_cut():
    cutter = Cutter()
    faces, shots = [cutter.face], [cutter.snap()]
    for _ in range(3):
        cutter.section(1.5)
        faces.append(cutter.face)
        shots.append(cutter.snap())
    assert [face.depth_um for face in faces] == pytest.approx([0.0, 1.5, 3.0, 4.5])
    seen = np.array([[likeness(shot, cutter.truth(face)) for face in faces] for shot in shots])
    assert seen.diagonal().min() > 0.99
    assert seen[~np.eye(4, dtype=bool)].max() < 0.6
    assert shots[2].astype(float) == pytest.approx(cutter.truth(faces[2]), abs=250)  # six times the noise


def test_an_advance_without_a_cut_shows_the_old_face_out_of_focus():
    cutter = Cutter()
    cutter.section()
    before = cutter.snap()
    cutter.advance(6.0)
    assert cutter.snap().std() < 0.6 * before.std()
    assert likeness(cutter.snap(6.0), before) > 0.98


def test_a_jammed_knife_leaves_the_old_face_and_stands_before_it():
    cutter = Cutter()
    cutter.section()
    before, face = cutter.snap(), cutter.face
    cutter.knife.jam = True
    cutter.section(0.5)
    assert cutter.knife.state is Stroke.JAMMED
    assert cutter.face == face
    half = SIZE[1] // 2
    shot = cutter.snap(0.5)
    assert likeness(shot[:half], before[:half]) > 0.98
    assert shot[half:].mean() < 0.1 * before[half:].mean()


def test_a_stroke_that_misses_counts_and_leaves_the_old_face():
    cutter = Cutter("block.miss@2")
    cutter.section()
    before = cutter.snap()
    cutter.section(0.5)
    assert cutter.knife.counter == 2
    assert likeness(cutter.snap(0.5), before) > 0.98
    cutter.section(0.5)
    assert cutter.machine.removed_um == pytest.approx([0.0, 0.0, 1.0])
    assert likeness(cutter.snap(), cutter.truth(cutter.face)) > 0.99


def test_a_knife_that_is_not_counted_has_cut_all_the_same():
    cutter = Cutter()
    cutter.knife.counter_dead = True
    cutter.section(1.5)
    assert cutter.knife.counter == 0
    assert cutter.face.depth_um == pytest.approx(1.5)
    assert likeness(cutter.snap(), cutter.truth(Face(1.5, 1))) > 0.99


def test_debris_lies_where_its_section_left_it_until_a_sweep():
    cutter = Cutter("block.debris@2")
    cutter.section()
    cutter.section()
    assert cutter.face.debris == 2
    clean = cutter.truth(Face(cutter.face.depth_um, 2))
    dirty = np.abs(cutter.snap() - clean) > 300
    assert 0.003 < dirty.mean() < 0.2
    assert likeness(cutter.snap(), cutter.truth(cutter.face)) > 0.99
    cutter.stroke()
    assert cutter.machine.removed_um[-1] == 0.0
    assert (np.abs(cutter.snap() - clean) > 300).mean() == 0.0


def test_debris_that_is_stuck_stays_until_the_next_section():
    cutter = Cutter("block.debris@1", "block.stuck")
    cutter.section()
    cutter.stroke()
    assert cutter.face.debris == 1
    cutter.section()
    assert cutter.face.debris is None


def test_thickness_errors_never_add_up():
    cutter = Cutter("block.uneven@50nm")
    for _ in range(200):
        cutter.machine.block.stroke(cutter.machine.block._deepest_um + 0.5 if cutter.face.section else 0.0)
    removed = np.array(cutter.machine.removed_um[1:])
    assert removed.min() >= 0
    assert removed.std() == pytest.approx(0.05 * math.sqrt(2), rel=0.2)  # of the difference of two planes
    assert abs(cutter.face.depth_um - 199 * 0.5) < 0.25


def test_a_sweep_never_cuts_deeper_even_with_an_uneven_knife():
    cutter = Cutter("block.uneven@300nm")
    cutter.section()
    face = cutter.face
    for _ in range(20):
        cutter.stroke()
    assert cutter.face == face


def test_the_block_drifts_and_its_focus_too():
    cutter = Cutter("block.drift@300nm", "block.focus@-800nm")
    for _ in range(5):
        cutter.section()
    assert cutter.face.offset_um == pytest.approx((1.2, 0.9))
    assert cutter.face.focus_um == pytest.approx(-4.0)
    assert cutter.specimen.picture(cutter.face) == pytest.approx(
        Solid(3).face(SIZE, cutter.specimen.pixel_um, 5.0, (1.2, 0.9)), abs=1e-4
    )
    sharpness = [cutter.snap(z).std() for z in (-8.0, -4.0, 0.0)]
    assert sharpness.index(max(sharpness)) == 1


def test_a_lost_specimen_leaves_empty_resin_for_good():
    cutter = Cutter("block.lost@2")
    cutter.section()
    assert cutter.snap().std() > 300
    cutter.section()
    cutter.faults.switch_off("block.lost")
    cutter.section()
    assert cutter.snap().std() < 60


def test_the_lamp_saturates_and_flickers():
    cutter = Cutter("lamp.bright")
    assert (cutter.snap() == 4095).mean() > 0.5
    cutter.faults.switch_off("lamp.bright")
    steady = [cutter.snap().mean() for _ in range(30)]
    cutter.faults.switch_on(parse_fault("lamp.flicker@5%"))
    flickering = [cutter.snap().mean() for _ in range(30)]
    assert np.std(steady) < 0.002 * np.mean(steady)
    assert np.std(flickering) == pytest.approx(0.05 * np.mean(steady), rel=0.5)


def test_frames_freeze_break_off_and_get_lost():
    cutter = Cutter()
    frames: list[np.ndarray] = []
    camera = SimCamera(cutter.bench.sensor, cutter.bench.axis, exposure_ms=2.0, faults=cutter.faults)
    camera.arm(None, lambda pixels, stamp: frames.append(pixels.copy()))
    for fault in (None, "camera.freeze", "camera.partial"):
        if fault:
            cutter.faults.switch_on(parse_fault(fault))
        camera.trigger()
        if fault:
            cutter.faults.switch_off(fault)
    assert np.array_equal(frames[0], frames[1])
    assert frames[2][SIZE[1] // 2 :].max() == 0 < frames[2][: SIZE[1] // 2].min()
    cutter.faults.switch_on(parse_fault("camera.drop@1"))
    with pytest.raises(CameraTimeout):
        camera.trigger()


@pytest.mark.parametrize("distance_um", [0.0, 3.0, 9.0])
def test_defocus_is_that_of_the_optics_without_seams_at_the_edges(distance_um):
    """The frame cut out of a much larger world, blurred there, is what the sensor makes of its own."""
    cutter = Cutter()
    margin_px = 80
    world = Solid(3).face((384, 256), cutter.specimen.pixel_um, 0.0, (-margin_px * 0.1725, -margin_px * 0.1725))
    padded = np.full((512, 512), world.mean(), np.float32)
    padded[:256, :384] = world
    light = blurred(padded, Optics(0.45, 1.0, 0.55, 0.1725), [distance_um])[0] / FULL_SCALE
    light = light[margin_px : margin_px + SIZE[1], margin_px : margin_px + SIZE[0]]
    expected = ((WHITE_LEVEL - BLACK_LEVEL) * light + BLACK_LEVEL) * 4095
    noise = np.mean([cutter.snap(distance_um) for _ in range(16)], axis=0) - expected
    assert abs(noise.mean()) < 2
    assert noise.std() < 15


def test_a_block_without_a_microtome_shows_its_first_face():
    spec = RigSpec.model_validate({key: value for key, value in SPEC.items() if key != "microtome"})
    bench = build_bench(spec, SimClock(100.0))
    picture = np.empty(SIZE[::-1], np.uint16)
    bench.sensor.expose(np.zeros(1), 2.0, picture)
    assert isinstance(bench.specimen, BlockSpecimen)
    assert likeness(picture, bench.specimen.picture(Face())) > 0.9


def test_the_truth_on_disk_computes_any_face(tmp_path):
    cutter = Cutter()
    cutter.specimen.save_truth(tmp_path / "truth.npz")
    with np.load(tmp_path / "truth.npz") as truth:
        size_px = tuple(truth["size_px"].tolist())
        face = Solid(int(truth["seed"])).face(size_px, float(truth["pixel_um"]), 2.5)
    assert np.array_equal(face, cutter.specimen.picture(Face(2.5)))


def test_a_block_needs_no_faults():
    block = Block()
    for depth_um in (1.0, 2.0, 2.0):
        block.stroke(depth_um)
    assert block.removed_um == [0.0, 1.0, 0.0]
    assert block.face == Face(2.0, 2)
