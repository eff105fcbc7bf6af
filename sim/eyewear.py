"""Liquid-crystal shutters: how much light gets through after they were told, and what the other eye sees of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from devices.glasses_timing import Edge, Eye

TEN_TO_NINETY = np.log(9.0)  # time constants from 10 to 90 %
STEP_S = 20e-6


@dataclass(frozen=True)
class Shutter:
    """How fast a shutter follows.

    Attributes
    ----------
    rise_s, fall_s : float
        From 10 to 90 % of the light at opening, from 90 to 10 % at closing.
    dark : float
        What a closed shutter lets through.
    silence_s : float or None
        Glasses that hear nothing for so long open both eyes; None: they stay as they are.
    """

    rise_s: float = 1.6e-3
    fall_s: float = 0.3e-3
    dark: float = 1e-3
    silence_s: float | None = 0.2


def light(
    edges: Sequence[Edge], eye: Eye, times_s: NDArray[np.float64], shutter: Shutter, *, open_s: float | None = None
) -> NDArray[np.float64]:
    """Return the share of light that reaches one eye, for rising times.

    Parameters
    ----------
    edges : sequence of Edge
        Which eye is told to open, when; the other one closes. Before the first both are open.
    eye : str
        Whose.
    times_s : array of shape (n,)
        CLOCK_MONOTONIC seconds.
    open_s : float, optional
        A shutter closes by itself after that; None: when the other one opens.

    Returns
    -------
    array of shape (n,)
        0 … 1.
    """
    at_s, target = _orders(edges, eye, shutter, open_s)
    level = np.empty(len(at_s))
    level[0] = 1.0
    for k in range(1, len(at_s)):
        level[k] = _follow(level[k - 1], target[k - 1], at_s[k] - at_s[k - 1], shutter)
    last = np.clip(np.searchsorted(at_s, times_s, side="right") - 1, 0, None)
    return _follow(level[last], target[last], times_s - at_s[last], shutter)


def leak(edges: Sequence[Edge], flips: Sequence[Edge], shutter: Shutter, *, open_s: float | None = None) -> float:
    """Return the share of the light that the eyes get from each other's pictures, all pictures equally bright."""
    ends_s = np.array([flip.at_ns for flip in flips]) / 1e9
    shown_left = np.array([flip.eye == "left" for flip in flips])
    times_s = np.arange(ends_s[0], ends_s[-1], STEP_S)
    left_now = shown_left[np.searchsorted(ends_s, times_s, side="right") - 1]
    left = light(edges, "left", times_s, shutter, open_s=open_s)
    right = light(edges, "right", times_s, shutter, open_s=open_s)
    wrong = left[~left_now].sum() + right[left_now].sum()
    return float(wrong / (left.sum() + right.sum()))


def _orders(
    edges: Sequence[Edge], eye: Eye, shutter: Shutter, open_s: float | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return when a shutter was told anything, and which light it goes to from then on."""
    told = [(0.0, 1.0)]  # CLOCK_MONOTONIC begins at the start of the computer
    nexts_s = [edge.at_ns / 1e9 for edge in edges[1:]] + [np.inf]
    for edge, next_s in zip(edges, nexts_s, strict=True):
        at_s = edge.at_ns / 1e9
        told.append((at_s, 1.0 if edge.eye == eye else shutter.dark))
        if open_s is not None and at_s + open_s < next_s:
            told.append((at_s + open_s, shutter.dark))
        if shutter.silence_s is not None and at_s + shutter.silence_s < next_s:
            told.append((at_s + shutter.silence_s, 1.0))
    at, target = zip(*told, strict=True)
    return np.array(at), np.array(target)


def _follow(
    level: NDArray[np.float64], target: NDArray[np.float64], after_s: NDArray[np.float64], shutter: Shutter
) -> NDArray[np.float64]:
    """Return the light ``after_s`` after it was at ``level`` on the way to ``target``."""
    span_s = np.where(target > level, shutter.rise_s, shutter.fall_s)
    left: NDArray[np.float64] = np.exp(-np.maximum(after_s, 0.0) * TEN_TO_NINETY / span_s)
    return target + (level - target) * left
