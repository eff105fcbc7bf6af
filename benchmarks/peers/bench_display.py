"""Volumes, cuts, live pictures and stereo pairs beside VTK, vispy and pygfx: CPU time of a frame, everybody in turn.

``STEREOTOME_PEERS=… xvfb-run python benchmarks/peers/bench_display.py [SIDE [ROUNDS [ROW …]]]``, see `display_peers`.
Each contestant has a process of its own, for their OpenGL contexts do not bear each other; they draw one after the
other, and the least of several rounds counts. Pictures are compared by correlation. Ends with 1 when a limit is missed.
"""

from __future__ import annotations

import multiprocessing
import sys
import time
from dataclasses import dataclass

import display_peers
import numpy as np

SIDE = int(sys.argv[1]) if len(sys.argv) > 1 else 256
ROUNDS = int(sys.argv[2]) if len(sys.argv) > 2 else 5
CHOSEN = sys.argv[3:]
PATIENCE_S = 120
VOLUME_PEERS = {"VTK GPU mapper": "VtkGpu", "VTK fixed point": "VtkFixed", "vispy": "Vispy", "pygfx": "Pygfx"}


@dataclass(frozen=True)
class Row:
    """One thing to draw: who draws it, ours first, and how many times faster than the best of the others we must be."""

    title: str
    specimen: str
    mode: str
    ours: dict[str, str]
    peers: dict[str, str]
    limit: float

    @property
    def contestants(self) -> dict[str, str]:
        return {**self.ours, **self.peers}


def volume_rows() -> list[Row]:
    still, moving = {"ours, still": "Ours"}, {"ours, moving": "OursMoving"}
    rows = []
    for specimen, faster in (("cells", 8.0), ("dense", 2.0)):
        for mode in ("mip", "translucent"):
            peers = {k: v for k, v in VOLUME_PEERS.items() if mode == "mip" or k != "pygfx"}
            rows.append(Row(f"{mode} {specimen}", specimen, mode, still | moving, peers, faster))
        peers = {k: v for k, v in VOLUME_PEERS.items() if k != "VTK fixed point"}
        rows.append(Row(f"first {specimen}", specimen, "first", still, peers, 2.5))
    return rows


ROWS = [
    *volume_rows(),
    Row("oblique slice", "dense", "oblique", {"ours": "OursOblique"}, {"vtkImageReslice": "VtkReslice"}, 3.0),
    Row("live 2048² uint16", "frames", "live", {"ours": "OursLive"}, {"vispy": "VispyLive"}, 3.0),
    Row(
        "pair of shifted planes", "cells", "shift", {"ours": "OursPair"}, {"the pair cast by us": "OursPair mip"}, 10.0
    ),
]


def serve(link, name: str, specimen: str, mode: str) -> None:
    """Draw angle after angle and say how much CPU each took; the first words say whether one can."""
    try:
        values = display_peers.SPECIMENS[specimen](SIDE)
        name, _, other = name.partition(" ")
        contestant = getattr(display_peers, name)(values, other or mode)
        contestant.draw(0.0)  # compiles and uploads
    except Exception as error:  # noqa: BLE001  a peer that is not there is left out, and said so
        link.send(f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}")
        return
    link.send("ready")
    while (angle := link.recv()) is not None:
        begin = time.process_time()
        picture = contestant.draw(angle)
        used = time.process_time() - begin
        link.send((used, grey(picture)))


def grey(picture: np.ndarray) -> np.ndarray:
    """Return a picture as small grey levels, to be compared."""
    flat = np.asarray(picture, np.float64)
    flat = flat.mean(axis=2) if flat.ndim == 3 else flat
    return flat[: flat.shape[0] // 4 * 4, : flat.shape[1] // 4 * 4].reshape(flat.shape[0] // 4, 4, -1, 4).mean((1, 3))


class Contestant:
    """One process that draws."""

    def __init__(self, label: str, name: str, row: Row) -> None:
        context = multiprocessing.get_context("spawn")
        self.label, (self.link, there) = label, context.Pipe()
        self.process = context.Process(target=serve, args=(there, name, row.specimen, row.mode), daemon=True)
        self.process.start()
        there.close()
        self.used: list[float] = []
        self.picture = np.zeros(0)
        self.word = self.answer()

    def answer(self):
        try:
            return self.link.recv() if self.link.poll(PATIENCE_S) else "no answer"
        except EOFError:
            return "ended"

    def draw(self, angle: float) -> None:
        self.link.send(angle)
        self.word = self.answer()
        if isinstance(self.word, tuple):
            self.used.append(self.word[0])
            self.picture = self.word[1]

    def end(self) -> None:
        self.process.kill()
        self.process.join()


def measured(row: Row) -> bool:
    """Let everybody draw in turn, print a line, and tell whether the limits of a row are met."""
    everybody = [Contestant(label, name, row) for label, name in row.contestants.items()]
    for each in everybody:
        if each.word != "ready":
            print(f"  {each.label}: {each.word}", flush=True)
    there = [each for each in everybody if each.word == "ready"]
    for k in range(ROUNDS):
        for each in there:
            each.draw(10.0 + 3 * k)
    for each in everybody:
        each.end()
    return reported(row, {each.label: each for each in there if each.used})


def reported(row: Row, there: dict[str, Contestant]) -> bool:
    least = {label: 1e3 * min(each.used) for label, each in there.items()}
    own, others = [k for k in row.ours if k in least], {k: v for k, v in least.items() if k in row.peers}
    words = [f"{label} {ms:.1f}" for label, ms in least.items()]
    kept = True
    for label in own if others else []:
        ratio, wanted = (
            min(others.values()) / least[label],
            1.0 if "still" in label and row.mode != "first" else row.limit,
        )
        kept &= ratio >= wanted
        words.append(f"best peer / {label} = {ratio:.1f} (limit {wanted:g}{'' if ratio >= wanted else ', MISSED'})")
    if not own:
        return False
    first = there[own[0]].picture
    alike = {
        k: f"{np.corrcoef(first.ravel(), there[k].picture.ravel())[0, 1]:.3f}"
        for k in least
        if k != own[0]
        if there[k].picture.shape == first.shape
    }
    print(f"{row.title}, CPU-ms: " + ", ".join(words) + f"; correlation with {own[0]}: {alike}", flush=True)
    return kept


if __name__ == "__main__":
    rows = [row for row in ROWS if not CHOSEN or any(word in row.title for word in CHOSEN)]
    kept = [measured(row) for row in rows]
    sys.exit(0 if all(kept) else 1)
