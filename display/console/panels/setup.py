"""The dialogue of the first start."""

from __future__ import annotations

from typing import TYPE_CHECKING

from imgui_bundle import imgui

from display.console.panels import widgets as w

if TYPE_CHECKING:
    from display.console.setup import Setup


def draw(setup: Setup) -> None:
    """Draw the dialogue in the middle of the window."""
    room = imgui.get_main_viewport().size
    imgui.set_next_window_size(imgui.ImVec2(min(w.em(38).x, room.x), 0))
    imgui.set_next_window_pos(imgui.ImVec2(room.x / 2, w.em(3).x), imgui.Cond_.appearing, imgui.ImVec2(0.5, 0))
    imgui.begin("First start", None, imgui.WindowFlags_.no_collapse)
    w.words("No instrument is served here. Describe yours, or look around on the simulated one.")
    if w.button("Simulated bench", setup.doing, "a microscope, a camera and a specimen, all of it simulated"):
        setup.simulate()
    w.words(setup.doing or setup.words or " ", w.BLUE if setup.doing else w.ORANGE)
    imgui.separator_text("z stage")
    _stage(setup)
    imgui.separator_text("camera and optics")
    _camera(setup)
    imgui.separator_text("instrument file")
    setup.file = w.text_field("file", setup.file, 16)
    imgui.same_line()
    why_not = setup.doing or ("" if setup.port else "name the port of the stage")
    if w.button("Write and start", why_not, "nothing moves"):
        setup.start()
    imgui.end()


def _stage(setup: Setup) -> None:
    if w.button("Look for ports", setup.doing):
        setup.look()
    for port in setup.ports:
        if imgui.radio_button(f"{port['name']} ({port['description']})", setup.port == port["name"]):
            setup.port = port["name"]
        for remark in (*(f"in use by {holder}" for holder in port["held_by"]), port["hint"]):
            if remark:
                w.words(f"    {remark}", w.ORANGE)
    setup.port = w.text_field("port", setup.port, 16)
    imgui.same_line()
    asks = "questions that change nothing, at every usual baud; nothing moves"
    if w.button("Ask who is there", setup.doing or ("" if setup.port else "name a port"), asks):
        setup.ask()
    setup.driver = w.choice("driver", setup.stages, setup.driver, 9)
    imgui.same_line()
    setup.baud = w.whole("baud", setup.baud, 300, 1_000_000)
    low_um = w.number("lowest µm", setup.limits_um[0], 5)[1]
    imgui.same_line()
    high_um = w.number("highest µm", setup.limits_um[1], 5)[1]
    setup.limits_um = (low_um, high_um)
    w.words("Drive to both ends by hand first, with the objective in mind: nothing is sent beyond them.", w.GREY)


def _camera(setup: Setup) -> None:
    setup.camera = w.choice("camera", setup.cameras, setup.camera, 9)
    if setup.source_words:
        setup.source = w.text_field(setup.source_words, setup.source, 12)
    setup.magnification = max(w.number("magnification", setup.magnification, 5)[1], 0.01)
    imgui.same_line()
    setup.na = max(w.number("numerical aperture", setup.na, 5)[1], 0.01)
