"""The twin of a feed behind its bytes: the drive, and the knife's controller beside it, with faults by request.

`FeedTwin` has what `sim.rack` asks of a twin: ``feed`` and ``power_cycle``; `counters` is the truth. Put its ``feed``
on a `sim.serial_line.SerialLine`: what comes over its pseudo-terminal is RTU, over its TCP port RTU within TCP, or
Modbus TCP when the twin was made for that.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

from devices.errors import RigError, did_you_mean
from sim.controllers.applied_motion import AppliedMotionScl
from sim.controllers.leadshine import LeadshineRs
from sim.controllers.modbus_frame import RtuServer, TcpServer, written
from sim.controllers.oriental import OrientalAz
from sim.controllers.plc import PlcMailbox
from sim.faults import Delayed, HungUp, PortDied
from sim.feed import FeedMachine, Microtome

if TYPE_CHECKING:
    from devices.feed_spec import FeedSpec
    from devices.protocols import Clock
    from sim.block import Block
    from sim.controllers.registers import RegisterTwin, WordOrder

DRIVES: dict[str, type[RegisterTwin]] = {
    "leadshine-rs": LeadshineRs,
    "applied-motion-scl": AppliedMotionScl,
    "oriental-az": OrientalAz,
    "plc-mailbox": PlcMailbox,
}
IDLE_CLOSE_S = 60.0
FRAME_GAP_S = 0.02  # 3.5 characters at 9600 baud are 4 ms; a client under load may pause within a frame
READ_FUNCTION = 3
FLIPPED = 0xA5

Request = Literal["any", "read", "write", "move", "cut"]
Kind = Literal["drop", "late", "half", "garble", "wrong-unit", "noise", "deaf", "crc", "busy", "die"]
UNHEARD = ("deaf", "crc", "busy")
BUSY = 6


@dataclass
class Upset:
    """A fault that strikes requests of a kind: ``deaf``, ``crc`` and ``busy`` before they are executed.

    Attributes
    ----------
    times : int
        How many more it strikes.
    delay_s : float
        Of a late reply.
    """

    kind: Kind
    on: Request = "any"
    times: int = 1
    delay_s: float = 0.7

    def strikes(self, request: set[str]) -> bool:
        """Count one request and tell whether it is struck."""
        if self.times <= 0 or self.on not in request:
            return False
        self.times -= 1
        return True


class FeedTwin:
    """Drive and knife controller on one line.

    Parameters
    ----------
    profile : str
        Whose twin; a key of `DRIVES`.
    clock : Clock
        Time.
    unit, knife_unit : int
        Their numbers on the line; a mailbox drives its knife itself.
    tcp : bool
        Modbus TCP in place of RTU frames.
    block : Block, optional
        What the feed carries.
    """

    def __init__(
        self,
        profile: str,
        clock: Clock,
        *,
        unit: int = 1,
        knife_unit: int | None = None,
        tcp: bool = False,
        counts_per_um: float = 500.0,
        word_order: WordOrder = "big",
        block: Block | None = None,
    ) -> None:
        self.machine = FeedMachine(clock, counts_per_um=counts_per_um, block=block)
        self.drive = DRIVES[profile](self.machine, word_order)
        self.upsets: list[Upset] = []
        self.plc = self.drive if isinstance(self.drive, PlcMailbox) else PlcMailbox(self.machine, cuts_only=True)
        self.microtome = Microtome(self.machine, self.plc.knife)
        units = {unit: self.drive} | ({knife_unit: self.plc} if knife_unit else {})
        self._server = (TcpServer if tcp else RtuServer)(units, crc_exception=profile == "leadshine-rs")
        self._clock = clock
        self._hangs_up = tcp and profile == "applied-motion-scl"
        self._heard_s = clock.now()

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes and return the replies of the drive; raises `HungUp` after too long a silence."""
        return [reply.data for reply in self.feed_upset(data)]

    def feed_upset(self, data: bytes) -> list[Delayed]:
        """Take bytes and return replies with the faults of `upsets` in them."""
        now_s, silence_s = self._clock.now(), self._clock.now() - self._heard_s
        self._heard_s = now_s
        if self._hangs_up and silence_s > IDLE_CLOSE_S:
            raise HungUp
        if silence_s > FRAME_GAP_S:
            self._server.forget()
        replies = [self._reply(unit, pdu) for unit, pdu in self._server.frames(data)]
        return [reply for reply in replies if reply.data]

    def power_cycle(self) -> None:
        """Switch off and on."""
        self.drive.power_cycle()

    def counters(self) -> dict[str, Any]:
        """Return the truth: motions, cuts, where it is, what was taken off and what lies open."""
        machine, knife = self.machine, self.plc.knife
        return {
            "feeds": machine.feeds_executed,
            "moves": machine.moves_executed,
            "cuts": knife.cuts_executed,
            "position_um": machine.position_um,
            "knife": str(knife.state),
            "removed_um": list(machine.removed_um),
            "face": asdict(machine.block.face),
        }

    def _reply(self, unit: int, pdu: bytes) -> Delayed:
        request = self._kinds(unit, pdu)
        struck = next((upset for upset in self.upsets if upset.strikes(request)), None)
        if struck is not None and struck.kind in UNHEARD:
            return Delayed(self._refusal(unit, pdu, struck.kind))
        reply = self._server.reply(unit, pdu)
        return Delayed(reply) if struck is None or not reply else self._spoil(reply, struck)

    def _refusal(self, unit: int, pdu: bytes, kind: str) -> bytes:
        if kind == "crc":
            return self._server.reply(unit, b"")
        return self._server.frame(unit, bytes([pdu[0] | 0x80, BUSY])) if kind == "busy" else b""

    def _kinds(self, unit: int, pdu: bytes) -> set[str]:
        write, drive = written(pdu), self._server.units.get(unit)
        if write is None or drive is None:
            return {"any", "read"} if pdu[:1] == bytes([READ_FUNCTION]) else {"any"}
        moves = unit in self._server.units and drive is self.drive and self.drive.is_move(*write)
        cuts = drive is self.plc and self.plc.is_cut(*write)
        return {"any", "write"} | ({"move"} if moves else set()) | ({"cut"} if cuts else set())

    def _spoil(self, reply: bytes, upset: Upset) -> Delayed:
        if upset.kind == "die":
            raise PortDied
        spoilt = {
            "drop": b"",
            "half": reply[: len(reply) // 2],
            "garble": reply[:2] + bytes(byte ^ FLIPPED for byte in reply[2:]),
            "noise": bytes((7 * index + 3) % 256 for index in range(23)),
            "wrong-unit": self._server.frame(reply[0] + 1, reply[1:-2]),
        }.get(upset.kind, reply)
        return Delayed(spoilt, upset.delay_s if upset.kind == "late" else 0.0)


def build_feed_twin(spec: FeedSpec, clock: Clock, block: Block | None = None) -> FeedTwin:
    """Return the twin of an instrument file's ``[microtome]``, carrying ``block``.

    Raises
    ------
    RigError
        The register map is no shipped one, and so has no twin.
    """
    profile = spec.feed_profile()
    if profile.profile not in DRIVES:
        raise RigError(f"no simulated feed for the profile '{spec.profile}'{did_you_mean(spec.profile, list(DRIVES))}")
    return FeedTwin(
        profile.profile,
        clock,
        unit=profile.link.unit,
        knife_unit=spec.knife.unit if spec.knife else None,
        tcp=profile.link.kind == "tcp",
        counts_per_um=profile.axis.counts_per_um,
        word_order=profile.address.word_order,
        block=block,
    )
