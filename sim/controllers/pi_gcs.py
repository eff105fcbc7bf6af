"""A PI controller of the GCS 2.0 family as its clients know it: bytes in, bytes out.

Written from PI's command documents and from what clients of these controllers were seen to send and to accept, and from
nothing the drivers are made of. Lengths are in the controller's own unit: µm for piezo drives, mm for motors.
"""

from __future__ import annotations

from threading import RLock
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim.motion import Axis, Move

UNKNOWN_COMMAND, NOT_ALLOWED, OUT_OF_LIMITS, BAD_VELOCITY, STOPPED = 2, 5, 7, 8, 10
BAD_AXIS, BAD_PARAMETER, MOTION_ERROR, SYNTAX = 15, 17, 1024, 1
MOVING_AXES, READY, HALT = 0x05, 0x07, 0x18
IS_READY, IS_BUSY = b"\xb1\n", b"\xb0\n"
HELP = (
    "#5 Request Motion Status", "#7 Request Controller Ready Status", "#24 Stop All Motion", "*IDN? Get Identity",
    "ATZ [{<AxisID> <LowVoltage>}] Auto Zero", "CSV? Get Current Syntax Version", "ERR? Get Error Number",
    "FNL [{<AxisID>}] Move To Negative Limit", "FPL [{<AxisID>}] Move To Positive Limit",
    "FRF [{<AxisID>}] Move To Reference", "FRF? [{<AxisID>}] Referenced",
    "HLP? List Commands", "HLT [{<AxisID>}] Halt Motion Smoothly", "MOV {<AxisID> <Position>} Set Target Position",
    "MOV? [{<AxisID>}] Get Target Position", "MVR {<AxisID> <Distance>} Set Target Relative",
    "ONT? [{<AxisID>}] Get On Target State", "POS? [{<AxisID>}] Get Real Position", "SAI? [ALL] Get Axis Identifiers",
    "STP Stop All Motion", "SVO {<AxisID> <ServoState>} Set Servo Mode", "SVO? [{<AxisID>}] Get Servo Mode",
    "TMN? [{<AxisID>}] Get Minimum Position", "TMX? [{<AxisID>}] Get Maximum Position",
    "VEL {<AxisID> <Velocity>} Set Velocity", "VEL? [{<AxisID>}] Get Velocity",
)  # fmt: skip


class GcsError(Exception):
    """A command failed; the number waits for ``ERR?``."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


class PiE709:
    """The twin of a controller of one axis: a piezo drive as it comes, a motor with other parameters.

    A servo that is off, and a motor that lost its reference, refuse to move (5). The piezo's sensor is absolute.

    Parameters
    ----------
    axis : Axis
        What it moves; its limits are the travel.
    axis_id : str
        The axis' name on the wire.
    um_per_unit : float
        1 for a controller that counts µm, 1000 for one that counts mm.
    model : str
        As the identity tells it.
    incremental : bool
        The encoder counts from where it was switched on, and the axis moves only once it was referenced.
    """

    def __init__(
        self,
        axis: Axis,
        *,
        axis_id: str = "1",
        um_per_unit: float = 1.0,
        model: str = "E-709.CHG",
        incremental: bool = False,
    ) -> None:
        self._axis = axis
        self._axis_id = axis_id
        self._um_per_unit = um_per_unit
        self._identity = f"(c)2013 Physik Instrumente(PI) Karlsruhe, {model},0123456789,1.021"
        self._incremental = incremental
        self._saved_speed_um_s = axis.speed_um_s
        self._origin_um = 0.0
        self._target_um = axis.encoder_um()
        self._one_at_a_time = RLock()
        self._tables()
        self._wake()

    @classmethod
    def c863(cls, axis: Axis) -> PiE709:
        """Return the twin of a motor controller that counts mm and wants to be referenced."""
        return cls(axis, um_per_unit=1000.0, model="C-863.11", incremental=True)

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes as they come and return the replies to the commands that became complete."""
        with self._one_at_a_time:
            replies = [self._take(byte) for byte in data]
        return [reply for reply in replies if reply]

    def power_cycle(self) -> None:
        """Be switched off and on: servo off, the speed of the factory, a motor's reference and count lost."""
        with self._one_at_a_time:
            self._axis.halt()
            self._axis.set_speed(self._saved_speed_um_s)
            self._origin_um = self._axis.encoder_um() if self._incremental else 0.0
            self._target_um = self._axis.encoder_um()
            self._wake()

    def motion_error(self) -> None:
        """Find the axis too far from where it ought to be: stop it, take the servo off, keep error 1024."""
        with self._one_at_a_time:
            self._stop()
            self._servo = False
            self._error = MOTION_ERROR

    def _wake(self) -> None:
        self._input = bytearray()
        self._error = 0
        self._servo = False
        self._referenced = not self._incremental
        self._searching: Move | None = None

    def _tables(self) -> None:
        self._facts: dict[str, Callable[[], str]] = {
            "*IDN?": lambda: self._identity,
            "CSV?": lambda: "2.0",
            "ERR?": self._take_error,
            "HLP?": lambda: " \n".join(("The following commands are available:", *HELP, "end of help")),
            "SAI?": lambda: self._axis_id,
        }
        self._told: dict[str, Callable[[], str]] = {
            "FRF?": lambda: f"{self._found():d}",
            "MOV?": lambda: self._units(self._target_um - self._origin_um),
            "ONT?": lambda: f"{self._on_target():d}",
            "POS?": lambda: self._units(self._position_um()),
            "SVO?": lambda: f"{self._servo:d}",
            "TMN?": lambda: self._units(self._axis.limits.min_um),
            "TMX?": lambda: self._units(self._axis.limits.max_um),
            "VEL?": lambda: self._units(self._axis.speed_um_s),
        }
        self._set: dict[str, Callable[[float], None]] = {
            "MOV": lambda value: self._drive(value * self._um_per_unit + self._origin_um),
            "MVR": lambda value: self._drive(self._target_um + value * self._um_per_unit),
            "SVO": self._set_servo,
            "VEL": self._set_velocity,
        }
        self._done: dict[str, Callable[[], None]] = {
            "ATZ": lambda: None,
            "FNL": lambda: self._search(self._axis.limits.min_um),
            "FPL": lambda: self._search(self._axis.limits.max_um),
            "FRF": lambda: self._search(0.0),
            "HLT": self._stop,
        }

    # -- the line ----------------------------------------------------------------------------------------------------

    def _take(self, byte: int) -> bytes:
        """Take one byte; three of them are commands without an end of line, wherever they come."""
        if byte == HALT:
            self._stop()
        elif byte == MOVING_AXES:
            return b"1\n" if self._axis.moving() else b"0\n"
        elif byte == READY:
            return IS_READY
        elif byte == ord("\n"):
            line, self._input = self._input.decode("latin-1").strip(), bytearray()
            return self._reply(line) if line else b""
        else:
            self._input.append(byte)
        return b""

    def _reply(self, line: str) -> bytes:
        name, *words = line.split()
        try:
            answer = self._execute(name.upper(), words)
        except GcsError as error:
            self._error = error.code
            return b""
        return b"" if answer is None else f"{answer}\n".encode("latin-1")

    def _execute(self, name: str, words: list[str]) -> str | None:
        if name in self._facts:
            return self._facts[name]()
        if name in self._told:
            return " \n".join(f"{axis}={self._told[name]()}" for axis in self._named(words))
        if name in self._set:
            self._set[name](self._value(words))
        elif name in self._done:
            self._named(words[:1])
            self._done[name]()
        elif name == "STP":
            self._stop()
        else:
            raise GcsError(UNKNOWN_COMMAND)
        return None

    def _named(self, words: list[str]) -> list[str]:
        if any(word != self._axis_id for word in words):
            raise GcsError(BAD_AXIS)
        return words or [self._axis_id]

    def _value(self, words: list[str]) -> float:
        if len(words) != 2:
            raise GcsError(SYNTAX)
        self._named(words[:1])
        try:
            return float(words[1])
        except ValueError:
            raise GcsError(SYNTAX) from None

    def _units(self, length_um: float) -> str:
        return f"{length_um / self._um_per_unit:.6f}"

    def _take_error(self) -> str:
        code, self._error = self._error, 0
        return str(code)

    # -- the axis ----------------------------------------------------------------------------------------------------

    def _drive(self, target_um: float) -> None:
        if not (self._servo and self._found()):
            raise GcsError(NOT_ALLOWED)
        limits = self._axis.limits
        if not limits.min_um <= target_um - self._origin_um <= limits.max_um:
            raise GcsError(OUT_OF_LIMITS)
        self._target_um = target_um
        self._axis.move_to(target_um)

    def _position_um(self) -> float:
        """Return what the sensor counts; a search that is over has set it."""
        self._found()
        return self._axis.encoder_um() - self._origin_um

    def _stop(self) -> None:
        self._axis.halt()
        self._target_um = self._axis.commanded.path.target_um
        self._error = STOPPED

    def _on_target(self) -> bool:
        return self._servo and not self._axis.moving() and self._axis.clock.now() >= self._axis.rests_at_s

    def _set_servo(self, value: float) -> None:
        if value not in (0, 1):
            raise GcsError(BAD_PARAMETER)
        self._servo = bool(value)
        self._target_um = self._axis.encoder_um()

    def _set_velocity(self, value: float) -> None:
        if not 0 < value * self._um_per_unit <= self._axis.top_speed_um_s:
            raise GcsError(BAD_VELOCITY)
        self._axis.set_speed(value * self._um_per_unit)

    def _search(self, mark_um: float) -> None:
        """Go to a mark, at the stage's own zero or an end of its travel; a piezo has none and needs none."""
        if not self._incremental:
            raise GcsError(UNKNOWN_COMMAND)
        if not self._servo:
            raise GcsError(NOT_ALLOWED)
        self._referenced, self._target_um = False, mark_um
        self._axis.move_to(mark_um)
        self._searching = self._axis.commanded

    def _found(self) -> bool:
        """Tell whether the reference is known: the search is over, and nothing came between."""
        if self._searching is not None and not self._axis.moving():
            self._referenced = self._axis.commanded is self._searching
            self._searching = None
            self._origin_um = 0.0 if self._referenced else self._origin_um
        return self._referenced
