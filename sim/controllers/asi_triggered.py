"""What an ASI axis does on a TTL pulse: the ring of positions and the linear stack."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sim.controllers.asi_grammar import FAILED, OUT_OF_RANGE, Command, Nack, Word

if TYPE_CHECKING:
    from sim.motion import Axis, Move

RING_SLOTS = 50
UNITS_PER_UM = 10.0
TTL_OFF, TTL_RING, TTL_REPEAT, TTL_STACK = 0, 1, 2, 4
OUT_HIGH, OUT_AFTER_MOVE = 1, 2
MOST_PLANES = 32767
Z_BIT = 4
ACK = ":A "


class Triggered:
    """State behind ``RM``, ``LD``, ``TTL`` and ``ZS`` for the Z axis.

    Parameters
    ----------
    axis : Axis
        The Z axis.
    slots : int
        Positions the ring has room for.
    mask : int
        Of ``RM Y`` at power-up: 3 is X and Y only, so that a ring for Z needs ``RM Y=4`` first.
    z_bit : int
        The bit of Z in that mask.

    Attributes
    ----------
    wait_s : float
        ``WT``: how long the controller rests after a move before it counts as completed.
    """

    def __init__(self, axis: Axis, *, slots: int = RING_SLOTS, mask: int = 3, z_bit: int = Z_BIT) -> None:
        self._axis = axis
        self._slots = slots
        self._z_bit = z_bit
        self.wait_s = 0.0
        self.origin_um = 0.0
        self.last_relative_um = 0.0
        self._ring: list[float] = []
        self._next = 0
        self._settings = {"RM": {"Y": float(mask), "F": 1.0}, "TTL": {"X": 0.0, "Y": 0.0, "F": 1.0}}
        self._stack = {"X": 0.0, "Y": 1.0, "Z": 0.0, "F": 500.0}
        self._stack_index: int | None = None
        self._centre_um = 0.0
        self._last_pulse_s = 0.0
        self._raised_s: float | None = None
        self._signalled: Move | None = None

    def ring(self, command: Command) -> str:
        """``RM``: clear (X), choose axes (Y), next place (Z) and mode (F), count, or step once without a pulse."""
        if not command.words:
            self._step_ring()
            return ACK
        if command.is_query:
            return self._told(command, self._settings["RM"] | {"X": len(self._ring), "Z": self._next})
        if command.value("X") is not None:
            self._ring, self._next = [], 0
        pointer = command.value("Z")
        self._next = self._next if pointer is None else max(int(pointer), 0)
        return self._set("RM", [word for word in command.words if word.letter not in "XZ"])

    def load(self, command: Command) -> str:
        """``LD``: append a position, in tenths of a µm."""
        position = command.value("Z")
        if position is not None:
            if len(self._ring) >= self._slots:
                raise Nack(FAILED)
            self._ring.append(position / UNITS_PER_UM)
        return ACK

    def line(self, command: Command) -> str:
        """``TTL``: what a pulse does."""
        if command.is_query:
            return self._told(command, self._settings["TTL"])
        if command.value("X") is not None:
            self._stack_index = None
        if command.value("Y") == OUT_HIGH:
            self._raised_s = self._axis.clock.now()
        return self._set("TTL", list(command.words))

    def stack(self, command: Command) -> str:
        """``ZS``: step, number, mode and timeout of the linear stack; its index and state."""
        if command.is_query:
            running = self._stack_index is not None
            return self._told(command, self._stack | {"T": float(self._stack_index or 0), "M": float(running)})
        if command.value("M") is not None:
            self.abort()
            return ACK
        planes = command.value("Y")
        if planes is not None and not 1 <= planes <= MOST_PLANES:
            raise Nack(OUT_OF_RANGE)
        self._stack.update({word.letter: word.number for word in command.words if word.letter in self._stack})
        return ACK

    def abort(self) -> None:
        """Forget a stack under way, and the signal at the end of the move."""
        self._stack_index = None
        self._signalled = None

    def move_to(self, target_um: float) -> None:
        """Move the axis, with a signal at the end if ``TTL Y=2`` asks for one."""
        self._axis.move_to(target_um)
        self._signalled = self._axis.commanded if self._settings["TTL"]["Y"] == OUT_AFTER_MOVE else None

    def out_s(self) -> float | None:
        """Return when TTL OUT0 rose last or, if a move is under way, will rise; None if never."""
        edges = [edge for edge in (self._raised_s, self._arrival_s()) if edge is not None]
        return max(edges, default=None)

    def pulse(self) -> None:
        """One pulse arrives at TTL IN0."""
        action = {TTL_RING: self._step_ring, TTL_REPEAT: self._repeat, TTL_STACK: self._step_stack}
        action.get(int(self._settings["TTL"]["X"]), lambda: None)()

    def check_timeout(self) -> None:
        """Return to the start when no pulse came for ``ZS F`` ms: the controller does so silently."""
        silent_s = self._axis.clock.now() - self._last_pulse_s
        if self._stack_index is not None and silent_s > self._stack["F"] / 1000:
            self._stack_index = None
            self.move_to(self._centre_um)

    def _arrival_s(self) -> float | None:
        move = self._signalled
        if move is None or move.blocked or move is not self._axis.commanded:
            return None
        return move.start_s + move.path.duration_s + self.wait_s

    def _step_ring(self) -> None:
        if self._ring and int(self._settings["RM"]["Y"]) & self._z_bit:
            self.move_to(self._ring[self._next % len(self._ring)] + self.origin_um)
            self._next = (self._next + 1) % len(self._ring)

    def _repeat(self) -> None:
        self.move_to(self._axis.encoder_um() + self.last_relative_um)

    def _step_stack(self) -> None:
        """Go from plane to plane around where the first pulse found the axis; after the last begin anew."""
        planes, step_um = int(self._stack["Y"]), self._stack["X"] / UNITS_PER_UM
        if self._stack_index is None:
            self._centre_um, self._stack_index = self._axis.encoder_um(), -1
        self._stack_index += 1
        self._last_pulse_s = self._axis.clock.now()
        plane = _triangle(self._stack_index, planes) if self._stack["Z"] else self._stack_index % planes
        self.move_to(self._centre_um + step_um * (plane - (planes - 1) / 2))

    def _set(self, name: str, words: list[Word]) -> str:
        self._settings[name].update({word.letter: word.number for word in words})
        return ACK

    def _told(self, command: Command, values: dict[str, float]) -> str:
        return ":A " + " ".join(f"{word.letter}={values.get(word.letter, 0):.0f}" for word in command.words)


def _triangle(index: int, planes: int) -> int:
    """Return 0, 1, … planes - 1, planes - 2, … 0, 1, …."""
    at = index % max(2 * planes - 2, 1)
    return min(at, 2 * planes - 2 - at)
