"""What the rest of the program may ask of a device. At most eight methods each; units are in the names."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from devices.values import CameraCaps, FrameStamp, Limits

    FrameSink = Callable[[np.ndarray, FrameStamp], None]


class Clock(Protocol):
    """Time, injected: real at the bench, simulated in tests."""

    def now(self) -> float:
        """Return seconds of a clock that never goes back (CLOCK_MONOTONIC at the bench)."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait; a simulated clock moves on by ``seconds`` and returns at once."""
        ...


class Transport(Protocol):
    """A way for bytes to a device and back. Raises `devices.errors.LinkLost` when the way itself is gone."""

    @property
    def name(self) -> str:
        """What a person calls it: the port, the address."""
        ...

    def write(self, data: bytes) -> None:
        """Send all of ``data``."""
        ...

    def read(self, wait_s: float) -> bytes:
        """Return what has arrived; waits at most ``wait_s``, perhaps less, for the first byte, and may return none."""
        ...

    def close(self) -> None:
        """Release the port."""
        ...


@runtime_checkable
class Stage(Protocol):
    """A focus axis. It reports where it is, not where it was told to go."""

    @property
    def limits(self) -> Limits:
        """Soft limits in µm, enforced before any byte is sent."""
        ...

    def move_to(self, z_um: float) -> None:
        """Start an absolute move and return once it was accepted; raises `LimitError` with nothing sent."""
        ...

    def settle(self, timeout_s: float) -> float:
        """Wait until the axis rests and return its position in µm, read from the device.

        Raises
        ------
        StageStalled
            No progress for 1 s.
        StageTimeout
            Still moving after ``timeout_s``.
        """
        ...

    def position_um(self) -> float:
        """Read the position now, in µm."""
        ...

    def halt(self) -> None:
        """Stop all motion of this axis; allowed at any time, from any thread."""
        ...

    def close(self) -> None:
        """Release the port; the axis stays where it is."""
        ...


@runtime_checkable
class Camera(Protocol):
    """A source of frames.

    A frame is handed to the sink given to `arm`, in `trigger`'s thread or the driver's own. The pixels belong to the
    driver: a sink copies what it wants before it returns.
    """

    def caps(self) -> CameraCaps:
        """Return what frames look like now."""
        ...

    def configure(self, *, exposure_ms: float) -> None:
        """Set the exposure; raises `LimitError` when the camera cannot do it."""
        ...

    def arm(self, frames: int | None, sink: FrameSink) -> None:
        """Get ready for a number of frames (None: until `stop`) and deliver each to ``sink``."""
        ...

    def trigger(self) -> None:
        """Ask for one frame. A triggered camera begins its exposure now; a free-running one ignores this."""
        ...

    def stop(self, timeout_s: float) -> None:
        """End the delivery within ``timeout_s``; no sink is called afterwards."""
        ...

    def close(self) -> None:
        """Release the camera."""
        ...
