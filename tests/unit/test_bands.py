"""Bands of an instrument: read from its file, chosen by a plan, taken on by a camera."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from devices.bands import BandSpec, choose_bands, switch_band
from devices.errors import LimitError, RigError
from devices.rig import RigSpec
from devices.toml_model import load_text
from devices.values import CameraCaps

RIG = """
schema = 1
name = "fluorescence"
[camera]
driver = "sim"
[optics]
magnification = 10.0
na = 0.3
[stage.z]
driver = "asi-ms2000"
port = "/dev/null"
limits = { min_um = -1.0, max_um = 1.0 }
[[band]]
name = "GFP"
exposure_ms = 80.0
colour = "#00ff40"
[band.settings]
"Filter.Label" = "GFP"
"Lamp.Intensity" = 40
[[band]]
name = "white"
"""


class Camera:
    """Keeps what it is told; ``shapes`` are those of its frames after each setting."""

    def __init__(self, *, width: int = 8) -> None:
        self.told: list[object] = []
        self.width_then, self.width = width, 8

    def caps(self) -> CameraCaps:
        return CameraCaps("plain", 6, self.width, 1, "uint8", 8, timed=True)

    def configure(self, *, exposure_ms: float, roi: object = None) -> None:
        self.told.append(exposure_ms)


class Settable(Camera):
    def apply_settings(self, settings) -> None:
        self.told.append(dict(settings))
        self.width = self.width_then


def bands() -> tuple[BandSpec, ...]:
    return load_text(RIG, "rig.toml", RigSpec, RigError).band


def test_they_are_read_from_the_instrument_file():
    gfp, white = bands()
    assert (gfp.name, gfp.exposure_ms, gfp.colour, gfp.unit) == ("GFP", 80.0, "#00ff40", "counts")
    assert list(gfp.settings.items()) == [("Filter.Label", "GFP"), ("Lamp.Intensity", 40)]
    assert (white.exposure_ms, white.settings) == (None, {})


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ('name = "white"', 'name = "GFP"', "more than one band is called GFP"),
        ('name = "white"', 'name = "a b"', "pattern"),
        ("exposure_ms = 80.0", "exposure_ms = 0.0", "greater than 0"),
        ('"#00ff40"', '"green"', "pattern"),
        ("exposure_ms = 80.0", "exposure = 80.0", "exposure_ms"),
        ('= "GFP"\n"Lamp', '= [1]\n"Lamp', "Filter.Label"),
    ],
)
def test_a_band_that_makes_no_sense(before: str, after: str, words: str):
    assert before in RIG
    with pytest.raises(RigError) as caught:
        load_text(RIG.replace(before, after), "rig.toml", RigSpec, RigError)
    assert words in caught.value.message()


def test_a_plan_chooses_in_its_own_order():
    assert [band.name for band in choose_bands(bands(), ["white", "GFP"])] == ["white", "GFP"]
    assert choose_bands(bands(), []) == ()


@pytest.mark.parametrize(
    ("names", "words"), [(["GFP", "wite"], "no band 'wite'; did you mean 'white'"), (["GFP", "GFP"], "twice")]
)
def test_a_plan_that_asks_for_what_there_is_not(names: list[str], words: str):
    with pytest.raises(RigError, match=words):
        choose_bands(bands(), names)


def test_settings_come_before_the_exposure_and_the_plans_counts_where_the_band_has_none():
    gfp, white = bands()
    camera = Settable()
    switch_band(camera, gfp, 10.0)
    switch_band(camera, white, 10.0)
    assert camera.told == [{"Filter.Label": "GFP", "Lamp.Intensity": 40}, 80.0, 10.0]


def test_a_camera_that_has_no_properties_can_only_change_its_exposure():
    gfp, white = bands()
    camera = Camera()
    switch_band(camera, white, 10.0)
    assert camera.told == [10.0]
    with pytest.raises(RigError, match="band 'GFP': the camera plain has no properties to set"):
        switch_band(camera, gfp, 10.0)
    assert camera.told == [10.0]


def test_frames_of_another_size_are_no_band_of_this_stack():
    with pytest.raises(RigError, match=r"band 'GFP': frames of \(6, 4\) uint8, before it \(6, 8\) uint8"):
        switch_band(Settable(width=4), bands()[0], 10.0)


def test_a_band_is_frozen():
    with pytest.raises(ValidationError):
        bands()[0].name = "other"


def test_limits_are_the_cameras_own():
    class Slow(Settable):
        def configure(self, *, exposure_ms: float, roi: object = None) -> None:
            raise LimitError("too long")

    with pytest.raises(LimitError):
        switch_band(Slow(), bands()[0], 10.0)
