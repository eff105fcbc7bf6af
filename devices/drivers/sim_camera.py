"""The camera of the simulated bench: triggers over TCP, pixels over a file in shared memory."""

from __future__ import annotations

import contextlib
import mmap
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Any

import numpy as np

from devices.drivers.cropping import Crop, check_exposure
from devices.errors import (
    CameraTimeout,
    DeviceBusy,
    DeviceError,
    IncompleteFrame,
    LimitError,
    LinkLost,
    MalformedReply,
    RigError,
)
from devices.transport.json_lines import JsonLines
from devices.values import CameraCaps, FrameStamp

if TYPE_CHECKING:
    from devices.protocols import Clock, FrameSink
    from devices.registry import DeviceContext
    from devices.rig import CameraSpec
    from devices.values import Roi

ANSWER_S = 5.0
LEAST_ANSWER_S = 0.1
STREAM_SLICE_S = 0.05
STAMPED = ("hw_id", "exposure_start_ns", "exposure_end_ns")
SHORTEST_FRAME_TIMEOUT_S = 1.0
EXPOSURES_PER_TIMEOUT = 5


class SimCamera:
    """A triggered camera; each trigger hands its frame to the sink before it returns.

    Parameters
    ----------
    wire : JsonLines
        To the bench.
    clock : Clock
        Time.

    Raises
    ------
    DeviceBusy
        Somebody else uses the bench's camera.
    """

    def __init__(self, wire: JsonLines, clock: Clock) -> None:
        self._wire = wire
        self._clock = clock
        self._asked = 0
        self._sink: FrameSink | None = None
        self._frames_left: int | None = None
        self._timeout_s = SHORTEST_FRAME_TIMEOUT_S
        self._stopped = Event()
        self._stream: Thread | None = None
        answer = self._ask("caps", ANSWER_S)
        try:
            whole = _caps(answer["caps"])
            self._slots = Slots(answer["frames"], whole)
        except (KeyError, TypeError, ValueError, OverflowError, OSError) as cause:
            raise _no_camera(f"{type(cause).__name__}: {cause}", answer) from cause
        self._crop = Crop(whole)

    def caps(self) -> CameraCaps:
        """Return what frames look like."""
        return self._crop.caps

    def configure(self, *, exposure_ms: float, roi: Roi | None = None) -> None:
        """Set exposure and part of the frame; raises `LimitError` with the bench's words when it refuses."""
        check_exposure(exposure_ms)
        self._crop.choose(roi)
        try:
            self._ask("configure", ANSWER_S, exposure_ms=exposure_ms)
        except _NotDone as refusal:
            raise LimitError(refusal.what) from refusal
        self._timeout_s = max(SHORTEST_FRAME_TIMEOUT_S, EXPOSURES_PER_TIMEOUT * exposure_ms / 1000)

    def arm(self, frames: int | None, sink: FrameSink) -> None:
        """Get ready for a number of frames."""
        self._sink, self._frames_left = sink, frames

    def trigger(self) -> None:
        """Expose now, wait for the frame and hand it to the sink.

        Raises
        ------
        CameraTimeout
            No frame within five exposures, or 1 s when that is longer; `IncompleteFrame` for one with holes.
        LinkLost
            The bench ended.
        """
        if self._sink is None or self._frames_left == 0:
            raise DeviceError("camera: triggered without being armed for another frame.")
        self._hand_over(self._ask("trigger", self._timeout_s))
        self._frames_left = None if self._frames_left is None else self._frames_left - 1

    def arm_external(self, frames: int, sink: FrameSink) -> int:
        """Get ready for pulses from the stage; frames come in a thread of their own until `stop`.

        Returns the ``hw_id`` of the first of them. Raises `DeviceError` when the bench has no trigger cables.
        """
        self._sink, self._frames_left = sink, 0
        first = self._ask("arm", ANSWER_S, frames=frames, trigger="external")
        self._stopped.clear()
        self._stream = Thread(target=self._receive, args=[self._asked], name="camera", daemon=True)
        self._stream.start()
        return int(first["first_hw_id"])

    def stop(self, timeout_s: float) -> None:
        """End the delivery; raises `CameraTimeout` when the bench, or a sink, does not come back."""
        self._sink = None
        if self._stream is None:
            return
        deadline = self._clock.now() + timeout_s
        self._stopped.set()
        self._stream.join(timeout_s)
        if self._stream.is_alive():
            raise CameraTimeout(f"camera: it did not stop within {timeout_s:g} s.")
        self._stream = None
        self._ask("disarm", max(deadline - self._clock.now(), LEAST_ANSWER_S))

    def close(self) -> None:
        """Leave the bench."""
        with contextlib.suppress(DeviceError):
            self.stop(ANSWER_S)
        self._wire.close()

    def _receive(self, armed: int) -> None:
        """Hand over frames until stopped; a broken wire ends it, and the next question says so."""
        with contextlib.suppress(DeviceError):
            while not self._stopped.is_set():
                answer = self._wire.receive(STREAM_SLICE_S)
                if answer is not None and answer.get("id") == armed:
                    with contextlib.suppress(IncompleteFrame):  # its number is missing, as that of a lost one
                        self._hand_over(_done(answer))
                    self._wire.send({"do": "taken"})

    def _hand_over(self, answer: dict[str, Any]) -> None:
        arrival_ns = int(self._clock.now() * 1e9)
        try:
            stamp = FrameStamp(arrival_ns, *(int(answer[key]) for key in STAMPED))
            if answer.get("incomplete"):
                raise _with_holes(stamp)
            pixels = self._crop(self._slots[int(answer["slot"])])
        except (KeyError, TypeError, ValueError, OverflowError, IndexError) as cause:
            raise _no_camera(f"{type(cause).__name__}: {cause}", answer) from cause
        if self._sink is not None:
            self._sink(pixels, stamp)

    def _ask(self, do: str, timeout_s: float, **values: float | str) -> dict[str, Any]:
        """Ask and return the answer; answers to older questions, given up on, are passed over."""
        self._asked += 1
        self._wire.send({"id": self._asked, "do": do, **values})
        deadline = self._clock.now() + timeout_s
        while (left_s := deadline - self._clock.now()) > 0:
            answer = self._wire.receive(left_s)
            if answer is not None and answer.get("id", self._asked) == self._asked:
                return _done(answer)
        raise CameraTimeout(
            f"camera: no answer to '{do}' within {timeout_s:g} s.",
            fix="see whether the bench still runs; a long exposure gets five times its length.",
        )


def open_camera(table: CameraSpec, context: DeviceContext) -> SimCamera:
    """Connect to the bench named by ``address``.

    Raises
    ------
    RigError
        There is no address.
    DeviceError
        device-missing, device-busy.
    """
    if table.address is None:
        raise RigError(
            "camera: the driver 'sim' needs the address of a running bench.",
            fix=("start one: stereotome sim serve, and use the instrument file it writes", "add --sim to the run"),
        )
    wire = JsonLines(table.address, device="camera")
    try:
        return SimCamera(wire, context.clock)
    except BaseException:
        wire.close()
        raise


class _NotDone(DeviceError):
    """The bench answered that it did not do it."""


def _done(answer: dict[str, Any]) -> dict[str, Any]:
    if answer.get("ok") is True:
        return answer
    error = str(answer.get("error", answer)).removeprefix("camera: ")
    if error == "busy":
        raise DeviceBusy(
            "camera: another program uses the camera of this bench.",
            fix="end the other program, or start a bench of your own: stereotome sim serve",
        )
    raise _NotDone(f"camera: {error}")


def _caps(said: dict[str, Any]) -> CameraCaps:
    caps = CameraCaps(
        name=str(said["name"]),
        height=int(said["height"]),
        width=int(said["width"]),
        bands=int(said["bands"]),
        dtype=str(np.dtype(said["dtype"])),
        bit_depth=int(said["bit_depth"]),
        timed=True,
        triggers=frozenset({"software", "external"}),
        numbered=True,
    )
    if caps.dtype not in ("uint8", "uint16") or caps.bands not in (1, 3) or min(caps.shape) < 1:
        raise ValueError(f"frames of {caps.shape} {caps.dtype}")
    return caps


class Slots:
    """The bench's frame file: a read-only view of each slot.

    Looking at what a shortened file no longer holds would end the program without a word, so its length is looked at
    first.
    """

    def __init__(self, said: dict[str, Any], caps: CameraCaps) -> None:
        with Path(said["path"]).open("rb") as file:
            self._memory = memory = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        offsets = [int(said["offset_bytes"]) + slot * int(said["stride_bytes"]) for slot in range(int(said["slots"]))]
        self._views = [np.ndarray(caps.shape, caps.dtype, buffer=memory, offset=offset) for offset in offsets]

    def __getitem__(self, slot: int) -> np.ndarray:
        if self._memory.size() < len(self._memory):  # size() is that of the file now
            raise LinkLost(
                "camera: the bench's frames are gone from its file.",
                why="The file in shared memory was shortened.",
                fix="start the bench again; leave its files alone.",
            )
        return self._views[slot]


def _with_holes(stamp: FrameStamp) -> IncompleteFrame:
    return IncompleteFrame(f"camera: frame {stamp.hw_id} came with holes.", fix="check the camera's cable and network.")


def _no_camera(why: str, answer: dict[str, Any]) -> MalformedReply:
    return MalformedReply(
        "camera: the bench's answer makes no sense.",
        reply=str(answer).encode(),
        why=why,
        fix="use a bench of the same version of this program.",
    )
