"""Peers small enough to be right by inspection, for the conformance tests: an axis behind ASI bytes, a camera bench."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import select
import socket
import threading
import tty
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path


class SteppingClock:
    """A clock that moves on only when somebody waits."""

    def __init__(self) -> None:
        self.seconds = 100.0

    def now(self) -> float:
        return self.seconds

    def sleep(self, seconds: float) -> None:
        self.seconds += max(seconds, 1e-4)


class SmallAxis:
    """An ASI Z axis that moves at constant speed; as much of the grammar as the stage driver speaks.

    ``reply_to`` may be replaced by a function that spoils replies.
    """

    def __init__(self, now: Callable[[], float], speed: float = 20_000.0) -> None:
        self.now = now
        self.speed = speed
        self.start, self.target, self.since = 0.0, 0.0, now()
        self.stall_at: float | None = None
        self.commands: list[str] = []
        self.pending = b""
        self.spoil: Callable[[str, bytes], bytes] = lambda command, reply: reply

    def position(self) -> float:
        travelled = self.speed * (self.now() - self.since)
        distance = self.target - self.start
        place = self.start + max(-travelled, min(travelled, distance))
        return place if self.stall_at is None else min(place, self.stall_at)

    def moving(self) -> bool:
        return abs(self.position() - self.target) > 1e-9 and self.stall_at is None

    def go(self, target: float) -> None:
        self.start, self.target, self.since = self.position(), target, self.now()

    def feed(self, data: bytes) -> list[bytes]:
        *commands, self.pending = (self.pending + data).split(b"\r")
        return [self.answer(command.decode("ascii", "replace")) for command in commands]

    def answer(self, command: str) -> bytes:
        self.commands.append(command)
        return self.spoil(command, self.reply_to(command).encode() + b"\r\n")

    def reply_to(self, command: str) -> str:  # noqa: C901  a table of the grammar
        value = float(command.partition("=")[2] or 0)
        match command.partition("=")[0]:
            case "M Z":
                self.go(value)
            case "R Z":
                self.go(self.target + value)
            case "H Z":
                self.start = self.target = value
            case "S Z":
                self.speed = min(value, 5.0) * 10_000
            case "S Z?":
                return f":A Z={self.speed / 10_000:f}"
            case "W Z":
                return f":A {self.position():.0f} "
            case "/":
                return "B" if self.moving() else "N"
            case "V":
                return ":A Version: USB-9.54 "
            case "\\":
                was_moving = self.moving()
                self.go(self.position())
                return ":N-21" if was_moving else ":A "
            case _:
                return ":N-1"
        return ":A "


class OnPty:
    """Serves ``feed`` on a pseudo-terminal from a thread until it is closed."""

    def __init__(self, feed: Callable[[bytes], Iterable[bytes]]) -> None:
        self.master, self.slave = pty.openpty()
        tty.setraw(self.master)
        tty.setraw(self.slave)
        self.port = os.ttyname(self.slave)
        self.feed = feed
        self.wake_read, self.wake_write = os.pipe()
        self.thread = threading.Thread(target=self._serve)
        self.thread.start()

    def _serve(self) -> None:
        while True:
            ready = select.select([self.master, self.wake_read], [], [])[0]
            if self.wake_read in ready:
                return
            for reply in self.feed(os.read(self.master, 1024)):
                os.write(self.master, reply)

    def close(self) -> None:
        if self.thread.is_alive():
            os.write(self.wake_write, b"x")
            self.thread.join()
            for end in (self.master, self.slave, self.wake_read, self.wake_write):
                os.close(end)


class OnTcp:
    """Serves ``feed`` on a loopback TCP port from a thread until it is closed."""

    def __init__(self, feed: Callable[[bytes], Iterable[bytes]]) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self.listener.getsockname()[1]}"
        self.feed = feed
        self.peer: socket.socket | None = None
        self.thread = threading.Thread(target=self._serve)
        self.thread.start()

    def _serve(self) -> None:
        try:
            self.peer = self.listener.accept()[0]
            while data := self.peer.recv(65536):
                for reply in self.feed(data):
                    self.peer.sendall(reply)
        except OSError:
            return

    def close(self) -> None:
        for end in (self.peer, self.listener):
            if end is not None:
                with contextlib.suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)
                end.close()
        self.thread.join()


class SmallBench:
    """The camera's half of a bench: JSON lines in and out, frames in a file; frame k is filled with k."""

    def __init__(self, folder: Path, shape: tuple[int, int] = (6, 8), slots: int = 2) -> None:
        self.frames = np.memmap(folder / "frames", np.uint16, "w+", 0, (slots, *shape))
        self.path = str(folder / "frames")
        self.shape = shape
        self.taken = 0
        self.pending = b""
        self.asked: list[dict] = []
        self.spoil: Callable[[dict, dict], list[bytes]] = lambda ask, answer: [json.dumps(answer).encode() + b"\n"]

    def feed(self, data: bytes) -> list[bytes]:
        *lines, self.pending = (self.pending + data).split(b"\n")
        replies = []
        for line in lines:
            self.asked.append(json.loads(line))
            replies += self.spoil(self.asked[-1], {"id": self.asked[-1]["id"], **self.answer(self.asked[-1])})
        return replies

    def answer(self, ask: dict) -> dict:
        if ask["do"] == "caps":
            caps = {"name": "small", "height": self.shape[0], "width": self.shape[1], "bands": 1}
            stride = self.frames[0].nbytes
            frames = {"path": self.path, "slots": len(self.frames), "offset_bytes": 0, "stride_bytes": stride}
            return {"ok": True, "caps": caps | {"dtype": "uint16", "bit_depth": 12}, "frames": frames}
        if ask["do"] == "configure":
            return {"ok": True} if 0 < ask["exposure_ms"] < 1000 else {"ok": False, "error": "at most 1000 ms"}
        slot = self.taken % len(self.frames)
        self.taken += 1
        self.frames[slot] = self.taken
        return {"ok": True, "slot": slot, "hw_id": self.taken, "exposure_start_ns": 5, "exposure_end_ns": 6}
