"""What went over a wire, as a file of JSON lines: recorded beside any transport, and replayed as one.

Each line is ``{"t": seconds, "to": "device" or "host", "bytes": text}``; a character of the text is a byte (Latin-1).
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from devices.errors import DeviceError, LinkLost

if TYPE_CHECKING:
    from pathlib import Path

    from devices.protocols import Clock, Transport


class Recorder:
    """A transport that hands everything on to another and writes it down."""

    def __init__(self, transport: Transport, path: Path, clock: Clock) -> None:
        self.name = transport.name
        self._transport = transport
        self._clock = clock
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("a", encoding="ascii")

    def write(self, data: bytes) -> None:
        """Send all of ``data``."""
        self._note("device", data)
        self._transport.write(data)

    def read(self, wait_s: float) -> bytes:
        """Return what has arrived."""
        data = self._transport.read(wait_s)
        if data:
            self._note("host", data)
        return data

    def close(self) -> None:
        """Release the port and the file."""
        self._transport.close()
        self._file.close()

    def _note(self, to: str, data: bytes) -> None:
        entry = {"t": round(self._clock.now(), 6), "to": to, "bytes": data.decode("latin-1")}
        self._file.write(json.dumps(entry) + "\n")
        self._file.flush()


class Replay:
    """A transport that answers as a transcript says, and insists on being asked the same.

    Parameters
    ----------
    path : Path
        The transcript.
    clock : Clock
        Waits while the transcript is silent.
    """

    def __init__(self, path: Path, clock: Clock) -> None:
        self.name = str(path)
        self._clock = clock
        entries = [json.loads(line) for line in path.read_text(encoding="ascii").splitlines()]
        self._entries: list[tuple[str, bytes]] = [(entry["to"], entry["bytes"].encode("latin-1")) for entry in entries]
        self._at = 0

    def write(self, data: bytes) -> None:
        """Check that ``data`` is what was sent then."""
        if self._at == len(self._entries):
            raise LinkLost(f"{self.name}: the transcript ends before {data!r}.")
        to, expected = self._entries[self._at]
        if (to, expected) != ("device", data):
            raise DeviceError(f"{self.name}:{self._at + 1}: has {expected!r} to the {to}, not {data!r} to the device.")
        self._at += 1

    def read(self, wait_s: float) -> bytes:
        """Return what arrived then; nothing, after ``wait_s``, when the host spoke next."""
        if self._at < len(self._entries) and self._entries[self._at][0] == "host":
            self._at += 1
            return self._entries[self._at - 1][1]
        self._clock.sleep(wait_s)
        return b""

    def close(self) -> None:
        """Nothing to release."""
