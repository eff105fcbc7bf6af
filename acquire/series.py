"""A series at camera rate: nobody waits between two frames, and a frame's place in time is its own number's."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from acquire.frame import FrameHeader
from acquire.taker import CAMERA_STOP_S, FIRST_FRAME_S
from devices.errors import CameraTimeout, StereotomeError
from devices.protocols import FreeRunningCamera

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import numpy as np

    from acquire.control import Control
    from acquire.gate import TakesFrames
    from acquire.run_plan import RunPlan
    from devices.protocols import Camera, Clock
    from devices.values import FrameStamp

POLL_S = 0.001
PATIENCE_FRAMES = 5


class Series:
    """Takes a series as the camera gives it.

    Attributes
    ----------
    lost : dict of int to str
        Points in time whose frame the camera lost, and how that shows.
    """

    def __init__(
        self,
        plan: RunPlan,
        camera: Camera,
        out: TakesFrames,
        clock: Clock,
        control: Control,
        *,
        utc_ns: Callable[[], int],
    ) -> None:
        assert plan.series is not None
        self._count = plan.series.count
        self._place = plan.stack.plane(0)
        self._exposure_ms = plan.exposure_ms(0)
        self._camera = camera
        self._out = out
        self._clock = clock
        self._control = control
        self._utc_ns = utc_ns
        self._numbered = camera.caps().numbered
        self._first_id: int | None = None
        self._next = 0
        self._first = 0
        self._begin_ns = 0
        self._z_um = 0.0
        self._taken: deque[int] = deque()
        self._error: StereotomeError | None = None
        self.lost: dict[int, str] = {}

    def take(self, first: int, z_um: float, *, check: Callable[[], None]) -> Iterator[int]:
        """Give each point in time that was taken, from ``first`` on; the stage rests at ``z_um``.

        Raises
        ------
        CameraTimeout
            Frames stopped coming.
        DeviceError, StoreError
            From the camera, and from ``check``, which is asked again and again.
        """
        self._first = self._next = first
        self._z_um, self._begin_ns = z_um, round(self._clock.now() * 1e9)
        free = isinstance(self._camera, FreeRunningCamera)
        if isinstance(self._camera, FreeRunningCamera):
            self._camera.arm_free_run(None, self)
        else:
            self._camera.arm(None, self)
        try:
            yield from self._watch(check, trigger=not free and "free-run" not in self._camera.caps().triggers)
        finally:
            self._next = self._count  # what still comes belongs to no point in time
            self._camera.stop(CAMERA_STOP_S)

    def __call__(self, pixels: np.ndarray, stamp: FrameStamp) -> None:
        """Take a frame from the camera, in whatever thread it comes."""
        start_ns = stamp.exposure_start_ns
        if self._next >= self._count or (start_ns is not None and start_ns < self._begin_ns):
            return
        section = self._point(stamp)
        if section >= self._count or section < self._next:
            self._next = max(self._next, section)
            return
        for missing in range(self._next, section):
            self.lost[missing] = f"camera: frame {missing} was lost on the way; its successor came."
        self._next = section + 1
        try:
            self._out.put(pixels, self._header(section, stamp))
        except StereotomeError as error:
            self._error = error
            return
        self._taken.append(section)

    def _point(self, stamp: FrameStamp) -> int:
        """Return which point in time a frame is: by the camera's own count, where it has one."""
        if not self._numbered or stamp.hw_id is None:
            return self._next
        if self._first_id is None:
            self._first_id = stamp.hw_id - self._first
        return stamp.hw_id - self._first_id

    def _header(self, section: int, stamp: FrameStamp) -> FrameHeader:
        return FrameHeader(
            plane=0,
            setpoint_um=self._place.z_um,
            z_um=self._z_um,
            exposure_ms=self._exposure_ms,
            exposure_start_ns=stamp.exposure_start_ns or 0,
            exposure_end_ns=stamp.exposure_end_ns or 0,
            arrival_ns=stamp.arrival_ns,
            utc_ns=self._utc_ns(),
            section=section,
            hw_id=-1 if stamp.hw_id is None else stamp.hw_id,
        )

    def _watch(self, check: Callable[[], None], *, trigger: bool) -> Iterator[int]:
        deadline = self._clock.now() + FIRST_FRAME_S
        while self._next < self._count or self._taken:
            if self._error is not None:
                raise self._error
            self._control.checkpoint()
            check()
            if trigger and self._next < self._count:
                self._camera.trigger()
            if self._taken:
                deadline = self._clock.now() + max(1.0, PATIENCE_FRAMES * self._exposure_ms / 1000)
                yield self._taken.popleft()
            elif self._clock.now() > deadline:
                raise CameraTimeout(f"camera: no further frame after {self._next} of {self._count}.")
            else:
                self._clock.sleep(POLL_S)
