"""A finished run looked at again: any kind of picture in any stereo, drawn by a thread of its own: nothing waits.

The thread has its own OpenGL context. Of what is wished for, only the newest is drawn.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tifffile

from acquire.depths import depths_nm
from acquire.store import is_run, open_run
from devices.errors import InputError, StereotomeError
from display.console.drawn import FLAT, Drawn, Wish
from display.controls import Shown
from display.light import encoded
from display.load import limits_of, load_volume
from display.modes import all_modes
from display.relief import Relief, ReliefLook
from display.scene import Band, Layer, Scene, SliceLook, Transfer, Volume
from display.stereo import Stereo
from processing.heights import read_heights
from processing.outputs import write_durably
from processing.pictures import png_bytes
from processing.readers_run import NM_PER_UM, is_cut

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from acquire.store import StoredRun
    from display.console.flipping import Flipping
    from display.console.journal import Journal
    from display.movie import Sweep
    from display.stereo import Mode
    from processing.heights import Heights

    Picture = NDArray[np.uint8]

RESULTS = "focus"
PAGE_FLIP: Mode = "page-flip"
MOVIE_HZ = 25.0
RELIEF_VIEW = (25.0, -50.0)


def kinds() -> tuple[str, ...]:
    """Return the names of all kinds of picture of a run."""
    return (*FLAT, *(name for name, mode in all_modes().items() if mode.data is Volume))


@dataclass(frozen=True)
class Film:
    """A movie to be written: what of, how it changes, how many pictures, and where to."""

    wish: Wish
    sweep: Sweep
    frames: int
    path: Path


class Data:
    """What was read of one folder, each thing once."""

    def __init__(self, folder: str) -> None:
        self.folder = folder
        self._kept: dict[str, Any] = {}

    def scene(self, wish: Wish) -> Scene:
        """Return the scene that is wished for."""
        shown = wish.shown
        view = replace(shown.view, azimuth_deg=0, elevation_deg=0) if shown.mode in FLAT[:2] else shown.view
        return Scene((self._layer(wish),), view, shown.stereo)

    def volume(self) -> Volume:
        """Return the stack as a volume."""
        made: Volume = self._once("volume", lambda: volume_of(Path(self.folder)))
        return made

    def _layer(self, wish: Wish) -> Layer:
        match wish.shown.mode:
            case "extended focus":
                return Layer(_coloured(self._once("focus", self._focus), wish.colours), "slice", SliceLook())
            case "range":
                look = ReliefLook(paint="heights", colours=wish.colours or "viridis")
                return Layer(self._once("range", lambda: self._relief(draped=False)), "isometric", look)
            case "relief":
                return Layer(self._once("relief", lambda: self._relief(draped=True)), "relief", self._lit(wish))
            case mode:
                return Layer(_coloured(self.volume(), wish.colours), mode, _look(wish))

    def _lit(self, wish: Wish) -> ReliefLook:
        return ReliefLook(paint="image", light=wish.light)

    def _focus(self) -> Volume:
        image = tifffile.imread(self._result("extended_focus.tif"))
        values = np.ascontiguousarray(image if image.ndim == 2 else image.mean(axis=2).astype(image.dtype))[None]
        heights = self._heights()
        return Volume((Band(values, limits_of(values), "extended focus"),), (1.0, *heights.pixel), heights.unit)

    def _relief(self, *, draped: bool) -> Relief:
        from display.relief_command import read_drape, usual_exaggeration  # noqa: PLC0415

        heights = self._heights()
        if not draped:
            return Relief(heights)
        return Relief(heights, usual_exaggeration(heights), read_drape(self._result("extended_focus.tif")))

    def heights(self, wish: Wish) -> Heights | None:
        """Return the heights of what is seen from above; None for other pictures."""
        return self._heights() if wish.shown.mode in FLAT[:2] else None

    def _heights(self) -> Heights:
        made: Heights = self._once("heights", lambda: read_heights(self._result("range.tif")))
        return made

    def _result(self, name: str) -> Path:
        path = Path(self.folder) / RESULTS / name
        if not path.exists():
            raise InputError(
                f"{self.folder} has no {name}.",
                why="It is made while a run is taken when the recipe asks for it.",
                fix=f"make it now: stereotome process focus {self.folder} -o {self.folder}/{RESULTS}",
            )
        return path

    def _once(self, name: str, make: Any) -> Any:
        if name not in self._kept:
            self._kept[name] = make()
        return self._kept[name]


def volume_of(path: Path) -> Volume:
    """Return a stack as a volume.

    Of a run of sections with stacks, the middle plane of each, as deep as the feed read back.
    """
    run = open_run(path) if is_run(path) else None
    if run is not None and run.layout.sections > 1 and run.layout.planes_each > 1 and is_cut(run):
        return _faces(run)
    return load_volume(path)


def _faces(run: StoredRun) -> Volume:
    middle = run.layout.planes_each // 2
    slots = [slot for slot, each in sorted(run.planes.items()) if (each.header.plane, each.header.band) == (middle, 0)]
    depth_nm, _ = depths_nm(run, [run.layout.place(slot)[0] for slot in slots])
    if depth_nm is None or len(slots) < 2:
        return _planes(run, slots, 1.0)
    return _planes(run, slots, float(np.ptp(depth_nm)) / (len(slots) - 1) / NM_PER_UM)


def _planes(run: StoredRun, slots: list[int], apart_um: float) -> Volume:
    if not slots:
        raise InputError(f"{run.folder} holds nothing whole yet.", fix="look again later", code="stack-empty")
    planes = [run.read(slot) for slot in slots]
    values = np.stack([plane if plane.ndim == 2 else plane[..., 1] for plane in planes])
    pixel_um = run.layout.pixel_um
    spacing = (apart_um, pixel_um, pixel_um) if pixel_um else (1.0, 1.0, 1.0)
    return Volume((Band(values, limits_of(values)),), spacing, "µm" if pixel_um else "voxels")


def _coloured(volume: Volume, colours: str) -> Volume:
    """Return a volume of one band in other colours."""
    if not colours or len(volume.bands) > 1:
        return volume
    return replace(volume, bands=(replace(volume.bands[0], colour=colours),))


def _look(wish: Wish) -> Any:
    look = wish.shown.look
    if not hasattr(look, "transfer"):
        return replace(look, light=wish.light)
    return replace(look, transfer=Transfer(wish.points), threshold=wish.threshold, light=wish.light)


def _without_glasses(scene: Scene) -> Scene:
    """Return a scene as one view if only glasses could part its two."""
    return replace(scene, stereo=Stereo()) if scene.stereo.mode == PAGE_FLIP else scene


class Reviewer:
    """Draws what is wished for, in a thread of its own, from the first wish on; pairs go to the shutter glasses.

    Attributes
    ----------
    drawn : Drawn or None
        The newest picture.
    problem : str
        Why there is none, in words.
    planes : int
        Of the stack read last.
    limits : (float, float)
        Grey levels shown as nothing and as full.
    filming : str
        How far a movie is, in words; empty without one.
    """

    def __init__(self, journal: Journal, flipping: Flipping) -> None:
        self.drawn: Drawn | None = None
        self.problem = ""
        self.planes = 1
        self.limits = (0.0, 4095.0)
        self.filming = ""
        self._film: Film | None = None
        self._journal = journal
        self._flipping = flipping
        self._wish: Wish | None = None
        self._wished = threading.Condition()
        self._over = False
        self._thread: threading.Thread | None = None

    @property
    def busy(self) -> bool:
        """Whether what was wished for last is not there yet."""
        return self._wish is not None and not self.problem and (self.drawn is None or self.drawn.wish != self._wish)

    def wish(self, wish: Wish) -> None:
        """Wish for a picture; what was wished for before and is not begun is dropped."""
        if wish == self._wish:
            return
        with self._wished:
            self._wish, self.problem = wish, ""
            self._wished.notify()
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="review", daemon=True)
            self._thread.start()

    def save(self, path: Path) -> None:
        """Write the newest picture as PNG."""
        if self.drawn is not None:
            write_durably(path, png_bytes(self.drawn.picture))

    def film(self, film: Film) -> None:
        """Have a movie written; pictures that are wished for meanwhile come after it."""
        with self._wished:
            self._film, self.filming = film, "a movie begins"
            self._wished.notify()

    def close(self) -> None:
        """Draw no more; a movie that is not whole is not kept."""
        with self._wished:
            self._over = True
            self._wished.notify()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        from display.gl.renderer import Renderer  # noqa: PLC0415  a console may never review

        done, data = None, Data("")
        with Renderer() as renderer:
            while (asked := self._next(done)) is not None:
                wish = asked if isinstance(asked, Wish) else asked.wish
                if data.folder != wish.folder:
                    data = Data(wish.folder)
                try:
                    if isinstance(asked, Wish):
                        done = asked
                        self.drawn = self._draw(renderer, data, asked)
                    else:
                        self._write(renderer, data, asked)
                except Exception as error:  # noqa: BLE001  the next wish must be drawn whatever this one did
                    words = f"{type(error).__name__}: {error}"
                    self.problem = error.message() if isinstance(error, StereotomeError) else words
                    self._journal.add("error", "review", self.problem)
                finally:
                    self.filming = "" if self._film is None else self.filming

    def _write(self, renderer: Any, data: Data, film: Film) -> None:
        """Write a movie and say how far it is."""
        from display.movie import frames_of, write_movie  # noqa: PLC0415
        from display.render import picture  # noqa: PLC0415

        scenes = frames_of(_without_glasses(data.scene(film.wish)), film.wish.size, film.sweep, film.frames)

        def pictures() -> Iterator[Picture]:
            for number, scene in enumerate(scenes, start=1):
                if self._over:
                    raise InputError("the console was closed before the movie was whole.", code="movie")
                self.filming = f"picture {number} of {len(scenes)}"
                yield picture(renderer, scene, film.wish.size)

        write_movie(film.path, pictures(), MOVIE_HZ)
        self._journal.add("info", "review", f"saved {film.path}")

    def _draw(self, renderer: Any, data: Data, wish: Wish) -> Drawn:
        from display.render import picture, views  # noqa: PLC0415

        scene = data.scene(wish)
        if wish.shown.mode not in FLAT:
            volume = data.volume()
            self.planes, self.limits = volume.shape[0], volume.bands[0].limits
        if scene.stereo.mode == PAGE_FLIP:
            left, right = (encoded(light) for light in views(renderer, scene, self._flipping.size))
            self._flipping.publish(*((right, left) if scene.stereo.swap else (left, right)))
        scene = _without_glasses(scene)
        return Drawn(wish, picture(renderer, scene, wish.size), scene, data.heights(wish))

    def _next(self, done: Wish | None) -> Wish | Film | None:
        with self._wished:
            while not self._over and self._wish is done and self._film is None:
                self._wished.wait()
            if self._over:
                return None
            film, self._film = self._film, None
            return film or self._wish


def first_shown() -> Shown:
    """Return what a review begins with."""
    return Shown(kinds(), 1, mode="extended focus")
