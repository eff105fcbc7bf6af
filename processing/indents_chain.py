"""Depth through many polished faces: indents wear away, new ones are pressed, and the sum goes on.

Every indent seen in a face says how deep it still is: depth = D − R, D its depth at the first face it would have had,
R what was removed up to this face. All sightings, and the feed's steps where there are any, give all R by weighted
least squares; so an indent seen in many faces is not counted as if each of its steps were independent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from devices.errors import InputError
from processing.align_fiducials import FEWEST, KNOWN
from processing.align_models import applied, fitted
from processing.indents import same_indents

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from processing.indents import Indent

    Array = NDArray[Any]

DISAGREEMENT = 3.0  # standard errors


@dataclass(frozen=True)
class Chain:
    """What was removed up to each of many faces.

    Attributes
    ----------
    removed_um, errors_um : array (faces,)
        From the first face on; 0 ± 0 there.
    tracks : tuple of tuple of (int, int)
        The same indent in several faces, as (face, indent).
    chi_square_per_freedom : float, optional
        About 1 when the stated errors are right; None where nothing is left over to judge by.
    notes : tuple of str
        What does not agree.
    """

    removed_um: Array
    errors_um: Array
    tracks: tuple[tuple[tuple[int, int], ...], ...]
    chi_square_per_freedom: float | None
    notes: tuple[str, ...]


def tracked(faces: Sequence[Sequence[Indent]]) -> list[list[tuple[int, int]]]:
    """Return every indent with the faces it is seen in, followed from each face to the next."""
    tracks: list[list[tuple[int, int]]] = []
    current: dict[int, list[tuple[int, int]]] = {}
    for face, indents in enumerate(faces):
        pairs = {b: a for a, b in same_indents(faces[face - 1], indents)} if face else {}
        following: dict[int, list[tuple[int, int]]] = {}
        for k in range(len(indents)):
            track = current[pairs[k]] if k in pairs else []
            if not track:
                tracks.append(track)
            track.append((face, k))
            following[k] = track
        current = following
    return tracks


def chain(faces: Sequence[Sequence[Indent]], feeds_um: Sequence[float] = (), feed_error_um: float = 0.1) -> Chain:
    """Return what was removed up to each face.

    Parameters
    ----------
    faces : sequence of sequence of Indent
        Indents of each face, in the order of polishing.
    feeds_um : sequence of float
        What the feed says was removed before the second, third, … face; none, or one for each.
    feed_error_um : float
        Standard error of each.

    Raises
    ------
    InputError
        ``indents-broken``: two faces share no indent, and no feed bridges them.
    """
    tracks = [track for track in tracked(faces) if len(track) > 1]
    steps = len(faces) - 1
    _check_joined(tracks, steps, bridged=bool(feeds_um))
    rows, values, errors = [], [], []
    for number, track in enumerate(tracks):
        for face, k in track:
            row = np.zeros(steps + len(tracks))
            row[steps + number] = 1.0
            if face:
                row[face - 1] = -1.0
            rows.append(row)
            values.append(faces[face][k].depth_um)
            errors.append(faces[face][k].depth_error_um)
    for step, feed in enumerate(feeds_um):
        row = np.zeros(steps + len(tracks))
        row[step] = 1.0
        if step:
            row[step - 1] = -1.0
        rows.append(row)
        values.append(feed)
        errors.append(feed_error_um)
    return _solved(np.array(rows), np.array(values), np.array(errors), steps, tracks)


def _check_joined(tracks: Sequence[Sequence[tuple[int, int]]], steps: int, *, bridged: bool) -> None:
    joined = {face for track in tracks for face, _ in track[1:]}
    missing = [step for step in range(1, steps + 1) if step not in joined]
    if missing and not bridged:
        raise InputError(
            f"faces {missing[0] - 1} and {missing[0]} share no indent: what was removed between them is not known.",
            fix=("press new indents before the last is gone", "give the feed of every step: --feed-um 1.5"),
            code="indents-broken",
        )


def _solved(rows: Array, values: Array, errors: Array, steps: int, tracks: list[list[tuple[int, int]]]) -> Chain:
    weighted = rows / errors[:, None]
    found = np.linalg.lstsq(weighted, values / errors, rcond=None)[0]
    covariance = np.linalg.pinv(weighted.T @ weighted)
    off = (values - rows @ found) / errors
    free = len(values) - rows.shape[1]
    removed = np.concatenate([[0.0], found[:steps]])
    sigma = np.concatenate([[0.0], np.sqrt(np.diag(covariance)[:steps])])
    said = [f"face {k}: less was removed than before it; are faces swapped?" for k in _falling(removed, sigma)]
    worst = int(np.abs(off).argmax()) if off.size else 0
    if off.size and abs(off[worst]) > DISAGREEMENT:
        said.append(f"one reading is {abs(off[worst]):.1f} standard errors from what the others say.")
    share = float(off @ off) / free if free > 0 else None
    return Chain(removed, sigma, tuple(tuple(track) for track in tracks), share, tuple(said))


def marks(faces: Sequence[Sequence[Indent]], pixels_um: Sequence[float]) -> list[tuple[int | str, int, float, float]]:
    """Return where indents lie as fiducial marks: the middle of a pyramid stays where it is while its face wears away.

    Parameters
    ----------
    faces : sequence of sequence of Indent
        Indents of each face, in the order of polishing.
    pixels_um : sequence of float
        Size of a pixel in the picture of each face.

    Returns
    -------
    list of (section, mark, x_px, y_px)
        The table that ``process align --fiducials`` takes. Lines of the section "known" give the place of every mark in
        the frame of the first face; one pressed later is carried there by the marks it shares a face with, where these
        are two or more.
    """
    tracks = [track for track in tracked(faces) if len(track) > 1]
    seen = np.full((len(faces), len(tracks), 2), np.nan)
    for number, track in enumerate(tracks):
        for face, k in track:
            seen[face, number] = np.array(faces[face][k].centre_um) / pixels_um[face]
    known = carried(seen)
    lines: list[tuple[int | str, int, float, float]] = []
    sections: list[tuple[int | str, Array]] = [(KNOWN, known), *enumerate(seen)]
    for name, places in sections:
        lines += [(name, m, float(x), float(y)) for m, (x, y) in enumerate(places) if np.isfinite(x)]
    return lines


def carried(seen: Array) -> Array:
    """Return the places of marks, seen as (faces, marks, 2), in the frame of the first face; NaN where not known."""
    known: Array = seen[0].copy()
    for face in seen[1:]:
        there, here = np.isfinite(known[:, 0]), np.isfinite(face[:, 0])
        if (there & here).sum() >= FEWEST["rigid"]:
            back = fitted("rigid", face[there & here], known[there & here])
            known[here & ~there] = applied(back, face[here & ~there])
    return known


def _falling(removed: Array, sigma: Array) -> list[int]:
    return [k for k in range(1, len(removed)) if removed[k] - removed[k - 1] < -DISAGREEMENT * sigma[k]]
