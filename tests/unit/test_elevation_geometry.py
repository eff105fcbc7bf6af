"""Every relation between height and place in a view against points projected by trigonometry written out here."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import InputError
from processing.stereo_geometry import View, fitted_plane, locate, shifted_pair, tilted_pair

X_UM = np.linspace(-400, 400, 41)
Z_UM = 60 * np.sin(X_UM / 70) + 0.05 * X_UM


def seen(x: np.ndarray, z: np.ndarray, tilt_deg: float, distance_um: float = math.inf) -> np.ndarray:
    """Turn a point about the axis with a rotation matrix, then draw the ray from the eye point."""
    t = math.radians(tilt_deg)
    turned = np.array([[math.cos(t), math.sin(t)], [-math.sin(t), math.cos(t)]]) @ np.stack([x, z])
    return turned[0] if math.isinf(distance_um) else turned[0] * distance_um / (distance_um - turned[1])


def test_symmetric_tilt_is_parallax_over_twice_the_sine_of_half_the_angle() -> None:
    left, right = seen(X_UM, Z_UM, 5), seen(X_UM, Z_UM, -5)
    found = locate(tilted_pair(10), (left, right))
    np.testing.assert_allclose(found.z_um, (left - right) / (2 * math.sin(math.radians(5))), atol=1e-9)
    np.testing.assert_allclose(found.z_um, Z_UM, atol=1e-9)
    np.testing.assert_allclose(found.x_um, X_UM, atol=1e-9)


def test_the_error_at_ten_degrees_is_five_point_seven_times_that_of_the_parallax() -> None:
    found = locate(tilted_pair(10), (seen(X_UM, Z_UM, 5), seen(X_UM, Z_UM, -5)))
    np.testing.assert_allclose(found.z_per_um, 1 / (2 * math.sin(math.radians(5))))
    assert found.z_per_um[0] == pytest.approx(5.74, abs=0.01)


def test_one_sided_tilt() -> None:
    left, right = X_UM, seen(X_UM, Z_UM, -8)
    found = locate(tilted_pair(8, left_deg=0), (left, right))
    t = math.radians(8)
    np.testing.assert_allclose(found.z_um, (left * math.cos(t) - right) / math.sin(t), atol=1e-9)
    np.testing.assert_allclose(found.z_um, Z_UM, atol=1e-9)
    np.testing.assert_allclose(found.z_per_um, 1 / math.sin(t))


@given(
    st.floats(-60, 60),
    st.floats(1, 40),
    st.sampled_from([math.inf, 3e3, 2e4]),
    st.floats(-300, 300),
    st.floats(-90, 90),
)
def test_any_two_tilts_with_and_without_perspective(
    left_deg: float, tilt_deg: float, distance_um: float, x_um: float, z_um: float
) -> None:
    views = tilted_pair(tilt_deg, left_deg=left_deg, distance_um=distance_um)
    x, z = np.array([x_um]), np.array([z_um])
    places = [seen(x, z, deg, distance_um) for deg in (left_deg, left_deg - tilt_deg)]
    np.testing.assert_allclose([v.project(x, z) for v in views], places, atol=1e-8)
    found = locate(views, places)
    np.testing.assert_allclose((found.x_um[0], found.z_um[0]), (x_um, z_um), atol=1e-6)


def test_many_views_are_solved_by_least_squares_and_are_surer_than_two() -> None:
    tilts = np.linspace(-20, 20, 9)
    noise = np.random.default_rng(5).normal(0, 0.2, (9, X_UM.size))
    views = [View(float(t)) for t in tilts]
    places = [seen(X_UM, Z_UM, t) + n for t, n in zip(tilts, noise, strict=True)]
    found = locate(views, places)
    design = np.array([[math.cos(math.radians(t)), math.sin(math.radians(t))] for t in tilts])
    expected = np.linalg.lstsq(design, np.array(places), rcond=None)[0]
    np.testing.assert_allclose((found.x_um, found.z_um), expected, atol=1e-9)
    two = locate([views[0], views[-1]], [places[0], places[-1]])
    assert np.std(found.z_um - Z_UM) < 0.85 * np.std(two.z_um - Z_UM)
    assert found.misfit_um.mean() == pytest.approx(0.2 * math.sqrt(7 / 9), rel=0.15)
    assert np.all(two.misfit_um < 1e-9)


def test_shifted_stage_under_perspective() -> None:
    shift, distance = 500.0, 1e4
    left, right = ((X_UM + s) * distance / (distance - Z_UM) for s in (shift / 2, -shift / 2))
    found = locate(shifted_pair(shift, distance), (left, right))
    np.testing.assert_allclose(found.z_um, Z_UM, atol=1e-7)
    np.testing.assert_allclose(found.z_um, distance * (left - right - shift) / (left - right), atol=1e-7)
    small = 1e-3 * Z_UM  # for low relief the textbook's p WD / S, p measured from the plane of the axis
    left, right = ((X_UM + s) * distance / (distance - small) for s in (shift / 2, -shift / 2))
    np.testing.assert_allclose((left - right - shift) * distance / shift, small, rtol=1e-4)


def test_sensitivity_is_the_derivative_under_perspective_too() -> None:
    for views in (tilted_pair(12, left_deg=3, distance_um=4e3), shifted_pair(300, 4e3)):
        left, right = (view.project(X_UM, Z_UM) for view in views)
        moved = [locate(views, (left, right + step)).z_um for step in (-1e-3, 1e-3)]
        np.testing.assert_allclose(locate(views, (left, right)).z_per_um, np.abs(moved[1] - moved[0]) / 2e-3, rtol=1e-4)


def test_points_that_are_not_known_stay_unknown() -> None:
    right = seen(X_UM, Z_UM, -4)
    right[7] = np.nan
    found = locate(tilted_pair(8), (seen(X_UM, Z_UM, 4), right))
    assert np.isnan(found.z_um[7])
    assert np.isfinite(np.delete(found.z_um, 7)).all()


@pytest.mark.parametrize("tilt", [0.0, math.nan, 0.001, 120.0, math.inf])
def test_a_tilt_that_gives_no_elevation_is_refused(tilt: float) -> None:
    with pytest.raises(InputError) as refused:
        tilted_pair(tilt)
    assert refused.value.code == "stereo-tilt"


def test_other_geometries_that_make_no_sense_are_refused() -> None:
    for make, code in (
        (lambda: tilted_pair(8, left_deg=math.nan), "stereo-tilt"),
        (lambda: tilted_pair(8, distance_um=-1), "stereo-distance"),
        (lambda: tilted_pair(8, distance_um=math.nan), "stereo-distance"),
        (lambda: shifted_pair(0, 1e4), "stereo-shift"),
        (lambda: shifted_pair(500, math.inf), "stereo-distance"),
        (lambda: locate([View(3), View(3)], [X_UM, X_UM]), "stereo-geometry"),
        (lambda: locate([View(3)], [X_UM]), "stereo-geometry"),
    ):
        with pytest.raises(InputError) as refused:
            make()
        assert refused.value.code == code


def test_a_plane_is_fitted_past_a_hill() -> None:
    x, y = (a.astype(float) for a in np.meshgrid(np.arange(40.0), np.arange(30.0)))
    z = 3 + 0.2 * x - 0.1 * y
    z[10:15, 10:16] += 40
    z[20, 20] = np.nan
    plane = fitted_plane(x, y, z)
    np.testing.assert_allclose((plane.height_um, plane.slope_x, plane.slope_y), (3, 0.2, -0.1), atol=1e-6)
    assert plane.tilt_deg == pytest.approx(math.degrees(math.atan(math.hypot(0.2, 0.1))))


def test_points_on_a_line_span_no_plane() -> None:
    with pytest.raises(InputError) as refused:
        fitted_plane(np.arange(5.0), np.arange(5.0), np.zeros(5))
    assert refused.value.code == "stereo-points"
