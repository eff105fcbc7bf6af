"""A real window under a virtual X server: what is in it is the picture that was drawn."""

import os
import subprocess
import sys

import numpy as np
from screens import needs_screen, virtual_screen

GRAB = """
import sys
import numpy as np
from display.gl.canvas import Canvas
from display.gl.show import show, window_context
from display.window import Window

window = Window("test", (80, 60))
canvas = Canvas(window_context())
picture = np.random.default_rng(1).integers(0, 255, (60, 80, 3), np.uint8)
show(canvas, picture, window.size)
seen = canvas.context.detect_framebuffer(0).read(components=3, alignment=1)
window.swap()
assert not window.closed
assert not window.wait(0.0)
window.close()
seen = np.frombuffer(seen, np.uint8).reshape(60, 80, 3)[::-1]
assert np.abs(seen.astype(int) - picture).max() <= 1
"""


@needs_screen
def test_a_window_shows_the_picture_the_right_way_up():
    with virtual_screen() as environment:
        subprocess.run([sys.executable, "-c", GRAB], check=True, env=environment, timeout=300)


def test_without_a_display_the_other_way_is_named(tmp_path):
    stack = tmp_path / "stack.npy"
    np.save(stack, np.zeros((3, 8, 8), np.uint8))
    environment = {key: value for key, value in os.environ.items() if key not in {"DISPLAY", "WAYLAND_DISPLAY"}}
    done = subprocess.run(
        [sys.executable, "-c", "from devices.cli import main; main()", "view", str(stack)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 10
    assert "error[no-display]" in done.stderr
    assert "stereotome render" in done.stderr
