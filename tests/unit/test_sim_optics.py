"""Defocus against its formulas, the sensor against the optics, the specimen against its truth."""

from __future__ import annotations

import numpy as np
import pytest

from sim.optics import FULL_SCALE, Optics, blurred, disc_transfer, level_distances_um
from sim.sensor import BLACK_LEVEL, FULL_WELL_E, READ_NOISE_E, WHITE_LEVEL, Sensor
from sim.specimen import Sheet, Specimen, make_specimen, tile_px, tiled

OPTICS = Optics(na=0.45, medium_index=1.0, wavelength_um=0.55, pixel_um=0.1725)
TILE = 256


def variance_px2(picture: np.ndarray) -> float:
    """Variance along x of a picture around its centre of mass."""
    profile = picture.astype(float).sum(axis=0)
    x = np.arange(profile.size)
    centre = (profile * x).sum() / profile.sum()
    return float((profile * (x - centre) ** 2).sum() / profile.sum())


@pytest.mark.parametrize("distance_um", [0.0, 1.0, 3.0, 8.0, 15.0])
def test_a_line_spreads_as_disc_and_core_say(distance_um):
    line = np.zeros((TILE, TILE), np.float32)
    line[:, TILE // 2] = 1.0
    radius = OPTICS.disc_radius_px(distance_um)
    assert radius == pytest.approx(distance_um * np.tan(np.arcsin(0.45)) / 0.1725)
    (picture,) = blurred(line, OPTICS, [distance_um])
    assert variance_px2(picture) == pytest.approx(radius**2 / 4 + OPTICS.core_sigma_px**2, rel=0.01)
    assert picture.sum() == pytest.approx(FULL_SCALE * TILE, rel=0.002)  # light is neither lost nor made


def test_a_step_becomes_the_integral_of_the_discs_chords():
    edge = np.zeros((TILE, TILE), np.float32)
    edge[:, : TILE // 2] = 1.0
    radius = OPTICS.disc_radius_px(8.0)
    profile = blurred(edge, OPTICS, [8.0])[0, 0] / FULL_SCALE
    x = (np.arange(TILE) - (TILE / 2 - 0.5)) / radius
    inside = np.abs(x[64:192].clip(-1, 1))
    covered = np.arccos(inside) / np.pi - inside * np.sqrt(1 - inside**2) / np.pi
    expected = np.where(x[64:192] < 0, 1 - covered, covered)
    assert profile[64:192] == pytest.approx(expected, abs=0.005)


def test_disc_transfer_has_the_zeros_of_the_bessel_function():
    assert disc_transfer(np.array([0.0])) == pytest.approx(1.0)
    first_zeros = np.array([3.8317059702, 7.0155866698, 10.1734681351]) / (2 * np.pi)
    assert disc_transfer(first_zeros) == pytest.approx(0.0, abs=1e-4)


def flat(height_um: float, texture: np.ndarray) -> Specimen:
    return Specimen("relief", (Sheet(np.full(texture.shape, height_um, np.float32), texture),), OPTICS.pixel_um)


def sensor_of(specimen: Specimen, *, seed: int = 1, bit_depth: int = 16) -> Sensor:
    return Sensor(specimen, OPTICS, bit_depth=bit_depth, exposure_ms=10.0, seed=seed)


def picture(sensor: Sensor, *path_um: float, exposure_ms: float = 10.0) -> np.ndarray:
    caps = sensor.caps()
    out = np.empty(caps.shape, caps.dtype)
    sensor.expose(np.array(path_um), exposure_ms, out)
    return out


@pytest.fixture(scope="module")
def texture() -> np.ndarray:
    return np.random.default_rng(5).random((TILE, TILE), np.float32)


def noiseless(sensor: Sensor) -> Sensor:
    sensor._film._noise[:] = 0
    return sensor


def test_sensor_shows_the_blur_of_the_distance(texture):
    sensor = noiseless(sensor_of(flat(3.0, texture)))
    for level in (0, 3, 10, 25):
        distance_um = level_distances_um()[level]
        (expected,) = blurred(texture, OPTICS, [distance_um]) / FULL_SCALE
        for z_um in (3.0 - distance_um, 3.0 + distance_um):
            seen = picture(sensor, z_um) / 65535
            assert np.abs(seen - expected * (WHITE_LEVEL - BLACK_LEVEL) - BLACK_LEVEL).max() < 2e-4


def test_between_two_levels_the_picture_stays_close_to_the_optics(texture):
    sensor, levels = noiseless(sensor_of(flat(0.0, texture))), level_distances_um()
    for level, error in [(0, 0.01), (1, 0.02), (4, 0.06), (12, 0.12)]:
        between_um = (levels[level] + levels[level + 1]) / 2
        (expected,) = blurred(texture, OPTICS, [between_um]) / FULL_SCALE
        seen = (picture(sensor, between_um) / 65535 - BLACK_LEVEL) / (WHITE_LEVEL - BLACK_LEVEL)
        assert np.std(seen - expected) < error * np.std(expected)


def test_exposure_is_the_mean_over_the_path(texture):
    sensor = noiseless(sensor_of(flat(0.0, texture)))
    path_um = [-6.0, -2.0, 1.0, 5.0]
    stills = np.mean([picture(sensor, z_um).astype(float) for z_um in path_um], axis=0)
    assert np.abs(picture(sensor, *path_um) - stills).max() <= 1.0


def test_brightness_is_proportional_to_exposure_until_full_scale(texture):
    sensor = noiseless(sensor_of(flat(0.0, texture), bit_depth=8))
    black = BLACK_LEVEL * 255
    half, whole = (picture(sensor, 0.0, exposure_ms=ms).astype(float) - black for ms in (5.0, 10.0))
    assert np.abs(2 * half - whole).max() <= 2.1
    assert picture(sensor, 0.0, exposure_ms=1000.0).max() == 255


def test_noise_has_the_variance_of_photons_and_reading():
    grey = np.full((TILE, TILE), 0.5, np.float32)
    seen = picture(sensor_of(flat(0.0, grey)), 0.0) / 65535 * FULL_WELL_E
    electrons = 0.5 * (WHITE_LEVEL - BLACK_LEVEL) * FULL_WELL_E
    assert seen.mean() == pytest.approx(electrons + BLACK_LEVEL * FULL_WELL_E, rel=0.005)
    assert seen.var() == pytest.approx(electrons + READ_NOISE_E**2, rel=0.03)


def test_noise_differs_from_frame_to_frame(texture):
    sensor = sensor_of(flat(0.0, texture))
    assert not np.array_equal(picture(sensor, 0.0), picture(sensor, 0.0))


@pytest.mark.parametrize("kind", ["relief", "depth"])
def test_a_seed_fixes_everything(kind):
    def frames(seed: int) -> np.ndarray:
        specimen = make_specimen(kind, (96, 64), 0.1725, seed=seed)
        sensor = sensor_of(specimen, seed=seed, bit_depth=12)
        return np.stack([picture(sensor, z_um) for z_um in (-5.0, 0.0, 5.0)])

    assert np.array_equal(frames(7), frames(7))
    assert not np.array_equal(frames(7), frames(8))


@pytest.mark.parametrize("bit_depth", [8, 12, 16])
def test_frames_are_as_announced(bit_depth):
    specimen = make_specimen("relief", (96, 64), 0.1725, seed=1)
    caps = sensor_of(specimen, bit_depth=bit_depth).caps()
    assert (caps.shape, caps.bit_depth, caps.timed) == ((64, 96), bit_depth, True)
    assert caps.dtype == ("uint8" if bit_depth == 8 else "uint16")
    assert picture(sensor_of(specimen, bit_depth=bit_depth), 0.0).max() < 2**bit_depth


@pytest.mark.parametrize("kind", ["relief", "depth"])
def test_specimen_fills_the_range_it_was_given(kind):
    specimen = make_specimen(kind, (160, 120), 0.1725, seed=2, centre_um=-100.0, reach_um=5.0)
    assert specimen.range_um == pytest.approx((-105.0, -95.0), abs=1e-3)
    assert specimen.height_um().shape == (120, 160)


def detail(frame: np.ndarray) -> np.ndarray:
    """Mean square of the differences between neighbours."""
    return np.square(np.diff(frame.astype(float), axis=-1)).mean(axis=(-2, -1))


def test_every_place_of_the_relief_has_fine_detail():
    specimen = make_specimen("relief", (256, 256), 0.1725, seed=7)
    blocks = tiled(specimen.sheets[0].texture, (256, 256)).reshape(16, 16, 16, 16).swapaxes(1, 2)
    assert np.sqrt(detail(blocks)).min() > 0.08


def test_relief_is_sharpest_at_its_true_height():
    specimen = make_specimen("relief", (256, 256), 0.1725, seed=7, reach_um=5.0)
    sensor, truth_um = noiseless(sensor_of(specimen)), specimen.height_um()
    distances_um = np.arange(-6.0, 6.1, 0.5)
    for y, x in np.random.default_rng(1).integers(10, 246, (12, 2)):
        around = np.s_[y - 6 : y + 7, x - 6 : x + 7]
        height_um = float(truth_um[around].mean())
        sharpness = [detail(picture(sensor, height_um + distance_um)[around]) for distance_um in distances_um]
        assert abs(distances_um[int(np.argmax(sharpness))]) <= 1.0


def test_depth_is_dark_with_truth_where_something_shines():
    specimen = make_specimen("depth", (256, 256), 0.1725, seed=7)
    known = np.isfinite(specimen.height_um())
    assert 0.03 < known.mean() < 0.5
    assert np.median(picture(sensor_of(specimen), 0.0)) < 0.3 * 65535


def test_truth_is_saved(tmp_path):
    specimen = make_specimen("relief", (64, 48), 0.5, seed=3)
    specimen.save_truth(tmp_path / "truth.npz")
    with np.load(tmp_path / "truth.npz") as truth:
        assert np.array_equal(truth["height_um"], specimen.height_um())
        assert truth["height_um"].dtype == np.float32
        assert (float(truth["pixel_um"]), str(truth["kind"])) == (0.5, "relief")


def test_tiles_cover_small_frames_and_repeat_over_large_ones():
    assert [tile_px(size) for size in [(512, 512), (513, 20), (640, 480), (4096, 3000)]] == [512, 1024, 1024, 1024]
    texture = np.arange(16, dtype=np.float32).reshape(4, 4)
    assert np.array_equal(tiled(texture, (6, 5)), np.tile(texture, (2, 2))[:6, :5])
