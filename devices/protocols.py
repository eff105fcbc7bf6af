"""What the rest of the program may ask of a device. At most eight methods each; units are in the names."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np

    from devices.feed_values import FeedState, KnifeState
    from devices.glasses_timing import Eye, EyewearTiming
    from devices.values import CameraCaps, FrameStamp, Limits, Roi, StageSequence

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
class SequencedStage(Protocol):
    """A focus axis that goes through loaded positions by itself, one on each pulse of a camera.

    When it has arrived it gives a pulse back, upon which the camera exposes: no computer is between two planes.
    """

    def load_sequence(self, positions_um: Sequence[float], longest_wait_s: float) -> StageSequence:
        """Go to where the sequence begins and get ready for pulses, which come at most ``longest_wait_s`` apart.

        Raises
        ------
        LimitError
            A position, or what the controller adds before or after, is outside the limits; nothing moved.
        PlanError
            The controller cannot do this sequence.
        """
        ...

    def start_sequence(self) -> None:
        """Give the pulse upon which the first frame is exposed."""
        ...

    def end_sequence(self, timeout_s: float) -> float:
        """Heed pulses no more, wait until the axis rests and return its position in µm."""
        ...


@runtime_checkable
class ComesBack(Protocol):
    """A stage that knows when it was out of touch, and then moves only after it was met anew."""

    @property
    def position_known(self) -> bool:
        """Whether it has been in touch without a break since it was met."""
        ...

    def reconnect(self, timeout_s: float, *, at_um: float | None = None) -> float:
        """Meet it anew and return where it says it is, in µm; moves nothing.

        Parameters
        ----------
        timeout_s : float
            After which no further attempt is begun; 0 is one attempt.
        at_um : float or None
            Where it has to be; None takes any place.

        Raises
        ------
        DeviceError
            It does not answer, is another one (``device-other``), or is elsewhere or was reset (``position-unknown``);
            moves stay refused.
        """
        ...


@runtime_checkable
class HandControls(Protocol):
    """A device that a hand can move as well, by a joystick or a wheel."""

    def hand_controls(self, *, enabled: bool) -> None:
        """Let the hand move it, or not: during a run nobody else may."""
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

    def configure(self, *, exposure_ms: float, roi: Roi | None = None) -> None:
        """Set the exposure and, if given, the part of the frame to deliver from now on; to be called while not armed.

        Raises
        ------
        LimitError
            The camera cannot do it.
        """
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


@runtime_checkable
class Eyewear(Protocol):
    """Shutter glasses.

    A presenter either shows each flip (`show`), or lets the glasses run free and tells them now and then where the
    flips are (`lock_to`); `free_running` says which of the two this instrument wants.
    """

    @property
    def free_running(self) -> bool:
        """Whether a presenter calls `lock_to` now and then (True) or `show` at each flip (False)."""
        ...

    @property
    def timing(self) -> EyewearTiming:
        """What was sent and when, CLOCK_MONOTONIC; may be read from any thread."""
        ...

    def show(self, eye: Eye) -> None:
        """Give one eye its turn now; ends a free run. No glasses hold one state for long: call it for every frame."""
        ...

    def both_open(self) -> None:
        """Let both eyes see, as far as the glasses can; ends a free run."""
        ...

    def lock_to(self, refresh_hz: float, left_flip_s: float) -> None:
        """Run free with ``refresh_hz`` turns a second: the left eye's begin at ``left_flip_s`` and every other turn.

        To be called about four times a second with the time of a recent flip; sends only when the lock is due again or
        no longer fits. May wait for two turns: not for the thread that flips.

        Raises
        ------
        LimitError
            No rate for glasses; nothing was sent.
        DeviceError
            The lock could not be made (glasses-unlocked); `EyewearTiming.locked` is False then.
        """
        ...

    def close(self) -> None:
        """Leave the glasses at rest and release the port."""
        ...


@runtime_checkable
class TriggeredCamera(Protocol):
    """A camera that exposes a frame on each pulse at its input and gives a pulse at the end of each exposure."""

    def arm_external(self, frames: int, sink: FrameSink) -> int:
        """Get ready for a number of pulses and deliver each frame to ``sink``, in the driver's own thread.

        Returns the ``FrameStamp.hw_id`` the first of them will have. `Camera.stop` ends it.
        """
        ...


@runtime_checkable
class Feed(Protocol):
    """What carries a specimen towards a knife or a polishing disc. Depths are absolute and are read back."""

    @property
    def thickness_limits(self) -> tuple[float, float]:
        """Least and greatest thickness of one section in nm."""
        ...

    def advance_to(self, depth_nm: float) -> None:
        """Feed forward to an absolute depth and read it back; the command is sent once, ever.

        Raises
        ------
        LimitError
            Backwards, too thin, too thick or too deep; nothing was sent.
        Unsafe
            Not homed, not ready, knife not clear, or nobody knows whether the command before was executed.
        DeviceError
            It was not executed, or stopped elsewhere: an alarm, a limit, something in the way.
        """
        ...

    def position_nm(self) -> float:
        """Read the depth now, in nm."""
        ...

    def cut(self) -> None:
        """Take one section: stroke, retract, knife clear, return. The stroke is sent once, ever."""
        ...

    def knife_state(self) -> KnifeState:
        """Read the knife's sensors."""
        ...

    def cut_count(self) -> int:
        """Read the counter of strokes."""
        ...

    def halt(self) -> None:
        """Stop feed and knife; allowed at any time, from any thread."""
        ...

    def close(self) -> None:
        """Release the line; feed and knife stay where they are."""
        ...


@runtime_checkable
class Microtome(Protocol):
    """A feed with a knife, as a run uses it beside what every `Feed` can do."""

    @property
    def behind_nm(self) -> float:
        """How far behind its depth a stroke or the taking up of lost motion may leave the feed."""
        ...

    def resolve(self) -> FeedState:
        """Look at feed and knife without moving anything, and say where things stand; the way out of UNKNOWN."""
        ...

    def home(self) -> None:
        """Find the reference: the feed moves to its home switch, away from the knife."""
        ...

    def approach_to(self, depth_nm: float) -> None:
        """Go to a depth in one go, forwards or backwards, whatever the thickness of a section."""
        ...

    def allow_cuts(self, may_cut: Callable[[], None]) -> None:
        """Let ``may_cut`` vouch for the microscope: it raises `Unsafe` unless that is out of the knife's way."""
        ...

    def arm(self) -> None:
        """Allow one stroke within the next 10 s."""
        ...

    def sweep(self, distance_nm: float) -> None:
        """Let the knife wipe over the face with the feed drawn back: one stroke that cuts nothing."""
        ...

    def abort(self) -> None:
        """Bring the knife out without a further feed."""
        ...


@runtime_checkable
class FreeRunningCamera(Protocol):
    """A camera that waits for triggers after `Camera.arm`, but can run free as well."""

    def arm_free_run(self, frames: int | None, sink: FrameSink) -> None:
        """Deliver a number of frames as they come (None: until `Camera.stop`), in the driver's own thread."""
        ...
