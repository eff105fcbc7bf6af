"""The camera of the bench for other processes: words over TCP, one JSON object a line; pixels over shared memory."""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import socket
import tempfile
import threading
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from devices.errors import DeviceError, LimitError
from sim.camera import NS, Shutter, check_exposure, spoil
from sim.triggered_camera import Burst

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim.camera import FrameMaker
    from sim.faults import Faults
    from sim.motion import Axis
    from sim.triggered_camera import TriggerLines

SHARED_MEMORY = Path("/dev/shm")  # noqa: S108  a file system in memory; the file is made by mkstemp
SLOTS = 4
GRACE_S = 2.0  # a program that starts right after another has ended is not told that the camera is in use
LATE_FRAME_S, LATE_EXPOSURES = 1.5, 6  # longer than drivers wait, which is 1 s or five exposures
PAGE = mmap.PAGESIZE
PREFIX = "stereotome-bench-"
Answer = dict[str, Any]


class FrameFile:
    """Frames in shared memory: ``slots`` of them from the second page on, each on pages of its own.

    The file is locked while its bench lives; one that is not was left behind, and is removed by the next bench.
    """

    def __init__(self, shape: tuple[int, ...], dtype: str, slots: int = SLOTS) -> None:
        folder = SHARED_MEMORY if SHARED_MEMORY.is_dir() else Path(tempfile.gettempdir())
        remove_left_behind(folder)
        frame_bytes = int(np.prod(shape)) * np.dtype(dtype).itemsize
        self.stride_bytes = -(-frame_bytes // PAGE) * PAGE
        self._file, name = tempfile.mkstemp(prefix=f"{PREFIX}{os.getpid()}-", dir=folder)
        self.path = Path(name)
        _lock(self._file)
        size = PAGE + slots * self.stride_bytes
        self._allocate(size)
        self._memory = mmap.mmap(self._file, size)
        self.frames = [np.ndarray(shape, dtype, self._memory, PAGE + slot * self.stride_bytes) for slot in range(slots)]

    def _allocate(self, size: int) -> None:
        """Get the memory now: what is missing later would kill the process in the middle of a frame."""
        try:
            os.posix_fallocate(self._file, 0, size) if hasattr(os, "posix_fallocate") else os.ftruncate(
                self._file, size
            )
        except OSError as cause:
            self.close()
            raise DeviceError(
                f"bench: no room for {size / 1e6:.0f} MB of frames in {self.path.parent}.",
                why=str(cause),
                fix="make room there, or choose a smaller camera.size_px.",
            ) from cause

    def describe(self) -> Answer:
        """Return what a client needs to find the frames."""
        slots = len(self.frames)
        return {"path": str(self.path), "slots": slots, "offset_bytes": PAGE, "stride_bytes": self.stride_bytes}

    def close(self) -> None:
        """Remove the file; clients keep what they have mapped."""
        self.path.unlink(missing_ok=True)
        os.close(self._file)


def remove_left_behind(folder: Path) -> None:
    """Remove the frame files of benches that were killed."""
    for path in folder.glob(f"{PREFIX}*"):
        with contextlib.suppress(OSError), path.open("rb+") as file:
            _lock(file.fileno())
            path.unlink()


def _lock(file: int) -> None:
    """Lock a file for us; raises OSError when another process has it."""
    if os.name == "posix":
        import fcntl  # noqa: PLC0415  there is none on Windows

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


class CameraServer:
    """Serves one client at a time.

    ``caps``, ``configure``, ``trigger`` are a camera's. ``arm`` lets the pulses of the stage trigger some frames; they
    are sent when they are ready, and each is acknowledged by ``taken``; ``disarm`` ends that. When there is no slot for
    a frame, because so many are not acknowledged, it is lost, and its number missing. ``truth`` tells how far the axis
    went between two times, so that a test can prove that nothing moved during an exposure.

    Parameters
    ----------
    lines : TriggerLines, optional
        The stage's end of the trigger cables; without them there is no ``arm``.
    """

    def __init__(
        self, maker: FrameMaker, axis: Axis, faults: Faults, *, exposure_ms: float, lines: TriggerLines | None = None
    ) -> None:
        self._lines = lines
        self._burst: Burst | None = None
        self._sent, self._acknowledged = 0, 0
        self._spare = np.empty(maker.caps().shape, maker.caps().dtype)
        self._axis = axis
        self._faults = faults
        self._caps = maker.caps()
        self._shutter = Shutter(maker, axis)
        self._exposure_ms = exposure_ms
        self._exposed = 0
        self._frames = FrameFile(self._caps.shape, self._caps.dtype)
        self._in_use = threading.Lock()
        self._listener = socket.create_server(("127.0.0.1", 0), backlog=4)
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"
        self._actions: dict[str, Callable[[Answer], Answer | None]] = {
            "caps": self._tell_caps,
            "configure": self._configure,
            "trigger": self._trigger,
            "arm": self._arm,
            "taken": self._taken,
            "disarm": self._disarm,
            "truth": self._truth,
        }
        self._send: Callable[[Answer], None] = lambda _: None
        self._hang_up: Callable[[], None] = lambda: None

    def serve(self) -> None:
        """Accept clients until closed; a second one at a time hears that the camera is busy."""
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                threading.Thread(target=self._attend, args=[connection], daemon=True).start()

    def close(self) -> None:
        """Stop accepting, and remove the shared memory."""
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._frames.close()

    def answer(self, line: bytes) -> Answer | None:
        """Return the answer to one line; None for silence."""
        try:
            asked = json.loads(line)
            done = self._actions[asked["do"]](asked)
        except LimitError as error:
            return {"id": asked.get("id"), "ok": False, "error": error.what}
        except (ValueError, TypeError, KeyError, OverflowError) as error:
            return {"ok": False, "error": f"not understood: {line[:80]!r} ({type(error).__name__})"}
        return None if done is None else {"id": asked.get("id"), "ok": True, **done}

    def _attend(self, connection: socket.socket) -> None:
        with contextlib.suppress(OSError), connection:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if not self._in_use.acquire(timeout=GRACE_S):
                connection.sendall(b'{"ok":false,"error":"busy"}\n')
                return
            try:
                self._converse(connection)
            finally:
                self._end_burst()
                self._in_use.release()

    def _converse(self, connection: socket.socket) -> None:
        one_at_a_time = threading.Lock()

        def send(answer: Answer) -> None:
            with one_at_a_time:
                connection.sendall(json.dumps(answer).encode() + b"\n")

        self._send, self._hang_up = send, partial(connection.shutdown, socket.SHUT_RDWR)
        for line in connection.makefile("rb"):
            answer = self.answer(line)
            if answer is not None:
                send(answer)

    def _tell_caps(self, _asked: Answer) -> Answer:
        caps = self._caps
        told = {"name": caps.name, "height": caps.height, "width": caps.width, "bands": caps.bands}
        return {"caps": {**told, "dtype": caps.dtype, "bit_depth": caps.bit_depth}, "frames": self._frames.describe()}

    def _configure(self, asked: Answer) -> Answer:
        exposure_ms = float(asked["exposure_ms"])
        check_exposure(exposure_ms)
        self._exposure_ms = exposure_ms
        return {}

    def _trigger(self, _asked: Answer) -> Answer | None:
        slot = self._exposed % SLOTS
        start_ns, end_ns = self._shutter.expose(self._exposure_ms, self._frames.frames[slot])
        return self._frame(slot, start_ns, end_ns)

    def _frame(self, slot: int, start_ns: int, end_ns: int) -> Answer | None:
        """Count a frame and return what is told of it, with the faults that strike it; None for one that is lost."""
        self._exposed += 1
        struck = self._faults.strike("camera")
        kinds = {kind.partition(".")[2] for kind in struck}
        spoil(self._frames.frames[slot], self._frames.frames[slot - 1], struck)
        if "die" in kinds:
            self._hang_up()
        if kinds & {"die", "drop", "hang"}:
            return None
        if "late" in kinds:
            self._axis.clock.sleep(max(LATE_FRAME_S, LATE_EXPOSURES * self._exposure_ms / 1000))
        frame = {"slot": slot, "hw_id": self._exposed, "exposure_start_ns": start_ns, "exposure_end_ns": end_ns}
        if "half" in kinds:
            self._frames.frames[slot][self._caps.height // 2 :] = 0
            return {**frame, "incomplete": True}
        return frame

    def _arm(self, asked: Answer) -> Answer:
        """Expose on the stage's pulses; frames carry the ``id`` of this question."""
        self._end_burst()
        if self._lines is None:
            return {"ok": False, "error": "the stage of this bench has no trigger lines"}

        def deliver(frame: Answer | None) -> None:
            if frame is not None:
                with contextlib.suppress(OSError):
                    self._send({"id": asked["id"], "ok": True, **frame})

        self._sent = self._acknowledged = 0
        self._burst = Burst(self._lines, self._axis.clock, self._expose_in_turn, deliver, self._faults)
        self._burst.start(int(asked["frames"]))
        return {"first_hw_id": self._exposed + 1}

    def _taken(self, _asked: Answer) -> None:
        self._acknowledged += 1

    def _disarm(self, _asked: Answer) -> Answer:
        self._end_burst()
        return {}

    def _end_burst(self) -> None:
        burst, self._burst = self._burst, None
        if burst is not None:
            burst.end()

    def _expose_in_turn(self) -> Answer | None:
        """Expose into the slot after the one sent last; into none, and lose the frame, if that is still being read."""
        slot, has_room = self._sent % SLOTS, self._sent - self._acknowledged < SLOTS
        start_ns, end_ns = self._shutter.expose(
            self._exposure_ms, self._frames.frames[slot] if has_room else self._spare
        )
        frame = self._frame(slot, start_ns, end_ns)
        if frame is None or not has_room:
            return None
        self._sent += 1
        return frame

    def _truth(self, asked: Answer) -> Answer:
        path_um = self._axis.path_um(asked["start_ns"] / NS, asked["end_ns"] / NS)
        return {"z_min_um": float(path_um.min()), "z_max_um": float(path_um.max())}
