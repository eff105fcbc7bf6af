"""Alarms: what has gone wrong with run or instrument, kept in words until somebody has seen it, and a sound."""

from __future__ import annotations

import io
import shutil
import subprocess
import sys
import wave
from typing import TYPE_CHECKING

import numpy as np

from processing.outputs import write_durably

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from display.console.journal import Journal, Line

PLAYERS = ("paplay", "pw-play", "aplay", "afplay")
SOUND = "alarm.wav"
RATE_HZ, TONE_S, TONES_HZ = 16_000, 0.25, (880.0, 660.0, 880.0, 660.0)
BELL = "\a"


def is_alarm(line: Line) -> bool:
    """Tell whether a line is of a run that stands or failed, of a lost instrument, or of a stop that failed.

    What a person did, or was refused while standing there, is none.
    """
    if line.place == "run":
        return line.level == "error" or line.words.startswith(("HOLD", "FAILED", "HELD", "COMPLETED_WITH_GAPS"))
    return line.level == "error" and line.place in {"instrument", "STOP", "queue", "monitor"}


class Alarms:
    """What nobody has seen yet, oldest first; it stays when its cause goes away.

    Parameters
    ----------
    sound : callable
        Called once for each telling of new alarms.

    Attributes
    ----------
    unseen : list of Line
        To be shown until `seen`.
    """

    def __init__(self, journal: Journal, sound: Callable[[], None]) -> None:
        self.unseen: list[Line] = []
        self._journal = journal
        self._sound = sound
        self._version = journal.version

    def tick(self) -> None:
        """Take over what the journal has been told since the last call."""
        if self._journal.version == self._version:
            return
        self._version, lines = self._journal.since(self._version)
        new = [line for line in lines if is_alarm(line)]
        self.unseen += new
        if new:
            self._sound()

    def seen(self) -> None:
        """Note that somebody has read them all."""
        self.unseen = []


def sound(file: Path) -> None:
    """Play a sound, kept in a file, by whatever this computer has, else ring the terminal; waits for nothing."""
    if sys.platform == "win32":
        import winsound  # noqa: PLC0415

        winsound.MessageBeep(winsound.MB_ICONEXCLAMATION)
        return
    player = next((found for name in PLAYERS if (found := shutil.which(name))), None)
    if player is None:
        sys.stderr.write(BELL)
        return
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        write_durably(file, _two_tones())
    quiet = subprocess.DEVNULL
    subprocess.Popen([player, str(file)], stdin=quiet, stdout=quiet, stderr=quiet)


def _two_tones() -> bytes:
    """Return a WAV file, high then low, heard well over fans."""
    seconds = np.arange(int(RATE_HZ * TONE_S)) / RATE_HZ
    tones = [np.sin(2 * np.pi * hz * seconds) * np.hanning(seconds.size) for hz in TONES_HZ]
    made = io.BytesIO()
    with wave.open(made, "wb") as file:
        file.setparams((1, 2, RATE_HZ, 0, "NONE", ""))
        file.writeframes((np.concatenate(tones) * 0.6 * 32767).astype("<i2").tobytes())
    return made.getvalue()
