"""The command ``stereotome view``: a window on a stack, a volume, or an instrument at work."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from cyclopts import Parameter

from acquire.client import Instrument
from acquire.store import StoredRun, is_run, open_run
from devices.clock import SystemClock
from display import controls
from display.controls import Shown
from display.flip_process import FlipOptions
from display.gl.renderer import Renderer
from display.gl.show import show, window_context
from display.light import encoded
from display.live_stack import LiveStack, range_band
from display.load import limits_of, load_volume
from display.modes import all_modes, find_mode
from display.page_flip import PageFlip
from display.render import parse_size, picture, views
from display.resolve import fitting_pixel_um
from display.scene import Band, Layer, Scene, Volume
from display.stereo import Mode, Stereo
from display.sync_codes import Code  # noqa: TC001  the command line is made from the annotations
from display.window import Window
from processing.outputs import write_durably
from processing.pictures import png_bytes

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from devices.protocols import Clock
    from display.window import Happened

    Picture = NDArray[np.uint8]

STILL_S = 0.15  # after this long without input a picture is drawn in full
MOVING_PIXELS = 2  # drawn as one, each way, until then
IDLE_S = 0.05
LIVE_S = 0.01
LOOK_S = 0.3  # between looks into the folder of a run
LATE_AT_ONCE = 16  # planes
CONNECTION = ".json"  # the file a served instrument writes


@Parameter(name="*")
@dataclass(frozen=True)
class Flipping:
    """For --stereo page-flip."""

    glasses: Path | None = None
    "Instrument file whose shutter glasses are told of each flip; left out for glasses that watch a code."
    code: Code = "none"
    "Marks that are drawn for glasses which watch the picture."
    flip_window: Annotated[bool, Parameter(negative="")] = False
    "Flip in a window instead of on the whole display."
    clock_hz: float | None = None
    "No second window: a clock of this rate in the display's place."


def view(
    source: str,
    *,
    mode: str = "",
    size: str = "1000x750",
    stereo: Mode = "mono",
    pixel_um: float | None = None,
    step_um: float | None = None,
    screenshot: Path | None = None,
    flipping: Flipping = Flipping(),
    until: Annotated[float | None, Parameter(help="Close after so many seconds.")] = None,
) -> int:
    """Open a window on a stack, a volume, or an instrument at work.

    Parameters
    ----------
    source
        What ``stereotome render`` reads, or a served instrument: its name, its connection file, or tcp://HOST:PORT.
    mode
        What kind of picture to begin with; mip, or all four live pictures.
    size
        Width and height of the window.
    stereo
        How two views are shown.
    pixel_um
        Size of a pixel in the specimen, for a live stack; goes before what the instrument file says.
    step_um
        Distance of planes; goes before what the file says.
    screenshot
        PNG of the last picture, written at the end.
    """
    clock = SystemClock()
    width, height = parse_size(size)
    feed = None if Path(source).exists() and not source.endswith(CONNECTION) else _feed(source)
    volume = None if feed is not None else load_volume(Path(source), step_um=step_um, quiet=False)
    names = tuple(name for name, each in all_modes().items() if each.data is Volume)
    if mode not in {"", "live"}:
        find_mode(mode)  # says in words that there is no such mode
    first = mode or ("live" if feed is not None else "mip")
    planes = 1 if volume is None else volume.shape[0]
    modes = ("live", *names) if feed is not None else names
    shown = Shown(modes, planes, mode=first, stereo=Stereo(stereo), plane=float(planes // 2))
    with ExitStack() as open_:
        if feed is not None:
            open_.callback(feed.close)
            pixel_um = pixel_um or feed.pixel_um
        window = Window(f"Stereotome: {source}", (width, height))
        open_.callback(window.close)
        flip = _flip((width, height), flipping, open_) if stereo == "page-flip" else None
        sys.stderr.write(controls.HELP)
        viewer = Viewer(window, Renderer(window_context()), clock, volume, feed, pixel_um, flip)
        last = viewer.run(shown, until_s=None if until is None else clock.now() + until)
    if screenshot is not None and last is not None:
        write_durably(screenshot, png_bytes(last))
        sys.stdout.write(f"{screenshot}\n")
    return 0


def _flip(size: tuple[int, int], flipping: Flipping, open_: ExitStack) -> PageFlip:
    """Start the process that flips views before shutter glasses; in the end it says how that went."""
    instrument = None if flipping.glasses is None else str(flipping.glasses)
    options = FlipOptions(
        "", flipping.code, windowed=flipping.flip_window, instrument=instrument, clock_hz=flipping.clock_hz
    )
    flip = PageFlip(size, options)

    def end() -> None:
        report = flip.close()
        sys.stderr.writelines(f"{line}\n" for line in flip.said)
        sys.stdout.write("" if report is None else f"{report.words()}\n")

    open_.callback(end)
    return flip


def _feed(source: str) -> Any:
    if not source.startswith("tcp://") and not source.endswith(CONNECTION) and ("/" in source or "." in source):
        load_volume(Path(source))  # says in words that there is no such file
    return Feed(Instrument.connect(Path(source) if source.endswith(CONNECTION) else source))


class Feed:
    """What comes from an instrument: the newest frames, and what was missed of them from the run's folder."""

    def __init__(self, instrument: Instrument) -> None:
        self.viewer = instrument.viewer()
        self.pixel_um = instrument.instrument().object_pixel_um
        self._instrument = instrument
        self._run: StoredRun | None = None
        self._looked_s = float("-inf")

    def fill(self, stack: LiveStack, now_s: float) -> int:
        """Put planes into the stack that came too late through the ring; return how many."""
        run = self._instrument.state.run
        if run is None or not stack.count or now_s - self._looked_s < LOOK_S:
            return 0
        self._looked_s = now_s
        folder = Path(run.folder)
        if self._run is None or self._run.folder != folder:
            self._run = open_run(folder) if is_run(folder) else None  # on another computer there is no such folder
        return 0 if self._run is None else stack.fill(self._run, LATE_AT_ONCE)

    def close(self) -> None:
        """Leave."""
        self.viewer.close()
        self._instrument.close()


class Viewer:
    """The loop of a window: what the user did, what the instrument sent, and a picture when one of them changed."""

    def __init__(
        self,
        window: Window,
        renderer: Renderer,
        clock: Clock,
        volume: Volume | None,
        feed: Any,
        pixel_um: float | None,
        flip: PageFlip | None = None,
    ) -> None:
        self._window = window
        self._renderer = renderer
        self._clock = clock
        self._volume = volume
        self._feed = feed
        self._pixel_um = pixel_um
        self._flip = flip
        self._stack = LiveStack()

    def run(self, shown: Shown, *, until_s: float | None = None) -> Picture | None:
        """Run until the window is closed; returns the last picture."""
        last: Picture | None = None
        drawn: tuple[object, ...] = ()
        before_s = self._clock.now()
        touched_s = (
            before_s if self._volume is not None else -1.0
        )  # the first picture of a file comes as fast as can be
        while not (self._ended or shown.quit or (until_s is not None and self._clock.now() >= until_s)):
            happened = self._window.wait(0.0 if shown.playing else LIVE_S if self._feed is not None else IDLE_S)
            now_s = self._clock.now()
            shown = controls.tick(self._answered(shown, happened), now_s - before_s)
            touched_s, before_s = (now_s if happened else touched_s), now_s
            shown = self._fed(shown)
            moving = now_s - touched_s < STILL_S and touched_s > 0
            state = (shown, self._window.size, moving, id(self._stack.newest), id(self._volume))
            if state != drawn and min(self._window.size) > 0:
                drawn = state
                last = self._drawn(shown, moving=moving)
                show(self._renderer.canvas, last, self._window.size)
                self._window.swap()
        return last

    @property
    def _ended(self) -> bool:
        return self._window.closed or (self._flip is not None and not self._flip.running)

    def _answered(self, shown: Shown, happened: Happened) -> Shown:
        for key in happened.keys:
            shown = controls.press(shown, key)
        for right, down, button in happened.drags:
            pixel_um = 1.0 if self._volume is None else fitting_pixel_um(self._scene(shown), self._window.size)
            shown = controls.drag(shown, right, down, button, pixel_um)
        return controls.wheel(shown, happened.wheel) if happened.wheel else shown

    def _fed(self, shown: Shown) -> Shown:
        """Take the newest frame of an instrument, if there is one."""
        if self._feed is None:
            return shown
        frame = self._feed.viewer.newest(0.0)
        if frame is not None:
            self._stack.take(frame)
        filled = self._feed.fill(self._stack, self._clock.now())
        if frame is None and not filled:
            return shown
        self._volume = self._stack.volume(self._pixel_um)
        return controls.grown(shown, max(self._stack.count, 1))

    def _scene(self, shown: Shown) -> Scene:
        assert self._volume is not None
        mode = "mip" if shown.mode == "live" else shown.mode
        return Scene((Layer(self._volume, mode, replace(shown, mode=mode).look),), shown.view, shown.stereo)

    def _drawn(self, shown: Shown, *, moving: bool) -> Picture:
        width, height = self._window.size
        self._renderer.canvas.moving = moving
        size, coarse = (width, height), MOVING_PIXELS if moving else 1
        if shown.mode == "live" and self._flip is None:
            return self._four(shown, size, coarse)
        if self._volume is None:
            return np.zeros((height, width, 3), np.uint8)
        if self._flip is not None:
            return self._flipped(self._scene(shown), self._flip)
        return picture(self._renderer, self._scene(shown), size, coarse=coarse)

    def _flipped(self, scene: Scene, flip: PageFlip) -> Picture:
        """Hand both views to the process that flips them; the window shows the left one."""
        both = replace(scene, stereo=replace(scene.stereo, mode="page-flip"))
        left, right = (encoded(light) for light in views(self._renderer, both, flip.size))
        flip.show(*((right, left) if scene.stereo.swap else (left, right)))
        return left

    def _four(self, shown: Shown, size: tuple[int, int], coarse: int) -> Picture:
        """Newest plane, extended focus so far, range so far and volume so far, side by side."""
        part = (max(size[0] // 2, 1), max(size[1] // 2, 1))

        def empty() -> Picture:
            return np.zeros((part[1], part[0], 3), np.uint8)

        focus = self._stack.focus()
        newest = self._stack.newest
        panes = [
            empty() if newest is None else self._flat(_band(newest, "newest plane"), part),
            empty() if focus is None else self._flat(_band(focus[0], "extended focus so far"), part),
            empty() if focus is None else self._flat(range_band(focus[1]), part),
            empty() if self._volume is None else self._fitted(self._scene(shown), part, coarse),
        ]
        return np.vstack([np.hstack(panes[:2]), np.hstack(panes[2:])])

    def _flat(self, band: Band, size: tuple[int, int]) -> Picture:
        pixel = self._pixel_um or 1.0
        volume = Volume((band,), (pixel,) * 3, "µm" if self._pixel_um else "voxels")
        return self._fitted(Scene((Layer(volume, "slice", find_mode("slice").look()),)), size)

    def _fitted(self, scene: Scene, size: tuple[int, int], coarse: int = 1) -> Picture:
        """Draw a scene so that what its stereo makes of it has a size of its own."""
        made = picture(self._renderer, scene, size, coarse=coarse)
        if made.shape[:2] == size[::-1]:
            return made
        import cv2  # noqa: PLC0415

        return np.asarray(cv2.resize(made, size, interpolation=cv2.INTER_AREA), np.uint8)


def _band(values: Any, name: str) -> Band:
    return Band(np.ascontiguousarray(values)[None], limits_of(np.asarray(values)), name)
