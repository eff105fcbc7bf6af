"""Two views become one picture: side by side, as an anaglyph, interlaced, packed. Pure functions.

Views are (height, width, 3) or (height, width): uint8 means sRGB grey levels, floats mean linear light. Anaglyphs are
mixed in linear light, for that is what filters and eyes add.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from devices.errors import DisplayError
from display.light import LUMINANCE, encoded, linear

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from display.stereo import Mode

    Array = NDArray[Any]

ANAGLYPH = "anaglyph-"
PACKED_ROWS, BLANK_ROWS = 1080, 45  # HDMI 1.4: two pictures of 1080 rows with 45 dark ones between them
OPTIMISED_RED = 1 / 1.5


def _kept(matrix: list[list[float]]) -> NDArray[np.float64]:
    """Return a matrix whose rows sum to one: published digits are rounded, and white has to stay white."""
    rows = np.array(matrix)
    total = rows.sum(axis=1, keepdims=True)
    return rows / np.where(total == 0, 1.0, total)


_R, _G, _B = np.eye(3)
_GREY, _NONE = LUMINANCE, np.zeros(3)


def _rows(*rows: tuple[Array, Array]) -> NDArray[np.float64]:
    return _kept([[*left, *right] for left, right in rows])


# Rows: R, G, B to be shown; columns: left R, G, B, right R, G, B. The filter named first is before the left eye.
# Least squares: Dubois 2001 (Proc. IEEE ICASSP, "A projection method to generate anaglyph stereo images") for a tube
# monitor (Sanders and McAllister 2003), and for liquid-crystal monitors and other filters as computed by Dubois 2009.
MATRICES: dict[str, NDArray[np.float64]] = {
    "grey": _rows((_GREY, _NONE), (_NONE, _GREY), (_NONE, _GREY)),
    "colour": _rows((_R, _NONE), (_NONE, _G), (_NONE, _B)),
    "half-colour": _rows((_GREY, _NONE), (_NONE, _G), (_NONE, _B)),
    "optimised": _rows((0.7 * _G + 0.3 * _B, _NONE), (_NONE, _G), (_NONE, _B)),
    "red-green": _rows((_GREY, _NONE), (_NONE, _GREY), (_NONE, _NONE)),
    "red-blue": _rows((_GREY, _NONE), (_NONE, _NONE), (_NONE, _GREY)),
    "dubois": _kept(
        [
            [0.4561, 0.5005, 0.1764, -0.0435, -0.0879, -0.0016],
            [-0.0401, -0.0378, -0.0158, 0.3785, 0.7336, -0.0185],
            [-0.0152, -0.0206, -0.0055, -0.0722, -0.1130, 1.2264],
        ]
    ),
    "dubois-lcd": _kept(
        [
            [0.437, 0.449, 0.164, -0.011, -0.032, -0.007],
            [-0.062, -0.062, -0.024, 0.377, 0.761, 0.009],
            [-0.048, -0.050, -0.017, -0.026, -0.093, 1.234],
        ]
    ),
    "green-magenta": _kept(
        [
            [-0.062, -0.158, -0.039, 0.529, 0.705, 0.024],
            [0.284, 0.668, 0.143, -0.016, -0.015, -0.065],
            [-0.015, -0.027, 0.021, 0.009, 0.075, 0.937],
        ]
    ),
    "amber-blue": _kept(
        [
            [1.062, -0.205, 0.299, -0.016, -0.123, -0.017],
            [-0.026, 0.908, 0.068, 0.006, 0.062, -0.017],
            [-0.038, -0.173, 0.022, 0.094, 0.185, 0.911],
        ]
    ),
}


def compose(left: Array, right: Array, mode: Mode, *, swap: bool = False, origin: tuple[int, int] = (0, 0)) -> Array:
    """Lay two views out as one picture.

    Parameters
    ----------
    left, right : array (height, width[, 3])
        What each eye sees; of one shape and type.
    mode : str
        One of `display.stereo.MODES`, without ``mono`` and ``page-flip``, which are no pictures of two views.
    swap : bool
        Exchange the eyes.
    origin : (int, int)
        Row and column of the screen at which the picture will lie: what is interlaced follows the screen, whose row
        and column 0 are the left eye's.

    Returns
    -------
    array
        RGB for anaglyphs, otherwise like the views; larger than they are when both are seen whole.

    Raises
    ------
    DisplayError
        Views that do not fit together, or a mode that is no picture.
    """
    if left.shape != right.shape or left.dtype != right.dtype:
        raise DisplayError(f"stereo: the left view is {_words(left)}, the right one {_words(right)}.")
    first, second = (right, left) if swap else (left, right)
    if mode.startswith(ANAGLYPH):
        return anaglyph(first, second, mode.removeprefix(ANAGLYPH))
    if mode in WOVEN:
        return _woven(first, second, WOVEN[mode](*_grid(left.shape, origin)))
    if mode not in LAID:
        raise DisplayError(f"stereo: '{mode}' is not one picture.", fix=f"choose one of {', '.join(PICTURES)}.")
    return LAID[mode](first, second)


def anaglyph(left: Array, right: Array, kind: str) -> Array:
    """Mix two views for coloured glasses, the filter named first before the left eye; see `MATRICES`."""
    if left.dtype == np.uint8:
        return encoded(anaglyph(linear(left), linear(right), kind))
    matrix = MATRICES[kind].astype(np.float32)
    light = _colours(left) @ matrix[:, :3].T + _colours(right) @ matrix[:, 3:].T
    np.clip(light, 0.0, 1.0, out=light)
    if kind == "optimised":  # Wimmer's: red is brightened, for most of it was taken away
        light[..., 0] **= OPTIMISED_RED
    return light


def frame_packed(left: Array, right: Array) -> Array:
    """Put the left view over the right one with the dark rows of HDMI 1.4 between: 1080 rows become 2205."""
    blank = round(left.shape[0] * BLANK_ROWS / PACKED_ROWS)
    return np.concatenate([left, np.zeros_like(left[:1]).repeat(blank, axis=0), right])


LAID: dict[str, Callable[[Array, Array], Array]] = {
    "parallel": lambda left, right: np.concatenate([left, right], axis=1),
    "crossed": lambda left, right: np.concatenate([right, left], axis=1),
    "over-under": lambda left, right: np.concatenate([left, right]),
    "frame-packed": frame_packed,
}
WOVEN: dict[str, Callable[[Array, Array], Array]] = {
    "rows": lambda row, _: row % 2 == 0,
    "columns": lambda _, column: column % 2 == 0,
    "checkerboard": lambda row, column: (row + column) % 2 == 0,
}
PICTURES = (*LAID, *WOVEN, *(ANAGLYPH + kind for kind in MATRICES))


def _woven(left: Array, right: Array, lefts: Array) -> Array:
    return np.where(lefts.reshape(lefts.shape + (1,) * (left.ndim - 2)), left, right)


def _grid(shape: tuple[int, ...], origin: tuple[int, int]) -> tuple[Array, Array]:
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    return rows + origin[0] + 0 * columns, columns + origin[1] + 0 * rows


def _colours(view: Array) -> Array:
    return np.asarray(view if view.ndim == 3 else np.repeat(view[..., None], 3, axis=2), np.float32)


def _words(view: Array) -> str:
    return f"{' × '.join(map(str, view.shape))} {view.dtype}"
