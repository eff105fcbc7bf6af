"""Two eyes: vergence, parallax of points through both projections, and what is refused."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import DisplayError
from display.compose import PICTURES
from display.stereo import MODES, Stereo, eye_matrix, parallax_warnings, plane_shifts, vergence_deg

if TYPE_CHECKING:
    from devices.glasses_timing import Eye

D = 10.0
BEFORE = st.floats(-9.5, 50)  # heights over the plane of the screen, from the eye to far behind


def seen(stereo: Stereo, eye: Eye | None, point: tuple[float, float, float]) -> np.ndarray:
    return np.asarray(eye_matrix(stereo, eye, D) @ [*point, 1.0])[:3]


def on_screen(stereo: Stereo, eye: Eye | None, point: tuple[float, float, float]) -> np.ndarray:
    """Where a line from the camera through the point meets the plane that lies in the screen."""
    x, y, z = seen(stereo, eye, point)
    return np.array([x, y]) * D / -z


def test_vergence_of_human_eyes() -> None:
    assert vergence_deg(75, 1000) == pytest.approx(4.295, abs=5e-4)
    assert vergence_deg(65, 1000) == pytest.approx(3.72, abs=5e-3)
    assert Stereo().vergence_deg == vergence_deg(75, 1000)


@given(x=st.floats(-3, 3), behind=BEFORE)
def test_perspective_parallax_is_that_of_two_eyes_before_a_screen(x: float, behind: float) -> None:
    stereo = Stereo("parallel")
    eyes_apart = 2 * D * math.tan(math.radians(stereo.vergence_deg) / 2)
    point = (x, 1.0, -(D + behind))
    left, right = (on_screen(stereo, eye, point) for eye in ("left", "right"))
    distance = D + behind
    assert left[0] - right[0] == pytest.approx(eyes_apart * (D / distance - 1), abs=1e-9)
    assert left[1] == right[1] == pytest.approx(D / distance)
    for view, at in ((left, -eyes_apart / 2), (right, eyes_apart / 2)):
        assert view[0] == pytest.approx(at + (x - at) * D / distance, abs=1e-9)


@given(height=st.floats(-5, 5), angle=st.floats(0, 30))
def test_parallel_parallax_is_the_shift_of_planes(height: float, angle: float) -> None:
    stereo = Stereo("parallel", vergence_deg=angle)
    left, right = (seen(stereo, eye, (1, 2, height - D)) for eye in ("left", "right"))
    assert left[0] - right[0] == pytest.approx(2 * height * math.tan(math.radians(angle) / 2), abs=1e-9)
    assert left[1] == right[1] == 2
    shifts = plane_shifts(np.array([height]), 0.5, angle, "left")
    assert (left[0] - 1) / 0.5 == pytest.approx(shifts[0], abs=1e-9)


def test_a_turned_pair_is_a_turn_about_the_plane_of_the_screen() -> None:
    stereo = Stereo("parallel", views="rotate", vergence_deg=8.0)
    left, right = (seen(stereo, eye, (0, 2, 3 - D)) for eye in ("left", "right"))
    assert left[0] - right[0] == pytest.approx(2 * 3 * math.sin(math.radians(4)))
    assert seen(stereo, "left", (2, 0, -D))[0] == pytest.approx(2 * math.cos(math.radians(4)))
    assert eye_matrix(stereo, "left", D)[:3, :3] @ eye_matrix(stereo, "left", D)[:3, :3].T == pytest.approx(np.eye(3))


@given(height=st.floats(-5, 5), depth=st.floats(-3, 3))
def test_depth_is_stretched_about_the_screen_and_turned_inside_out(height: float, depth: float) -> None:
    plain = [seen(Stereo("parallel"), eye, (0, 0, depth * height - D)) for eye in ("left", "right")]
    stretched = [seen(Stereo("parallel", depth=depth), eye, (0, 0, height - D)) for eye in ("left", "right")]
    assert stretched == [pytest.approx(view) for view in plain]


@pytest.mark.parametrize("views", ["shift", "rotate"])
def test_between_the_eyes_nothing_moves_and_the_screen_stays(views: Any) -> None:
    assert eye_matrix(Stereo(views=views), None, D) == pytest.approx(np.eye(4))
    for eye in ("left", "right"):
        assert seen(Stereo("rows", views=views), eye, (0, 1, -D)) == pytest.approx([0, 1, -D])


def test_one_view_for_mono_and_two_for_every_other_mode() -> None:
    assert Stereo().eyes == (None,)
    assert {Stereo(mode).eyes for mode in MODES[1:]} == {("left", "right")}  # type: ignore[arg-type]
    assert set(MODES) == {"mono", "page-flip", *PICTURES}


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"mode": "anaglyf-grey"}, "did you mean 'anaglyph-grey'"),
        ({"views": "turn"}, "no views 'turn'"),
        ({"vergence_deg": 61}, "61° apart"),
        ({"vergence_deg": math.nan}, "nan° apart"),
        ({"depth": math.inf}, "depth × inf"),
    ],
)
def test_values_that_make_no_sense_are_refused(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(DisplayError, match=words):
        Stereo(**wrong)


@pytest.mark.parametrize(("eyes", "distance"), [(65, 0), (65, -1), (-1, 100), (math.nan, 100), (65, math.inf)])
def test_lengths_that_make_no_sense_are_refused(eyes: float, distance: float) -> None:
    with pytest.raises(DisplayError):
        vergence_deg(eyes, distance)


def test_what_is_hard_to_fuse_is_told() -> None:
    assert "hard to fuse" in Stereo("parallel", vergence_deg=12).warnings[0]
    assert Stereo("parallel").warnings == Stereo(vergence_deg=12).warnings == ()
    assert "1/30" in parallax_warnings(-21, 600)[0]
    assert parallax_warnings(19, 600) == ()
