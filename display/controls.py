"""What keys, mouse and wheel do to what is shown. Pure functions from one frozen state to the next."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, get_args

from display.scene import SliceLook, View, VolumeLook
from display.stereo import Mode, Stereo

if TYPE_CHECKING:
    from collections.abc import Callable

TURN_DEG_PER_PX = 0.4
ZOOM_PER_STEP = 1.15
ZOOMS = (0.05, 200.0)
FASTER = 1.5
SPEEDS = (0.5, 120.0)  # planes a second
STEREOS: tuple[Mode, ...] = tuple(mode for mode in get_args(Mode) if mode != "page-flip")
PLANES = ("slice", "oblique", "orthogonal", "exploded", "cubes")
Button = Literal["left", "right", "middle"]


@dataclass(frozen=True)
class Shown:
    """Everything a user can change.

    Attributes
    ----------
    mode : str
    modes : tuple of str
        Those one goes through.
    view : View
    stereo : Stereo
    slices, volume : SliceLook, VolumeLook
        Options of both kinds of mode.
    playing : {-1, 0, 1}
        Direction in which planes are played.
    speed : float
        Planes a second.
    bounce : bool
        Turn back at the ends; otherwise begin anew.
    plane, planes : float, int
        Plane in the middle, and how many there are.
    quit : bool
    """

    modes: tuple[str, ...]
    planes: int
    mode: str = "mip"
    view: View = field(default_factory=View)
    stereo: Stereo = field(default_factory=Stereo)
    slices: SliceLook = field(default_factory=SliceLook)
    volume: VolumeLook = field(default_factory=VolumeLook)
    playing: int = 0
    speed: float = 10.0
    bounce: bool = False
    plane: float = 0.0
    quit: bool = False

    @property
    def look(self) -> Any:
        """The options of the mode shown."""
        if self.mode not in PLANES:
            return self.volume
        place = (round(self.plane) + 0.5) / max(self.planes, 1)
        return replace(self.slices, at=(*self.slices.at[:2], place))


def press(shown: Shown, key: str) -> Shown:
    """Return what a key leads to; unknown keys change nothing. `HELP` lists them."""
    return _KEYS[key](shown) if key in _KEYS else shown


def drag(shown: Shown, right_px: float, down_px: float, button: Button, pixel_um: float) -> Shown:
    """Return what dragging the mouse leads to: left turns, right moves, middle turns an oblique plane."""
    view = shown.view
    if button == "left":
        turned = view.azimuth_deg - right_px * TURN_DEG_PER_PX, view.elevation_deg + down_px * TURN_DEG_PER_PX
        return replace(shown, view=replace(view, azimuth_deg=_wrapped(turned[0]), elevation_deg=_wrapped(turned[1])))
    if button == "middle":
        look = shown.slices
        turn, tilt = look.turn_deg - right_px * TURN_DEG_PER_PX, look.tilt_deg + down_px * TURN_DEG_PER_PX
        return replace(shown, slices=replace(look, turn_deg=_wrapped(turn), tilt_deg=_wrapped(tilt)))
    from display.resolve import axes  # noqa: PLC0415

    right, down, _ = axes(view)
    x, y, z = view.centre_um - pixel_um * (right_px * right + down_px * down)
    return replace(shown, view=replace(view, centre_um=(float(x), float(y), float(z))))


def wheel(shown: Shown, steps: float) -> Shown:
    """Return what the wheel leads to: upwards is nearer."""
    zoom = shown.view.zoom * ZOOM_PER_STEP**steps
    return replace(shown, view=replace(shown.view, zoom=_within(zoom, ZOOMS)))


def tick(shown: Shown, passed_s: float) -> Shown:
    """Return what time leads to: the next plane while planes are played."""
    if not shown.playing or shown.planes < 2:
        return shown
    plane = shown.plane + shown.playing * shown.speed * passed_s
    last = shown.planes - 1
    if 0 <= plane <= last:
        return replace(shown, plane=plane)
    if shown.bounce:
        return replace(shown, plane=_within(plane, (0, last)), playing=-shown.playing)
    return replace(shown, plane=0.0 if plane > last else float(last))


def grown(shown: Shown, planes: int) -> Shown:
    """Return the same with more planes there; whoever looked at the newest one still does."""
    at_the_end = round(shown.plane) >= shown.planes - 1
    plane = float(planes - 1) if at_the_end and not shown.playing else min(shown.plane, planes - 1)
    return replace(shown, planes=planes, plane=plane)


def _step(by: int) -> Callable[[Shown], Shown]:
    def step(shown: Shown) -> Shown:
        plane = _within(round(shown.plane) + by, (0, max(shown.planes - 1, 0)))
        return replace(shown, plane=float(plane), playing=0)

    return step


def _play(shown: Shown) -> Shown:
    return replace(shown, playing=0 if shown.playing else 1)


def _faster(factor: float) -> Callable[[Shown], Shown]:
    return lambda shown: replace(shown, speed=_within(shown.speed * factor, SPEEDS))


def _next_mode(by: int) -> Callable[[Shown], Shown]:
    def change(shown: Shown) -> Shown:
        place = shown.modes.index(shown.mode) if shown.mode in shown.modes else 0
        return replace(shown, mode=shown.modes[(place + by) % len(shown.modes)])

    return change


def _next_stereo(by: int) -> Callable[[Shown], Shown]:
    def change(shown: Shown) -> Shown:
        place = (STEREOS.index(shown.stereo.mode) + by) % len(STEREOS) if shown.stereo.mode in STEREOS else 0
        return replace(shown, stereo=replace(shown.stereo, mode=STEREOS[place]))

    return change


def _vergence(by: float) -> Callable[[Shown], Shown]:
    def change(shown: Shown) -> Shown:
        angle = _within(shown.stereo.vergence_deg + by, (0.0, 20.0))
        return replace(shown, stereo=replace(shown.stereo, vergence_deg=angle))

    return change


def _along(view: View) -> Callable[[Shown], Shown]:
    def look(shown: Shown) -> Shown:
        return replace(shown, view=replace(view, zoom=shown.view.zoom, perspective_deg=shown.view.perspective_deg))

    return look


def _rule(shown: Shown) -> Shown:
    other: Literal["nearest", "trilinear"] = "nearest" if shown.slices.interpolation == "trilinear" else "trilinear"
    return replace(
        shown,
        slices=replace(shown.slices, interpolation=other),
        volume=replace(shown.volume, interpolation=other),
    )


def _perspective(shown: Shown) -> Shown:
    return replace(shown, view=replace(shown.view, perspective_deg=0.0 if shown.view.perspective_deg else 30.0))


_KEYS: dict[str, Callable[[Shown], Shown]] = {
    "space": _play,
    "right": _step(1),
    "left": _step(-1),
    "home": _step(-(10**9)),
    "end": _step(10**9),
    "up": _faster(FASTER),
    "down": _faster(1 / FASTER),
    "b": lambda shown: replace(shown, bounce=not shown.bounce),
    "backspace": lambda shown: replace(shown, playing=-1),
    "m": _next_mode(1),
    "n": _next_mode(-1),
    "s": _next_stereo(1),
    "a": _next_stereo(-1),
    "e": lambda shown: replace(shown, stereo=replace(shown.stereo, swap=not shown.stereo.swap)),
    "period": _vergence(0.5),
    "comma": _vergence(-0.5),
    "x": _along(View(azimuth_deg=90)),
    "y": _along(View(elevation_deg=-90)),
    "z": _along(View()),
    "i": _rule,
    "p": _perspective,
    "t": lambda shown: replace(shown, slices=replace(shown.slices, tint=not shown.slices.tint)),
    "r": lambda shown: replace(shown, view=View(), stereo=replace(shown.stereo, swap=False)),
    "q": lambda shown: replace(shown, quit=True),
    "escape": lambda shown: replace(shown, quit=True),
}
HELP = (
    "drag: left turns, right moves, middle turns the oblique plane; wheel: nearer, farther\n"
    "space play, backspace play back, left/right step, home/end, up/down speed, b bounce\n"
    "m/n next/last mode, s/a next/last stereo, e swap eyes, comma/period vergence, p perspective\n"
    "x y z look along an axis, i interpolation, t tint, r reset, q quit\n"
)


def _within(value: float, limits: tuple[float, float]) -> float:
    return min(max(value, limits[0]), limits[1])


def _wrapped(angle_deg: float) -> float:
    return (angle_deg + 180) % 360 - 180
