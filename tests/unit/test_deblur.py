"""Point spread functions and deblurring against specimens whose truth is known; the commands against bad input."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
import tifffile
from scipy.ndimage import convolve1d

from devices.cli import run
from devices.errors import InputError
from processing import deblur_tiles
from processing.deblur import nearest_neighbour, noise_over_signal, richardson_lucy, van_cittert, wiener
from processing.deblur_cli import FILES, blank_planes
from processing.deblur_known import known_of
from processing.deblur_tiles import Deblurring, deblur, tile_side
from processing.psf import Optics, from_beads, modelled
from sim.scenes.beads import beads, blurred, cells

if TYPE_CHECKING:
    from pathlib import Path

OPTICS = Optics(1.0, 0.525, 1.33)
SPACING = (0.3, 0.12, 0.12)
SHAPE = (12, 48, 48)


@pytest.fixture(scope="module")
def psf() -> np.ndarray:
    return modelled(OPTICS, SPACING, (9, 17, 17))


@pytest.fixture(scope="module")
def scene(psf):
    return cells(11, psf, SHAPE, level=2000)


def rms(found: np.ndarray, truth: np.ndarray) -> float:
    return float(np.sqrt(np.mean((found - truth) ** 2)))


def test_in_focus_it_is_airy_s_pattern():
    """First dark ring at 0.61 λ/NA; on the axis the light falls to 0 at 2 n λ/NA² where angles are small."""
    low = Optics(0.1, 0.5, 1.0)
    plane = modelled(low, (100.0, 0.1, 0.1), (3, 81, 81))[1]
    row = plane[40, 40:]
    assert abs(row.argmin() * 0.1 - 0.61 * 0.5 / 0.1) < 0.1
    axis = modelled(low, (1.0, 0.5, 0.5), (241, 1, 1))[:, 0, 0]
    assert abs(axis[121:].argmin() + 1 - 2 * 0.5 / 0.01) <= 2


def test_planes_hold_equal_light_and_the_model_is_symmetric(psf):
    wide = modelled(OPTICS, SPACING, (9, 61, 61))
    assert np.ptp(wide.sum((1, 2))) < 0.05 * wide.sum((1, 2)).max()
    np.testing.assert_allclose(psf, psf[::-1, ::-1, ::-1], rtol=1e-4, atol=1e-9)
    assert abs(float(psf.sum()) - 1) < 1e-5


def test_another_index_makes_it_lopsided_in_depth():
    deep = modelled(Optics(1.0, 0.525, 1.33, 1.45, depth_um=30), SPACING, (15, 31, 31))
    assert np.abs(deep - deep[::-1]).max() > 0.05 * deep.max()


@pytest.mark.parametrize("values", [(0, 0.5, 1), (1.2, 0.5, 1.0), (0.5, 525, 1.0), (np.nan, 0.5, 1.0)])
def test_optics_that_cannot_be_are_refused(values):
    with pytest.raises(InputError):
        Optics(*values)


def test_beads_give_the_point_spread_function_back(psf):
    stack = beads(3, psf, (40, 120, 120), count=12)
    found, count = from_beads(stack.seen, (4, 8, 8))
    assert count >= 6
    for axis in range(3):  # a bead between voxels is shared linearly among them: on the mean, this
        psf = convolve1d(psf, [1 / 12, 5 / 6, 1 / 12], axis=axis)
    assert np.abs(found - psf).max() < 0.08 * psf.max()


def test_a_stack_without_beads_is_refused():
    with pytest.raises(InputError, match="no bead"):
        from_beads(np.random.default_rng(0).poisson(100, (12, 40, 40)).astype(np.uint16), (2, 4, 4))


def test_richardson_lucy_halves_the_error_and_stops_at_the_noise(psf, scene):
    found = richardson_lucy(scene.seen, psf, noise=scene.noise, background=scene.background, most_steps=60)
    raw = rms(scene.seen - scene.background, scene.truth)
    assert rms(found.volume, scene.truth) < 0.75 * raw
    assert found.stopped in {"noise", "still"}
    assert found.steps < 60
    assert found.volume.min() >= 0


def test_more_steps_never_make_the_misfit_larger(psf, scene):
    residual = richardson_lucy(
        scene.seen, psf, noise=2, background=scene.background, most_steps=12, stop=False
    ).residual
    assert (np.diff(residual) < 1e-3).all()


def test_padding_keeps_the_other_side_out(psf):
    truth = np.zeros(SHAPE, np.float32)
    truth[6, 24, 2] = 1e5
    seen = blurred(truth, psf) + 1
    found = richardson_lucy(seen, psf, noise=1, background=0, most_steps=8, stop=False).volume
    assert found[:, :, 40:].max() < 3
    assert found[6, 24, 2] == found.max()


def test_one_step_equals_the_definition(psf):
    """Slow: with the blur as a matrix, on a tiny volume, from the same start, light beyond the edges included."""
    from processing.deblur import Blur

    seen = np.random.default_rng(1).uniform(1, 20, (3, 5, 5)).astype(np.float32)
    small = psf[3:6, 6:11, 6:11] / psf[3:6, 6:11, 6:11].sum()
    blur = Blur(small, seen.shape)
    size = int(np.prod(blur.padded))
    matrix = np.stack([blur.forth(e.reshape(blur.padded)).ravel() for e in np.eye(size, dtype=np.float32)], 1)
    direct = np.zeros((size, size))
    kernel = np.zeros(blur.padded)
    kernel[: small.shape[0], : small.shape[1], : small.shape[2]] = small
    kernel = np.roll(kernel, [-(n // 2) for n in small.shape], (0, 1, 2))
    for column, place in enumerate(np.ndindex(blur.padded)):
        direct[:, column] = np.roll(kernel, place, (0, 1, 2)).ravel()
    np.testing.assert_allclose(matrix, direct, atol=1e-6)
    shown = np.zeros(blur.padded, bool)
    shown[blur.seen] = True
    start = np.maximum(direct @ np.maximum(blur.padded_with(seen, "edge"), seen.mean() * 1e-6).ravel(), 1e-6)
    ratio = np.zeros(size)
    ratio[shown.ravel()] = seen.ravel() / (direct @ start)[shown.ravel()]
    expected = start * (direct.T @ ratio) / np.maximum(direct.T @ shown.ravel().astype(float), 1e-6)
    found = richardson_lucy(seen, small, noise=0.0, most_steps=1, stop=False).volume
    np.testing.assert_allclose(found, expected.reshape(blur.padded)[blur.seen], rtol=2e-3)


def test_wiener_and_van_cittert_gain_without_making_noise(psf, scene):
    light = scene.seen - np.float32(scene.background)
    raw = rms(light, scene.truth)
    assert rms(wiener(light, psf, noise_share=noise_over_signal(light, scene.noise)), scene.truth) < 0.99 * raw
    found = van_cittert(scene.seen, psf, noise=scene.noise, background=scene.background)
    assert rms(found.volume, scene.truth) < 0.97 * raw
    noisy = np.random.default_rng(2).normal(100, 5, SHAPE).astype(np.float32)
    assert van_cittert(noisy, psf, noise=5, background=0).volume.std() < 2 * noisy.std()


def test_nearest_neighbours_take_their_blur():
    plane = np.full((32, 32), 50, np.float32)
    plane[16, 16] = 150
    side = np.full((32, 32), 50, np.float32)
    found = nearest_neighbour(side, plane, side, disc_px=3, share=0.4)
    assert found[16, 16] > 400
    np.testing.assert_allclose(found[2, 2], 50, rtol=1e-4)
    with pytest.raises(InputError):
        nearest_neighbour(side, plane, side, disc_px=3, share=0.5)


@pytest.mark.parametrize(("method", "steps"), [("richardson-lucy", 12), ("van-cittert", 8), ("wiener", 1)])
def test_tiles_agree_with_the_whole(psf, scene, method, steps, monkeypatch):
    """To a few thousandths of the brightest voxel; but for the linear inverse, which looks at the whole."""
    how = Deblurring(method, scene.noise, scene.background, most_steps=steps, brightest=float(scene.seen.max()))
    whole = deblur(scene.seen, psf, how, memory=1e12)
    monkeypatch.setattr(deblur_tiles, "tile_side", lambda *_: 24)
    cut = deblur(scene.seen, psf, how, memory=1e12)
    assert (whole.course.tiles, cut.course.tiles) == (1, 4)
    away = np.abs(whole.volume.astype(float) - cut.volume)
    assert np.sqrt(np.mean(away**2)) < 0.03 * scene.truth.std()
    if method != "wiener":
        assert away.max() <= 4e-3 * whole.volume.max()
        assert np.sqrt(np.mean(away**2)) < 2e-3 * scene.truth.std()


def test_too_little_memory_is_told_with_the_figure():
    with pytest.raises(InputError, match=r"needs .* GB"):
        tile_side((64, 4000, 4000), (33, 31, 31), 15, 1e6)


def saved(folder: Path, volume: np.ndarray) -> Path:
    path = folder / "stack.npy"
    np.save(path, volume)
    return path


def command(path: Path, folder: Path, *more: object) -> int:
    return run(["process", "deblur", str(path), "-o", str(folder), "-q", *map(str, more)])


SIZES = ("--pixel-um", 0.12, "--step-um", 0.3)
LENS = ("--na", 1.0, "--wavelength-um", 0.525, "--index", 1.33)


def test_the_commands_measure_a_psf_and_deblur_with_it(psf, scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "beads").mkdir()
    bead_stack = saved(tmp_path / "beads", beads(3, psf, (30, 90, 90), count=8).seen)
    measured = ["process", "psf", str(bead_stack), "-o", str(tmp_path / "psf"), *map(str, SIZES)]
    assert run([*measured, "--half", "4", "8", "8", "-q"]) == 0
    stack = saved(tmp_path, scene.seen)
    given = ("--psf", tmp_path / "psf" / "psf.tif")
    assert command(stack, tmp_path / "out", *SIZES, *given, "--steps", 5, "--json") == 0
    report = json.loads(capsys.readouterr().out.partition("\n{")[2].join(["{", ""]))
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(FILES)
    assert report["steps"] <= 5
    found = tifffile.imread(tmp_path / "out" / "deblurred.ome.tif")
    assert found.dtype == scene.seen.dtype
    assert rms(found - scene.background, scene.truth) < rms(scene.seen - scene.background, scene.truth)
    assert command(stack, tmp_path / "other", "--pixel-um", 0.2, "--step-um", 0.3, *given) == 2
    assert "was made for voxels of" in capsys.readouterr().err


def test_a_plane_that_was_lost_is_named_and_does_not_count_as_free_of_noise(psf, scene, tmp_path: Path):
    holed = scene.seen.copy()
    holed[5] = 0
    whole, lost = (blank_planes(known_of(volume).flat, 4) for volume in (scene.seen, holed))
    assert whole == []
    assert "plane 5 is" in lost[0]
    noise = []
    for name, volume in (("whole", scene.seen), ("holed", holed)):
        (tmp_path / name).mkdir()
        assert (
            command(saved(tmp_path / name, volume), tmp_path / name / "out", *SIZES, *LENS, "--method", "wiener") == 0
        )
        noise.append(json.loads((tmp_path / name / "out" / "report.json").read_text())["noise"])
    assert noise[1] == pytest.approx(noise[0], rel=0.1)


@pytest.mark.parametrize(
    ("volume", "more", "words"),
    [
        (np.zeros(SHAPE, np.uint16), (*SIZES, *LENS), "is 0 everywhere"),
        (np.ones((2, 8, 8), np.uint16), (*SIZES, *LENS), "has 2 grey planes"),
        (np.ones((4, 8, 8, 3), np.uint8), (*SIZES, *LENS), "colour planes"),
        (np.ones(SHAPE, np.uint16), ("--step-um", -1, *LENS), "plane spacing of -1"),
        (np.ones(SHAPE, np.uint16), ("--step-um", 1, "--pixel-um", -1, *LENS), "needs the size of the voxels"),
        (np.ones(SHAPE, np.uint16), SIZES, "is not known"),
        (np.ones(SHAPE, np.uint16), (*SIZES, "--na", 2, "--wavelength-um", 0.5), "no objective has NA 2"),
        (np.ones(SHAPE, np.uint16), (*SIZES, "--psf", "nowhere.tif"), "there is no nowhere.tif"),
        (np.full(SHAPE, np.nan, np.float32), (*SIZES, *LENS), "not numbers"),
    ],
)
def test_bad_input_is_one_clear_line(volume, more, words, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "stack.npy"
    np.save(path, volume)
    assert command(path, tmp_path / "out", *more) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
