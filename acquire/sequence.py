"""A stack that stage and camera trigger plane by plane between themselves, watched over its serial line.

Frame k belongs to plane k by the camera's own count, never by the order of arrival. While it runs the stage's position
is read again and again; a frame during whose exposure the stage was read elsewhere than at its plane is not recorded.
Planes left out, for whatever reason, are the engine's to take one by one.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from acquire.frame import FrameHeader
from devices.errors import PlanError, SequenceBroken, StereotomeError
from devices.protocols import SequencedStage, TriggeredCamera
from devices.values import to_nm, to_um

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from acquire.plan import StackPlan
    from acquire.ports import FrameOut
    from devices.protocols import Camera, Clock, Stage
    from devices.values import FrameStamp, StageSequence

READINGS_KEPT = 64
POLL_S = 0.004
FIRST_FRAME_S = 5.0
CAMERA_STOP_S = 2.0
PATIENCE = 2.0  # the controller waits for a pulse this much longer than we do, so as not to go home by itself before


@dataclass(frozen=True)
class Reading:
    """Where the stage was, read between two times of the clock."""

    asked_ns: int
    told_ns: int
    z_um: float


@dataclass(frozen=True)
class TakenPlane:
    """A plane of the stack that was recorded: its index, where the stage was, and whether that was read or assumed."""

    plane: int
    z_um: float
    read: bool


@dataclass
class SequenceGate:
    """Gives each frame of a triggered stack to its plane and lets it through unless a reading speaks against it.

    Attributes
    ----------
    frames_seen : int
        Frames up to the newest one, lost ones included.
    taken : list of TakenPlane
        What was recorded, in order of arrival.
    astray : dict of int to float
        Planes not recorded because the stage was read elsewhere, in µm, while they were exposed.
    """

    plan: StackPlan
    out: FrameOut
    lead_frames: int
    utc_ns: Callable[[], int]
    first_hw_id: int | None = None
    frames_seen: int = 0
    taken: list[TakenPlane] = field(default_factory=list)
    astray: dict[int, float] = field(default_factory=dict)
    error: StereotomeError | None = None
    closed: bool = False
    _readings: deque[Reading] = field(default_factory=lambda: deque(maxlen=READINGS_KEPT))

    def saw(self, reading: Reading) -> None:
        """Take note of a reading of the stage."""
        self._readings.append(reading)

    def __call__(self, pixels: np.ndarray, stamp: FrameStamp) -> None:
        """Take a frame from the camera, in whatever thread it comes."""
        if self.closed or stamp.hw_id is None or self.first_hw_id is None:
            return
        number = stamp.hw_id - self.first_hw_id
        if 0 <= number - self.lead_frames < self.plan.count:
            self._take(number - self.lead_frames, pixels, stamp)
        self.frames_seen = max(self.frames_seen, number + 1)

    def _take(self, plane: int, pixels: np.ndarray, stamp: FrameStamp) -> None:
        setpoint_nm = self.plan.z_nm(plane)
        z_um = self._read_during(stamp)
        if z_um is not None and abs(to_nm(z_um) - setpoint_nm) > self.plan.tolerance_nm:
            self.astray[plane] = z_um
            return
        place = TakenPlane(plane, to_um(setpoint_nm) if z_um is None else z_um, z_um is not None)
        try:
            self.out.put(pixels, self._header(place, to_um(setpoint_nm), stamp))
        except StereotomeError as error:
            self.error = error
            return
        self.taken.append(place)

    def _read_during(self, stamp: FrameStamp) -> float | None:
        """Return what was read wholly within an exposure, the worst of several; None without a reading."""
        start_ns, end_ns = stamp.exposure_start_ns, stamp.exposure_end_ns
        if start_ns is None or end_ns is None:
            return None
        readings = [r.z_um for r in tuple(self._readings) if r.asked_ns >= start_ns and r.told_ns <= end_ns]
        return readings[-1] if readings else None

    def _header(self, place: TakenPlane, setpoint_um: float, stamp: FrameStamp) -> FrameHeader:
        return FrameHeader(
            plane=place.plane,
            setpoint_um=setpoint_um,
            z_um=place.z_um,
            exposure_ms=self.plan.exposure_ms,
            exposure_start_ns=stamp.exposure_start_ns or 0,
            exposure_end_ns=stamp.exposure_end_ns or 0,
            arrival_ns=stamp.arrival_ns,
            utc_ns=self.utc_ns(),
            hw_id=-1 if stamp.hw_id is None else stamp.hw_id,
        )


def check_triggered(plan: StackPlan, stage: Stage, camera: Camera) -> None:
    """Raise `PlanError` unless these devices can take this plan by triggering each other."""
    for device, protocol, words in (
        (stage, SequencedStage, "z stage: its driver cannot be stepped by pulses."),
        (camera, TriggeredCamera, "camera: its driver cannot be triggered by pulses."),
    ):
        if not isinstance(device, protocol):
            raise PlanError(words, fix='set stack.trigger = "software"', code="no-trigger")
    if plan.overshoot_nm and plan.count > 1 and plan.step_nm * plan.approach < 0:
        raise PlanError(
            "a triggered stack cannot go against the side from which backlash is taken up.",
            fix=('set stack.direction = "up"', 'or stack.trigger = "software"'),
        )


class TriggeredStack:
    """Takes as much of a plan as stage and camera bring about by themselves.

    Parameters
    ----------
    plan, stage, camera, out, clock
        As of `acquire.engine.Run`.
    ended : callable
        Tells whether the operator wants no more.
    took : callable
        Called for each plane recorded.
    """

    def __init__(
        self,
        plan: StackPlan,
        stage: Stage,
        camera: Camera,
        out: FrameOut,
        clock: Clock,
        *,
        utc_ns: Callable[[], int],
        ended: Callable[[], bool],
        took: Callable[[TakenPlane], None],
    ) -> None:
        check_triggered(plan, stage, camera)
        assert isinstance(stage, SequencedStage)
        assert isinstance(camera, TriggeredCamera)
        self._plan = plan
        self._stage, self._sequenced = stage, stage
        self._camera, self._triggered = camera, camera
        self._out = out
        self._clock = clock
        self._utc_ns = utc_ns
        self._ended = ended
        self._took = took
        self._wait_s = max(1.0, 5 * plan.exposure_ms / 1000)

    def take(self, timeout_s: float) -> str:
        """Run the stack once and return in words what went wrong, empty for nothing; the planes taken are told.

        Raises
        ------
        SequenceBroken
            The stage ended elsewhere than it should have, and planes were recorded without a reading.
        DeviceError, PlanError, StoreError
            From the devices and the recorder; both devices are out of the sequence again.
        """
        positions_um = [plane.z_um for plane in self._plan]
        sequence = self._sequenced.load_sequence(positions_um, PATIENCE * (self._wait_s + FIRST_FRAME_S))
        gate = SequenceGate(self._plan, self._out, sequence.lead_frames, self._utc_ns)
        try:
            gate.first_hw_id = self._triggered.arm_external(sequence.frames, gate)
            self._sequenced.start_sequence()
            self._watch(gate, sequence)
        finally:
            gate.closed = True
            rest_um = self._end(timeout_s)
        return self._judge(gate, sequence, rest_um)

    def _end(self, timeout_s: float) -> float:
        """Take both devices out of the sequence, the stage even if the camera fails; return where the stage rests."""
        try:
            self._camera.stop(CAMERA_STOP_S)
        finally:
            rest_um = self._sequenced.end_sequence(timeout_s)
        return rest_um

    def _watch(self, gate: SequenceGate, sequence: StageSequence) -> None:
        """Read the stage until all frames are there or none comes any more."""
        told, seen, deadline = 0, 0, self._clock.now() + FIRST_FRAME_S + self._wait_s
        while gate.frames_seen < sequence.frames and not self._ended():
            gate.saw(self._reading())
            if gate.error is not None:
                raise gate.error
            self._out.check()
            told = self._tell(gate, told)
            if gate.frames_seen > seen:
                seen, deadline = gate.frames_seen, self._clock.now() + self._wait_s
            elif self._clock.now() > deadline:
                break
            self._clock.sleep(POLL_S)
        self._tell(gate, told)

    def _reading(self) -> Reading:
        asked_ns = round(self._clock.now() * 1e9)
        z_um = self._stage.position_um()
        return Reading(asked_ns, round(self._clock.now() * 1e9), z_um)

    def _tell(self, gate: SequenceGate, told: int) -> int:
        news = gate.taken[told:]
        for place in news:
            self._took(place)
        return told + len(news)

    def _judge(self, gate: SequenceGate, sequence: StageSequence, rest_um: float) -> str:
        """Compare what was counted with where the stage is."""
        if self._ended():
            return ""
        unread = [place.plane for place in gate.taken if not place.read]
        expected_um = sequence.positions_um[gate.frames_seen :][:1] or sequence.positions_um[-1:]
        lost = gate.frames_seen < sequence.frames
        if lost and gate.frames_seen:  # the pulse of the last frame may be the one that was lost
            expected_um = sequence.positions_um[gate.frames_seen - 1 : gate.frames_seen + 1]
        off = all(abs(to_nm(rest_um) - to_nm(z_um)) > self._plan.tolerance_nm for z_um in expected_um)
        if off and unread:
            raise SequenceBroken(
                f"z stage: the triggered stack lost its step: it rests at {rest_um:+.2f} µm, not at "
                f"{expected_um[-1]:+.2f} µm.",
                why=f"Planes {', '.join(map(str, unread))} were recorded without a reading; they may be elsewhere.",
                fix=("check the trigger cables, then take the stack again", 'or set stack.trigger = "software"'),
            )
        return self._complaint(gate, rest_um, expected_um[-1], lost=lost, off=off)

    def _complaint(self, gate: SequenceGate, rest_um: float, end_um: float, *, lost: bool, off: bool) -> str:
        said = [f"plane {plane} was exposed at {z_um:+.2f} µm" for plane, z_um in gate.astray.items()]
        if lost:
            said.append(f"no frame came after number {gate.frames_seen}: a pulse or frames were lost")
        if off:
            said.append(f"the stage rests at {rest_um:+.2f} µm, not at {end_um:+.2f} µm")
        return "; ".join(said)
